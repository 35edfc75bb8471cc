"""Queries of the pipeline's arm among random shapes of every kind, and among thin plates."""

import itertools
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.arm_source import ArmSource, opened
from constraint_geodesics.benchmark.problem_files import Problem
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud, Points
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.preparation import free_configurations
from constraint_geodesics.text_files import write_text

AWAY_M, HIGH_M = (0.3, 0.8), (0.05, 0.9)
"""Where the middles of shapes lie: from the base's axis, and above the table."""
PLATE_M, PLATES_M = 0.004, (0.15, 0.5)
"""Thickness of a plate, and its length and width."""
POINTS, POINT_M = 100, 0.015
"""Points of a cloud, and the radius of their balls."""
DRAWN = 8
"""Configurations drawn for each end that is needed, at most."""

Place = tuple[float, float, float]
Maker = Callable[[str, Placement, float, np.random.Generator, Path], Shape]


@dataclass(frozen=True)
class Kind:
    """A kind of scene: how many shapes, about how large their halves are [m], none for plates."""

    name: str
    shapes: int
    half_m: tuple[float, float] | None


KINDS = (
    Kind("10 shapes", 10, (0.05, 0.12)),
    Kind("100 shapes", 100, (0.015, 0.05)),
    Kind("12 thin plates", 12, None),
)


def _box(name: str, at: Placement, half_m: float, rng: np.random.Generator, _: Path) -> Shape:
    x, y, z = (2.0 * half_m * rng.uniform(0.4, 1.0, 3)).tolist()
    return Box(name, at.position_m, (x, y, z), rpy_rad=at.rpy_rad)


def _sphere(name: str, at: Placement, half_m: float, rng: np.random.Generator, _: Path) -> Shape:
    return Sphere(name, at.position_m, half_m * float(rng.uniform(0.5, 1.0)))


def _capsule(name: str, at: Placement, half_m: float, rng: np.random.Generator, _: Path) -> Shape:
    along, radius = 0.7 * half_m * at.turn[:, 2], half_m * float(rng.uniform(0.2, 0.5))
    first, last = (np.add(at.position_m, sign * along).tolist() for sign in (-1.0, 1.0))
    return Capsule(name, (first[0], first[1], first[2]), (last[0], last[1], last[2]), radius)


def _cylinder(name: str, at: Placement, half_m: float, rng: np.random.Generator, _: Path) -> Shape:
    length, radius = (half_m * rng.uniform((1.0, 0.3), (2.0, 0.8))).tolist()
    return Cylinder(name, at, length, radius)


def _mesh(name: str, at: Placement, half_m: float, _: np.random.Generator, file: Path) -> Shape:
    return Mesh(name, file, at, scale=round(half_m, 2))  # a size is divided into parts once


def _cloud(name: str, at: Placement, half_m: float, rng: np.random.Generator, _: Path) -> Shape:
    """Of a ball's surface, as seen from all sides."""
    out = rng.normal(size=(POINTS, 3))
    seen = (half_m - POINT_M) * out / np.linalg.norm(out, axis=1, keepdims=True)
    return PointCloud(name, Points(seen), POINT_M, at)


MAKERS: dict[str, Maker] = {
    "box": _box,
    "sphere": _sphere,
    "capsule": _capsule,
    "cylinder": _cylinder,
    "mesh": _mesh,
    "point_cloud": _cloud,
}
"""By the kind of the shape that it makes, at any angle, no larger than a ball of twice the half."""


def write_bracket(folder: Path) -> Path:
    """A mesh that is not convex: two plates at a right angle, about their middle, within 1 of it in
    each direction.
    """
    outline = [(-1.0, -1.0), (1.0, -1.0), (1.0, -0.5), (-0.5, -0.5), (-0.5, 1.0), (-1.0, 1.0)]
    corners = [(x, y, z) for z in (-0.6, 0.6) for x, y in outline]
    lids = [(1, 2, 3), (1, 3, 4), (1, 4, 5), (1, 5, 6)]
    faces = [face[::-1] for face in lids]
    faces += [(a + 6, b + 6, c + 6) for a, b, c in lids]
    for a in range(1, 7):
        b = a % 6 + 1
        faces += [(a, b, b + 6), (a, b + 6, a + 6)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a} {b} {c}" for a, b, c in faces]
    file = folder / "bracket.obj"
    write_text(file, "\n".join(lines) + "\n")
    return file


def shapes_of(kind: Kind, rng: np.random.Generator, bracket: Path) -> tuple[Shape, ...]:
    """Random shapes within an arm's reach, the kinds by turns."""
    makers = itertools.cycle(MAKERS.items())
    found = list[Shape]()
    for k in range(kind.shapes):
        at = _placed(rng)
        if kind.half_m is None:
            found.append(_plate(f"plate{k}", at, rng))
            continue
        name, make = next(makers)
        found.append(make(f"{name}{k}", at, float(rng.uniform(*kind.half_m)), rng, bracket))
    return tuple(found)


def _placed(rng: np.random.Generator) -> Placement:
    turn, away, height = rng.uniform(-np.pi, np.pi), rng.uniform(*AWAY_M), rng.uniform(*HIGH_M)
    place = float(away * np.cos(turn)), float(away * np.sin(turn)), float(height)
    roll, pitch, yaw = rng.uniform(-np.pi, np.pi, 3).tolist()
    return Placement(place, (roll, pitch, yaw))


def _plate(name: str, at: Placement, rng: np.random.Generator) -> Box:
    x, y = rng.uniform(*PLATES_M, 2).tolist()
    return Box(name, at.position_m, (x, y, PLATE_M), rpy_rad=at.rpy_rad)


def cluttered(
    arm: ArmSource, constraints: tuple[str, ...], scenes: int, queries: int, seed: int, folder: Path
) -> Iterator[Problem]:
    """So many queries of each kind of scene and constraint, spread over so many scenes: random
    configurations on the constraint that touch nothing; fewer where there is hardly any room.

    folder: where the mesh is written.
    """
    bracket, planner = write_bracket(folder), opened(arm)
    for kind, k in itertools.product(KINDS, range(scenes)):
        rng = np.random.default_rng((seed, zlib.crc32(kind.name.encode()), k))
        empty = planner.bundle.workcell.shapes.values()
        scene = Scene(planner.robot, (*empty, *shapes_of(kind, rng, bracket)))
        count = queries // scenes + (k < queries % scenes)
        with Certifier(scene) as certifier:
            for name in constraints:
                constraint = planner.constraints[name]
                manifold = ConstraintManifold(planner.robot, constraint)
                pairs = _pairs(manifold, certifier, count, rng)
                for j, (start, goal) in enumerate(pairs):
                    # numbers of one scene do not depend on how many have room in another
                    number = k * (queries // scenes + 1) + j
                    ends = start, goal, constraint, name
                    yield Problem(kind.name, number, arm, scene, *ends)


def _pairs(
    manifold: ConstraintManifold, certifier: Certifier, count: int, rng: np.random.Generator
) -> list[tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D"]]]:
    checks, sample = certifier.collisions, manifold.robot.sample
    found = free_configurations(manifold, checks, sample, DRAWN * count, rng)[: 2 * count]
    return list(zip(found[:-1:2], found[1::2], strict=False))
