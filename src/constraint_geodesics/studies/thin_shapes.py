"""Ways among thin plates and rods: of the queries that a sampling planner solves, how many the
planner solves too.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import problem_of
from constraint_geodesics.bundle import Bundle
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.certification.collisions import CollisionCheck
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.peers.birrt import BirrtSettings
from constraint_geodesics.peers.making import until_sound
from constraint_geodesics.peers.ompl import SamplingPlanner
from constraint_geodesics.planner import Planner, limits_of
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import robot_from

SHAPES = 12
"""Plates and rods of a scene, by turns."""
PLATE_M, PLATES_M = 0.004, (0.15, 0.5)
"""Thickness of a plate, and its length and width."""
ROD_M, RODS_M = 0.01, (0.3, 0.8)
"""Thickness of a rod, and its length."""
AWAY_M, HIGH_M = (0.3, 0.75), (0.1, 0.8)
"""Where they lie: from the base's axis, and above the table."""
ITERATIONS, BUDGET_S = 10_000, 120.0
"""Of the sampling planner, for each query: so many that it ends by them, some 5 s."""
DRAWN = 400
"""Configurations that are drawn for a constraint's queries."""


@dataclass(frozen=True)
class Thicket:
    """A scene with random plates and rods, and so many queries of each of some constraints."""

    bundle: Bundle
    constraints: tuple[str, ...]
    queries: int
    seed: int


@dataclass(frozen=True)
class Solved:
    """Queries that were asked, those of them that the sampling planner solves, those of these that
    the planner solves, and those that it solves of all; by the certificate's word.
    """

    asked: int
    sampled: int
    both: int
    planned: int


def plates_and_rods(rng: np.random.Generator) -> dict[str, Box]:
    """Thin boxes within reach of an arm, by their names."""
    found = {}
    for k in range(SHAPES):
        turn, away, height = rng.uniform(-np.pi, np.pi), rng.uniform(*AWAY_M), rng.uniform(*HIGH_M)
        centre = float(away * np.cos(turn)), float(away * np.sin(turn)), float(height)
        size = rng.uniform(*PLATES_M, 3) if k % 2 else np.full(3, ROD_M)
        size[rng.integers(3)] = PLATE_M if k % 2 else rng.uniform(*RODS_M)
        x, y, z = map(float, size)
        found[f"thin{k}"] = Box(f"thin{k}", centre, (x, y, z))
    return found


def try_thicket(task: Thicket) -> Solved:
    """Ask both planners."""
    rng = np.random.default_rng(task.seed)
    shapes = {**task.bundle.workcell.shapes, **plates_and_rods(rng)}
    workcell = task.bundle.workcell.model_copy(update={"shapes": shapes})
    judge = task.bundle.judge
    settings = BirrtSettings(iterations=ITERATIONS, budget_s=BUDGET_S)
    sampling = until_sound(
        lambda own: SamplingPlanner(own.search, own, judge.row_spacing_rad), settings, BUDGET_S
    )
    solved: list[tuple[bool, bool]] = []
    bundle = replace(task.bundle, workcell=workcell)
    limits = limits_of(bundle.planner, judge, robot_from(bundle.robot))
    with (
        Planner(bundle, "thin shapes") as planner,
        Certifier(planner.scene.now, limits) as certifier,
    ):
        checks = certifier.collisions
        for name in task.constraints:
            manifold = ConstraintManifold(planner.scene.robot, planner.constraints[name])
            for start, goal in _pairs(manifold, checks, task.queries, rng):
                found = sampling.plan(problem_of(start, goal, manifold, certifier, None), seed=0)
                solved.append(
                    (
                        found.status == "solved"
                        and certifier.certify(found.joints, manifold.constraint, start, goal).valid,
                        planner.plan(start, goal, name).status == "solved",
                    )
                )
    sampled, planned = map(sum, zip(*solved, strict=True))
    return Solved(len(solved), sampled, sum(map(all, solved)), planned)


def _pairs(
    manifold: ConstraintManifold, checks: CollisionCheck, count: int, rng: np.random.Generator
) -> list[tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D"]]]:
    """Ends that keep the constraint and touch nothing."""
    drawn = retract(manifold, manifold.robot.sample(DRAWN, rng))
    inside = drawn.converged & (manifold.robot.limit_distance(drawn.joints) >= 0.0)
    joints = drawn.joints[inside]
    free = joints[checks.free(joints)][: 2 * count]
    return list(zip(free[:-1:2], free[1::2], strict=False))
