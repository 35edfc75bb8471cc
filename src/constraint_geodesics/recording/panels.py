"""How recordings are arranged in the viewer: the arm large at the left, what is read beside it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

ROOTS = ("robot", "workcell", "attached", "tool", "transforms")
"""Entities of every recording that stand in space."""
SHORT_S, SLOWER = 3.0, 0.5
"""What is shorter plays slower."""
LEAST, MOST = 120.0, 200.0
"""Shares of a limit [%] that a panel shows at least and at most: what breaks one by far leaves the
panel, and what keeps it can still be read.
"""
_TURNED, _RAISED = math.radians(-50.0), math.radians(22.0)
"""Of the eye: from the side on which the path is, and how high."""
_AWAY = 1.9
"""Its distance, in radii of what is to be seen."""
_PAPER = (255, 255, 255)


def arranged(scene: Any, rows: Sequence[tuple[Any, float]], time: Any) -> Any:
    """A blueprint: the scene, and panels beside it, each with its share of the height."""
    panels, shares = zip(*rows, strict=True)
    right = rrb.Vertical(*panels, row_shares=list(shares))
    return blueprint(rrb.Horizontal(scene, right, column_shares=[3.0, 2.0]), time)


def blueprint(panels: Any, time: Any) -> Any:
    """Some panels and a time panel, and nothing else open."""
    closed = [kind(state="collapsed") for kind in (rrb.BlueprintPanel, rrb.SelectionPanel)]
    return rrb.Blueprint(panels, *closed, time, auto_views=False, auto_layout=False)


def time_panel(timeline: str, duration_s: float) -> Any:
    """A time panel that plays from the start, again and again."""
    speed = SLOWER if duration_s < SHORT_S else 1.0
    how = {"state": "collapsed", "play_state": "playing", "loop_mode": "all"}
    return rrb.TimePanel(timeline=timeline, playback_speed=speed, **how)


def status_panel() -> Any:
    """The path's status as text."""
    return rrb.TextDocumentView(origin="status", name="Status")


def scene_view(name: str, entities: Sequence[str], seen: Float[np.ndarray, "n 3"]) -> Any:
    """What lies below some entities, with the points [m] and the base in the middle, from the side
    on which they are.
    """
    points = np.concatenate([seen, np.zeros((1, 3))])
    low, high = points.min(axis=0), points.max(axis=0)
    radius = max(0.5 * float(np.linalg.norm(high - low)), 0.1)
    x, y = points.mean(axis=0)[:2]
    around, up = math.atan2(y, x) + _TURNED, _RAISED
    towards = np.array(
        [math.cos(around) * math.cos(up), math.sin(around) * math.cos(up), math.sin(up)]
    )
    middle = 0.5 * (low + high)
    return space_view(name, entities, middle + _AWAY * radius * towards, middle)


def space_view(
    name: str,
    entities: Sequence[str],
    eye: Float[np.ndarray, "3"],
    target: Float[np.ndarray, "3"],
    **more: Any,
) -> Any:
    """What lies below some entities, seen from the eye to the target [m]; the third axis is up."""
    where = {"position": eye.tolist(), "look_target": target.tolist()}
    eyes = rrb.EyeControls3D(**where, eye_up=(0.0, 0.0, 1.0))
    contents = [f"+ /{entity}/**" for entity in entities]
    # a grid at z = 0 would flicker with the top of a table there
    grid = rrb.LineGrid3D(visible=False)
    shown = {"contents": contents, "eye_controls": eyes, "line_grid": grid, **more}
    shown["background"] = _PAPER  # black is drawn too, which a dark theme would swallow
    return rrb.Spatial3DView(origin="/", name=name, **shown)


def constraint_panel(largest: float | None, *, residuals: bool) -> list[Any]:
    """What the constraint bounds: as shares of what the judge grants, up to the largest [%] if
    there are any, and behind that in its own units; nothing where it bounds nothing.
    """
    tabs = [] if largest is None else [share_panel(largest)]
    if residuals:
        name = "Constraint [mm or deg]"
        tabs.append(rrb.TimeSeriesView(origin="constraint", name=name))
    return [rrb.Tabs(*tabs, active_tab=0)] if tabs else []


def share_panel(largest: float) -> Any:
    """Shares of limits; 100 % are granted."""
    top = float(np.clip(1.1 * largest, LEAST, MOST))
    return series_view("share", "Constraint [% of its limit]", (0.0, top))


def joint_panel() -> Any:
    """All joints as shares of their range, and behind that in their own units."""
    own = rrb.TimeSeriesView(origin="joints", name="Joints [rad or m]")
    return rrb.Tabs(range_panel(), own, active_tab=0)


def range_panel(*, legend: bool = True) -> Any:
    """All joints as shares of their range."""
    return series_view("joint_range", "Joints within their limits (±1)", (-1.1, 1.1), legend=legend)


def cup_panels(spheres: float, tilt_deg: float) -> list[Any]:
    """The cup's tilt, and how many of its spheres are still in it; the largest of both."""
    tilted = (0.0, 1.1 * max(tilt_deg, 1e-3))
    return [
        series_view("cup_tilt", "Tilt of the cup [deg]", tilted, legend=False),
        series_view("cup_spheres", "Spheres in the cup", (0.0, 1.1 * spheres), legend=False),
    ]


def series_view(origin: str, name: str, limits: tuple[float, float], *, legend: bool = True) -> Any:
    """The series below an entity between two values."""
    how = {} if legend else {"plot_legend": rrb.PlotLegend(visible=False)}
    axis = rrb.ScalarAxis(range=limits)
    return rrb.TimeSeriesView(origin=origin, name=name, axis_y=axis, **how)


def latent_view_of(axis_names: Sequence[str], low: np.ndarray, high: np.ndarray) -> Any:
    """The latent plane between two corners."""
    room = 0.1 * (high - low)  # for the axes' names
    low, high = low - room, high + room
    bounds = rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(-high[1], -low[1]))
    name = f"Latent space: {', '.join(axis_names)}"
    return rrb.Spatial2DView(origin="latent", name=name, background=_PAPER, visual_bounds=bounds)
