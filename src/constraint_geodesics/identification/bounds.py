"""Tolerances that demonstrations use: a tool axis that leans from an axis of the base in a cone, a
tip that stays near a plane across one.

Unlike a relation, which motions keep to within the noise, a bound is filled: motions go up to it
and no further, also those that it was not found on.  What merely happens not to vary much fades
out instead, about axes that have no name.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.polynomial import Relation
from constraint_geodesics.constraints.tool_features import FEATURES
from constraint_geodesics.identification.forms import axis_words, of_axis, vector
from constraint_geodesics.identification.vanishing import Sample

WIDEST_RAD, WIDEST_M = 0.35, 0.03
"""Half-widths beyond which nothing is taken for a tolerance."""
NAMED_RAD = 0.06
"""How far from the axes of tool and base those of a bound may seem to be."""
SHARE, INLIERS = 0.99, 0.9
"""Of the rows that are within a bound; of those that tell how far right rows can be off."""
WRONG = 2.5
"""Rows that are off by so many times what INLIERS of them are at most, are wrong."""
FILLED = 1.9
"""A bound over the rms of what it bounds, at most: 1.4 where a disc is filled evenly, 1.7 for an
interval, 2.2 and 2.6 where values fade out as a normal distribution's.
"""
FREER = 2.5
"""What is not bounded varies by so many times as much, at least."""
BEYOND = 1.2
"""Left-out demonstrations go up to so many times a bound that was found without them, at most."""

Offs = Float[np.ndarray, "n"]


class Bound(NamedTuple):
    """relation: the row of the residual, with its tolerance.  left_out: the rms by which left-out
    rows were beyond bounds that were found without them [rad or m].
    """

    relation: Relation
    left_out: float


class _Middle(NamedTuple):
    """What rows are near.  off: how far they are from it.  other: how much the least of what it
    leaves free varies.  row: the relation of a half-width.
    """

    off: Callable[[Sample], Offs]
    other: float
    row: Callable[[float], Relation]


def bounds_of(
    sample: Sample, turned: bool, placed: bool, folds: Sequence[Bool[np.ndarray, "n"]]
) -> tuple[Bound, ...]:
    """Bounds on rows of the tool; turned, placed: whether relations hold its orientation or the
    tip already, of which no more is looked for then.
    """
    found = []
    for held, middle, widest in ((turned, _cone, WIDEST_RAD), (placed, _slab, WIDEST_M)):
        own = None if held or not folds else middle(sample)
        found.append(None if own is None else _bound(own, widest, sample, folds))
    return tuple(own for own in found if own is not None)


def _bound(
    own: _Middle, widest: float, sample: Sample, folds: Sequence[Bool[np.ndarray, "n"]]
) -> Bound | None:
    off = own.off(sample)
    right = off <= WRONG * np.quantile(off, INLIERS)
    rms, width = float(np.sqrt((off[right] ** 2).mean())), float(np.quantile(off[right], SHARE))
    if not 0.0 < width <= min(widest, FILLED * rms) or own.other < FREER * rms:
        return None
    beyond = []
    for out in folds:
        narrow = float(np.quantile(off[right & ~out], SHARE))
        left = off[right & out]
        if not len(left) or np.quantile(left, SHARE) > BEYOND * narrow:
            return None
        beyond.append(float((np.maximum(left - narrow, 0.0) ** 2).mean()))
    return Bound(own.row(width), float(np.sqrt(np.mean(beyond))))


def _named(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"] | None:
    """The axis that a direction is near, if it is near one."""
    k = int(np.argmax(np.abs(direction)))
    axis = np.zeros(3)
    axis[k] = np.sign(direction[k])
    return axis if np.linalg.norm(direction - axis) < NAMED_RAD else None


def _cone(sample: Sample) -> _Middle | None:
    """About the direction that an axis keeps best, in the mean."""
    left, sizes, right = np.linalg.svd(sample.rotation.mean(axis=0))
    own, direction = _named(right[0]), _named(left[:, 0])
    if own is None or direction is None:
        return None
    if direction.sum() < 0.0:
        own, direction = -own, -direction

    def off(some: Sample) -> Offs:
        return np.arccos(np.clip((some.rotation @ own) @ direction, -1.0, 1.0))

    def row(width: float) -> Relation:
        """With s = nᵀR a: cos θ ≤ s ≤ 1 is |s − (1 + cos θ)/2| ≤ (1 − cos θ)/2, over sin θ."""
        words = (
            f"the tool's {axis_words(own)} stays within {np.degrees(width):.1f}° of "
            f"{vector(direction)}"
        )
        steep, level = float(np.sin(width)), float(np.cos(width))
        linear = of_axis(direction / steep, own)
        middle, half = -0.5 * (1.0 + level) / steep, 0.5 * (1.0 - level) / steep
        return Relation(words, "rad", middle, linear, None, half)

    return _Middle(off, float(np.arccos(np.clip(sizes[1], -1.0, 1.0))), row)


def _slab(sample: Sample) -> _Middle | None:
    """Across the direction in which the tip moves least."""
    spreads, directions = np.linalg.eigh(np.cov(sample.position.T))
    normal = _named(directions[:, 0])
    if normal is None:
        return None
    normal = np.abs(normal)
    low, high = np.quantile(sample.position @ normal, (0.5 - 0.5 * SHARE, 0.5 + 0.5 * SHARE))
    middle = 0.5 * float(low + high)

    def row(width: float) -> Relation:
        words = (
            f"the tool's tip stays within {1e3 * width:.1f} mm of a plane, normal "
            f"{vector(normal)}, {1e3 * middle:.1f} mm from the base"
        )
        linear = np.concatenate([normal, np.zeros(FEATURES - 3)])
        return Relation(words, "m", -middle, linear, None, width)

    return _Middle(
        lambda some: np.abs(some.position @ normal - middle), float(np.sqrt(spreads[1])), row
    )
