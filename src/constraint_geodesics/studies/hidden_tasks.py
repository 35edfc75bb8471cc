"""Tasks whose formula identification is not told, and demonstrations of them, labelled free of
collision by PyBullet.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.constraints.functions import FunctionsConstraint, RowBound
from constraint_geodesics.constraints.polynomial import PolynomialConstraint, Relation
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.robot.kernels import new_posture, pose_of
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.scene import Scene

CENTRE, RADIUS = np.array([0.42, 0.0, -0.05]), 0.25
HINGE, REACH, HEIGHT = np.array([0.55, 0.35, 0.0]), 0.35, 0.3
HOLE, HOLE_M = CENTRE + RADIUS * np.array([-0.09, 0.44, 0.893]), 0.04
"""A place on the bowl, and what is left out around it."""
HOSE, HOSE_M, LINK = np.array([0.25, 0.25, 0.55]), 0.4, 3
LEAN_RAD = float(np.radians(10.0))
"""How far a cup may lean, of the task with a tolerance."""
TORUS_M, TUBE_M, TORUS_HEIGHT = 0.38, 0.12, 0.3
ROWS, STEP_RAD, APART_RAD = 60, 0.3, (0.4, 2.5)
"""Rows of a demonstration, their largest step, and how far apart its ends are."""
KNOTS = 8
"""Leanings that a demonstration goes through, where it may lean."""
SMOOTH_ROWS = 5
"""Over which a person's error changes."""
Rows = Float[np.ndarray, "n D"]


@dataclass(frozen=True, eq=False)
class HiddenTask:
    """hidden: the formula.  shown: of configurations that keep to it, which a demonstration may
    hold.  branch_rad: how far from one configuration all are, where there are several branches.
    made_for: whether a family of features was made for it.  loosely_rad: how far off LEVEL what is
    shown may be, where that much is allowed.
    """

    name: str
    hidden: Callable[[SerialRobot], Constraint]
    shown: Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]], Bool[np.ndarray, "n"]]
    branch_rad: float = np.inf
    made_for: bool = True
    loosely_rad: float = 0.0
    off: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    _made: dict[str, ConstraintManifold] = field(default_factory=dict)
    _centres: dict[str, np.ndarray] = field(default_factory=dict)

    def manifold(self, robot: SerialRobot) -> ConstraintManifold:
        """The hidden set."""
        if robot.name not in self._made:
            self._made[robot.name] = ConstraintManifold(robot, self.hidden(robot))
        return self._made[robot.name]

    def centre(self, robot: SerialRobot) -> Float[np.ndarray, "D"]:
        """The configuration with the most others nearby, in the branch that is shown."""
        if robot.name not in self._centres:
            q = self._kept(robot, robot.sample(12_000, np.random.default_rng(5)))[:1500]
            near = np.linalg.norm(q[:, None] - q[None], axis=2) < self.branch_rad
            self._centres[robot.name] = q[np.argmax(near.sum(axis=1))]
        return self._centres[robot.name]

    def around(self, robot: SerialRobot) -> ConstraintManifold:
        """What configurations are drawn on or, where a tolerance is allowed, around."""
        if not self.loosely_rad:
            return self.manifold(robot)
        return ConstraintManifold(robot, PolynomialConstraint(LEVEL))

    def missed(self, robot: SerialRobot, q: Rows) -> tuple[np.ndarray, np.ndarray]:
        """By how much configurations miss it, in degrees and mm."""
        if self.off is not None:
            return self.off(*robot.forward(q))
        hidden = self.manifold(robot)
        off, units = hidden.residual(q), np.array(hidden.constraint.units)
        turned, moved = (np.linalg.norm(off[:, units == unit], axis=1) for unit in ("rad", "m"))
        return np.degrees(turned), 1e3 * moved

    def draw(self, scene: Scene, count: int, seed: int) -> Rows:
        """Configurations that keep to it, within the limits and free of collision."""
        robot, rng = scene.robot, np.random.default_rng(seed)
        found: list[np.ndarray] = []
        centre = self.centre(robot) if np.isfinite(self.branch_rad) else None
        with scene.world() as world:
            while sum(map(len, found)) < count:
                if centre is None:
                    drawn = robot.sample(4000, rng)
                else:
                    spread = self.branch_rad * rng.uniform(-1.0, 1.0, (4000, robot.dof))
                    drawn = centre + spread
                q = self._kept(robot, drawn)
                if centre is not None:
                    q = q[np.abs(q - centre).max(axis=1) < self.branch_rad]
                labels = world.label(q)
                found.append(q[~(labels.self_collision | labels.workcell_collision)])
        return np.concatenate(found)[:count]

    def _kept(self, robot: SerialRobot, drawn: Rows) -> Rows:
        projected = retract(self.around(robot), drawn)
        q = projected.joints[projected.converged]
        if self.loosely_rad:
            q = self._leaning(robot, q, _in_disc(len(q), np.random.default_rng(len(q))))
        q = q[robot.limit_distance(q) > 0.0]
        return q[self.shown(*robot.forward(q))]

    def _leaning(self, robot: SerialRobot, q: Rows, tilts: Float[np.ndarray, "n 2"]) -> Rows:
        """Configurations that are off LEVEL by shares of what is allowed."""
        for _ in range(2):
            off, slopes = self.around(robot).linearise(q)
            wanted = np.sin(self.loosely_rad) * tilts - off
            q = q + (np.linalg.pinv(slopes) @ wanted[:, :, None])[:, :, 0]
        return q

    def demonstrate(self, scene: Scene, count: int, error_deg: float, seed: int) -> list[Rows]:
        """Motions of ROWS rows between such configurations, with a person's smooth error."""
        robot, rng = scene.robot, np.random.default_rng(seed)
        ends, found = self.draw(scene, 60 * count, seed + 1000), list[np.ndarray]()
        with scene.world() as world:
            while len(found) < count:
                first = ends[rng.integers(len(ends))]
                away = np.linalg.norm(ends - first, axis=1)
                near = np.flatnonzero((away > APART_RAD[0]) & (away < APART_RAD[1]))
                if not len(near):
                    continue
                last = ends[near[rng.integers(len(near))]]
                t = np.linspace(0.0, 1.0, ROWS)[:, None]
                way = retract(self.around(robot), first + t * (last - first))
                q = way.joints
                if self.loosely_rad:
                    q = self._leaning(robot, q, _wandering(rng))
                steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
                if not way.converged.all() or steps.max() > STEP_RAD:
                    continue
                inside = robot.limit_distance(q).min() > 0.0
                if not inside or not self.shown(*robot.forward(q)).all():
                    continue
                labels = world.label(q)
                if not (labels.self_collision | labels.workcell_collision).any():
                    found.append(q)
        return [q + _error(q.shape, error_deg, rng) for q in found]


