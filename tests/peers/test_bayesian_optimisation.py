from dataclasses import replace

import numpy as np
import pytest
from tests.planner_fixtures import assert_sound, length, packaged_chart, problem

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.peers.bayesian_optimisation import BayesianPlanner, BayesianSettings
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.world import World

QUICK = BayesianPlanner(BayesianSettings(drawn=256, initial=10, evaluations=6))
FAR = 4
"""Seed of a query whose straight line is far from the shortest path."""


@pytest.mark.parametrize("name", ["free", "level_cup", "level_cup_relaxed", "slide"])
def test_paths_keep_the_constraint_in_either_chart(
    world: World, certifier: Certifier, name: str
) -> None:
    asked, solved = problem(world, name, 1), 0
    for search in (QUICK, replace(QUICK, learned=packaged_chart())):
        path = search.plan(asked, 0)
        assert path.status in ("solved", "not_found")
        if path.status == "solved":
            solved += 1
            assert_sound(path, asked, certifier)
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
