from dataclasses import replace

import numpy as np
import pytest
from tests.planner_fixtures import (
    NAMES,
    assert_sound,
    length,
    manifold_of,
    packaged_planner,
    problems,
    walled,
)

from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.peers.elastic_band import rows_along, uniform_configurations
from constraint_geodesics.peers.many_bands import MultiStartBand
from constraint_geodesics.peers.ompl import SamplingPlanner
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.peers.wrappers import BandAfter, band_after
from constraint_geodesics.problem import PlanningProblem, Solution
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World
from constraint_geodesics.search.band import BandSettings

BIRRT = SamplingPlanner("birrt", OmplSettings(budget_s=60.0, iterations=300))
PILLAR = Box("pillar", (0.45, 0.0, 0.5), (0.1, 0.1, 1.0))


def test_many_starts_are_no_longer_than_one_and_the_band_no_longer_than_its_path(
    world: World,
) -> None:
    for asked in problems(world, "level_cup", 4):
        straight, many = StraightBand().plan(asked, 0), MultiStartBand(8).plan(asked, 0)
        if straight.status == "solved":
            assert many.status == "solved"
            assert length(many.joints) <= length(straight.joints) * (1 + 1e-6)
        given = BIRRT.plan(asked, 0)
        after = band_after(asked, given, BandSettings())
        assert after.status == given.status == "solved"
        assert length(after.joints) <= length(given.joints) * (
            1 + 1e-3
        )  # lines between far rows cut corners
        assert after.time_s > given.time_s


def test_a_sound_path_is_not_given_away_for_a_band_that_is_not(world: World) -> None:
    (asked,) = problems(world, "level_cup", 1)
    given = BIRRT.plan(asked, 0)
    picky = replace(asked, is_sound=lambda rows: rows is given.joints)
    assert band_after(picky, given, BandSettings()).joints is given.joints
    assert band_after(asked, given, BandSettings()).joints is not given.joints


def test_many_starts_depend_on_the_seed_where_the_straight_one_fails(world: World) -> None:
    for asked in problems(world, "slide", 20):
        if (
            StraightBand().plan(asked, 0).status == "not_found"
            and MultiStartBand(32).plan(asked, 0).status == "solved"
        ):
            few = [MultiStartBand(2).plan(asked, seed) for seed in range(6)]
            assert len({path.joints.tobytes() for path in few}) > 1
            break
    else:
        pytest.fail("no query where bends help")


def test_path_itself_where_every_band_touches_something(world: World) -> None:
    corner = np.array([0.0, -1.2, -1.0, 0, 0, 0])

    def is_free(q: np.ndarray) -> bool:
        return bool(
            abs(q[1] - corner[1] * (1.0 - abs(q[0]))) < 1e-6
        )  # on the two lines past the corner only

    asked = walled(world.robot, is_free)
    lines = [np.linspace(a, b, 40) for a, b in ((asked.start, corner), (corner, asked.goal))]
    given = Solution("solved", np.concatenate([lines[0], lines[1][1:]]), 0.5, 7)
    after = band_after(asked, given, BandSettings())
    assert after.status == "solved"
    assert length(after.joints) == pytest.approx(length(given.joints))
    np.testing.assert_array_equal(after.joints[[0, -1]], given.joints[[0, -1]])
    assert after.iterations > 7
    nothing = Solution("not_found", np.empty((0, 6)), 0.5, 7)
    assert band_after(asked, nothing, BandSettings()) is nothing


def test_a_pillar_is_gone_around(scene: Scene) -> None:
    around = Scene(scene.robot, (*scene.workcell, PILLAR))
    manifold = ConstraintManifold(scene.robot, Constraint((0,) * 6))
    start, goal = (np.array([angle, 0.3, -1.2, 0.0, 0.9, 0.0]) for angle in (-0.8, 0.8))
    with around.world() as loaded, Certifier(around, Limits()) as judge:
        clearance = clearance_model(around)
        asked = PlanningProblem(start, goal, manifold, loaded.is_free, clearance)
        assert not loaded.free(start + np.linspace(0, 1, 50)[:, None] * (goal - start)).all()
        path = BandAfter(BIRRT).plan(asked, seed=0)
        assert_sound(path, asked, judge)
        assert (
            np.linalg.norm(goal - start)
            < length(path.joints)
            < 0.98 * length(BIRRT.plan(asked, seed=0).joints)
        )


@pytest.mark.parametrize("name", NAMES)
def test_configurations_are_on_the_constraint(name: str) -> None:
    manifold = manifold_of(packaged_planner(), name)
    drawn = uniform_configurations(manifold, 20, np.random.default_rng(0))
    assert drawn.shape == (20, 6)
    assert manifold.violation(drawn).max() <= 1e-8
    assert manifold.robot.limit_distance(drawn).min() >= 0.0


def test_rows_keep_the_constraint_between_them(world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    found = BIRRT.plan(asked, 0).joints
    given = np.concatenate([found[:-1:3], found[-1:]])
    rows = rows_along(asked.manifold, given)
    np.testing.assert_array_equal(rows[[0, -1]], given[[0, -1]])
    halfway = asked.manifold.violation(0.5 * (rows[1:] + rows[:-1])).max()
    assert halfway <= 1e-4 < asked.manifold.violation(0.5 * (given[1:] + given[:-1])).max()


def test_seven_joints_need_no_other_code(kuka_scene: Scene) -> None:
    manifold = ConstraintManifold(kuka_scene.robot, packaged_planner().constraints["level_cup"])
    drawn = uniform_configurations(manifold, 60, np.random.default_rng(2))
    with kuka_scene.world() as loaded, Certifier(kuka_scene, Limits()) as judge:
        start, goal = drawn[loaded.free(drawn)][:2]
        asked = PlanningProblem(start, goal, manifold, loaded.is_free)
        path = MultiStartBand(16).plan(asked, 0)
        assert_sound(path, asked, judge)


def test_fewer_configurations_make_fewer_starts(world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    assert (
        MultiStartBand(8, lambda manifold, count, rng: np.empty((0, 6))).plan(asked, 0).iterations
        == 1
    )
    assert MultiStartBand(8).plan(asked, 0).iterations == 8


def test_the_band_is_named_after_its_planner() -> None:
    assert BandAfter(MultiStartBand(name="bends")).name == "bends + band"


def test_a_band_in_place_of_a_path_that_is_not_sound_may_be_longer(scene: Scene) -> None:
    """Where a path must keep off, and one is given that does not, the band that does is longer."""
    around = Scene(scene.robot, (*scene.workcell, PILLAR))
    manifold = ConstraintManifold(scene.robot, Constraint((0,) * 6))
    start, goal = (np.array([angle, 0.3, -1.2, 0.0, 0.9, 0.0]) for angle in (-0.8, 0.8))
    clearance = clearance_model(around)

    def keeps_off(rows: np.ndarray) -> bool:
        return bool(clearance.clearance(scene.robot, rows).min() > 0.01)

    with around.world() as loaded:
        asked = PlanningProblem(start, goal, manifold, loaded.is_free, clearance)
        near = band_after(asked, BIRRT.plan(asked, 0), BandSettings(clearance_m=0.001))
        assert not keeps_off(near.joints)
        asked = replace(asked, is_sound=keeps_off)
        found = band_after(asked, near, BandSettings(clearance_m=0.02))
    assert keeps_off(found.joints)
    assert length(found.joints) > length(near.joints)
