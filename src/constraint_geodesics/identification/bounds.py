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
from constraint_geodesics.identification.forms import across, axis_near, axis_words, of_axis, vector
from constraint_geodesics.identification.vanishing import Sample

WIDEST_RAD, WIDEST_M = 0.35, 0.03
"""Half-widths beyond which nothing is taken for a tolerance."""
SHARE, INLIERS = 0.99, 0.9
"""Of the rows that are within a bound; of those that tell how far right rows can be off."""
WRONG = 2.5
"""Rows that are off by so many times what INLIERS of them are at most, are wrong."""
FILLED = 1.9
"""A bound over the rms of what it bounds, at most: 1.4 where a disc is filled evenly, 1.7 for an
interval, 2.2 and 2.6 where values fade out as a normal distribution's.
"""
ROUND = 0.6
"""The rms of leaning the one way over that the other way, at least."""
FREER = 2.5
"""What is not bounded varies by so many times as much, at least."""
BEYOND = 1.2
"""Left-out demonstrations go up to so many times a bound that was found without them, at most."""

Offs = Float[np.ndarray, "n"]


class Bound(NamedTuple):
    """relation: the row of the residual, with its tolerance.  left_out: the rms by which left-out
    rows were beyond bounds that were found without them [rad or m].  right (n,): rows that are not
    taken to be wrong.
    """

    relation: Relation
    left_out: float
    right: Bool[np.ndarray, "n"]


class _Middle(NamedTuple):
    """What rows are near.  off: how far they are from it.  other: how much the least of what it
    leaves free varies, of rows.  row: the relation of a half-width.
    """

    off: Offs
    other: Callable[[Sample], float]
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
    off = own.off
    right = off <= WRONG * np.quantile(off, INLIERS)
    rms, width = float(np.sqrt((off[right] ** 2).mean())), float(np.quantile(off[right], SHARE))
    if not 0.0 < width <= min(widest, FILLED * rms) or own.other(sample[right]) < FREER * rms:
        return None
    beyond = []
    for out in folds:
        narrow = float(np.quantile(off[right & ~out], SHARE))
        left = off[right & out]
        if not len(left) or np.quantile(left, SHARE) > BEYOND * narrow:
            return None
        beyond.append(float((np.maximum(left - narrow, 0.0) ** 2).mean()))
    return Bound(own.row(width), float(np.sqrt(np.mean(beyond))), right)


def _cone(sample: Sample) -> _Middle | None:
    """About the direction that an axis keeps best, in the mean."""
    left, _, turned = np.linalg.svd(sample.rotation.mean(axis=0))
    own, direction = axis_near(turned[0]), axis_near(left[:, 0])
    if own is None or direction is None:
        return None
    if direction.sum() < 0.0:
        own, direction = -own, -direction

    leaning = sample.rotation @ own
    off = np.arccos(np.clip(leaning @ direction, -1.0, 1.0))
    # in both directions alike: of a cone that is a line, most was never shown
    right = leaning[off <= WRONG * np.quantile(off, INLIERS)] @ np.stack(across(direction)).T
    least, most = np.linalg.eigvalsh(right.T @ right)
    if least < ROUND**2 * most:
        return None

    def other(some: Sample) -> float:
        sizes = np.linalg.svd(some.rotation.mean(axis=0), compute_uv=False)
        return float(np.arccos(np.clip(sizes[1], -1.0, 1.0)))

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

    return _Middle(off, other, row)


def _slab(sample: Sample) -> _Middle | None:
    """Across the axis along which most rows are nearest to each other."""
    spans = [_shortest(sample.position[:, k], INLIERS) for k in range(3)]
    k = int(np.argmin([high - low for low, high in spans]))
    heights, (low, high) = sample.position[:, k], spans[k]
    right = np.abs(heights - 0.5 * (low + high)) <= WRONG * 0.5 * (high - low)
    low, high = _shortest(heights[right], SHARE)
    middle, normal = 0.5 * (low + high), np.eye(3)[k]
    _, directions = np.linalg.eigh(np.cov(sample.position[right].T))
    if axis_near(directions[:, 0]) is None:
        return None

    def other(some: Sample) -> float:
        flat = np.delete(some.position, k, axis=1)
        return float(np.sqrt(np.linalg.eigvalsh(np.cov(flat.T))[0]))

    def row(width: float) -> Relation:
        words = (
            f"the tool's tip stays within {1e3 * width:.1f} mm of a plane, normal "
            f"{vector(normal)}, {1e3 * middle:.1f} mm from the base"
        )
        linear = np.concatenate([normal, np.zeros(FEATURES - 3)])
        return Relation(words, "m", -middle, linear, None, width)

    return _Middle(np.abs(heights - middle), other, row)


def _shortest(values: Float[np.ndarray, "n"], share: float) -> tuple[float, float]:
    """The shortest interval that holds a share of values."""
    ordered = np.sort(values)
    count = max(int(share * len(ordered)), 2)
    widths = ordered[count - 1 :] - ordered[: len(ordered) - count + 1]
    first = int(np.argmin(widths))
    return float(ordered[first]), float(ordered[first + count - 1])