def _in_disc(count: int, rng: np.random.Generator) -> Float[np.ndarray, "n 2"]:
    """Random places of the unit disc."""
    away, angle = np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    return np.stack([away * np.cos(angle), away * np.sin(angle)], axis=1)


def _wandering(rng: np.random.Generator) -> Float[np.ndarray, "T 2"]:
    """ROWS places on a way through random ones of the unit disc."""
    knots, at = _in_disc(KNOTS, rng), np.linspace(0.0, KNOTS - 1.0, ROWS)
    return np.stack([np.interp(at, np.arange(KNOTS), own) for own in knots.T], axis=1)


def _error(shape: tuple[int, ...], degrees: float, rng: np.random.Generator) -> np.ndarray:
    error = gaussian_filter1d(rng.normal(size=shape), SMOOTH_ROWS, axis=0)
    return np.asarray(np.radians(degrees) * error / error.std())


def row(unit: str, constant: float, quadratic=None, **entries: float) -> Relation:  # type: ignore[no-untyped-def]
    """One relation: entries p0 p1 p2, and u11 for the first entry of R e_x and so on."""
    linear = np.zeros(12)
    for name, value in entries.items():
        at = int(name[1]) if name[0] == "p" else 3 * int(name[1]) + int(name[2]) - 1
        linear[at] = value
    return Relation("hidden", unit, constant, linear, quadratic)


def about(centre: np.ndarray, radius: float, flat: bool) -> Relation:
    """The tip at a distance from a point, or from the upright line through it."""
    full, keep = np.zeros((12, 12)), np.diag([1.0, 1.0, 0.0 if flat else 1.0])
    full[:3, :3] = keep / radius
    linear = np.zeros(12)
    linear[:3] = -keep @ centre / radius
    constant = float((centre @ keep @ centre - radius**2) / (2 * radius))
    return Relation("hidden", "m", constant, linear, full)


LEVEL = (row("rad", 0.0, u21=1.0), row("rad", 0.0, u22=1.0))
"""The tool's y axis upright."""
BOWL = tuple(row("m", -float(CENTRE[k]), **{f"p{k}": 1.0, f"u3{k + 1}": RADIUS}) for k in range(3))
"""The tip on a sphere, the tool's z axis towards its centre."""


