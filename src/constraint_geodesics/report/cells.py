"""How the report writes numbers, and tables of them as Markdown; and the paper's own table."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

PUBLISHED = {
    "PRM": (499.42, 530.89, 24.43, 9.75, 1.53),
    "RRT* 10 s": (134.80, 155.28, 17.84, 5.21, 1.38),
    "BiRRT": (53.00, 84.65, 25.52, 2.903, 0.16),
    "learned": (70.56, 79.81, 7.64, 3.8, 1.81),
}
"""Table I of the paper: shortest path, average, its ±, planning time [s], its ±; its learned
geodesic stands next to the benchmark's `learned`.
"""
Cells = list[Sequence[str]]
"""A table's header and its rows."""


def origin(run: Mapping[str, str]) -> str:
    """Where a report's rows are from, as a sentence without its stop.  run: of `run_header`; older
    files have less.
    """
    commit = f" of commit {run['commit'][:12]}" if run.get("commit") else ""
    date = f", {run['date']}" if run.get("date") else ""
    return f"Rows{commit}{date}, one thread of {run['processor']}"


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows as dictionaries by column."""
    return [{str(name): value for name, value in row.items()} for row in frame.to_dict("records")]


def fixed(value: float | None, digits: int = 2) -> str:
    """So many decimals, or a dash where there is no value."""
    return _in_words(value) or f"{value:.{digits}f}"


def short(value: float | None) -> str:
    """Three digits, or a dash where there is no value."""
    return _in_words(value) or (f"{value:.1e}" if 0 < abs(value or 0) < 1e-3 else f"{value:.3g}")


def share(value: float | None, digits: int = 0) -> str:
    """Per cent, or a dash where there is no value."""
    return _in_words(value) or f"{value:.{digits}%}"


def milliseconds(seconds: float) -> str:
    """Three digits, or all of a larger number's."""
    return _in_words(seconds) or f"{1e3 * seconds:{',.0f' if seconds >= 0.1 else '.3g'}}"


def _in_words(value: float | None) -> str:
    """What stands for no value, or an infinite one; else nothing."""
    return "–" if value is None or np.isnan(value) else "∞" if value == np.inf else ""


def plus_minus(mean: float, deviation: float, number: Callable[[float], str]) -> str:
    """A mean and its deviation, if it has one."""
    return number(mean) if np.isnan(deviation) else f"{number(mean)} ± {number(deviation)}"


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, its header first, aligned, so that it reads in a terminal too."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]

    def line(cells: Sequence[str]) -> str:  # names to the left, figures to the right
        sized = enumerate(zip(cells, widths, strict=True))
        return " | ".join(c.ljust(width) if k < 2 else c.rjust(width) for k, (c, width) in sized)

    rule = ["-" * width if k < 2 else "-" * (width - 1) + ":" for k, width in enumerate(widths)]
    return "\n".join(f"| {line(cells)} |" for cells in (rows[0], rule, *rows[1:]))
