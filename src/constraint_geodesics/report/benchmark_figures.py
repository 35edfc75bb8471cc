"""Figures of the benchmark: what each planner has within a time budget, how its lengths spread, and
when training pays.

Planners of one family share their colour of palette.py; within it they differ by line style.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from constraint_geodesics.benchmark.statistics import over_budget
from constraint_geodesics.palette import LIGHT, planner_colour

DASHES: tuple[str | tuple[int, tuple[int, ...]], ...] = (
    "-",
    "--",
    ":",
    "-.",
    (0, (5, 1, 1, 1, 1, 1)),
    (0, (1, 3)),
)
BUDGETS = np.geomspace(1e-3, 20.0, 60)
"""Time budgets at which curves are drawn [s]."""


def styles_of(planners: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour and dashes of every planner: its family's colour, and dashes that no other of this
    family has here.
    """
    met: dict[str, int] = {}
    styles: dict[str, dict[str, Any]] = {}
    for planner in planners:
        colour = planner_colour(planner)
        k = met.get(colour, 0)
        met[colour] = k + 1
        styles[planner] = {
            "color": colour,
            "linestyle": DASHES[k % len(DASHES)],
            "linewidth": 2.2 if k == 0 else 1.2,
        }
    return styles


def success_over_budget(rows: pd.DataFrame, planners: Sequence[str]) -> Figure:
    """Share of solvable queries with a valid path within a time budget; a panel for each constraint
    and scene.
    """
    return _over_budget(rows, planners, "success", "solved of solvable", (0.0, 1.02))


def length_over_budget(rows: pd.DataFrame, planners: Sequence[str]) -> Figure:
    """95th percentile of length over best known within a time budget, failures counted as
    infinite.
    """
    return _over_budget(rows, planners, "ratio_p95", "length / best known, p95", (0.98, 3.0))


def ratio_distributions(rows: pd.DataFrame, planners: Sequence[str]) -> Figure:
    """How large a share of the solvable rows has a path within some excess over the best known
    length.
    """
    styles, solvable = styles_of(planners), rows[rows["best_known_rad"].notna()]
    figure, grid = _grid_of(rows)
    for axes, (_, case) in zip(
        grid, solvable.groupby(["constraint", "scene"], sort=False), strict=True
    ):
        for planner, values in _excess(case):
            if planner in planners:
                share = np.arange(1, len(values) + 1) / len(values)
                axes.step(
                    np.maximum(values, 1e-5), share, where="post", label=planner, **styles[planner]
                )
        axes.set(xscale="log", xlim=(1e-5, 3.0), ylim=(0.0, 1.02))
    _finished(figure, grid, rows, planners, "excess over best known", "share of solvable rows")
    return figure


def overview(rows: pd.DataFrame, planners: Sequence[str]) -> Figure:
    """Success, p95 of the length within a time budget, and the spread of lengths; a line of panels
    for each scene.
    """
    styles, table = styles_of(planners), over_budget(rows, BUDGETS.tolist())
    scenes = list(dict.fromkeys(rows["scene"]))
    figure = Figure(figsize=(10.0, 1.6 + 2.7 * len(scenes)), layout="constrained")
    grid = np.atleast_2d(figure.subplots(len(scenes), 3))
    for line, scene in zip(grid, scenes, strict=True):
        for planner, own in table[table["scene"] == scene].groupby("planner", sort=False):
            if planner in planners:
                line[0].plot(own["budget_s"], own["success"], label=planner, **styles[str(planner)])
                line[1].plot(own["budget_s"], own["ratio_p95"], **styles[str(planner)])
        for planner, values in _excess(rows[rows["scene"] == scene]):
            if planner in planners:
                share = np.arange(1, len(values) + 1) / len(values)
                line[2].step(np.maximum(values, 1e-5), share, where="post", **styles[planner])
        line[0].set(
            xscale="log",
            xlim=BUDGETS[[0, -1]],
            ylim=(0.0, 1.02),
            ylabel=f"{scene}: solved of solvable",
            xlabel="time budget [s]",
        )
        line[0].yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        line[1].set(
            xscale="log",
            xlim=BUDGETS[[0, -1]],
            ylim=(0.98, 2.5),
            ylabel="length / best known, p95",
            xlabel="time budget [s]",
        )
        line[2].set(
            xscale="log",
            xlim=(1e-5, 3.0),
            ylim=(0.0, 1.02),
            ylabel="share of rows",
            xlabel="excess over best known",
        )
        for axes in line:
            axes.grid(color=LIGHT, linewidth=0.6)
            axes.tick_params(labelsize=7)
    _legend(figure, grid[:, 0].tolist(), planners)
    return figure


