"""Functions of the tool's pose that stay constant over demonstrations, in units of joint space.

Of features ψ(q) those combinations wᵀψ are looked for that vary least for the joints' sake:
minimise Var(wᵀψ) / E‖∇_q wᵀψ‖², a generalised eigenvalue problem.  The root of an eigenvalue is the
rms distance of the demonstrations from the relation [rad]: noise of 0.5° reads 0.0087.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import eigh

from constraint_geodesics.constraints.polynomial import Relation
from constraint_geodesics.constraints.spline import SplineRelation
from constraint_geodesics.constraints.tool_features import features
from constraint_geodesics.identification.kernels import joint_origins
from constraint_geodesics.robot.kinematics import SerialRobot

METRES = 0.3
"""Unit of positions among the features: a reach, so that they are as large as a rotation's."""
SEEN = 2e-4
"""Combinations whose squared gradient is smaller than this share of the largest hardly move with
the joints: noise alone makes them vary.
"""
APART = 0.15
"""Of the normals of several relations, those directions count that are this long at least, as a
share of the longest.
"""
AnyRelation = Relation | SplineRelation
FLOOR_RAD = 1e-4
SURELY_RAD, AT_MOST_RAD, TIMES = 2e-3, 0.02, 4.0
"""A relation holds on demonstrations that it was not found on if these are off by no more than
TIMES the distance of the best relation of all, or SURELY_RAD; and by AT_MOST_RAD in any case.
"""
GOOD = 0.9
"""Share of the rows that a distance is taken over: some may be wrong."""
WRONG, LEAST_WRONG_RAD = 5.0, 1e-4
"""Rows that are further off than so many times the median, and than so much, are wrong."""
RIDGE = 1e-9
"""Added to J Jᵀ, as a share of its trace: two relations may touch at a row."""
TRIMS = 8
MOST_FOLDS = 5
LEAST_STEEP = 0.3
"""Least gradient that a relation is taken to have on rows that it was not found on, where it was 1
on the others.
"""


