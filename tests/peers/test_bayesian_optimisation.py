from collections.abc import Iterator

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_learned, packaged_planner, pairs_of

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.peers.bayesian_optimisation import BayesianPlanner, BayesianSettings
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.world import World

QUICK = BayesianPlanner(BayesianSettings(drawn=256, initial=10, evaluations=6))
FAR = 4
"""Seed of a query whose straight line is far from the shortest path."""


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    with packaged_planner().scene.world() as opened:
        yield opened


def problem(world: World, name: str, seed: int) -> PlanningProblem:
    start, goal = pairs_of(name, 1, seed)[0]
    return PlanningProblem(start, goal, manifold_of(packaged_planner(), name), world.is_free)


def length(joints: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(joints, axis=0), axis=1).sum())


@pytest.mark.parametrize("name", ["free", "level_cup", "level_cup_relaxed", "slide"])
def test_paths_keep_the_constraint_in_either_chart(world: World, name: str) -> None:
    planner = packaged_planner()
    chart = LearnedManifold.from_arrays(packaged_learned().manifold)
    asked, solved = problem(world, name, 1), 0
    with Certifier(planner.scene) as judge:
        for search in (
            QUICK,
            BayesianPlanner(BayesianSettings(drawn=256, initial=10, evaluations=6), chart),
        ):
            path = search.plan(asked, 0)
            assert path.status in ("solved", "not_found")
            if path.status == "solved":
                solved += 1
                np.testing.assert_array_equal(path.joints[[0, -1]], [asked.start, asked.goal])
                found = judge.certify(
                    path.joints, asked.manifold.constraint, asked.start, asked.goal
                )
                assert found.violation is None, found.violation
    assert solved


def test_the_process_finds_shorter_curves_than_it_was_given(world: World) -> None:
    asked = problem(world, "level_cup", FAR)
    few, many = (
        BayesianPlanner(BayesianSettings(drawn=64, kept=5, initial=5, evaluations=n)).plan(asked, 0)
        for n in (1, 25)
    )
    assert many.iterations - few.iterations == 24
    assert few.status == many.status == "solved"
    assert length(many.joints) < length(few.joints) - 1e-3


def test_same_seed_same_path(world: World) -> None:
    asked = problem(world, "level_cup", FAR)
    first, again, other = (QUICK.plan(asked, seed) for seed in (3, 3, 4))
    assert first.status == "solved"
    np.testing.assert_array_equal(first.joints, again.joints)
    assert not np.array_equal(first.joints, other.joints)


def test_refused_ends_and_walls(world: World) -> None:
    asked = problem(world, "level_cup", 2)
    tilted = asked.start + np.array([0, 0, 0, 0, 0.3, 0])
    path = QUICK.plan(PlanningProblem(tilted, asked.goal, asked.manifold, world.is_free), 0)
    assert (path.status, path.joints.shape, path.iterations) == ("start_violates", (0, 6), 0)

    def only_ends(q: np.ndarray) -> bool:
        return any(np.array_equal(q, end) for end in (asked.start, asked.goal))

    path = QUICK.plan(PlanningProblem(asked.start, asked.goal, asked.manifold, only_ends), 0)
    assert (path.status, path.joints.shape) == ("not_found", (0, 6))


def test_seven_joints_need_no_chart(kuka: SerialRobot) -> None:
    level = Constraint(
        (0, 0, 0, 1, 1, 0), reference=Pose.from_rpy((0.4, 0.0, 0.3), (np.pi / 2, 0.0, 0.0))
    )
    manifold = ConstraintManifold(kuka, level)
    found = retract(manifold, kuka.sample(64, np.random.default_rng(0)))
    kept = found.joints[found.converged & (kuka.limit_distance(found.joints) > 0.01)]
    solved = 0
    for start, goal in zip(kept[0:8:2], kept[1:8:2], strict=True):
        path = QUICK.plan(PlanningProblem(start, goal, manifold, lambda _: True), 0)
        if path.status == "solved":
            solved += 1
            assert manifold.violation(0.5 * (path.joints[1:] + path.joints[:-1])).max() <= 1e-4
    assert solved


def test_misuse_names_the_value() -> None:
    for setting, value in (
        ("degree", 1),
        ("bound", 0.0),
        ("drawn", 0),
        ("initial", 0),
        ("evaluations", 0),
    ):
        with pytest.raises(ValueError, match=setting):
            BayesianSettings(**{setting: value})
