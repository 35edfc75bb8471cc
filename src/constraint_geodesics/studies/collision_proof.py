"""What the proof of freedom from collision is worth, against PyBullet at a dense row of
configurations: paths that are certified and are not free, free paths that are not certified, and
shapes that a path only just misses.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from typing import Literal

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.dense_check import DENSE_RAD
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.world import World, physics

Kind = Literal["table", "spheres", "boxes", "plates"]
KINDS: tuple[Kind, ...] = ("table", "spheres", "boxes", "plates")
SHAPES = 3
"""Shapes added to a scene."""
ROW_RAD = 0.05
"""Distance of the rows of a straight joint line."""
AWAY_M, HIGH_M = (0.35, 0.75), (0.1, 0.8)
"""Where shapes lie: from the base's axis, and above the table."""
TRIES = 100
"""Pairs of configurations that are drawn for a line at most."""
THIN_M = 0.004
SMALLEST_M, LARGEST_M = 0.005, 0.4
"""Half sizes between which a shape is bisected."""
SLACK_M, BITE_M = 0.001, 0.0005
"""How much smaller a shape is than the one that only just touches, and how much larger."""
_HALVINGS = 14


@dataclass(frozen=True)
class Trial:
    """Paths to be tried in a scene with random shapes: so many straight joint lines between free
    configurations, and these.
    """

    scene: Scene
    robot: str
    kind: Kind
    seed: int
    lines: int
    planned: tuple[Float[np.ndarray, "T D"], ...] = ()


@dataclass(frozen=True)
class Counts:
    """What became of the paths of a kind: how many, how many PyBullet finds free, how many are
    certified, how many wrongly, how many free ones are undecided before PyBullet is asked, and how
    many of those are refused in the end.
    """

    robot: str
    scene: Kind
    path: Literal["line", "planned"]
    paths: int
    free: int
    certified: int
    wrongly_certified: int
    undecided: int
    refused: int


def random_shapes(kind: Kind, rng: np.random.Generator) -> tuple[Shape, ...]:
    """Shapes within reach of an arm, none for a table alone."""
    found: list[Shape] = []
    for k in range(0 if kind == "table" else SHAPES):
        turn, away = rng.uniform(-np.pi, np.pi), rng.uniform(*AWAY_M)
        place = (
            float(away * np.cos(turn)),
            float(away * np.sin(turn)),
            float(rng.uniform(*HIGH_M)),
        )
        if kind == "spheres":
            found.append(Sphere(f"sphere{k}", place, float(rng.uniform(0.03, 0.15))))
            continue
        size = rng.uniform(0.06, 0.3, 3)
        if kind == "plates":
            size[rng.integers(3)] = THIN_M
        x, y, z = map(float, size)
        found.append(Box(f"box{k}", place, (x, y, z)))
    return tuple(found)


def try_scene(trial: Trial) -> list[Counts]:
    """Certify the trial's paths and ask PyBullet about each of them."""
    rng = np.random.default_rng(trial.seed)
    around = Scene(trial.scene.robot, (*trial.scene.workcell, *random_shapes(trial.kind, rng)))
    with around.world() as world, Certifier(around) as certifier:
        lines = list(_lines(world, trial.lines, rng))
        found = [_counted(trial, "line", lines, world, certifier)] if lines else []
        planned = [path for path in trial.planned if world.free(path[[0, -1]]).all()]
        if planned:
            found.append(_counted(trial, "planned", planned, world, certifier))
    return found


def _lines(
    world: World, count: int, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, "T D"]]:
    """Straight joint lines whose ends are free."""
    drawn = (world.robot.sample(2, rng) for _ in range(TRIES * count))
    free = (densify(ends, ROW_RAD) for ends in drawn if world.free(ends).all())
    yield from islice(free, count)


def _counted(
    trial: Trial,
    path: Literal["line", "planned"],
    paths: Sequence[Float[np.ndarray, "T D"]],
    world: World,
    certifier: Certifier,
) -> Counts:
    free = [is_free(world, rows) for rows in paths]
    found = [certifier.collisions.along(np.ascontiguousarray(rows)) for rows in paths]
    certified = [each.violation is None for each in found]
    asked = [each.asked > 0 for each in found]
    pairs = list(zip(free, certified, asked, strict=True))
    return Counts(
        trial.robot,
        trial.kind,
        path,
        len(paths),
        sum(free),
        sum(certified),
        sum(ok and not untouched for untouched, ok, _ in pairs),
        sum(untouched and (late or not ok) for untouched, ok, late in pairs),
        sum(untouched and not ok for untouched, ok, _ in pairs),
    )