def _cone(angle: float) -> Relation:
    """The tool's y axis within an angle of straight up."""
    steep, level = np.sin(angle), np.cos(angle)
    own = row("rad", float(-0.5 * (1.0 + level) / steep), u23=float(1.0 / steep))
    return replace(own, tolerance=float(0.5 * (1.0 - level) / steep))


def _polynomial(*relations: Relation) -> Callable[[SerialRobot], Constraint]:
    return lambda _: PolynomialConstraint(relations)


def _by_position(*bounds: RowBound) -> Callable:
    """Residuals that a plain function of posture writes, with differences for their slopes."""

    def made(write: Callable) -> Callable[[SerialRobot], Constraint]:
        def constraint(robot: SerialRobot) -> Constraint:
            from numba import njit

            chain, count, step, own = robot.chain, len(bounds), 1e-6, njit(write)

            def residual(q: np.ndarray, out: np.ndarray) -> None:
                posture = new_posture(q.shape[0])
                pose_of(chain, q, posture)
                own(posture, out)

            compiled = njit(residual)

            def jacobian(q: np.ndarray, out: np.ndarray) -> None:
                there, low, high = q.copy(), np.empty(count), np.empty(count)
                for j in range(q.shape[0]):
                    there[j] = q[j] - step
                    compiled(there, low)
                    there[j] = q[j] + step
                    compiled(there, high)
                    there[j] = q[j]
                    for i in range(count):
                        out[i, j] = (high[i] - low[i]) / (2.0 * step)

            return FunctionsConstraint(residual, jacobian, bounds)

        return constraint

    return made


STEEP = 100.0
"""Bound of second derivatives of these tasks' residuals, generous, not proven: they are references
alone, and paths are judged by the formula at their rows [unit/rad²].
"""


@_by_position(
    *(RowBound(name, unit, STEEP) for name, unit in (("height", "m"), ("u", "rad"), ("v", "rad")))
)
def _wavy(posture, out) -> None:  # type: ignore[no-untyped-def]
    """A surface z = 0.15 + 0.04 sin 12x cos 9y, the tool's z axis along its normal."""
    p, turned = posture.position, posture.rotation
    sx, cx, sy, cy = np.sin(12 * p[0]), np.cos(12 * p[0]), np.sin(9 * p[1]), np.cos(9 * p[1])
    out[0] = p[2] - 0.15 - 0.04 * sx * cy
    out[1] = turned[0, 2] + 0.48 * cx * cy * turned[2, 2]
    out[2] = turned[1, 2] - 0.36 * sx * sy * turned[2, 2]


@_by_position(RowBound("torus", "m", STEEP))
def _torus(posture, out) -> None:  # type: ignore[no-untyped-def]
    """The tip on a torus about the base's axis."""
    p = posture.position
    away = np.sqrt(p[0] * p[0] + p[1] * p[1]) - TORUS_M
    out[0] = np.sqrt(away * away + (p[2] - TORUS_HEIGHT) ** 2) - TUBE_M


@_by_position(
    RowBound("u", "rad", STEEP), RowBound("v", "rad", STEEP), RowBound("away", "rad", STEEP)
)
def _looking_away(posture, out) -> None:  # type: ignore[no-untyped-def]
    """The tool's y axis upright, its z axis in the plane of the base's axis and the tip."""
    p, turned = posture.position, posture.rotation
    out[0], out[1] = turned[0, 1], turned[1, 1]
    away = np.sqrt(p[0] * p[0] + p[1] * p[1]) + 1e-9
    out[2] = (p[0] * turned[1, 2] - p[1] * turned[0, 2]) / away


@_by_position(RowBound("lean", "rad", STEEP))
def _leaning(posture, out) -> None:  # type: ignore[no-untyped-def]
    """The tool's z axis leans from straight down by an angle that grows with the tip's height."""
    down = min(max(-posture.rotation[2, 2], -1.0), 1.0)
    out[0] = np.arccos(down) - 0.6 - 1.5 * (posture.position[2] - 0.3)


@_by_position(RowBound("hose", "m", STEEP))
def _hose(posture, out) -> None:  # type: ignore[no-untyped-def]
    """The elbow at the end of a taut hose."""
    v = posture.origins[LINK] - HOSE
    out[0] = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) - HOSE_M


def _anywhere(p: np.ndarray, _: np.ndarray) -> np.ndarray:
    return np.ones(len(p), dtype=bool)


