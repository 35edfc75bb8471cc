"""What a constraint keeps, drawn about the tool: the plane, line or place that it stays on, the
direction that stays upright with the level plane across it, or the axes that do not turn.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from constraint_geodesics import palette
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.recording.colours import AXES, CARRIED, INK, LIMIT, rgb

FRAME, PLACE, REGION = "tool/frame", "tool/place", "tool/region"
"""Entities: what moves and turns with the tool, what moves with it but does not turn, and what
stays in the base frame.
"""
AXIS_M, UPRIGHT_M, LEVEL_M = 0.08, 0.16, 0.12
"""Lengths of a tool's axes and of the direction that is kept, and the level plane's radius."""
_MARGIN_M, _THIN_M = 0.08, 0.001
"""A region reaches so much beyond the path where it is not held, and has this thickness where it is
held exactly.
"""
_THIN = rr.Radius.ui_points(1.5)
_TURNS = np.linspace(0.0, 2.0 * np.pi, 41)
_ROUND = np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])

Drawing = tuple[Any, ...]


def kept_drawings(
    constraint: Constraint | None, tool: Float[np.ndarray, "frames 3"]
) -> Iterator[Drawing]:
    """Entities with what Rerun draws, of a constraint that has a reference pose; tool: where the
    tool goes [m].
    """
    if constraint is None or constraint.reference is None or constraint.is_free:
        return
    rows, reference = constraint.rows, constraint.reference
    if rows.held[:3].any():
        yield REGION, _region(rows.held[:3], rows.tolerance[:3], reference.position, tool)
    angles = np.flatnonzero(rows.held[3:])
    if len(angles) == 3:
        ends = 1.5 * AXIS_M * reference.rotation.T
        lines = np.stack([np.zeros((3, 3)), ends], axis=1)
        yield f"{PLACE}/kept", rr.LineStrips3D(lines, colors=AXES, radii=[_THIN])
    elif len(angles) == 2:
        yield from _upright(reference.rotation, angles, rows.tolerance[3 + angles])


def _region(held: np.ndarray, tolerance: np.ndarray, place: np.ndarray, tool: np.ndarray) -> Any:
    low, high = tool.min(axis=0), tool.max(axis=0)
    centre = np.where(held, place, 0.5 * (low + high))
    half = np.where(held, np.maximum(tolerance, 0.5 * _THIN_M), 0.5 * (high - low) + _MARGIN_M)
    style = {"colors": [(*rgb(palette.BLUE), 40)], "fill_mode": "transparentfillmajorwireframe"}
    return rr.Boxes3D(centers=[centre], half_sizes=[half], **style)


def _upright(turn: np.ndarray, angles: np.ndarray, loosely: np.ndarray) -> Iterator[Drawing]:
    """The base axis that the tool may turn about, as the tool sees it; the plane across it, and the
    ring in which the arrow's tip has to stay.
    """
    (free,) = set(range(3)) - set(angles.tolist())
    axis = np.eye(3)[free]
    arrow = rr.Arrows3D(vectors=[UPRIGHT_M * turn[free]], colors=[INK], radii=[0.004])
    yield f"{FRAME}/upright", arrow
    lying = Rotation.from_matrix(np.roll(np.eye(3), -free - 1, axis=1)).as_quat()
    size = {"lengths": [_THIN_M], "radii": [LEVEL_M], "quaternions": [rr.Quaternion(xyzw=lying)]}
    plane = rr.Cylinders3D(**size, colors=[(*CARRIED, 90)], fill_mode="solid")
    limit: tuple[Any, ...] = ()
    if (loosely > 0.0).all() and (loosely < 0.5 * np.pi).all():
        # angles of one tolerance are bounded together, else each by its own
        apart = loosely[0] != loosely[1]
        ring = _ROUND / (np.abs(_ROUND).max(axis=1, keepdims=True) if apart else 1.0)
        about = (loosely * ring) @ np.eye(3)[angles]
        circle = Rotation.from_rotvec(about).apply(UPRIGHT_M * axis)
        limit = (rr.LineStrips3D([circle], colors=[LIMIT], radii=[_THIN]),)
    yield f"{PLACE}/level", plane, *limit
