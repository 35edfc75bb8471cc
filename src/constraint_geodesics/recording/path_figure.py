"""The picture of one planned path: the arm along it, its joints over time, how well it keeps
the constraint.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.figure import Figure

from constraint_geodesics.palette import (
    BLACK,
    BLUE,
    GOAL,
    GREEN,
    LIGHT,
    ORANGE,
    PURPLE,
    SKY,
    START,
    VERMILION,
)

SHOWN = 9
"""Configurations of the arm that are drawn."""
_COLOURS = (BLUE, ORANGE, GREEN, VERMILION, PURPLE, SKY, BLACK)


class DrawnPath(NamedTuple):
    """What is drawn of a path: times [s], waypoints under the joints' names in their units (rad or
    m), base, joint origins and tool of each [m], its violation and the bound on it [rad or m].
    """

    times: Float[np.ndarray, "T"]
    joints: Float[np.ndarray, "T D"]
    names: Sequence[str]
    units: Sequence[str]
    skeletons: Float[np.ndarray, "T n 3"]
    violation: Float[np.ndarray, "T"]
    bound: float


def path_figure(path: DrawnPath, title: str) -> Figure:
    """The arm from start to goal with its tool's curve, joint positions, and the violation at the
    waypoints with its bound.
    """
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.25))
    _draw_arm(figure, grid[:, 0], path.skeletons)
    axes = figure.add_subplot(grid[0, 1])
    for k, name in enumerate(path.names):
        colour = _COLOURS[k % len(_COLOURS)]
        axes.plot(path.times, path.joints[:, k], color=colour, lw=1.4, label=name)
    axes.set_ylabel(f"joint position [{' or '.join(dict.fromkeys(path.units))}]")
    axes.legend(ncols=3, fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(0.0, 1.28))
    below = figure.add_subplot(grid[1, 1], sharex=axes)
    violation, bound = np.maximum(path.violation, 1e-12), max(path.bound, 1e-12)
    below.semilogy(path.times, violation, color=BLUE, lw=1.2, label="at the waypoints")
    below.axhline(bound, color=VERMILION, lw=1.2, ls="--", label="bound on the whole path")
    below.set(xlabel="time [s]", ylabel="violation [rad or m]", ylim=(1e-13, 1e-2))
    below.legend(fontsize=7, frameon=False, loc="upper right")
    for panel in (axes, below):
        panel.grid(color=LIGHT, lw=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=9, x=0.02, ha="left")
    return figure


def _draw_arm(figure: Figure, place: object, skeletons: Float[np.ndarray, "T n 3"]) -> None:
    axes = figure.add_subplot(place, projection="3d")
    shown = np.linspace(0, len(skeletons) - 1, SHOWN).round().astype(int)
    shade = colormaps["Greys"](np.linspace(0.25, 0.65, SHOWN))
    for colour, row in zip(shade, shown, strict=True):
        axes.plot(*skeletons[row].T, color=colour, lw=2.0, marker="o", ms=2.5)
    tool = skeletons[:, -1]
    axes.plot(*tool.T, color=ORANGE, lw=1.8)
    for point, colour, label in ((tool[0], START, "start"), (tool[-1], GOAL, "goal")):
        axes.scatter(*point, color=colour, s=36, depthshade=False, label=label)
    span = skeletons.reshape(-1, 3)
    centre, half = 0.5 * (span.max(0) + span.min(0)), 0.55 * np.ptp(span, axis=0).max()
    for name, middle in zip("xyz", centre, strict=True):
        getattr(axes, f"set_{name}lim")(middle - half, middle + half)
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=7)
    axes.tick_params(labelsize=6)
    axes.set_zlim(min(0.0, centre[2] - half), centre[2] + half)
    axes.legend(fontsize=7, frameon=False, loc="upper left")
    axes.view_init(elev=22, azim=-58)
