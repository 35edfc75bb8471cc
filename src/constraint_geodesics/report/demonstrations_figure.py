"""The picture of demonstrations, what they keep to, and a path that keeps to it."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from constraint_geodesics.palette import BLUE, GOAL, GREY, LIGHT, START
from constraint_geodesics.studies.demonstrations import Example

MESH = 60
"""Lines of the surface along each side."""
AXIS_M, AXES = 0.05, 12
"""Length of the drawn tool axes, and how many."""


def demonstrations_figure(example: Example) -> Figure:
    """Demonstrated places, the identified surface where it was shown, and a planned path with its
    tool axes; and how far the path is from the formula that was hidden.
    """
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=(1.7, 1.0))
    axes: Any = figure.add_subplot(grid[0, 0], projection="3d", computed_zorder=False)
    axes.plot_surface(*_surface(example), color=LIGHT, alpha=0.55, lw=0, zorder=1)
    for rows in example.shown:
        axes.plot(*rows.T, color=GREY, lw=0.7, alpha=0.8, zorder=2)
    path = example.path
    axes.plot(*path.T, color=BLUE, lw=2.6, zorder=4)
    some = np.linspace(0, len(path) - 1, AXES).astype(int)
    back = path[some] - AXIS_M * example.axes[some]
    for tip, end in zip(path[some], back, strict=True):
        axes.plot(*np.stack([tip, end]).T, color=BLUE, lw=1.0, zorder=5)
    for place, colour, name in ((path[0], START, "start"), (path[-1], GOAL, "goal")):
        axes.scatter(*place, color=colour, s=36, zorder=6, label=name)
    axes.set_box_aspect(np.ptp(np.concatenate(example.shown), axis=0) + 0.03, zoom=1.3)
    axes.view_init(elev=32.0, azim=-62.0)
    for name in "xyz":
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=8)
        getattr(axes, f"{name}axis").set_tick_params(labelsize=7)
    axes.locator_params(nbins=5)
    axes.locator_params(axis="z", nbins=3)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.93), fontsize=8, frameon=False)
    axes.set_title(example.title, fontsize=9)
    below: Any = figure.add_subplot(grid[0, 1])
    share = np.linspace(0.0, 100.0, len(path))
    below.plot(share, example.off_mm, color=BLUE, lw=1.4, label="tip off the surface [mm]")
    below.plot(share, example.off_deg, color=START, lw=1.4, label="axis off the normal [°]")
    below.set_ylim(0.0, None)
    below.set_xlabel("along the path [%]")
    below.set_title("off the formula that was hidden", fontsize=9)
    below.legend(fontsize=8, frameon=False)
    below.spines[["top", "right"]].set_visible(False)
    return figure


def _surface(example: Example) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The identified surface over the rectangle of the demonstrated places."""
    spline = example.surface
    x = spline.coordinates(np.concatenate(example.shown))
    low, high = x.min(axis=0), x.max(axis=0)
    u, v = np.meshgrid(*(np.linspace(low[k], high[k], MESH) for k in range(2)))
    flat: Float[np.ndarray, "n 3"] = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)
    heights = spline.look(spline.origin + flat @ spline.frame)[:, 0]
    flat[:, 2] = heights
    places = spline.origin + flat @ spline.frame
    columns = places.T.reshape(3, *u.shape)
    return columns[0], columns[1], columns[2]
