"""Forms that relations of the tool's pose have names for: planes, lines and points, held axes and
orientations, spheres that the tool points at the centre of, spheres, circles and cylinders.

A form has few numbers.  They are first read off the rows in closed form, then fitted so that the
rows' distances from the constraint manifold, in joint space, become least: with noise in the joints
that is the estimate of greatest likelihood, and what is noisy on both sides of an equation does not
bias it.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from constraint_geodesics.constraints.polynomial import Relation
from constraint_geodesics.constraints.tool_features import FEATURES
from constraint_geodesics.identification.vanishing import AnyRelation, Sample

AXES = np.eye(3)
NAMES = ("x", "y", "z")
CAREFULLY = 4000
"""Rows that a form's numbers are fitted to at most, even among those there are."""

Numbers = Float[np.ndarray, "p"]


class Round(NamedTuple):
    """What lengths and angles are rounded to multiples of."""

    metres: float
    degrees: float


ROUND = (Round(0.05, 15.0), Round(0.01, 5.0), Round(0.005, 1.0), Round(0.001, 0.5))
"""From the roundest on."""
NEAR_AXIS = 0.06
"""How far from an axis of tool or base a direction may seem to be that is meant to be along it."""


class Form(NamedTuple):
    """start: its numbers in closed form, from rows.  relations: the rows of the residual that they
    make, in words.  facing: the numbers of which the rows are on the right side, where opposite
    ones have the same zeros.  sides: relations with a tolerance that leave that side alone.
    parts: what the numbers are, one letter each: d a direction (3 numbers), l a length [m], c a
    cosine.  flat: whether it is of a plane that is known.
    """

    start: Callable[[Sample], Numbers]
    relations: Callable[[Numbers], tuple[Relation, ...]]
    facing: Callable[[Sample, Numbers], Numbers] = lambda _, x: x
    sides: Callable[[Numbers], tuple[Relation, ...]] = lambda _: ()
    parts: str = ""
    flat: bool = False

    def rounded(self, x: Numbers, digits: Round) -> Numbers:
        """The numbers with directions along an axis, where they are near one, and with round
        lengths and angles.
        """
        x, at = x.copy(), 0
        for part in self.parts:
            if part == "d":
                direction = unit(x[at : at + 3])
                near = axis_near(direction)
                x[at : at + 3] = direction if near is None else near
            elif part == "l":
                x[at] = digits.metres * np.round(x[at] / digits.metres)
            elif part == "c":
                angle = np.degrees(np.arccos(np.clip(x[at], -1.0, 1.0)))
                x[at] = np.cos(np.radians(digits.degrees * np.round(angle / digits.degrees)))
            at += 3 if part == "d" else 1
        return x

    def roughly(self, sample: Sample) -> tuple[Relation, ...]:
        """As read off in closed form."""
        return self.relations(self.facing(sample, self.start(sample)))

    def fitted(self, sample: Sample) -> Numbers:
        """The numbers with the least distances in joint space."""
        some = sample.thinned(CAREFULLY)

        def off(x: Numbers) -> np.ndarray:
            return some.whitened(self.relations(x)).ravel()

        found = least_squares(off, self.start(sample), max_nfev=20)
        return self.facing(sample, found.x)


def _plane(count: int) -> Form:
    """The tip in a plane, on a line or at a point: `count` of 1, 2 or 3."""
    what = ("lies in a plane", "lies on a line", "stays at a point")[count - 1]

    def start(sample: Sample) -> Numbers:
        mean = sample.position.mean(axis=0)
        if count == 3:
            return mean
        _, directions = np.linalg.eigh(np.cov((sample.position - mean).T))
        normals = np.stack([_upright(directions[:, k]) for k in range(count)])
        return np.concatenate([normals.ravel(), normals @ mean])

    def relations(x: Numbers) -> tuple[Relation, ...]:
        normals, offsets = AXES, x
        if count < 3:
            # kept orthonormal: two that lean on each other would hold less than they say
            left, _, right = np.linalg.svd(x[: 3 * count].reshape(count, 3), full_matrices=False)
            normals, offsets = left @ right, x[3 * count :]
        point = offsets @ normals
        if count == 1:
            told = f"{what}, normal {vector(normals[0])}, {_mm(offsets[0])} from the base"
        elif count == 2:
            along = _upright(np.cross(normals[0], normals[1]))
            told = f"{what} through {_place(point)}, direction {vector(along)}"
        else:
            told = f"{what}, {_place(point)}"
        words = f"the tool's tip {told}"
        return tuple(
            _relation(words, "m", -float(d), position=n)
            for n, d in zip(normals, offsets, strict=True)
        )

    return Form(start, relations, parts="lll" if count == 3 else "d" * count + "l" * count)


