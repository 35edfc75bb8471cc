"""The benchmark's queries: random pairs in the workcell, and pairs with a sphere on the way between
them.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.runner import KEEP_OUT, TABLE, Case
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.dataset import DatasetError, draw_queries
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere

Plan = Callable[[Float[np.ndarray, "D"], Float[np.ndarray, "D"]], Float[np.ndarray, "T D"]]
"""The shortest path without obstacles that is known (T, D) [rad], or (0, D)."""
DRAWN = 8
"""Pairs drawn for each query with a sphere: where the tool hardly moves, or an end touches it,
there is no place.
"""


def draw_cases(
    scene: Scene,
    manifold: ConstraintManifold,
    constraint: str,
    count: int,
    radius_m: float,
    plan: Plan,
    seed: int,
) -> list[Case]:
    """`count` queries in the workcell alone, then as many with a sphere centred on the tool halfway
    along the path that `plan` finds without it.

    A pair is used for a sphere if a path exists, neither end touches the sphere, and the path does.
    Raises DatasetError if too few pairs leave room for it.
    """
    drawn = draw_queries(scene, manifold, constraint, (1 + DRAWN) * count, seed)
    cases = [Case(constraint, TABLE, k, drawn.starts[k], drawn.goals[k]) for k in range(count)]
    for start, goal in zip(drawn.starts[count:], drawn.goals[count:], strict=True):
        if len(cases) == 2 * count:
            break
        ball = _on_the_way(scene, start, goal, radius_m, plan)
        if ball is not None:
            cases.append(Case(constraint, KEEP_OUT, len(cases), start, goal, ball))
    if len(cases) < 2 * count:
        found = len(cases) - count
        raise DatasetError(
            f"constraint {constraint!r}: a sphere of {radius_m} m fits on {found} of {count} "
            f"ways only"
        )
    return cases


def _on_the_way(
    scene: Scene,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    radius_m: float,
    plan: Plan,
) -> Sphere | None:
    joints = plan(start, goal)
    if len(joints) < 2:
        return None
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(joints, axis=0), axis=1))])
    half = joints[int(np.searchsorted(way, 0.5 * way[-1]))]
    x, y, z = map(float, scene.robot.forward(half)[0])
    ball = Sphere("keep_out", (x, y, z), radius_m)
    with Scene(scene.robot, (*scene.workcell, ball)).world() as world:
        ends_free = world.is_free(start) and world.is_free(goal)
        return ball if ends_free and world.first_collision(joints) is not None else None
