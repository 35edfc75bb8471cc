"""Relations of the tool's pose with a function of its position that has no formula: freeform
surfaces and lines, axes that turn from place to place, and regions where demonstrations were.

With y = (p, R e_x, R e_y, R e_z) (12,) as in constraints/polynomial.py, and s a tensor-product
B-spline of the tool's position p or one of its derivatives, one row is
r = c + wᵀy + s(p) (c′ + w′ᵀy).  A surface is w = e₃, c′ = −1; a tool axis t along its normal is
r = tᵀe₁ + (∂s/∂u) tᵀe₃, and the same along v.
"""

from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, ClassVar, NamedTuple
from zlib import compress, decompressobj
from zlib import error as zlib_error

import numpy as np
from jaxtyping import Float
from numba import carray, int64, njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.constraint import ConstraintError
from constraint_geodesics.constraints.kernels import (
    JOINT_WORDS,
    LINEARISE_WORDS,
    TOOL_WORDS,
    ConstraintArrays,
    c_function,
    chain_at,
    floats,
    lanes_at,
)
from constraint_geodesics.constraints.relations import RelationsConstraint
from constraint_geodesics.constraints.tool_features import FEATURES, into_joints
from constraint_geodesics.robot.kernels import geometric_jacobian, poses_of, posture_in
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.text_files import MOST_BYTES

