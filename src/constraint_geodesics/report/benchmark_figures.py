"""Figures of the benchmark: what each planner has within a time budget, how its lengths spread, and
when training pays.

Planners of one family share a colour; within it they differ by line style.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from constraint_geodesics.benchmark.statistics import over_budget
from constraint_geodesics.palette import LIGHT

DASHES: tuple[str | tuple[int, tuple[int, ...]], ...]
DASHES = ("-", "--", ":", "-.", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
BUDGETS = np.geomspace(1e-3, 20.0, 60)
"""Time budgets at which curves are drawn [s]."""
SERVED = np.geomspace(1.0, 1e7, 200)
"""Numbers of queries over which training may pay."""
LEAST = 1e-3
"""Excess of the 95th percentile below which all planners are drawn as one."""
SHORTEST = 1e-5
"""Excess over the best known length below which all paths are drawn as one."""

Styles = Mapping[str, Mapping[str, Any]]
"""How the line of each planner is drawn; others are left out."""


def styles_of(planners: Sequence[str], colours: Mapping[str, str]) -> Styles:
    """Colour and dashes of every planner: its family's colour, and dashes that no other of this
    family has here.
    """
    met: dict[str, int] = {}
    styles: dict[str, dict[str, Any]] = {}
    for planner in planners:
        colour = colours[planner]
        k = met.get(colour, 0)
        met[colour] = k + 1
        dashes, width = DASHES[k % len(DASHES)], 2.2 if k == 0 else 1.2
        styles[planner] = {"color": colour, "linestyle": dashes, "linewidth": width}
    return styles


def overview(rows: pd.DataFrame, styles: Styles, words: Mapping[str, str]) -> Figure:
    """Success, p95 of the length within a time budget, and the spread of lengths; a line of panels
    for each scene.

    words: what is said of each scene.
    """
    scenes = list(dict.fromkeys(rows["scene"]))
    figure = Figure(figsize=(10.0, 1.0 + 2.7 * len(scenes)), layout="constrained")
    panels = np.atleast_2d(figure.subplots(len(scenes), 3))
    for (success, length, excess), scene in zip(panels, scenes, strict=True):
        case = rows[rows["scene"] == scene]
        _draw_budget(success, case, styles, "success")
        _draw_budget(length, case, styles, "ratio_p95")
        _draw_excess(excess, case, styles)
        success.set(ylabel=f"{words[scene]}:\nsolved of solvable", xlabel="time budget [s]")
        length.set(ylabel="excess length, p95,\nonce 95% are solved", xlabel="time budget [s]")
        excess.set(ylabel="share of rows", xlabel="excess over best known")
        for axes in (success, length, excess):
            _plain(axes)
    _legend(figure, panels[:, 0].tolist(), styles)
    return figure


def break_even(costs: pd.DataFrame, styles: Styles) -> Figure:
    """Time spent in all, training and roadmaps included, over that of the first planner of
    `styles`, against the number of queries served; a dot where its training begins to pay.

    costs: as of `break_even_table`.
    """
    rows = costs.set_index("planner").loc[
        [name for name in styles if name in set(costs["planner"])]
    ]
    trained_s = rows["training_s"].iloc[0]
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes = figure.add_subplot()
    ends: dict[str, float] = {}
    for planner, row in rows.iterrows():
        spent = row["training_s"] + SERVED * row["query_s"]
        over = spent / (trained_s + SERVED * row["reference_s"])
        style = styles[str(planner)]
        axes.plot(SERVED, over, **style)
        ends[str(planner)] = over[-1]
        if 0.0 < row["break_even"] < SERVED[-1]:
            axes.plot(row["break_even"], 1.0, "o", color=style["color"], zorder=3)
            axes.annotate(
                f"{row['break_even']:,.0f}",
                (row["break_even"], 1.0),
                xytext=(3, -11),
                textcoords="offset points",
                fontsize=7,
            )
    for planner, place in _apart(ends).items():
        label = {"color": styles[planner]["color"], "fontsize": 8, "va": "center"}
        axes.text(1.5 * SERVED[-1], place, planner, **label)
    axes.set(xscale="log", yscale="log", xlim=SERVED[[0, -1]])
    axes.set(xlabel="queries served", ylabel=f"time in all, over that of {rows.index[0]}")
    axes.grid(color=LIGHT, linewidth=0.6)
    axes.tick_params(labelsize=8)
    return figure


def _apart(places: Mapping[str, float], factor: float = 1.6) -> dict[str, float]:
    """Places on a log axis, moved up where the next below is nearer than the factor."""
    found: dict[str, float] = {}
    least = 0.0
    for name, place in sorted(places.items(), key=lambda entry: entry[1]):
        found[name] = max(place, least)
        least = factor * found[name]
    return found


def _draw_budget(axes: Axes, case: pd.DataFrame, styles: Styles, column: str) -> None:
    table = over_budget(case[case["planner"].isin(list(styles))], BUDGETS.tolist())
    shared = column == "success"
    for planner, own in table.groupby("planner", sort=False):
        drawn = own[column] if shared else np.maximum(own[column] - 1.0, LEAST)
        axes.plot(own["budget_s"], drawn, label=planner, **styles[str(planner)])
    axes.set(xscale="log", xlim=BUDGETS[[0, -1]])
    if shared:
        axes.set(ylim=(0.0, 1.02))
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    else:
        axes.set(yscale="log", ylim=(LEAST, 3.0))


def _draw_excess(axes: Axes, case: pd.DataFrame, styles: Styles) -> None:
    for planner, values in _excess(case):
        if planner in styles:
            share = np.arange(1, len(values) + 1) / len(values)
            place = np.maximum(values, SHORTEST)
            axes.step(place, share, where="post", label=planner, **styles[planner])
    axes.set(xscale="log", xlim=(SHORTEST, 3.0), ylim=(0.0, 1.02))


def _excess(rows: pd.DataFrame) -> Iterator[tuple[str, np.ndarray]]:
    """Each planner's excess over the best known length on the solvable rows, sorted; failures are
    nan and come last.
    """
    solvable = rows[rows["best_known_rad"].notna()]
    excess = solvable["length_rad"].where(solvable["valid"]) / solvable["best_known_rad"] - 1.0
    for planner, own in excess.groupby(solvable["planner"], sort=False):
        yield str(planner), np.sort(own.to_numpy())


def _plain(axes: Axes) -> None:
    axes.grid(color=LIGHT, linewidth=0.6)
    axes.tick_params(labelsize=7)


def _legend(figure: Figure, panels: Sequence[Axes], styles: Styles) -> None:
    """One legend for all panels, planners in the order of `styles`."""
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(str(label), handle)
    names = [name for name in styles if name in handles]
    figure.legend(
        [handles[name] for name in names],
        names,
        loc="outside upper center",
        ncols=5,
        fontsize=7,
        frameon=False,
    )
