"""The benchmark's queries: random pairs in the workcell, and pairs with a sphere between them.

They are drawn once and kept in git (data/benchmark_queries/), so that they hang on nothing trained;
`make draw-queries` draws them again.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.dataset import DatasetError, draw_queries
from constraint_geodesics.params import BenchmarkParams
from constraint_geodesics.problem import PathPlanner, PlanningProblem
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.text_files import written

TABLE, KEEP_OUT = "table", "keep_out"
"""Scenes: the workcell of params.yaml, and the same with a sphere between the ends."""
SPHERE = ("sphere_x", "sphere_y", "sphere_z", "sphere_radius")
DRAWN = 8
"""Pairs drawn for each query with a sphere: where the tool hardly moves, or an end touches it,
there is no place.
"""

Plan = Callable[[Float[np.ndarray, "D"], Float[np.ndarray, "D"]], Float[np.ndarray, "T D"]]
"""The shortest path without obstacles that is known (T, D) [rad], or (0, D)."""


class QueryError(ValueError):
    """A constraint has no queries; the message is one line with its file."""


@dataclass(frozen=True)
class Query:
    """Two ends [rad] and the scene they stand in, with the sphere to keep out of, if any."""

    constraint: str
    scene: str
    number: int
    start: Float[np.ndarray, "D"]
    goal: Float[np.ndarray, "D"]
    obstacle: Sphere | None = None

    def in_scene(self, scene: Scene) -> Scene:
        """The workcell with this query's obstacle."""
        if self.obstacle is None:
            return scene
        return scene.adding(self.obstacle)


def write_queries(queries: Sequence[Query], file: Path) -> None:
    """One row a query: scene, the ends [rad], and centre and radius of the sphere [m], blank where
    there is none.
    """
    rows = []
    for query in queries:
        ball = query.obstacle
        place = ("", "", "", "") if ball is None else (*ball.centre_m, ball.radius_m)
        rows.append(
            {"constraint": query.constraint, "scene": query.scene, "query": query.number}
            | {f"start_{k + 1}": value for k, value in enumerate(query.start)}
            | {f"goal_{k + 1}": value for k, value in enumerate(query.goal)}
            | dict(zip(SPHERE, place, strict=True))
        )
    with written(file) as part:
        pd.DataFrame(rows).to_csv(part, index=False)


def read_queries(file: Path) -> list[Query]:
    """Read what `write_queries` wrote.  Raises QueryError if there is no such file."""
    if not file.is_file():
        command = f"make draw-queries CONSTRAINT={file.stem}"
        raise QueryError(f"{file}: missing, the constraint's queries: `{command}` draws them")
    frame = pd.read_csv(file, float_precision="round_trip")
    starts, goals = (frame.filter(regex=f"^{end}_").to_numpy() for end in ("start", "goal"))
    spheres = frame[list(SPHERE)].to_numpy()
    return [
        Query(
            str(row["constraint"]), str(row["scene"]), int(row["query"]), start, goal, _ball(sphere)
        )
        for row, start, goal, sphere in zip(
            frame.to_dict("records"), starts, goals, spheres, strict=True
        )
    ]


def _ball(sphere: Float[np.ndarray, "4"]) -> Sphere | None:
    x, y, z, radius = map(float, sphere)
    return None if np.isnan(radius) else Sphere(KEEP_OUT, (x, y, z), radius)


def draw_benchmark(
    scene: Scene,
    manifold: ConstraintManifold,
    constraint: str,
    settings: BenchmarkParams,
    plan: Plan,
) -> list[Query]:
    """So many queries in the workcell alone, then as many with a sphere centred on the tool halfway
    along the path that `plan` finds without it.

    A pair is used for a sphere if a path exists, neither end touches the sphere, and the path does.
    Raises DatasetError if too few pairs leave room for it.
    """
    count, radius_m = settings.queries, settings.radius_m
    drawn = draw_queries(scene, manifold, constraint, (1 + DRAWN) * count, settings.seed)
    found = [Query(constraint, TABLE, k, drawn.starts[k], drawn.goals[k]) for k in range(count)]
    for start, goal in zip(drawn.starts[count:], drawn.goals[count:], strict=True):
        if len(found) == 2 * count:
            break
        ball = _between(scene, plan(start, goal), radius_m)
        if ball is not None:
            found.append(Query(constraint, KEEP_OUT, len(found), start, goal, ball))
    if len(found) < 2 * count:
        raise DatasetError(
            f"constraint {constraint!r}: a sphere of {radius_m} m fits on "
            f"{len(found) - count} of {count} paths only"
        )
    return found


def _between(scene: Scene, joints: Float[np.ndarray, "T D"], radius_m: float) -> Sphere | None:
    if len(joints) < 2:
        return None
    passed = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))])
    half = joints[int(np.searchsorted(passed, 0.5 * passed[-1]))]
    x, y, z = map(float, scene.robot.forward(half)[0])
    ball = Sphere(KEEP_OUT, (x, y, z), radius_m)
    with scene.adding(ball).world() as world:
        ends_free = world.is_free(joints[0]) and world.is_free(joints[-1])
        return ball if ends_free and world.first_collision(joints) is not None else None


def shortest_of(
    planners: Mapping[str, PathPlanner], problem: PlanningProblem, certifier: Certifier
) -> Float[np.ndarray, "T D"]:
    """The shortest certified path (T, D) [rad] that any of these planners finds, or (0, D)."""
    shortest, length = np.empty((0, len(problem.start))), np.inf
    for planner in planners.values():
        joints = planner.plan(problem, 0).joints
        if len(joints) < 2:
            continue
        found = certifier.certify(joints, problem.manifold.constraint, problem.start, problem.goal)
        if found.valid and found.length_rad < length:
            shortest, length = joints, found.length_rad
    return shortest