@dataclass(frozen=True)
class Sample:
    """Rows of demonstrations: tool positions (n, 3) [m], rotations (n, 3, 3), Jacobians (n, 6, D),
    and the demonstration that each is of.
    """

    position: Float[np.ndarray, "n 3"]
    rotation: Float[np.ndarray, "n 3 3"]
    jacobian: Float[np.ndarray, "n 6 D"]
    of: Int[np.ndarray, "n"]

    @classmethod
    def of_joints(
        cls, robot: SerialRobot, shown: Sequence[Float[np.ndarray, "T D"]], motions: bool
    ) -> "Sample":
        """Of demonstrations; independent rows count as MOST_FOLDS of them, drawn at random."""
        q = np.concatenate(shown)
        of = np.repeat(np.arange(len(shown)), [len(own) for own in shown])
        if not motions:
            of = np.random.default_rng(0).permutation(len(q)) % MOST_FOLDS
        return cls(*robot.forward(q), robot.jacobian(q), of)

    def of_joint(self, robot: SerialRobot, q: Float[np.ndarray, "n D"], joint: int) -> "Sample":
        """The same rows with the place of a joint's origin instead of the tool's pose."""
        places, jacobian = np.empty((len(q), 3)), np.empty((len(q), 6, robot.dof))
        joint_origins(robot.chain, np.ascontiguousarray(q), joint, places, jacobian)
        return Sample(places, np.zeros((len(q), 3, 3)), jacobian, self.of)

    def __len__(self) -> int:
        return len(self.of)

    def __getitem__(self, rows: np.ndarray) -> "Sample":
        return Sample(*(getattr(self, own.name)[rows] for own in fields(self)))

    def thinned(self, most: int) -> "Sample":
        """Every nth row, so that there are no more than `most`."""
        return self[np.arange(0, len(self), -(-len(self) // most))]

    def folds(self) -> list[Bool[np.ndarray, "n"]]:
        """Which rows are left out, whole demonstrations each time; none for one demonstration."""
        names = np.unique(self.of)
        parts = np.array_split(names, min(len(names), MOST_FOLDS))
        return [np.isin(self.of, part) for part in parts] if len(names) > 1 else []

    @cached_property
    def pose(self) -> tuple[Float[np.ndarray, "n 12"], Float[np.ndarray, "n 12 D"]]:
        """Y = (p, R e_x, R e_y, R e_z), and its Jacobian."""
        linear, angular = self.jacobian[:, :3], self.jacobian[:, 3:]
        columns = [
            np.cross(angular, self.rotation[:, :, k][:, :, None], axisa=1, axisb=1, axisc=1)
            for k in range(3)
        ]
        return features(self.position, self.rotation), np.concatenate([linear, *columns], axis=1)

    def slopes(self, relations: Sequence[AnyRelation]) -> Float[np.ndarray, "n k D"]:
        """∂r/∂q of relations."""
        y, own = self.pose
        found = [np.einsum("na,nad->nd", r.gradients(y), own) for r in relations]
        return np.stack(found, axis=1) if found else np.zeros((len(self), 0, own.shape[2]))

    def whitened(self, relations: Sequence[AnyRelation]) -> Float[np.ndarray, "n k"]:
        """Residuals r as L⁻¹ r with J Jᵀ = L Lᵀ: their length is the distance from the manifold of
        all relations, to first order [rad].
        """
        off = np.stack([own.values(self.pose[0]) for own in relations], axis=1)
        slopes = self.slopes(relations)
        factor = np.linalg.cholesky(squares(slopes))
        return np.linalg.solve(factor, off[:, :, None])[:, :, 0]

    def distances(self, relations: Sequence[AnyRelation]) -> Float[np.ndarray, "n"]:
        """How far each row is from the manifold of all relations [rad]."""
        return np.linalg.norm(self.whitened(relations), axis=1)


@dataclass(frozen=True)
class Vanishing:
    """Combinations W (M, k) of features, the least varying first, what they are in the mean (M,)
    features, their rms distance [rad] on the rows they were found on and on those left out.
    """

    weights: Float[np.ndarray, "M k"]
    mean: Float[np.ndarray, "M"]
    found_rad: Float[np.ndarray, "k"]
    left_out_rad: Float[np.ndarray, "k"]

    def held(self, best_rad: float) -> int:
        """How many hold on what was left out; best_rad: what the best of all is off by."""
        return _count(self.left_out_rad, best_rad)

    def seeming(self, best_rad: float) -> int:
        """How many hold on the rows that they were found on."""
        return _count(self.found_rad, best_rad)


def squares(slopes: Float[np.ndarray, "n k D"]) -> Float[np.ndarray, "n k k"]:
    """J Jᵀ of each row, which may be singular there, and a little."""
    found: np.ndarray = np.matmul(slopes, slopes.transpose(0, 2, 1))
    ridge = RIDGE * np.trace(found, axis1=1, axis2=2) + 1e-300
    return found + ridge[:, None, None] * np.eye(found.shape[1])


def near(off: Float[np.ndarray, "n"], among: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "n"]:
    """Which distances [rad] are no larger than WRONG times the median of those `among`."""
    return off <= max(WRONG * float(np.median(among)), LEAST_WRONG_RAD)


def principal(
    positions: Float[np.ndarray, "n 3"], flat: Float[np.ndarray, "3"] | None = None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """The mean of positions, and a frame whose rows are the directions that they spread most in,
    the first two of them within the plane of a normal, if one is given.
    """
    mean = positions.mean(axis=0)
    away = positions - mean
    if flat is not None:
        away = away - np.outer(away @ flat, flat)
    _, directions = np.linalg.eigh(away.T @ away)
    frame = directions.T[::-1].copy()
    frame[2] = np.cross(frame[0], frame[1])
    return mean, frame


def better_rms(off: Float[np.ndarray, "n"]) -> float:
    """Root of the mean square of the better GOOD of distances."""
    return float(np.sqrt(np.mean(np.sort(off)[: max(1, int(GOOD * len(off)))] ** 2)))


def most_rad(best_rad: float) -> float:
    """Distance up to which a relation holds, where the best of all is off by so much [rad]."""
    return min(max(TIMES * max(best_rad, FLOOR_RAD), SURELY_RAD), AT_MOST_RAD)


def _count(distances: Float[np.ndarray, "k"], best_rad: float) -> int:
    beyond = np.flatnonzero(distances > most_rad(best_rad))
    return int(beyond[0]) if len(beyond) else len(distances)


def vanishing(
    psi: Float[np.ndarray, "n M"],
    slopes: Float[np.ndarray, "n M D"],
    folds: Sequence[Bool[np.ndarray, "n"]],
) -> Vanishing:
    """The least varying combinations, found on all rows and, for the left-out distances, on each
    fold's others.  Without folds these are infinite: one demonstration supports nothing.
    """
    mean, weights, found = _least(psi, slopes)
    left_out = np.full(len(found), np.inf)
    if folds:
        off = [_left_out(psi, slopes, out) for out in folds]
        count = min(len(own) for own in [*off, found])
        left_out = np.sqrt(np.mean([own[:count] for own in off], axis=0))
    return Vanishing(weights[:, : len(left_out)], mean, found[: len(left_out)], left_out)


def _left_out(
    psi: Float[np.ndarray, "n M"], slopes: Float[np.ndarray, "n M D"], out: Bool[np.ndarray, "n"]
) -> Float[np.ndarray, "k"]:
    """Mean squared distance [rad²] of one fold's rows from what its others vary least in."""
    mean, own, _ = _least(psi[~out], slopes[~out])
    off = (psi[out] - mean) @ own
    steep = (np.matmul(own.T, slopes[out]) ** 2).sum(axis=2).mean(axis=0)
    return (off**2).mean(axis=0) / np.maximum(steep, LEAST_STEEP**2)


def _least(
    psi: Float[np.ndarray, "n M"], slopes: Float[np.ndarray, "n M D"]
) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M k"], Float[np.ndarray, "k"]]:
    """Mean features, combinations with E‖∇‖² = 1, and their rms distance [rad]."""
    mean = psi.mean(axis=0)
    spread = (psi - mean).T @ (psi - mean) / len(psi)
    steep = np.einsum("nad,nbd->ab", slopes, slopes, optimize=True) / len(psi)
    size, basis = np.linalg.eigh(steep)
    kept = size > SEEN * max(size[-1], 1e-300)
    if not kept.any() or size[-1] <= 0.0:  # nothing of it moves with the joints
        return mean, np.zeros((psi.shape[1], 0)), np.zeros(0)
    basis = basis[:, kept] / np.sqrt(size[kept])
    values, own = eigh(basis.T @ spread @ basis)
    return mean, basis @ own, np.sqrt(np.maximum(values, 0.0))


def trimmed(
    psi: Float[np.ndarray, "n M"], slopes: Float[np.ndarray, "n M D"], share: float
) -> tuple[float, Float[np.ndarray, "n"]]:
    """The rms distance [rad] of the better share of the rows from the relation that these vary
    least in, and the distance of each row: where some are wrong, the first look is blurred.
    """
    kept = np.ones(len(psi), dtype=bool)
    for _ in range(TRIMS):
        mean, own, found = _least(psi[kept], slopes[kept])
        if not len(found):
            return np.inf, np.zeros(len(psi))
        steep = np.linalg.norm(np.matmul(own[:, 0], slopes), axis=1)
        off = np.abs((psi - mean) @ own[:, 0]) / np.maximum(steep, LEAST_STEEP)
        kept = off <= np.quantile(off, share)
    return float(found[0]), off


def rank(slopes: Float[np.ndarray, "n M D"], weights: Float[np.ndarray, "M k"]) -> int:
    """How many of k combinations are independent: of the tool's axes two fix the third."""
    sizes = np.linalg.svd(np.matmul(weights.T, slopes), compute_uv=False)
    rms = np.sqrt((sizes**2).mean(axis=0))
    if not len(rms):
        return 0
    return int((rms > APART * rms[0]).sum())


def without(
    slopes: Float[np.ndarray, "n M D"], normals: Float[np.ndarray, "n k D"]
) -> Float[np.ndarray, "n M D"]:
    """Slopes along what relations that are known already leave free."""
    if not normals.shape[1]:
        return slopes
    basis, _ = np.linalg.qr(normals.transpose(0, 2, 1))
    return slopes - np.matmul(np.matmul(slopes, basis), basis.transpose(0, 2, 1))
