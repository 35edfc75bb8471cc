"""A constraint given by two functions of the joints: a residual r(q) and its Jacobian.

Both are written in plain Python that numba compiles, `residual(q, out)` with out (m,) and
`jacobian(q, out)` with out (m, D).  The search is compiled once for all constraints of this kind:
it takes the addresses of what is compiled here.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, wraps
from importlib import import_module
from inspect import BoundArguments, signature
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float
from numba import carray, njit

from constraint_geodesics.compiled import COMPILE, LEAF
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintError,
    Series,
    each_drawn,
    each_held,
)
from constraint_geodesics.constraints.kernels import (
    LINEARISE_WORDS,
    ConstraintArrays,
    Rows,
    c_function,
    call,
    floats,
)
from constraint_geodesics.plugs import require_trusted
from constraint_geodesics.robot.kernels import new_posture, pose_of
from constraint_geodesics.robot.kinematics import SerialRobot

Writes = Callable[[np.ndarray, np.ndarray], None]


class RowBound(NamedTuple):
    """What is demanded of one row: |r| ≤ tolerance [unit], "m" or "rad".

    second_derivative: K with |d²r(q + t d)/dt²| ≤ K |d|² for all q within the joint limits [unit
    per rad²]; the certifier's proof between waypoints stands on it.
    """

    name: str
    unit: str
    second_derivative: float
    tolerance: float = 0.0


class Origin(NamedTuple):
    """The factory `module:function` that made a constraint for a robot, its arguments as JSON."""

    factory: str
    arguments: str
    robot: SerialRobot


@dataclass(frozen=True, eq=False)
class FunctionsConstraint(Constraint):
    """Two functions of the joints and what is demanded of each row.

    origin: how a factory made it, if one did.  is_named: whether a file named that: then it is the
    same as all that are made so, else its functions say which it is.

    Raises ConstraintError for a row without a name, of another unit, or whose numbers are negative
    or not finite.
    """

    kind: ClassVar[str] = "functions"
    residual: Writes
    jacobian: Writes
    bounds: tuple[RowBound, ...]
    origin: Origin | None = None
    is_named: bool = False

    def __post_init__(self) -> None:
        if not self.bounds:
            raise ConstraintError("bounds = (): one is needed for each row of the residual")
        for i, bound in enumerate(self.bounds):
            if not bound.name or bound.unit not in ("m", "rad"):
                raise ConstraintError(f"bounds[{i}] = {bound}: a name and m or rad are needed")
            for name in ("tolerance", "second_derivative"):
                value = getattr(bound, name)
                if not (math.isfinite(value) and value >= 0.0):
                    raise ConstraintError(
                        f"bounds[{i}].{name} = {value}: must be finite and not negative"
                    )

    def __reduce__(self) -> Any:
        if self.origin is None:
            return FunctionsConstraint, (self.residual, self.jacobian, self.bounds)
        return _made_again, (self.origin, self.bounds)

    @property
    def rows(self) -> Rows:
        """Every row is held, each by itself."""
        return each_held(self.bounds)

    @property
    def units(self) -> tuple[str, ...]:
        """As the bounds say."""
        return tuple(bound.unit for bound in self.bounds)

    def arrays(self, robot: SerialRobot) -> ConstraintArrays:
        """For the kernels."""
        return ConstraintArrays(self.rows, np.empty(0), self._function().address, 0, 0)

    def compile(self) -> None:
        """Both functions, once."""
        self._function()

    def values(self, q: Float[np.ndarray, "n D"]) -> Float[np.ndarray, "n m"]:
        """The residuals of configurations."""
        address = self._function().address
        out = np.empty((len(q), len(self.bounds)))
        values_batch(address, np.require(q, np.float64, ("C", "W")), out)
        return out

    def _function(self) -> Any:
        return _compiled(self.residual, self.jacobian, len(self.bounds))

    def loosened(self, least: Mapping[str, float]) -> "FunctionsConstraint":
        """The same with every tolerance at least that of its row's unit."""
        return self._with([max(bound.tolerance, least[bound.unit]) for bound in self.bounds])

    def _with(self, tolerances: Sequence[float]) -> "FunctionsConstraint":
        pairs = zip(self.bounds, tolerances, strict=True)
        return replace(self, bounds=tuple(b._replace(tolerance=float(t)) for b, t in pairs))

    @property
    def label(self) -> str:
        """Its rows."""
        return f"the constraint on {' and '.join(bound.name for bound in self.bounds)}"

    @property
    def key(self) -> tuple:
        """Factory and arguments, or the functions; and the bounds."""
        own = (self.residual, self.jacobian)
        made = self.origin[:2] if self.is_named and self.origin is not None else own
        return (self.kind, *made, self.bounds)

    def series(self, residual: Float[np.ndarray, "n m"]) -> list[Series]:
        """Each row by itself, in mm or degrees."""
        return each_drawn(self.bounds, residual)

    def to_json(self) -> dict[str, Any]:
        """Factory, arguments and tolerances; ConstraintError for functions without a factory."""
        if self.origin is None:
            raise ConstraintError(
                f"{self.label} was not made by a factory of a module, so that it can't be "
                f"written: see constraints.functions.constraint_factory"
            )
        return {
            "kind": self.kind,
            "factory": self.origin.factory,
            "arguments": json.loads(self.origin.arguments),
            "tolerance": [bound.tolerance for bound in self.bounds],
        }

    @classmethod
    def from_json(cls, about: Mapping[str, Any], robot: SerialRobot | None) -> Constraint:
        """What `to_json` wrote, for a robot.  Raises ConstraintError for a factory in a module
        that nobody has imported: a file's word is no reason to run it.
        """
        if robot is None:
            raise ConstraintError(f"{about['factory']} can't be called without a robot")
        try:
            require_trusted(str(about["factory"]).partition(":")[0])
        except ImportError as error:
            raise ConstraintError(f"factory = {about['factory']!r}: {error}") from None
        return made_by(about["factory"], about["arguments"], robot)._with(about["tolerance"])

    @classmethod
    def from_params(cls, params: Any, robot: SerialRobot) -> Constraint:
        """What the entry's factory makes."""
        return made_by(params.factory, params.arguments, robot)


