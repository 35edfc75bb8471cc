"""How cost grows: a figure with a log-log panel an axis, and a table of the exponents."""

from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator

from constraint_geodesics.palette import (
    BLACK,
    LIGHT,
    PURPLE,
    VERMILION,
    planner_colour,
    planner_family,
)
from constraint_geodesics.report.benchmark_figures import Styles, styles_of
from constraint_geodesics.report.cells import Cells, fixed, markdown_table
from constraint_geodesics.studies.growth import MOST

COLUMNS = 3
OTHERS = (VERMILION, PURPLE, BLACK)
"""Colours of what is of no family of planners, one after another."""
LABELS = {
    "joints": "joints (one query)",
    "codimension": "held task axes (one query)",
    "obstacles": "spheres in the workcell (one query)",
    "queries": "queries (all of them)",
    "latent dimension": "latent dimensions",
    "dataset rows": "dataset rows, or nodes of the roadmap",
}
"""What is below each axis' panel."""
NOTE = (
    "shaded: quartiles;  dotted: fit to sizes above 0;  "
    f"hollow: fewer than {100 * MOST:.0f} % of the queries solved, in no exponent"
)
LEGEND_ROOM = 0.27
"""Of a panel's height, above what is drawn."""


def slopes_markdown(fits: pd.DataFrame) -> str:
    """The exponents as a table, axis by axis.  fits: `growth.slopes`."""
    rows: Cells = [("grows with", "what", "exponent", "± standard error", "points")]
    for row in fits[fits["points"] > 2].to_dict("records"):  # any two points lie on a line
        slope, error = (fixed(row[name]) for name in ("slope", "standard_error"))
        rows.append((row["axis"], row["what"], slope, error, str(row["points"])))
    return f"{markdown_table(rows)}\n"


def growth_figure(table: pd.DataFrame, fits: pd.DataFrame) -> Figure:
    """Seconds over size: medians joined, quartiles shaded, the fitted line thin, its slope ±
    standard error next to it.

    table: as `growth.measure_growth` has it.  fits: its `growth.slopes`.
    """
    axes_names = list(dict.fromkeys(table["axis"]))
    lines = -(-len(axes_names) // COLUMNS)
    figure = Figure(figsize=(10.5, 0.6 + 3.1 * lines), layout="constrained")
    for k, name in enumerate(axes_names):
        panel = figure.add_subplot(lines, COLUMNS, k + 1)
        _draw_panel(panel, table[table["axis"] == name], fits[fits["axis"] == name])
        panel.set_xlabel(LABELS.get(name, name), fontsize=9)
    figure.supxlabel(NOTE, fontsize=8)
    figure.supylabel("seconds", fontsize=9)
    return figure


def _draw_panel(panel: Axes, table: pd.DataFrame, fits: pd.DataFrame) -> None:
    styles = _styles(list(dict.fromkeys(table["what"])))
    for what, rows in table.groupby("what", sort=False):
        own, style = rows.sort_values("value"), styles[str(what)]
        value, colour = own["value"].to_numpy(float), style["color"]
        fit = fits[fits["what"] == what].iloc[0]
        panel.plot(value, own["seconds"], label=f"{what}: {_slope(fit)}", **style)
        panel.fill_between(value, own["low"], own["high"], color=colour, alpha=0.12, linewidth=0)
        # nan, no query, is filled
        inside = ["white" if share < MOST else colour for share in own["solved"]]
        edge: Any = {"edgecolors": colour, "linewidths": 0.9, "zorder": 3}
        panel.scatter(value, own["seconds"], s=14, c=inside, **edge)
        above = value[value > 0]
        if np.isfinite(fit["slope"]):
            ends = np.array([above.min(), above.max()])
            line = fit["seconds_at_1"] * ends ** fit["slope"]
            panel.plot(ends, line, color=colour, lw=0.8, ls=":")
    values = np.unique(table["value"].to_numpy(float))
    _scale(panel, values, table["low"].min(), table["high"].max())
    panel.grid(color=LIGHT, linewidth=0.6)
    panel.tick_params(labelsize=7, which="both")
    panel.legend(fontsize=7, frameon=False, loc="upper left")


def _scale(panel: Axes, values: Float[np.ndarray, "n"], low: float, high: float) -> None:
    """Logarithmic, what was measured as its ticks, a decade of seconds at least; nothing, 0, stands
    to the left of 1.

    low, high: of the seconds drawn.
    """
    if values.min() > 0:
        panel.set_xscale("log")
    else:
        panel.set_xscale("symlog", linthresh=1.0, linscale=0.4)
    middle, decades = np.log10(low * high) / 2, max(np.log10(high / low), 1.0) + 0.2
    bottom = middle - decades / 2
    panel.set_yscale("log")
    panel.set_ylim(10**bottom, 10 ** (bottom + decades / (1.0 - LEGEND_ROOM)))
    panel.set_xticks(values, [f"{value:g}" for value in values])
    panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_minor_formatter(NullFormatter())


def _slope(fit: pd.Series) -> str:
    if not np.isfinite(fit["slope"]):
        return "no slope"
    error = fit["standard_error"]
    return f"slope {fit['slope']:.2f}" + (f" ± {error:.2f}" if np.isfinite(error) else "")


def _styles(names: list[str]) -> Styles:
    """Colour and dashes of each name of a panel."""
    others = cycle(OTHERS)
    colours = {n: planner_colour(n) if planner_family(n) else next(others) for n in names}
    return {name: {**own, "linewidth": 1.3} for name, own in styles_of(names, colours).items()}