def _axis_start(sample: Sample) -> Numbers:
    left, _, right = np.linalg.svd(sample.rotation.mean(axis=0))
    return np.concatenate(_oriented(right[0], left[:, 0]))


def _axis_relations(x: Numbers) -> tuple[Relation, ...]:
    """R a = n."""
    own, direction = unit(x[:3]), unit(x[3:])
    words = f"the tool's {axis_words(own)} keeps the direction {vector(direction)}"
    return tuple(_relation(words, "rad", 0.0, turned=(e, own)) for e in across(direction))


def _axis_facing(sample: Sample, x: Numbers) -> Numbers:
    """The direction that the axis points to, not the opposite one."""
    own, direction = unit(x[:3]), unit(x[3:])
    if _along(sample, direction, own).mean() < 0.0:
        direction = -direction
    return np.concatenate(_oriented(own, direction))


def _axis_sides(x: Numbers) -> tuple[Relation, ...]:
    """1 − nᵀR a ≤ 1: within 90°, for R a = −n has the same zeros."""
    words = _axis_relations(x)[0].name
    side = _relation(words, "rad", 1.0, turned=(-unit(x[3:]), unit(x[:3])))
    return (replace(side, tolerance=1.0),)


def _orientation_start(sample: Sample) -> Numbers:
    """R₀ as a vector of its axis and angle [rad]: of nine numbers, those of mirrored frames would
    fit as well.
    """
    left, _, right = np.linalg.svd(sample.rotation.mean(axis=0))
    mean = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return Rotation.from_matrix(mean).as_rotvec()


def _orientation_relations(x: Numbers) -> tuple[Relation, ...]:
    """vee(R₀ᵀR − RᵀR₀)/2 = 0."""
    held, found = Rotation.from_rotvec(x).as_matrix(), []
    for i, j in ((2, 1), (0, 2), (1, 0)):
        linear = np.zeros(FEATURES)
        linear[3 + 3 * j : 6 + 3 * j] += 0.5 * held[:, i]
        linear[3 + 3 * i : 6 + 3 * i] -= 0.5 * held[:, j]
        found.append(Relation("the tool keeps its whole orientation", "rad", 0.0, linear))
    return tuple(found)


def _orientation_sides(x: Numbers) -> tuple[Relation, ...]:
    """(3 − tr R₀ᵀR)/4 = (1 − cos θ)/2 ≤ 1/2: within 90°, for half turns have the same zeros."""
    linear = np.zeros(FEATURES)
    linear[3:] = -0.25 * Rotation.from_rotvec(x).as_matrix().T.ravel()
    words = _orientation_relations(x)[0].name
    return (Relation(words, "rad", 0.75, linear, None, 0.5),)


def _angle_start(sample: Sample) -> Numbers:
    best, least = np.zeros(7), np.inf
    for n in AXES:
        for a in AXES:
            start = np.concatenate([n, a, [_along(sample, n, a).mean()]])
            found = least_squares(_off_angle, start, args=(sample,), max_nfev=40)
            if found.cost < least:
                best, least = found.x, found.cost
    return best


def _off_angle(x: Numbers, sample: Sample) -> np.ndarray:
    off: np.ndarray = _along(sample, unit(x[:3]), unit(x[3:6])) - x[6]
    return off


def _along(sample: Sample, n: np.ndarray, a: np.ndarray) -> Float[np.ndarray, "k"]:
    """nᵀ R a."""
    return (sample.rotation @ a) @ n