def _upright(_: np.ndarray, turned: np.ndarray) -> np.ndarray:
    return np.asarray(turned[:, 2, 1] > 0.0)


def _on_top(p: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Within 50° of the bowl's highest place."""
    return np.asarray(p[:, 2] - CENTRE[2] > RADIUS * np.cos(np.radians(50.0)))


def _off_cone(p: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the tool's y axis beyond what it may lean."""
    lean = np.arccos(np.clip(turned[:, 2, 1], -1.0, 1.0))
    return np.degrees(np.maximum(lean - LEAN_RAD, 0.0)), np.zeros(len(p))


def _off_bowl(p: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the tool's z axis from the direction to the centre, and of the tip from the sphere."""
    inward = CENTRE - p
    away = np.linalg.norm(inward, axis=1)
    axis = turned[:, :, 2]
    angle = np.arctan2(np.linalg.norm(np.cross(axis, inward), axis=1), (axis * inward).sum(axis=1))
    return np.degrees(angle), 1e3 * np.abs(away - RADIUS)


def _off_waves(p: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the tool's z axis from the normal into the surface, and of the tip along the normal."""
    x, y = 12.0 * p[:, 0], 9.0 * p[:, 1]
    steep = [-0.48 * np.cos(x) * np.cos(y), 0.36 * np.sin(x) * np.sin(y), np.ones(len(p))]
    normal, axis = np.stack(steep, axis=1), -turned[:, :, 2]
    angle = np.arctan2(np.linalg.norm(np.cross(axis, normal), axis=1), (axis * normal).sum(axis=1))
    height = p[:, 2] - 0.15 - 0.04 * np.sin(x) * np.cos(y)
    return np.degrees(angle), 1e3 * np.abs(height) / np.linalg.norm(normal, axis=1)


def _beside_hole(p: np.ndarray, turned: np.ndarray) -> np.ndarray:
    return _on_top(p, turned) & (np.linalg.norm(p - HOLE, axis=1) > HOLE_M)


def _patch(p: np.ndarray, turned: np.ndarray) -> np.ndarray:
    inside = (p[:, 0] > 0.28) & (p[:, 0] < 0.58) & (np.abs(p[:, 1]) < 0.25)
    return np.asarray(inside & (turned[:, 2, 2] < 0.0))


def _above(p: np.ndarray, _: np.ndarray) -> np.ndarray:
    return np.asarray((p[:, 2] > TORUS_HEIGHT + 0.03) & (p[:, 0] > 0.0))


def _between(p: np.ndarray, _: np.ndarray) -> np.ndarray:
    return np.asarray((p[:, 2] > 0.05) & (p[:, 2] < 0.6))


def _little_tilted(_: np.ndarray, turned: np.ndarray) -> np.ndarray:
    # paths turn at the edge
    return np.asarray(turned[:, 2, 1] > np.cos(LEAN_RAD + 1e-3))


def _door(p: np.ndarray, turned: np.ndarray) -> np.ndarray:
    return _upright(p, turned) & (p[:, 1] < 0.30) & (p[:, 0] > 0.15)


TASKS = {
    task.name: task
    for task in (
        HiddenTask("cup", _polynomial(*LEVEL), _upright),
        HiddenTask("plane", _polynomial(row("m", -0.2, p2=1.0), *LEVEL), _upright),
        HiddenTask("sphere", _polynomial(*BOWL), _on_top, 1.3, off=_off_bowl),
        HiddenTask(
            "door",
            _polynomial(*LEVEL, row("m", -HEIGHT, p2=1.0), about(HINGE, REACH, flat=True)),
            _door,
            1.5,
        ),
        HiddenTask("cylinder", _polynomial(about(HINGE, REACH, flat=True)), _anywhere, 1.5),
        HiddenTask("wavy surface", _wavy, _patch, 1.3, off=_off_waves),
        HiddenTask("hole", _polynomial(*BOWL), _beside_hole, 1.3, off=_off_bowl),
        HiddenTask("hose at the elbow", _hose, _anywhere, 1.5),
        HiddenTask(
            "leaning cup",
            _polynomial(_cone(LEAN_RAD)),
            _little_tilted,
            loosely_rad=LEAN_RAD,
            off=_off_cone,
        ),
        HiddenTask("torus", _torus, _above, 1.3, made_for=False),
        HiddenTask("looking away", _looking_away, _upright, 1.3),
        HiddenTask("leaning with height", _leaning, _between, 1.3, made_for=False),
    )
}
"""All tasks, by name."""
