"""Freeform surfaces and lines that the tip keeps to, and tool axes that turn with its place.

What has no formula is a B-spline of the position (constraints/spline.py).  Its coefficients, and
the tool's axis beside them, are fitted so that the rows' distances from the constraint manifold, in
joint space, become least: each row is moved onto the manifold along its Jacobian, the residuals
there are linear in the coefficients, and so on until nothing changes (orthogonal distance
regression, e.g. Boggs, Byrd and Schnabel, SIAM J. Sci. Stat. Comput. 8(6), 1987).  A penalty on
third differences of the coefficients smooths (Eilers and Marx, Statistical Science 11(2), 1996);
its weight is that which is best on demonstrations left out.

Where the tool's axis is along the normal each row tells the surface's slopes as well as its height,
and the slopes tell by far more: noise that moves the tip by 4 mm turns the axis by half a degree.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from constraint_geodesics.constraints.spline import Spline, SplineRelation, Term
from constraint_geodesics.constraints.tool_features import FEATURES
from constraint_geodesics.identification.forms import across, axis_words, of_axis
from constraint_geodesics.identification.kernels import add_up
from constraint_geodesics.identification.vanishing import (
    Sample,
    better_rms,
    near,
    principal,
    squares,
)

CELLS, COARSE = 16, 8
"""Of the grid along the longest side of where the rows are: of heights, and of axes that turn."""
FACING = 0.995
"""Share of the rows that must be on a side for it to be the one that is shown."""
MARGIN = 1.0
"""Cells that the grid reaches beyond the rows."""
DEGREE, PENALISED = 5, 3
SMOOTHINGS = 10.0 ** np.arange(-11, 2, 2)
"""Weights of the penalty that are tried, as shares of what makes it weigh as much as the rows."""
RIDGE = 1e-14
"""Added to the normal equations, as a share of their trace."""
AGAIN, STEPS_AGAIN, SCREENED = 2000, 2, 1000
"""Rows at most that a fit is done again on, the steps that takes, and rows that axes are looked for
among.
"""
HOPELESS_RAD = 0.1
"""Where rows that were left out are further off after the first step, there is no second."""
ROUNDS, LOOKED = 6, (0, 1, 5)
"""Steps of the fit, and those at which the smoothing is chosen."""
Relations = tuple[SplineRelation, ...]


class Model(NamedTuple):
    """relations: the rows that splines (one for each of `splines`) and a tool axis make.
    axis: the tool axis to begin with, None where no row has one.  grid: a spline whose coefficients
    don't matter.  faces: directions, and tool axes that are within 90° of them.
    """

    relations: Callable[[Sequence[Spline], np.ndarray], Relations]
    splines: int
    grid: Spline
    axis: Float[np.ndarray, "3"] | None
    faces: tuple[tuple[np.ndarray, np.ndarray], ...] = ()


@dataclass(frozen=True)
class Freeform:
    """A model fitted: its relations and what the fit needs to be done again on fewer rows.

    found_rad, left_out_rad, worst_fold_rad: the rms distance of the rows along each direction that
    is held, on those that it was fitted to, on those that were left out, and of the worst part of
    these.  rotation: the rows' tool frames.
    """

    model: Model
    coefficients: Float[np.ndarray, "splines M"]
    axis: Float[np.ndarray, "3"]
    smoothing: float
    found_rad: float
    left_out_rad: float
    worst_fold_rad: float
    side: float
    rotation: Float[np.ndarray, "n 3 3"]

    @property
    def sides(self) -> Relations:
        """The sides that the tool's axes are on, for the opposite ones have the same zeros: where
        one side alone is shown.
        """
        own = self.model.faces
        if self.model.axis is not None:
            own = ((np.sign(self.side) * self.model.grid.frame[2], self.axis),)
        words = self.relations[0].name
        return tuple(
            SplineRelation(words, "rad", 1.0, -of_axis(main, body), None, 1.0)
            for main, body in own
            if ((self.rotation @ body) @ main > 0.0).mean() >= FACING
        )

    @property
    def relations(self) -> Relations:
        """The rows."""
        return self.model.relations(_splines(self.model.grid, self.coefficients), self.axis)

    def again(self, sample: Sample) -> Relations:
        """The same, fitted to other rows."""
        few = sample.thinned(AGAIN)
        return fitted(self.model, few, [], (self.smoothing,), self).relations


def fitted(
    model: Model,
    sample: Sample,
    folds: Sequence[Bool[np.ndarray, "n"]],
    smoothings: Sequence[float] = tuple(SMOOTHINGS),
    begin: Freeform | None = None,
) -> Freeform:
    """The coefficients and the axis with the least distances in joint space.

    folds: which rows are left out when the smoothing is chosen.  begin: what was fitted to nearly
    the same rows, from where it takes fewer steps.
    """
    (y, to_joints), count = sample.pose, model.grid.coefficients.size
    size, no_fold = count * model.splines, np.zeros(len(y), dtype=bool)
    found = np.zeros((model.splines, count))
    axis = np.zeros(3) if model.axis is None else model.axis
    smooth = np.kron(np.eye(model.splines), _penalty(model.grid))
    moved, right = np.zeros((len(y), to_joints.shape[2])), ~no_fold
    smoothing, left_out = smoothings[-1], np.full(len(y), np.inf)
    if begin is not None:
        found, axis = begin.coefficients, begin.axis
    for step in range(0 if begin is None else ROUNDS - STEPS_AGAIN, ROUNDS):
        relations = model.relations(_splines(model.grid, found), axis)
        if step > 0:
            off = _distances(relations, y, to_joints)
            right = near(off, off)
        # the first two: as the rows are, since they would be moved onto what is not it yet
        if step > 1:
            moved = _onto(relations, y, to_joints, moved)
        there = y + np.einsum("nad,nd->na", to_joints, moved)
        system = _system(model, found, axis, there, to_joints, moved)
        rest = ~np.logical_or.reduce([no_fold, *folds])
        parts = [_normal(model.grid, there, system, out & right) for out in (*folds, rest)]
        whole = _Normal(
            np.sum([own.matrix for own in parts], axis=0),
            np.sum([own.right for own in parts], axis=0),
            sum(own.total for own in parts),
        )
        share = np.trace(whole.matrix[:size, :size]) / np.trace(smooth)
        penalty = np.zeros_like(whole.matrix)
        penalty[:size, :size] = share * smooth
        ridge = RIDGE * share * np.trace(smooth) / size * np.eye(len(penalty))
        if step in LOOKED and folds:
            tried = [
                [_solved(whole, part, weight * penalty + ridge) for part in parts[:-1]]
                for weight in smoothings
            ]
            sums = [sum(p.off(x) for p, x in zip(parts, own, strict=False)) for own in tried]
            best = int(np.argmin(sums))
            smoothing = smoothings[best]
            for x, out in zip(tried[best], folds, strict=True):
                own = model.relations(*_unknowns(model, x, axis))
                left_out[out] = _distances(own, y[out], to_joints[out])
            if step == 0 and better_rms(left_out) > HOPELESS_RAD:
                break
        numbers = _solved(whole, None, smoothing * penalty + ridge)
        _, axis = _unknowns(model, numbers, axis)
        found = numbers[:size].reshape(model.splines, count)
    relations = model.relations(_splines(model.grid, found), axis)
    each = np.sqrt(len(relations))
    found_rad = better_rms(_distances(relations, y, to_joints)) / each
    side = float(((sample.rotation @ axis) @ model.grid.frame[2]).mean())
    on_others = better_rms(left_out) / each
    worst = max((better_rms(left_out[out]) / each for out in folds), default=np.inf)
    fit = model, found, axis, float(smoothing), found_rad, on_others, worst, side
    return Freeform(*fit, sample.rotation)


def _unknowns(
    model: Model, numbers: Float[np.ndarray, "M"], axis: np.ndarray
) -> tuple[tuple[Spline, ...], np.ndarray]:
    """Splines, and the axis where it is one step on."""
    size = model.grid.coefficients.size * model.splines
    if model.axis is not None:
        axis = axis + numbers[size:] @ _tangents(axis)
        axis = axis / np.linalg.norm(axis)
    return _splines(model.grid, numbers[:size].reshape(model.splines, -1)), axis


def surface(sample: Sample) -> Model:
    """The tip on a freeform surface over the plane that its positions are nearest to."""
    grid = _grid(sample, 2)
    words = "the tool's tip lies on a freeform surface"

    def relations(splines: Sequence[Spline], _: np.ndarray) -> Relations:
        return (_height(words, grid, splines[0], 2),)

    return Model(relations, 1, grid, None)


def line(sample: Sample, flat: Float[np.ndarray, "3"] | None) -> Model:
    """The tip on a freeform line over the direction that its positions spread most in.

    flat: the normal of a plane that holds it already.
    """
    grid = _grid(sample, 1, flat)
    words = "the tool's tip lies on a freeform line"
    across = (1, 2) if flat is None else (1,)

    def relations(splines: Sequence[Spline], _: np.ndarray) -> Relations:
        return tuple(_height(words, grid, splines[k], j) for k, j in enumerate(across))

    return Model(relations, len(across), grid, None)


def along_normal(sample: Sample, found: Freeform) -> Model:
    """The tip on a surface that is found already, and a tool axis along its normal."""
    (height,), grid = found.relations, found.model.grid
    turned = sample.rotation.transpose(0, 2, 1) @ _normals(height, sample)[:, :, None]
    mean = turned[:, :, 0].mean(axis=0)

    def relations(splines: Sequence[Spline], axis: np.ndarray) -> Relations:
        words = f"{height.name}, and the tool's {axis_words(axis)} is normal to it"
        heights = _height(words, grid, splines[0], 2)
        rows = [heights]
        for k in range(2):
            term = Term(splines[0], k, 0.0, of_axis(grid.frame[2], axis))
            rows.append(SplineRelation(words, "rad", 0.0, of_axis(grid.frame[k], axis), term))
        return tuple(rows)

    return Model(relations, 1, grid, mean / np.linalg.norm(mean))


def turning(
    sample: Sample,
    place: Spline,
    axis: np.ndarray | None,
    held: np.ndarray | None,
    only: int | None = None,
) -> Model:
    """Tool axes that are functions of the place.

    place: any spline over the same coordinates.  axis: one that turns with the place, or None.
    held: one, this or another that is held, about which the turn is told, too; or None.
    only: of the rows, where another relation holds the rest.
    """
    grid, rows = _coarse(sample, place), []
    if axis is not None:
        words = f"the tool's {axis_words(axis)} is a smooth function of the place"
        main = _mean_direction(sample, axis)
        rows += [(words, axis, main, out) for out in across(main)]
    if held is not None:
        words = f"the turn about the tool's {axis_words(held)} is a smooth function of the place"
        second = across(held)[0]
        main = _mean_direction(sample, second)
        aside = np.cross(_mean_direction(sample, held), main)
        rows.append((words, second, main, aside / np.linalg.norm(aside)))
    rows = rows if only is None else [rows[only]]

    def relations(splines: Sequence[Spline], _: np.ndarray) -> Relations:
        found = []
        for spline, (words, body, main, out) in zip(splines, rows, strict=True):
            term = Term(spline, -1, 0.0, of_axis(-main, body))
            found.append(SplineRelation(words, "rad", 0.0, of_axis(out, body), term))
        return tuple(found)

    faces = tuple((main, body) for _, body, main, _ in rows[::2])
    return Model(relations, len(rows), grid, None, faces)


def plane_grid(sample: Sample, normal: Float[np.ndarray, "3"]) -> Spline:
    """A grid over a plane that holds the tip."""
    return _grid(sample, 2, normal)


def _coarse(sample: Sample, place: Spline) -> Spline:
    """A grid of COARSE cells over the same place."""
    x, count = place.coordinates(sample.position), len(place.active)
    return _cut(place.frame, place.origin, x, count, COARSE)


def axes_of_place(
    sample: Sample, grid: Spline, folds: Sequence[Bool[np.ndarray, "n"]]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """How far the tool's axes are from smooth functions of the place, rms over left-out rows, the
    least first, and the axes as rows.
    """
    some = np.arange(0, len(sample), -(-len(sample) // SCREENED))
    sample, folds, grid = sample[some], [out[some] for out in folds], _coarse(sample, grid)
    count = len(sample)
    omega, extra = np.zeros((count, 1, 1, 4)), np.zeros((count, 1, 0))
    omega[:, :, :, 0] = 1.0
    entries = sample.rotation.reshape(count, 9)
    smooth, least = _penalty(grid), (np.inf, np.zeros((3, 3)))
    parts = [
        [
            _normal(grid, sample.position, _System(omega, entries[:, k : k + 1], extra), out)
            for k in range(9)
        ]
        for out in folds
    ]
    matrix = sum(own[0].matrix for own in parts)
    rights = sum(np.stack([one.right for one in own], axis=1) for own in parts)
    share = np.trace(matrix) / np.trace(smooth)
    for weight in SMOOTHINGS:
        off = np.zeros((count, 3, 3))
        for own, out in zip(parts, folds, strict=True):
            right = rights - np.stack([one.right for one in own], axis=1)
            penalty = weight * share * smooth + RIDGE * share * np.eye(len(smooth))
            found = np.linalg.solve(matrix - own[0].matrix + penalty, right)
            told = _values(grid, found, sample.position[out])
            off[out] = (entries[out] - told).reshape(-1, 3, 3)
        spread = np.einsum("nij,nik->jk", off, off) / count
        if np.trace(spread) < least[0]:
            least = float(np.trace(spread)), spread
    values, axes = np.linalg.eigh(least[1])
    return np.sqrt(np.maximum(values, 0.0)), axes.T


def _values(
    grid: Spline, coefficients: Float[np.ndarray, "M k"], positions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n k"]:
    splines = _splines(grid, coefficients.T)
    return np.stack([own.look(positions)[:, 0] for own in splines], axis=1)


def _mean_direction(sample: Sample, body: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Of a tool axis."""
    mean = (sample.rotation @ body).mean(axis=0)
    return mean / np.linalg.norm(mean)


