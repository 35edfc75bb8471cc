"""Figures by which runs of different stages are compared, from the rows of their tables."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any

from constraint_geodesics.tracking.views import COMPARED

Cell = tuple[dict[str, Any], dict[str, Any]]
"""What sets a run apart, and its figures."""


@dataclass(frozen=True)
class Columns:
    """Where a table has what runs are compared by.  per_ms: milliseconds of its unit of time."""

    success: str
    ratio: str
    time: str
    per_ms: float = 1.0


REPORT = Columns("success", "over_best_median", "time_median_s", 1e3)
BENCHMARK = Columns("success_of_solvable", "ratio_median", "time_median_s", 1e3)
PROBLEMS = Columns("share", "ratio_median", "time_ms_median")
ARMS = Columns("success", "ratio_median", "time_ms_median")


def of_seeds(
    rows: Sequence[Mapping[str, Any]], planner: str, seeds: Sequence[int]
) -> list[dict[str, float]]:
    """COMPARED of each seed of a planner; nan where it has no valid path.

    rows: of all planners on the same queries, with planner, query, seed, valid, length_rad and
    time_s.  The lengths are held against the shortest valid path of the query among all rows; the
    times are of all answers.
    """
    best: dict[Any, float] = {}
    for row in rows:
        if row["valid"]:
            best[row["query"]] = min(row["length_rad"], best.get(row["query"], math.inf))
    found = []
    for seed in seeds:
        own = [row for row in rows if row["planner"] == planner and row["seed"] == seed]
        ratios = [row["length_rad"] / best[row["query"]] for row in own if row["valid"]]
        figures = (
            fmean(bool(row["valid"]) for row in own),
            median(ratios) if ratios else math.nan,
            1e3 * median(row["time_s"] for row in own),
        )
        found.append(_compared(*figures))
    return found


def _compared(success: float, ratio: float, spent_ms: float) -> dict[str, float]:
    """With as many digits as a column shows."""
    figures = (float(f"{figure:.6g}") for figure in (success, ratio, spent_ms))
    return dict(zip(COMPARED, figures, strict=True))


def of_summary(row: Mapping[str, Any], columns: Columns) -> dict[str, float]:
    """COMPARED of a row of figures; nan where it has none."""
    told = (row.get(name) for name in (columns.success, columns.ratio, columns.time))
    success, ratio, spent = (math.nan if figure is None else float(figure) for figure in told)
    return _compared(success, ratio, columns.per_ms * spent)


def cells_of(
    rows: Iterable[Mapping[str, Any]], told_by: Sequence[str], columns: Columns
) -> dict[str, Cell]:
    """A cell for each row, by what tells the rows apart.  told_by: names of these columns."""
    return {
        ", ".join(str(row[name]) for name in told_by): (
            {name: row[name] for name in told_by},
            of_summary(row, columns),
        )
        for row in rows
    }


def problem_cells(
    found: Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]],
) -> dict[str, Cell]:
    """A cell for each constraint and planner, of all scenes together.

    found: by constraint, scene or "all", and planner.
    """
    rows = (
        {"constraint": constraint, "planner": planner, **row}
        for constraint, scenes in found.items()
        for planner, row in scenes["all"].items()
    )
    return cells_of(rows, ("constraint", "planner"), PROBLEMS)