ORDER = 6
"""Basis functions that are not zero at a place: one more than the largest degree."""
_LOOK = 10
"""Numbers that are known of a spline at a place: value, gradient (3,), Hessian (6,)."""
_BASIS = 9 * ORDER
"""Basis functions along three coordinates with two derivatives."""
HEAD = 24
"""Numbers of a spline before its coefficients: frame, origin, lower, cells a metre, degrees and
counts along three coordinates.
"""
_ROW = 4 + 2 * FEATURES
"""Numbers of one row: c, w, which spline (−1: none), which derivative (−1: none), c′, w′."""
_NONE = np.zeros(HEAD + 1)
"""Stands where a constraint has no spline."""
_SECOND = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where ∂²s/∂x_a∂x_b stands among the six."""


@dataclass(frozen=True, eq=False)
class Spline:
    """A tensor-product B-spline s(x), x = F (p − o), on uniform knots.

    frame (3, 3): F, a rotation.  origin (3,) [m].  lower (3,): where the domain begins [m].
    spacing (3,): of the knots [m].  degrees (3,): 3 or 5, or 0 for a coordinate that it does not
    depend on.  coefficients (n₁, n₂, n₃): degree + cells along each coordinate, 1 for degree 0.
    Beyond the domain it is continued along its slopes at the border.  Raises ConstraintError where
    these do not fit.
    """

    frame: Float[np.ndarray, "3 3"]
    origin: Float[np.ndarray, "3"]
    lower: Float[np.ndarray, "3"]
    spacing: Float[np.ndarray, "3"]
    degrees: tuple[int, int, int]
    coefficients: Float[np.ndarray, "n1 n2 n3"]

    def __post_init__(self) -> None:
        shapes = {"frame": (3, 3), "origin": (3,), "lower": (3,), "spacing": (3,)}
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ConstraintError(f"spline: {name} must be {shape} finite numbers")
            object.__setattr__(self, name, value)
        if np.abs(self.frame @ self.frame.T - np.eye(3)).max() > 1e-9:
            raise ConstraintError("spline: frame must be a rotation")
        if not (self.spacing > 0.0).all():
            raise ConstraintError(f"spline: spacing = {self.spacing.tolist()}: must be positive")
        c = np.array(self.coefficients, np.float64)
        degrees = tuple(int(d) for d in self.degrees)
        if len(degrees) != 3 or not set(degrees) <= {0, 3, 5} or not any(degrees):
            raise ConstraintError(f"spline: degrees = {self.degrees}: 0, 3 or 5 each, not all 0")
        if c.ndim != 3 or not np.isfinite(c).all():
            raise ConstraintError("spline: coefficients must be (n1, n2, n3) finite numbers")
        for count, degree in zip(c.shape, degrees, strict=True):
            if count < degree + 1 or (degree == 0 and count != 1):
                raise ConstraintError(
                    f"spline: {count} coefficients along a coordinate of degree {degree}: "
                    f"{degree + 1} are needed{' exactly' if degree == 0 else ''}"
                )
        object.__setattr__(self, "degrees", degrees)
        object.__setattr__(self, "coefficients", c)

    @property
    def active(self) -> tuple[int, ...]:
        """The coordinates that it depends on."""
        return tuple(k for k in range(3) if self.degrees[k])

    @property
    def upper(self) -> Float[np.ndarray, "3"]:
        """Where the domain ends [m]."""
        cells = np.array(self.coefficients.shape) - np.array(self.degrees)
        return self.lower + cells * self.spacing

    @cached_property
    def numbers(self) -> Float[np.ndarray, "n"]:
        """All of it, one after another, as the kernels take it."""
        parts = (
            self.frame.ravel(),
            self.origin,
            self.lower,
            1.0 / self.spacing,
            self.degrees,
            self.coefficients.shape,
            self.coefficients.ravel(),
        )
        return np.concatenate([np.asarray(part, np.float64) for part in parts])

    def coordinates(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Those of positions, x = F (p − o)."""
        return (positions - self.origin) @ self.frame.T

    def look(self, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 10"]:
        """Value, gradient and second derivatives (11, 12, 13, 22, 23, 33) along x."""
        out = np.empty((len(positions), _LOOK))
        _looks(self.numbers, np.ascontiguousarray(positions, np.float64), out)
        return out

    def seen_at(self, y: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 10"]:
        """The same at the positions of features, which several relations ask for one after another:
        the last answer is kept, for as long as nothing writes to y.
        """
        if not self._seen or self._seen[0] is not y:
            self._seen[:] = y, self.look(y[:, :3])
        found: np.ndarray = self._seen[1]
        return found

    @cached_property
    def _seen(self) -> list[np.ndarray]:
        return []

    def __getstate__(self) -> dict[str, Any]:
        return {name: own for name, own in vars(self).items() if name != "_seen"}

    def to_json(self) -> dict[str, Any]:
        """All numbers; the coefficients, which may be many, as the bytes of 64-bit numbers,
        compressed, in base 64.
        """
        return {
            "frame": self.frame.tolist(),
            "origin": self.origin.tolist(),
            "lower": self.lower.tolist(),
            "spacing": self.spacing.tolist(),
            "degrees": list(self.degrees),
            "shape": list(self.coefficients.shape),
            "coefficients": b64encode(compress(self.coefficients.tobytes())).decode(),
        }

    @classmethod
    def from_json(cls, about: Mapping[str, Any]) -> "Spline":
        """What `to_json` wrote."""
        own = dict(about)
        shape = own.pop("shape")
        try:
            unpacking = decompressobj()
            content = unpacking.decompress(b64decode(own["coefficients"]), MOST_BYTES)
            if not unpacking.eof:
                raise ValueError(f"cut short, or more than {MOST_BYTES / 2**20:g} MiB, unpacked")
            numbers = np.frombuffer(content)
            return cls(**{**own, "coefficients": numbers.reshape(shape)})
        except (ValueError, zlib_error) as error:
            raise ConstraintError(f"spline: coefficients: {error}") from None


class Term(NamedTuple):
    """s(p) (c′ + w′ᵀy): a spline, which derivative of it (0, 1, 2, or −1 for the value), c′ and
    w′ (12,).
    """

    spline: Spline
    derivative: int
    constant: float
    linear: Float[np.ndarray, "12"]


@dataclass(frozen=True, eq=False)
class SplineRelation:
    """One row |c + wᵀy + s(p) (c′ + w′ᵀy)| ≤ tolerance, in metres or radians.

    Raises ConstraintError for numbers that are not finite, or no name.
    """

    name: str
    unit: str
    constant: float
    linear: Float[np.ndarray, "12"]
    term: Term | None
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        if not self.name or self.unit not in ("m", "rad"):
            raise ConstraintError(f"relation {self.name!r}: a name and m or rad are needed")
        numbers = np.append(self.numbers, self.tolerance)
        if numbers.shape != (_ROW + 1,) or not np.isfinite(numbers).all() or self.tolerance < 0.0:
            raise ConstraintError(
                f"relation {self.name!r}: its numbers must be finite, (12,) each, its tolerance "
                f"not negative"
            )
        if self.term is not None and self.term.derivative not in (-1, 0, 1, 2):
            raise ConstraintError(
                f"relation {self.name!r}: derivative = {self.term.derivative}: −1, 0, 1 or 2"
            )

    @property
    def numbers(self) -> Float[np.ndarray, "28"]:
        """As the kernels take it, all but the number of its spline."""
        own = self.term or (None, -1, 0.0, np.zeros(FEATURES))
        parts = [[self.constant], self.linear, [-1.0, own[1], own[2]], own[3]]
        return np.concatenate([np.asarray(part, np.float64) for part in parts])

    def values(self, y: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n"]:
        """The residual of features."""
        found: np.ndarray = self.constant + y @ self.linear
        if self.term is not None:
            spline, a, constant, linear = self.term
            found += spline.seen_at(y)[:, 1 + a] * (constant + y @ linear)
        return found

    def gradients(self, y: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 12"]:
        """∂r/∂y."""
        found = np.tile(self.linear, (len(y), 1))
        if self.term is not None:
            spline, a, constant, linear = self.term
            look = spline.seen_at(y)
            steep = look[:, 1:4] if a < 0 else look[:, 4 + _SECOND[a]]
            found += look[:, 1 + a, None] * linear
            found[:, :3] += (constant + y @ linear)[:, None] * (steep @ spline.frame)
        return found


@dataclass(frozen=True, eq=False)
class SplineConstraint(RelationsConstraint):
    """Relations that all hold."""

    kind: ClassVar[str] = "spline"

    @cached_property
    def splines(self) -> tuple[Spline, ...]:
        """Those of the relations, each once."""
        named = [own.term.spline for own in self.relations if own.term is not None]
        return tuple({id(own): own for own in named}.values())

    def _which(self, relation: SplineRelation) -> int:
        """The number of a relation's spline, −1 if it has none."""
        own = None if relation.term is None else relation.term.spline
        return next((k for k, spline in enumerate(self.splines) if spline is own), -1)

    def arrays(self, robot: SerialRobot) -> ConstraintArrays:
        """For the kernels."""
        blocks = [own.numbers for own in self.splines] or [_NONE]
        head = 1 + len(blocks)
        at = head + _ROW * len(self.relations)
        places = at + np.cumsum([0, *(len(block) for block in blocks)])[:-1]
        relations = [own.numbers for own in self.relations]
        for own, numbers in zip(self.relations, relations, strict=True):
            numbers[1 + FEATURES] = self._which(own)
        data = np.concatenate([[len(blocks)], places, *relations, *blocks])
        room = TOOL_WORDS + JOINT_WORDS * robot.dof + 2 * FEATURES + 6 * robot.dof
        room += _BASIS + _LOOK * len(blocks)
        return ConstraintArrays(self.rows, data, _compiled().address, 0, room)

    def compile(self) -> None:
        """What all of this kind share, once."""
        _compiled()

    @property
    def key(self) -> tuple:
        """All numbers, to the bit."""
        relations = tuple(
            (r.unit, r.tolerance, self._which(r), r.numbers.tobytes()) for r in self.relations
        )
        return (self.kind, relations, tuple(own.numbers.tobytes() for own in self.splines))

    def to_json(self) -> dict[str, Any]:
        """All numbers; relations name their splines by place."""
        relations = []
        for own in self.relations:
            about: dict[str, Any] = {
                "name": own.name,
                "unit": own.unit,
                "constant": float(own.constant),
                "linear": np.asarray(own.linear, float).tolist(),
                "tolerance": float(own.tolerance),
                "spline": self._which(own),
            }
            if own.term is not None:
                about["derivative"] = int(own.term.derivative)
                about["factor_constant"] = float(own.term.constant)
                about["factor_linear"] = np.asarray(own.term.linear, float).tolist()
            relations.append(about)
        splines = [own.to_json() for own in self.splines]
        return {
            "kind": self.kind,
            "relations": relations,
            "splines": splines,
            "left_out": list(self.left_out),
        }

    @classmethod
    def from_json(cls, about: Mapping[str, Any], robot: SerialRobot | None) -> "SplineConstraint":
        """What `to_json` wrote."""
        splines = [Spline.from_json(own) for own in about["splines"]]
        relations = []
        for own in about["relations"]:
            which, term = int(own["spline"]), None
            if not -1 <= which < len(splines):
                raise ConstraintError(f"spline {which}: there are {len(splines)} of them")
            if which >= 0:
                factor = np.array(own["factor_linear"], float)
                derivative, constant = int(own["derivative"]), float(own["factor_constant"])
                term = Term(splines[which], derivative, constant, factor)
            relations.append(
                SplineRelation(
                    str(own["name"]),
                    str(own["unit"]),
                    float(own["constant"]),
                    np.array(own["linear"], float),
                    term,
                    float(own["tolerance"]),
                )
            )
        return cls(tuple(relations), tuple(float(x) for x in about["left_out"]))


KIND = SplineConstraint


@njit(**LEAF)
def basis_at(degree, at, count, scale, basis):
    """Basis functions at `at` cells from the domain's lower end, with two derivatives along the
    coordinate, into basis (3, 6); the first coefficient that they are of.  scale: cells a metre.
    """
    for i in range(3):
        for j in range(ORDER):
            basis[i, j] = 0.0
    if degree == 0:
        basis[0, 0] = 1.0
        return 0
    cells = count - degree
    inside = min(max(at, 0.0), float(cells))
    cell = min(int(inside), cells - 1)
    f = inside - cell
    basis[0, 0] = 1.0
    for k in range(1, degree + 1):
        if k == degree - 1:
            for j in range(k):
                basis[2, j] = basis[0, j]
        if k == degree:
            for j in range(k):
                basis[1, j] = basis[0, j]
        for j in range(k, -1, -1):
            left = (f + k - j) * basis[0, j - 1] if j > 0 else 0.0
            right = (j + 1 - f) * basis[0, j] if j < k else 0.0
            basis[0, j] = (left + right) / k
    # derivatives are differences of basis functions of a lower degree
    for _ in range(2):
        for j in range(degree, -1, -1):
            before = basis[2, j - 1] if j > 0 else 0.0
            basis[2, j] = (before - basis[2, j]) * scale
    for j in range(degree, -1, -1):
        before = basis[1, j - 1] if j > 0 else 0.0
        basis[1, j] = (before - basis[1, j]) * scale
    return cell


@njit(**LEAF)
def _look(head, coefficients, p, basis, out):
    """Value, gradient and second derivatives of a spline at a position p (3,), into out (10,)."""
    x0, x1, x2 = p[0] - head[9], p[1] - head[10], p[2] - head[11]
    first, beyond = 0, False
    for k in range(3):
        x = head[3 * k] * x0 + head[3 * k + 1] * x1 + head[3 * k + 2] * x2
        at = (x - head[12 + k]) * head[15 + k]
        degree, count = int(head[18 + k]), int(head[21 + k])
        cell = basis_at(degree, at, count, head[15 + k], basis[k])
        beyond = beyond or (degree > 0 and (at < 0.0 or at > count - degree))
        first = first * count + cell
    for i in range(_LOOK):
        out[i] = 0.0
    n1, n2, n3 = int(head[18]) + 1, int(head[19]) + 1, int(head[20]) + 1
    c2, c3 = int(head[22]), int(head[23])
    for i in range(n1):
        for j in range(n2):
            # sums along the last coordinate, with no, one and two derivatives
            s0, s1, s2 = 0.0, 0.0, 0.0
            row = first + (i * c2 + j) * c3
            for k in range(n3):
                value = coefficients[row + k]
                s0 += value * basis[2, 0, k]
                s1 += value * basis[2, 1, k]
                s2 += value * basis[2, 2, k]
            a0, a1, a2 = basis[0, 0, i], basis[0, 1, i], basis[0, 2, i]
            b0, b1, b2 = basis[1, 0, j], basis[1, 1, j], basis[1, 2, j]
            out[0] += a0 * b0 * s0
            out[1] += a1 * b0 * s0
            out[2] += a0 * b1 * s0
            out[3] += a0 * b0 * s1
            out[4] += a2 * b0 * s0
            out[5] += a1 * b1 * s0
            out[6] += a1 * b0 * s1
            out[7] += a0 * b2 * s0
            out[8] += a0 * b1 * s1
            out[9] += a0 * b0 * s2
    if beyond:
        _continue(head, x0, x1, x2, out)


@njit(**LEAF)
def _continue(head, x0, x1, x2, out):
    """From the border of the domain on along its slopes there, first derivatives included."""
    bent = out[4], out[5], out[6], out[7], out[8], out[9]
    value, g0, g1, g2 = out[0], out[1], out[2], out[3]
    for k in range(3):
        if head[18 + k] == 0.0:
            continue
        x = head[3 * k] * x0 + head[3 * k + 1] * x1 + head[3 * k + 2] * x2 - head[12 + k]
        far = x - min(max(x, 0.0), (head[21 + k] - head[18 + k]) / head[15 + k])
        if far == 0.0:
            continue
        value += out[1 + k] * far
        if k == 0:
            g1 += bent[1] * far
            g2 += bent[2] * far
            out[4] = 0.0
        elif k == 1:
            g0 += bent[1] * far
            g2 += bent[4] * far
            out[7] = 0.0
        else:
            g0 += bent[2] * far
            g1 += bent[4] * far
            out[9] = 0.0
    out[0], out[1], out[2], out[3] = value, g0, g1, g2


@njit(**COMPILE)
def _looks(numbers, positions, out):
    basis = np.empty((3, 3, ORDER))
    for n in range(positions.shape[0]):
        _look(numbers[:HEAD], numbers[HEAD:], positions[n], basis, out[n])


@njit(**LEAF)
def _value_and_gradient(row, frame, look, y, gradient):
    """The value r of one row's numbers, and ∂r/∂y into gradient (12,).  frame (9,), look (10,):
    of its spline, if it has one.
    """
    value = row[0]
    for i in range(FEATURES):
        value += row[1 + i] * y[i]
        gradient[i] = row[1 + i]
    if row[1 + FEATURES] < 0.0:
        return value
    a, factor, at = int(row[2 + FEATURES]), row[3 + FEATURES], 4 + FEATURES
    for i in range(FEATURES):
        factor += row[at + i] * y[i]
        gradient[i] += row[at + i] * look[1 + a]
    g0, g1, g2 = look[1], look[2], look[3]
    if a == 0:
        g0, g1, g2 = look[4], look[5], look[6]
    elif a == 1:
        g0, g1, g2 = look[5], look[7], look[8]
    elif a == 2:
        g0, g1, g2 = look[6], look[8], look[9]
    for i in range(3):
        gradient[i] += factor * (g0 * frame[i] + g1 * frame[3 + i] + g2 * frame[6 + i])
    return value + factor * look[1 + a]


def _write(
    origins, axes, prismatic, base, tool, data, q, room, residuals, jacobians, dof, rows, count
):
    chain, lanes = chain_at(origins, axes, prismatic, base, tool, dof), lanes_at(room, dof)
    rest = room + 8 * (TOOL_WORDS + JOINT_WORDS * dof)
    y = carray(floats(rest), (FEATURES,))
    gradient = carray(floats(rest + 8 * FEATURES), (FEATURES,))
    rest += 16 * FEATURES
    geometric = carray(floats(rest), (6, dof))
    rest += 48 * dof
    basis = carray(floats(rest), (3, 3, ORDER))
    splines = int64(carray(floats(data), (1,))[0])
    looks = carray(floats(rest + 8 * _BASIS), (splines, _LOOK))
    places = carray(floats(data + 8), (splines,))
    values = carray(floats(residuals), (count, rows))
    poses_of(chain, carray(floats(q), (count, dof)), lanes)
    for n in range(count):
        posture = posture_in(lanes, n)
        for i in range(3):
            y[i] = posture.position[i]
            for k in range(3):
                y[3 + 3 * k + i] = posture.rotation[i, k]
        if jacobians != 0:
            geometric_jacobian(chain.prismatic, posture, geometric)
        for k in range(splines):
            place = data + 8 * int64(places[k])
            head = carray(floats(place), (HEAD,))
            size = int64(head[21]) * int64(head[22]) * int64(head[23])
            _look(head, carray(floats(place + 8 * HEAD), (size,)), y, basis, looks[k])
        for m in range(rows):
            row = carray(floats(data + 8 * (1 + splines + _ROW * m)), (_ROW,))
            which = max(int64(row[1 + FEATURES]), 0)
            frame = carray(floats(data + 8 * int64(places[which])), (9,))
            values[n, m] = _value_and_gradient(row, frame, looks[which], y, gradient)
            if jacobians != 0:
                slopes = carray(floats(jacobians + 8 * dof * (rows * n + m)), (dof,))
                into_joints(gradient, y, geometric, slopes)
    return 0


@cache
def _compiled() -> Any:
    return c_function(_write, LINEARISE_WORDS)