def least_moving(sample: Sample) -> Float[np.ndarray, "3"]:
    """The tool axis whose direction changes least."""
    away = sample.rotation - sample.rotation.mean(axis=0)
    return np.linalg.eigh(np.einsum("nij,nik->jk", away, away))[1][:, 0]


def _splines(grid: Spline, coefficients: Float[np.ndarray, "splines M"]) -> tuple[Spline, ...]:
    shape = grid.coefficients.shape
    return tuple(replace(grid, coefficients=own.reshape(shape)) for own in coefficients)


def _grid(sample: Sample, count: int, flat: Float[np.ndarray, "3"] | None = None) -> Spline:
    """Over as many directions as the positions spread most in, or two of a plane with this
    normal.
    """
    mean, frame = principal(sample.position, flat)
    return _cut(frame, mean, (sample.position - mean) @ frame.T, count, CELLS)


def _cut(
    frame: Float[np.ndarray, "3 3"],
    origin: Float[np.ndarray, "3"],
    x: Float[np.ndarray, "n 3"],
    count: int,
    most: int,
) -> Spline:
    """A grid over the first coordinates of rows x, with so many cells along the longest side."""
    lower, sides = x.min(axis=0), np.ptp(x, axis=0)
    longest = sides[:count].max()
    cells = np.maximum(np.ceil(most * sides / longest).astype(int), 1)
    cells[count:], margin = 0, MARGIN * longest / most
    spacing = (sides + 2 * margin) / np.maximum(cells, 1)
    degrees = (DEGREE, DEGREE if count > 1 else 0, DEGREE if count > 2 else 0)
    shape = [int(cells[k]) + DEGREE if k < count else 1 for k in range(3)]
    return Spline(frame, origin, lower - margin, spacing, degrees, np.zeros(shape))


