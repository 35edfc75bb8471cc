"""The paper's system as a method of the planner: certified curves of the policies, alone and
refined, and files that nothing else reads.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_learned, pairs_of

from constraint_geodesics import Constraint, Planner, Pose, bundle
from constraint_geodesics.bundle import BundleError
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geodesics.learned_method import (
    CARD,
    FOLDER,
    MANIFOLD,
    POLICY,
    SUBMANIFOLDS,
    _free_configurations,
    read_learned,
)
from constraint_geodesics.problem import PlannerError

METHODS = ("learned", "learned+band")


@pytest.fixture(scope="module", params=METHODS)
def planner(request: pytest.FixtureRequest) -> Iterator[Planner]:
    with Planner.load(bundle.PACKAGED, request.param) as planner:
        yield planner


@pytest.mark.parametrize("name", ["free", "level_cup", "slide"])
def test_its_paths_are_the_policies_and_certified(planner, name) -> None:
    solved = 0
    for start, goal in pairs_of(name, 4, seed=1):
        path = planner.plan(start, goal, name)
        assert path.status in ("solved", "not_found"), path.explanation
        if path.status != "solved":
            continue
        solved += 1
        assert path.certificate.valid
        assert (path.source, path.method) == ("policy", planner.method.name)
        assert path.summary()["method"] == planner.method.name
        assert path.joints[0].tobytes() == start.tobytes()
        assert path.goal.tobytes() == goal.tobytes()
        points = path.at(np.linspace(0.0, 1.0, 50))
        assert manifold_of(planner, name).violation(points).max() <= 1e-6
    assert solved >= 3


@pytest.mark.parametrize("name", ["level_cup", "slide", "fixed_orientation"])
def test_random_curves_bend_towards_what_is_within_limits_and_clear(name) -> None:
    with Planner.load(bundle.PACKAGED, "learned") as planner:
        manifold = manifold_of(planner, name)
        task = planner._preparation.task(manifold.constraint)
        drawn = _free_configurations(task)
        assert 20 <= len(drawn) < 1000
        assert planner.robot.limit_distance(drawn).min() >= 0.0
        assert manifold.violation(drawn).max() <= 1e-4
        with planner.scene.now.world() as world:
            assert world.free(drawn).all()


def test_refinement_makes_its_paths_no_longer() -> None:
    with (
        Planner.load(bundle.PACKAGED, "learned") as alone,
        Planner.load(bundle.PACKAGED, "learned+band") as refined,
    ):
        judged = 0
        for start, goal in pairs_of("level_cup", 4, seed=1):
            first, better = (p.plan(start, goal, "level_cup") for p in (alone, refined))
            if first.status == better.status == "solved":
                judged += 1
                assert better.length_rad <= first.length_rad * (1.0 + 1e-3)
        assert judged >= 3


def test_different_components_of_the_submanifold_are_not_connected(planner) -> None:
    start, goal = pairs_of("tool_down", 1, seed=10, joined=False)[0]
    path = planner.plan(start, goal, "tool_down")
    assert path.status == "not_connected"
    assert "different components of tool_down" in path.explanation


def test_a_constraint_that_no_training_saw_is_planned_too() -> None:
    with Planner.load(bundle.PACKAGED, "learned") as planner:
        robot, near = planner.scene.robot, pairs_of("level_cup", 1, seed=1)[0][0]
        never = Constraint((0, 0, 1, 0, 0, 0), reference=Pose(*robot.forward(near)))
        manifold = planner._preparation.task(never).manifold
        goal = retract(manifold, near + np.array([0.4, 0.2, -0.2, 0.1, 0.1, 0.0])).joints
        assert planner.plan(near, goal, never).status == "solved"


def test_a_budget_keeps_the_shortest_of_the_policies_curves(planner) -> None:
    start, goal = pairs_of("slide", 1, seed=1)[0]
    first = planner.plan(start, goal, "slide")
    better = planner.plan(start, goal, "slide", budget_s=5.0)
    assert better.length_rad <= first.length_rad


def test_an_unknown_method_is_misuse() -> None:
    with pytest.raises(PlannerError, match="'paper': must be one of planner, learned"):
        Planner.load(bundle.PACKAGED, "paper")


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    packaged_learned().write(tmp_path)
    for name in (CARD, MANIFOLD, POLICY, SUBMANIFOLDS):
        original = bundle.PACKAGED / FOLDER / name
        assert (tmp_path / name).read_bytes() == original.read_bytes()
    content = (tmp_path / POLICY).read_bytes()
    (tmp_path / POLICY).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(BundleError, match=POLICY):
        read_learned(tmp_path)


def test_the_planner_needs_none_of_its_files(tmp_path: Path) -> None:
    """They lie in the planner's folder or beside it; without them the planner still plans."""
    folder = tmp_path / "planner"
    shutil.copytree(bundle.PACKAGED, folder, ignore=shutil.ignore_patterns(FOLDER))
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    with Planner.load(folder) as planner:
        assert planner.plan(start, goal, "level_cup").status == "solved"
    with pytest.raises(BundleError, match=CARD):
        Planner.load(folder, "learned")
    shutil.copytree(bundle.PACKAGED / FOLDER, tmp_path / FOLDER)
    Planner.load(folder, "learned").close()