def is_free(world: World, rows: Float[np.ndarray, "T D"]) -> bool:
    """PyBullet's word on configurations DENSE_RAD apart."""
    return world.first_collision(densify(rows, DENSE_RAD)) is None


@dataclass(frozen=True)
class Grazed:
    """A path that a shape just touches, and whether it is certified beside one that is smaller by
    SLACK_M, and beside one that is larger by BITE_M; half sizes [m].
    """

    kind: Literal["sphere", "box"]
    critical_m: float
    beside_smaller: bool
    beside_larger: bool


@dataclass(frozen=True)
class Grazing:
    """A path, and where the centre of a shape lies that grows until it touches the moving arm."""

    scene: Scene
    kind: Literal["sphere", "box"]
    rows: Float[np.ndarray, "T D"]
    centre: tuple[float, float, float]


def graze(task: Grazing) -> Grazed | None:
    """Bisect the shape's half size to what PyBullet finds in contact; None where none between the
    smallest and the largest just touches.
    """
    points = densify(task.rows, DENSE_RAD)
    # from the middle of what was last in contact outwards: a contact is met soon
    with task.scene.world() as world:
        low, high = SMALLEST_M, LARGEST_M
        if _touching(world, points, task, low) is not None:
            return None
        last = _touching(world, points, task, high)
        if last is None:
            return None
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            order = np.argsort(np.abs(np.arange(len(points)) - last), kind="stable")
            hit = _touching(world, points[order], task, middle)
            if hit is None:
                low = middle
            else:
                high, last = middle, int(order[hit])
    critical = 0.5 * (low + high)
    return Grazed(
        task.kind,
        critical,
        _is_certified(task, critical - SLACK_M),
        _is_certified(task, critical + BITE_M),
    )


def _shape(task: Grazing, half_m: float) -> Shape:
    if task.kind == "sphere":
        return Sphere("grazed", task.centre, half_m)
    return Box("grazed", task.centre, (2.0 * half_m, 2.0 * half_m, 2.0 * half_m))


def _touching(
    world: World, points: Float[np.ndarray, "n D"], task: Grazing, half_m: float
) -> int | None:
    """The first configuration at which the arm touches the shape."""
    asked = physics(world)
    body = _shape(task, half_m).add_to(asked.bullet)
    try:
        for index, q in enumerate(points):
            asked.bullet.resetJointStatesMultiDof(asked.body, asked.joints, q[:, None].tolist())
            if any(c[8] < 0.0 for c in asked.bullet.getClosestPoints(asked.body, body, 0.0)):
                return index
        return None
    finally:
        asked.bullet.removeBody(body)


def _is_certified(task: Grazing, half_m: float) -> bool:
    scene = Scene(task.scene.robot, (*task.scene.workcell, _shape(task, half_m)))
    with Certifier(scene) as certifier:
        return certifier.collisions.along(np.ascontiguousarray(task.rows)).violation is None


def grazings(
    scene: Scene, paths: Sequence[Float[np.ndarray, "T D"]], count: int, seed: int
) -> list[Grazing]:
    """So many centres near the way of a joint or the tool, spheres and boxes by turns."""
    rng, found = np.random.default_rng(seed), list[Grazing]()
    for k in range(count):
        rows = paths[int(rng.integers(len(paths)))]
        skeleton = scene.robot.skeleton(rows[int(rng.integers(len(rows)))])
        point = skeleton[int(rng.integers(2, len(skeleton)))]
        x, y, z = map(float, point + rng.normal(size=3) * 0.15)
        found.append(Grazing(scene, "box" if k % 2 else "sphere", rows, (x, y, abs(z))))
    return found


def summed(counts: Sequence[Counts]) -> list[Counts]:
    """Over the scenes of a kind, for each robot and kind of path."""
    found: dict[tuple[str, ...], list[Counts]] = {}
    for own in counts:
        found.setdefault((own.robot, own.scene, own.path), []).append(own)
    numbers = [field.name for field in fields(Counts)][3:]
    return [
        replace(own[0], **{name: sum(getattr(each, name) for each in own) for name in numbers})
        for own in found.values()
    ]