def _height(words: str, grid: Spline, spline: Spline, across: int) -> SplineRelation:
    """x_j − s along one direction of the grid's frame."""
    linear = np.zeros(FEATURES)
    linear[:3] = grid.frame[across]
    constant = -float(grid.frame[across] @ grid.origin)
    return SplineRelation(words, "m", constant, linear, Term(spline, -1, -1.0, np.zeros(FEATURES)))


def _normals(height: SplineRelation, sample: Sample) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a surface at the rows' places."""
    steep = height.gradients(sample.pose[0])[:, :3]
    return steep / np.linalg.norm(steep, axis=1)[:, None]


def _tangents(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    return np.stack(across(axis))


def _onto(
    relations: Relations,
    y: Float[np.ndarray, "n 12"],
    to_joints: Float[np.ndarray, "n 12 D"],
    moved: Float[np.ndarray, "n D"],
) -> Float[np.ndarray, "n D"]:
    """The least joint steps (n, D) onto the manifold, to first order from where the last ended."""
    there = y + np.einsum("nad,nd->na", to_joints, moved)
    off, slopes = _residuals(relations, there, to_joints)
    off = off - np.einsum("nkd,nd->nk", slopes, moved)
    weights = np.linalg.solve(squares(slopes), off[:, :, None])
    found: np.ndarray = -(slopes.transpose(0, 2, 1) @ weights)[:, :, 0]
    return found


def _distances(
    relations: Relations, y: Float[np.ndarray, "n 12"], to_joints: Float[np.ndarray, "n 12 D"]
) -> Float[np.ndarray, "n"]:
    """How far rows are from the manifold, to first order [rad]."""
    still = np.zeros((len(y), to_joints.shape[2]))
    return np.linalg.norm(_onto(relations, y, to_joints, still), axis=1)


def _residuals(
    relations: Relations, y: Float[np.ndarray, "n 12"], to_joints: Float[np.ndarray, "n 12 D"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k D"]]:
    values = np.stack([own.values(y) for own in relations], axis=1)
    slopes = [np.einsum("na,nad->nd", own.gradients(y), to_joints) for own in relations]
    return values, np.stack(slopes, axis=1)


class _System(NamedTuple):
    """Whitened residuals −t + Σ ω ∂s c + Z da of rows, linear in coefficients c and axis.

    omega (n, k, splines, 4): factors of a spline's value and of its derivatives.  target (n, k).
    extra (n, k, 2).
    """

    omega: np.ndarray
    target: np.ndarray
    extra: np.ndarray


def _system(
    model: Model,
    coefficients: np.ndarray,
    axis: np.ndarray,
    there: Float[np.ndarray, "n 12"],
    to_joints: Float[np.ndarray, "n 12 D"],
    moved: Float[np.ndarray, "n D"],
) -> _System:
    splines = _splines(model.grid, coefficients)
    relations = model.relations(splines, axis)
    values, slopes = _residuals(relations, there, to_joints)
    factor = np.linalg.cholesky(squares(slopes))
    count, rows = values.shape
    omega = np.zeros((count, rows, model.splines, 4))
    target = np.einsum("nkd,nd->nk", slopes, moved)
    extra = np.zeros((count, rows, 0 if model.axis is None else 2))
    for k, own in enumerate(relations):
        target[:, k] -= own.constant + there @ own.linear
        if own.term is not None:
            which = next(i for i, spline in enumerate(splines) if spline is own.term.spline)
            omega[:, k, which, 1 + own.term.derivative] = (
                own.term.constant + there @ own.term.linear
            )
    for e, tangent in enumerate(_tangents(axis) if model.axis is not None else ()):
        tilted = model.relations(splines, axis + tangent)
        for k, own in enumerate(tilted):
            extra[:, k, e] = own.values(there) - values[:, k]
    wide = np.concatenate([omega.reshape(count, rows, -1), target[:, :, None], extra], axis=2)
    wide = np.linalg.solve(factor, wide)
    split = 4 * model.splines
    return _System(
        wide[:, :, :split].reshape(omega.shape), wide[:, :, split], wide[:, :, split + 1 :]
    )


class _Normal(NamedTuple):
    """Normal equations A x = b of residuals whose squares sum up to xᵀA x − 2 bᵀx + t."""

    matrix: np.ndarray
    right: np.ndarray
    total: float

    def off(self, x: np.ndarray) -> float:
        """That sum."""
        return float(x @ self.matrix @ x - 2.0 * self.right @ x + self.total)


def _normal(grid: Spline, there: np.ndarray, system: _System, rows: np.ndarray) -> _Normal:
    splines, extra = system.omega.shape[2], system.extra.shape[2]
    size = splines * grid.coefficients.size + extra
    matrix, right = np.zeros((size, size)), np.zeros(size)
    places = np.ascontiguousarray(there[rows, :3])
    own = [np.ascontiguousarray(part[rows]) for part in system]
    add_up(grid.numbers, places, *own, matrix, right)
    return _Normal(matrix, right, float((own[1] ** 2).sum()))


def _solved(whole: _Normal, without: _Normal | None, penalty: np.ndarray) -> np.ndarray:
    matrix, right = whole.matrix + penalty, whole.right
    if without is not None:
        matrix, right = matrix - without.matrix, right - without.right
    return np.linalg.solve(matrix, right)


def _penalty(grid: Spline) -> Float[np.ndarray, "M M"]:
    """Squares of the coefficients' third differences along each coordinate."""
    shape = grid.coefficients.shape
    found = np.zeros((grid.coefficients.size,) * 2)
    for k in grid.active:
        parts = [np.eye(size) for size in shape]
        steps = np.diff(parts[k], PENALISED, axis=0)
        parts[k] = steps.T @ steps
        found += np.kron(np.kron(parts[0], parts[1]), parts[2])
    return found