KIND = FunctionsConstraint


def constraint_factory(
    function: Callable[..., FunctionsConstraint],
) -> Callable[..., FunctionsConstraint]:
    """Mark a function (robot, **arguments) → FunctionsConstraint that files may name: no other is
    called, whatever a file says.

    What it makes knows how it was made, so that its paths can be saved, and worker processes make
    it again: where it is a function of a module that can be imported, and its arguments are
    numbers, texts, lists or arrays.  Make it once: each call is a constraint of its own, with a
    roadmap of its own.  What files name is one for the same arguments, and must not hang on more.
    """
    can_be_found = function.__module__ != "__main__" and function.__qualname__.isidentifier()
    called = signature(function)

    @wraps(function)
    def making(*given: Any, **named: Any) -> FunctionsConstraint:
        made, whole = function(*given, **named), called.bind(*given, **named)
        said = _said(whole)
        if said is None or not can_be_found:
            return made
        factory, robot = f"{function.__module__}:{function.__qualname__}", whole.args[0]
        return replace(made, origin=Origin(factory, said, robot), is_named=False)

    function.__dict__["makes_constraints"] = making.__dict__["makes_constraints"] = True
    return making


def _said(called: BoundArguments) -> str | None:
    """The arguments of a call but the first, by name, as JSON; None where that can't hold them."""
    _, *others = called.signature.parameters.values()
    found = dict[str, Any]()
    for parameter in others:
        if parameter.name not in called.arguments:
            continue
        value = called.arguments[parameter.name]
        if parameter.kind in (parameter.POSITIONAL_ONLY, parameter.VAR_POSITIONAL):
            return None  # nobody can name them
        found |= value if parameter.kind is parameter.VAR_KEYWORD else {parameter.name: value}
    try:
        said = json.dumps(found, sort_keys=True, default=_listed)
    except (TypeError, ValueError):
        return None
    return said if _has_texts(found) else None


def _has_texts(value: Any) -> bool:
    """Whether all keys of dictionaries in it are texts, as JSON's are."""
    if isinstance(value, dict):
        return all(isinstance(key, str) and _has_texts(own) for key, own in value.items())
    return not isinstance(value, list | tuple) or all(map(_has_texts, value))