def _excess(rows: pd.DataFrame) -> Iterator[tuple[str, np.ndarray]]:
    """Each planner's excess over the best known length on the solvable rows, sorted; failures are
    nan and come last.
    """
    solvable = rows[rows["best_known_rad"].notna()]
    excess = solvable["length_rad"].where(solvable["valid"]) / solvable["best_known_rad"] - 1.0
    for planner, own in excess.groupby(solvable["planner"], sort=False):
        yield str(planner), np.sort(own.to_numpy())


def break_even(costs: pd.DataFrame, planners: Sequence[str]) -> Figure:
    """Time spent in all, training included, against the number of queries served.

    costs: planner, training_s, query_s (mean time of a query).
    """
    styles, served = styles_of(planners), np.geomspace(1, 1e7, 200)
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for row in costs[costs["planner"].isin(list(planners))].to_dict("records"):
        axes.plot(
            served,
            row["training_s"] + served * row["query_s"],
            label=row["planner"],
            **styles[row["planner"]],
        )
    axes.set(
        xscale="log", yscale="log", xlabel="queries served", ylabel="training and planning [s]"
    )
    axes.grid(color=LIGHT, linewidth=0.6)
    figure.legend(loc="outside right upper", fontsize=7, frameon=False)
    return figure


def _over_budget(
    rows: pd.DataFrame,
    planners: Sequence[str],
    column: str,
    label: str,
    limits: tuple[float, float],
) -> Figure:
    styles, table = styles_of(planners), over_budget(rows, BUDGETS.tolist())
    figure, grid = _grid_of(rows)
    for axes, (_, case) in zip(
        grid, table.groupby(["constraint", "scene"], sort=False), strict=True
    ):
        for planner, own in case.groupby("planner", sort=False):
            if planner in planners:
                axes.plot(own["budget_s"], own[column], label=planner, **styles[str(planner)])
        axes.set(xscale="log", xlim=BUDGETS[[0, -1]], ylim=limits)
        if column == "success":
            axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    _finished(figure, grid, rows, planners, "time budget [s]", label)
    return figure


def _grid_of(rows: pd.DataFrame) -> tuple[Figure, list[Axes]]:
    """A panel for each constraint and scene, scenes side by side."""
    solvable = rows[rows["best_known_rad"].notna()]
    cases = solvable.groupby(["constraint", "scene"], sort=False).ngroups
    columns = 2 if rows["scene"].nunique() > 1 else 3
    lines = -(-cases // columns)
    figure = Figure(figsize=(9.0, 1.6 + 2.0 * lines), layout="constrained")
    return figure, [figure.add_subplot(lines, columns, k + 1) for k in range(cases)]


def _finished(
    figure: Figure,
    grid: Sequence[Axes],
    rows: pd.DataFrame,
    planners: Sequence[str],
    below: str,
    beside: str,
) -> None:
    solvable = rows[rows["best_known_rad"].notna()]
    names = [f"{c}, {s}" for (c, s), _ in solvable.groupby(["constraint", "scene"], sort=False)]
    for axes, name in zip(grid, names, strict=True):
        axes.set_title(name, fontsize=9)
        axes.grid(color=LIGHT, linewidth=0.6)
        axes.tick_params(labelsize=7)
    figure.supxlabel(below, fontsize=9)
    figure.supylabel(beside, fontsize=9)
    _legend(figure, grid, planners)


def _legend(figure: Figure, grid: Sequence[Axes], planners: Sequence[str]) -> None:
    """One legend for all panels, planners in the order of `planners`."""
    handles: dict[str, Any] = {}
    for axes in grid:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(str(label), handle)
    names = [name for name in planners if name in handles]
    figure.legend(
        [handles[name] for name in names],
        names,
        loc="outside upper center",
        ncols=5,
        fontsize=7,
        frameon=False,
    )