def _angle_relations(x: Numbers) -> tuple[Relation, ...]:
    """nᵀ R a = cos θ, divided by sin θ."""
    a, n = _oriented(unit(x[3:6]), unit(x[:3]))
    level = float(np.clip(x[6], -1.0, 1.0))
    words = (
        f"the tool's {axis_words(a)} stays at {np.degrees(np.arccos(level)):.2f}° to {vector(n)}"
    )
    scale = 1.0 / max(np.sqrt(1.0 - level**2), 0.1)
    return (_relation(words, "rad", -level * scale, turned=(n * scale, a)),)


def _centre_start(sample: Sample) -> Numbers:
    count = len(sample)
    free = np.broadcast_to(-AXES, (count, 3, 3))
    system = np.concatenate([sample.rotation, free], axis=2).reshape(-1, 6)
    return np.linalg.lstsq(system, -sample.position.ravel(), rcond=None)[0]


def _centre_relations(x: Numbers) -> tuple[Relation, ...]:
    """The rows of p + R b = c."""
    arm, centre = x[:3], x[3:]
    radius = float(np.linalg.norm(arm))
    words = (
        f"the tool's tip lies on a sphere, r = {1e3 * radius:.1f} mm about {_place(centre)}, and "
        f"the tool's {axis_words(arm / max(radius, 1e-12))} points at its centre"
    )
    return tuple(
        _relation(words, "m", -float(e @ centre), position=e, turned=(e, arm)) for e in AXES
    )


def _sphere_start(sample: Sample) -> Numbers:
    centre, radius = _round_through(sample.position)
    return np.append(centre, radius)


def _round_through(points: Float[np.ndarray, "n k"]) -> tuple[Float[np.ndarray, "k"], float]:
    """Centre and radius of the sphere or circle through points, |p|² = 2 cᵀp + ρ² − |c|²."""
    system = np.c_[2 * points, np.ones(len(points))]
    solved, *_ = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)
    centre = solved[:-1]
    return centre, float(np.sqrt(max(solved[-1] + centre @ centre, 1e-6)))


def _sphere_relations(x: Numbers) -> tuple[Relation, ...]:
    centre, radius = x[:3], float(abs(x[3]))
    words = f"the tool's tip lies on a sphere, r = {1e3 * radius:.1f} mm about {_place(centre)}"
    return (_round(words, AXES, centre, radius),)


def _cylinder_start(sample: Sample) -> Numbers:
    found = [least_squares(_off_cylinder, _around(sample, axis), args=(sample,)) for axis in AXES]
    return min(found, key=lambda one: one.cost).x


def _off_cylinder(x: Numbers, sample: Sample) -> np.ndarray:
    axis, away = unit(x[:3]), sample.position - x[3:6]
    away = away - (away @ axis)[:, None] * axis
    off: np.ndarray = np.linalg.norm(away, axis=1) - x[6]
    return off


def _around(sample: Sample, axis: Float[np.ndarray, "3"]) -> Numbers:
    """A circle about a direction: direction, centre, radius."""
    flat = np.stack(across(axis))
    centre, radius = _round_through(sample.position @ flat.T)
    return np.concatenate([axis, centre @ flat, [radius]])


def _cylinder_relations(x: Numbers) -> tuple[Relation, ...]:
    return _about_a_line("cylinder", _upright(unit(x[:3])), x[3:6], float(abs(x[6])))


def _about_a_line(
    what: str, axis: np.ndarray, centre: np.ndarray, radius: float
) -> tuple[Relation, ...]:
    centre = centre - (centre @ axis) * axis
    words = (
        f"the tool's tip lies on a {what}, r = {1e3 * radius:.1f} mm about the line through "
        f"{_place(centre)} along {vector(axis)}"
    )
    return (_round(words, AXES - np.outer(axis, axis), centre, radius),)


def circle(normal: Float[np.ndarray, "3"]) -> Form:
    """The tip keeps its distance to a line along a normal that is known: an arc in its plane."""
    axis = _upright(normal / np.linalg.norm(normal))
    return Form(
        lambda sample: _around(sample, axis)[3:],
        lambda x: _about_a_line("circle", axis, x[:3], float(abs(x[3]))),
        parts="llll",
        flat=True,
    )


