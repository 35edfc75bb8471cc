"""Where demonstrations were: the distance of the tip from the nearest of them, as an inequality.

The region is the morphological closing of the demonstrated places, in the coordinates in which the
identified constraint leaves the tip free: what no ball that holds none of them reaches.  The ball's
radius comes from how far demonstrations are from each other, so that gaps between them are closed
and larger holes stay.  The distance to the region is a B-spline (constraints/spline.py), which is
planned with and certified like any other row.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from constraint_geodesics.constraints.spline import Spline, SplineRelation, Term
from constraint_geodesics.constraints.tool_features import FEATURES
from constraint_geodesics.identification.vanishing import AnyRelation, Sample, principal, without

SHARE = 0.95
"""Of the rows that are within the radius of other demonstrations' rows."""
CELLS = (0, 400, 160, 40)
"""Of the grid along the longest side at most, by the number of coordinates."""
TIMES, MARGIN = 2.0, 0.25
"""The ball's radius, as a multiple of how far SHARE of the rows are from other demonstrations, and
how far beyond the region the tip may be, as a share of the radius.
"""
FINE = 4.0
"""Cells that a radius is across."""
FREE = 0.2
"""Of the directions that the tip moves in, those count that are so long, as a share of the longest.
"""
BENT = 0.35
"""A line or surface that leaves its flat coordinates by this share needs one more of them."""
LEAST_M = 1e-3


@dataclass(frozen=True)
class Support:
    """The region where demonstrations were.

    radius_m: of the ball; narrower gaps between demonstrations are closed.  margin_m: how far
    beyond the region the tip may be.  coordinates: how many of the tip's coordinates it is in.
    relation: the inequality.
    """

    radius_m: float
    margin_m: float
    coordinates: int
    relation: SplineRelation

    @property
    def words(self) -> str:
        """In words."""
        return self.relation.name


def support_of(
    sample: Sample, relations: Sequence[AnyRelation], folds: Sequence[Bool[np.ndarray, "n"]]
) -> Support:
    """The region, from rows that keep to relations."""
    mean, frame = principal(sample.position)
    x = (sample.position - mean) @ frame.T
    count = _coordinates(sample, relations, x)
    radius = TIMES * max(_apart(x[:, :count], folds), LEAST_M)
    spline = _distances(frame, mean, x, count, radius)
    # every demonstrated place is in it, on a grid that is too coarse for the radius as well
    margin = max(MARGIN * radius, float(spline.look(sample.position)[:, 0].max()))
    words = f"the tool's tip stays within {1e3 * margin:.1f} mm of the region where it was shown"
    nothing = np.zeros(FEATURES)
    relation = SplineRelation(words, "m", 0.0, nothing, Term(spline, -1, 1.0, nothing), margin)
    return Support(radius, margin, count, relation)


def _coordinates(
    sample: Sample, relations: Sequence[AnyRelation], x: Float[np.ndarray, "n 3"]
) -> int:
    """In how many of them the tip is free, and one more where it is bent too much for that."""
    free = without(sample.jacobian[:, :3], sample.slopes(relations))
    sizes = np.sqrt((np.linalg.svd(free, compute_uv=False) ** 2).mean(axis=0))
    count = max(int((sizes > FREE * sizes[0]).sum()), 1)
    spread = x.std(axis=0)
    while count < 3 and spread[count] > BENT * spread[0]:
        count += 1
    return count


def _apart(x: Float[np.ndarray, "n k"], folds: Sequence[Bool[np.ndarray, "n"]]) -> float:
    """How far rows are from those of other demonstrations."""
    if not folds:
        return float(np.quantile(np.asarray(KDTree(x).query(x, 2)[0])[:, 1], SHARE))
    off = [KDTree(x[~out]).query(x[out])[0] for out in folds]
    return float(np.quantile(np.concatenate(off), SHARE))


def _distances(
    frame: Float[np.ndarray, "3 3"],
    origin: Float[np.ndarray, "3"],
    x: Float[np.ndarray, "n 3"],
    count: int,
    radius: float,
) -> Spline:
    """A cubic spline whose coefficients are distances to the region at their own places."""
    lower, upper = x.min(axis=0) - 4.0 * radius, x.max(axis=0) + 4.0 * radius
    h = max(radius / FINE, float((upper - lower)[:count].max()) / CELLS[count])
    cells = np.ceil((upper - lower) / h).astype(int)
    # the middle of the knots that a coefficient's basis function turns at, its Greville abscissa
    places = [lower[k] + h * (np.arange(cells[k] + 3) - 1.0) for k in range(count)]
    mesh = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1)
    away = np.asarray(KDTree(x[:, :count]).query(mesh.reshape(-1, count))[0])
    away = away.reshape(mesh.shape[:-1])
    near = away <= max(radius, h)
    # a place of the closing is no nearer than the radius to one that is not near a row
    outside = h * (distance_transform_edt(near) - 0.5)
    off = np.where(near, np.maximum(radius - outside, 0.0), away)
    degrees = (3, 3 if count > 1 else 0, 3 if count > 2 else 0)
    coefficients = np.round(off, 5).reshape([*off.shape, *[1] * (3 - count)])
    return Spline(frame, origin, lower, np.full(3, h), degrees, coefficients)