def _listed(value: Any) -> Any:
    """For JSON."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__}: is nothing that JSON holds")


def made_by(factory: str, arguments: Mapping[str, Any], robot: SerialRobot) -> FunctionsConstraint:
    """The constraint that a factory `module:function` makes.

    Raises ConstraintError if there is none, it is not marked, or the arguments are not its own.
    """
    module, _, name = factory.partition(":")
    try:
        function = getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise ConstraintError(f"factory = {factory!r}: can't be imported: {error}") from None
    if not getattr(function, "makes_constraints", False):
        raise ConstraintError(f"factory = {factory!r}: is no constraint_factory")
    try:
        made: FunctionsConstraint = function(robot, **arguments)
        said = json.dumps(arguments, sort_keys=True, default=_listed)
    except TypeError as error:
        raise ConstraintError(f"factory = {factory!r}: {error}") from None
    return replace(made, origin=Origin(factory, said, robot), is_named=True)


def _made_again(origin: Origin, bounds: tuple[RowBound, ...]) -> FunctionsConstraint:
    made = made_by(origin.factory, json.loads(origin.arguments), origin.robot)
    return replace(made, bounds=bounds)


@cache
def _compiled(residual: Writes, jacobian: Writes, count: int) -> Any:
    """Both functions as a C function for the search; kept, since the search holds its address."""
    options = {key: value for key, value in COMPILE.items() if key != "cache"}
    own_residual, own_jacobian = njit(**options)(residual), njit(**options)(jacobian)

    def write(origins, axes, prismatic, base, tool, data, q, room, values, slopes, dof, rows, many):
        for n in range(many):
            place = carray(floats(q + 8 * dof * n), (dof,))
            own_residual(place, carray(floats(values + 8 * count * n), (count,)))
            if slopes != 0:
                slope = carray(floats(slopes + 8 * count * dof * n), (count, dof))
                own_jacobian(place, slope)
        return 0

    return c_function(write, LINEARISE_WORDS, cache=False)


@njit(**LEAF)
def values_batch(address, q, out):
    """Residuals (B, m) of q (B, D), by the C function at an address."""
    places, values, (count, dof) = q.ctypes.data, out.ctypes.data, q.shape
    if count:
        call(address, (0, 0, 0, 0, 0, 0, places, 0, values, 0, dof, out.shape[1], count))


@constraint_factory
def tip_on_sphere(
    robot: SerialRobot, centre_m: Sequence[float], radius_m: float, tolerance_m: float = 0.0
) -> FunctionsConstraint:
    """The tool's tip keeps to the surface of a sphere, as when a bowl is wiped.

    With v = p(q) − c: r = (|v|² − R²) / 2R, which is the distance to the surface to first order.
    Along q + t d: r″ = (|v′|² + v·v″) / R.  Let g_j bound |∂p/∂q_j|: the length of the chain behind
    joint j, or 1 for a prismatic one.  For i ≤ j ∂²p/∂q_i∂q_j = a_i × ∂p/∂q_j, or 0 for a prismatic
    i, so that it is at most G_ij = g_j.  Hence |v′| ≤ |g||d| and |v″| ≤ λ_max(G) |d|², and with V,
    the largest |v|, K = (|g|² + V λ_max(G)) / R.
    """
    centre, radius = np.array(centre_m, float), float(radius_m)
    if centre.shape != (3,) or not np.isfinite(centre).all() or not 0.0 < radius < math.inf:
        raise ConstraintError(
            f"centre_m = {centre_m}, radius_m = {radius_m}: 3 finite numbers and a positive one"
        )
    chain = robot.chain
    prismatic, dof = chain.prismatic, robot.dof

    def residual(q: np.ndarray, out: np.ndarray) -> None:
        posture = new_posture(q.shape[0])
        pose_of(chain, q, posture)
        v = posture.position - centre
        out[0] = 0.5 * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2] - radius * radius) / radius

    def jacobian(q: np.ndarray, out: np.ndarray) -> None:
        posture = new_posture(q.shape[0])
        pose_of(chain, q, posture)
        v = posture.position - centre
        for j in range(dof):
            a, arm = posture.axes[j], posture.position - posture.origins[j]
            x, y, z = a[0], a[1], a[2]
            if not prismatic[j]:
                x, y, z = (
                    a[1] * arm[2] - a[2] * arm[1],
                    a[2] * arm[0] - a[0] * arm[2],
                    a[0] * arm[1] - a[1] * arm[0],
                )
            out[0, j] = (v[0] * x + v[1] * y + v[2] * z) / radius

    bound = _sphere_bound(robot, centre, radius)
    row = RowBound("distance to the sphere", "m", bound, tolerance_m)
    return FunctionsConstraint(residual, jacobian, (row,))


def _sphere_bound(robot: SerialRobot, centre: np.ndarray, radius: float) -> float:
    """K of `tip_on_sphere` [m/rad²]."""
    chain = robot.chain
    frames = np.concatenate([chain.origins[1:], chain.tool[None]])
    strokes = chain.prismatic * np.maximum(abs(robot.lower), abs(robot.upper))
    behind = np.cumsum((np.linalg.norm(frames[:, :3, 3], axis=1) + strokes)[::-1])[::-1]
    g = np.where(chain.prismatic, 1.0, behind)
    index = np.arange(robot.dof)
    second = g[np.maximum(index[:, None], index)]
    second[chain.prismatic[np.minimum(index[:, None], index)]] = 0.0
    first = (chain.base @ chain.origins[0])[:3, 3]
    farthest = np.linalg.norm(first - centre) + behind[0]
    return float((g @ g + farthest * np.linalg.eigvalsh(second)[-1]) / radius)