AXIS = Form(_axis_start, _axis_relations, _axis_facing, _axis_sides, "dd")
ORIENTATION = Form(_orientation_start, _orientation_relations, sides=_orientation_sides)
ANGLE = Form(_angle_start, _angle_relations, parts="ddc")
CENTRE = Form(_centre_start, _centre_relations, parts="llllll")
SPHERE = Form(_sphere_start, _sphere_relations, parts="llll")
CYLINDER = Form(_cylinder_start, _cylinder_relations, parts="dllll")
POSITION, TURNED, POSE, QUADRIC = "position", "orientation", "pose", "position's quadrics"
PRODUCT = "position times its orientation"


def named(features: str, rank: int, known: tuple[AnyRelation, ...]) -> Iterator[Form]:
    """Forms that as many independent relations of these features may be, the simplest first.

    known: what is held already.
    """
    if features == POSITION:
        yield _plane(rank)
    elif features == TURNED:
        yield (ANGLE, AXIS, ORIENTATION)[rank - 1]
    elif features == POSE and rank == 3:
        yield CENTRE
    elif features == QUADRIC and rank == 1:
        flat = [own.linear[:3] for own in known if np.any(own.linear[:3])]
        if len(flat) == 1:
            yield circle(flat[0])
        yield SPHERE
        yield CYLINDER


def _round(words: str, around: np.ndarray, centre: np.ndarray, radius: float) -> Relation:
    """((p − c)ᵀ P (p − c) − ρ²) / 2ρ."""
    linear, full = np.zeros(FEATURES), np.zeros((FEATURES, FEATURES))
    full[:3, :3] = around / radius
    linear[:3] = -around @ centre / radius
    constant = float((centre @ around @ centre - radius**2) / (2.0 * radius))
    return Relation(words, "m", constant, linear, full)


def _relation(
    words: str,
    unit: str,
    constant: float,
    position: Float[np.ndarray, "3"] | None = None,
    turned: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None,
) -> Relation:
    """The row c + eᵀp + fᵀR a."""
    linear = np.zeros(FEATURES) if turned is None else of_axis(*turned)
    if position is not None:
        linear[:3] = position
    return Relation(words, unit, constant, linear)


def of_axis(e: Float[np.ndarray, "3"], own: Float[np.ndarray, "3"]) -> Float[np.ndarray, "12"]:
    """The linear form eᵀ R a of features."""
    return np.concatenate([np.zeros(3), np.outer(own, e).ravel()])


def across(direction: Float[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that complete a direction to a frame."""
    first = unit(np.cross(direction, AXES[np.argmin(np.abs(direction))]))
    return first, np.cross(direction, first)


def unit(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The unit vector along v."""
    return v / np.linalg.norm(v)


def axis_near(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"] | None:
    """The axis that a direction is near, if it is near one."""
    axis = np.sign(direction) * (np.abs(direction) == np.abs(direction).max())
    return axis if np.linalg.norm(direction - axis) < NEAR_AXIS else None


def _upright(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Of two opposite directions that with a positive largest entry."""
    return direction * np.sign(direction[np.argmax(np.abs(direction))])


def _oriented(
    own: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Both turned about, where the direction's largest entry would be negative."""
    sign = np.sign(direction[np.argmax(np.abs(direction))])
    return sign * own, sign * direction


def axis_words(own: Float[np.ndarray, "3"]) -> str:
    """A tool axis in words: "-z axis", or its numbers where it is none of the three."""
    k = int(np.argmax(np.abs(own)))
    angle = np.degrees(np.arccos(min(abs(own[k]), 1.0)))
    return f"{'-' if own[k] < 0 else ''}{NAMES[k]} axis" if angle < 0.5 else f"axis {vector(own)}"


def vector(v: Float[np.ndarray, "3"]) -> str:
    """A direction in words."""
    return "(" + ", ".join(f"{x:g}" for x in np.round(v, 4) + 0.0) + ")"


def _place(p: Float[np.ndarray, "3"]) -> str:
    return "(" + ", ".join(f"{x:.1f}" for x in np.round(1e3 * p, 1) + 0.0) + ") mm"


def _mm(x: float) -> str:
    return f"{1e3 * x:.1f} mm"
