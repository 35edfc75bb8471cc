from dataclasses import replace

import numpy as np
import pytest
from tests.planner_fixtures import (
    assert_sound,
    length,
    manifold_of,
    packaged_planner,
    pairs_of,
    problems,
)

from constraint_geodesics.certification.certifier import Certifier, Limits
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.peers.elastic_band import task_of
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.peers.trajectory_optimisation import (
    Course,
    Demand,
    TrajectoryOptimisation,
    TrajectoryOptimisationSettings,
    demands_of,
)
from constraint_geodesics.problem import PathPlanner, PlanningProblem
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World
from constraint_geodesics.search.band import BandSettings

SLSQP = TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=6))
TRUST = TrajectoryOptimisation(
    TrajectoryOptimisationSettings(method="trust-constr", starts=2, iterations=100)
)
PILLAR = Box("pillar", (0.45, 0.0, 0.5), (0.1, 0.1, 1.0))


def test_the_other_method_finds_the_same_path(world: World, certifier: Certifier) -> None:
    asked = problems(world, "level_cup", 2)[0]
    first, second = SLSQP.plan(asked, 0), TRUST.plan(asked, 0)
    assert_sound(first, asked, certifier)
    assert_sound(second, asked, certifier)
    assert length(second.joints) == pytest.approx(length(first.joints), rel=1e-3)


def test_straight_start_ends_where_the_band_does(world: World) -> None:
    compared = 0
    for asked in problems(world, "level_cup", 4):
        band, found = (
            StraightBand().plan(asked, 0),
            TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=1)).plan(asked, 0),
        )
        if band.status == found.status == "solved":
            assert length(found.joints) == pytest.approx(length(band.joints), rel=2e-3)
            compared += 1
    assert compared


@pytest.mark.parametrize("planner", [SLSQP, TRUST], ids=lambda planner: planner.name)
def test_free_motion_is_the_straight_line(planner: PathPlanner, world: World) -> None:
    free = ConstraintManifold(world.robot, Constraint((0,) * 6))
    start, goal = np.array([-0.5, 0, -1.0, 0, 0, 0]), np.array([0.5, -0.3, -1.0, 0, 0.2, 0])
    path = planner.plan(PlanningProblem(start, goal, free, world.is_free), 0)
    assert path.status == "solved"
    assert length(path.joints) == pytest.approx(np.linalg.norm(goal - start), rel=1e-6)


def test_more_wanted_paths_are_no_longer(world: World) -> None:
    for asked in problems(world, "level_cup", 2):
        first, best = (
            TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=6, wanted=wanted)).plan(
                asked, 0
            )
            for wanted in (1, 6)
        )
        assert first.status == best.status == "solved"
        assert length(best.joints) <= length(first.joints)
        assert best.iterations > first.iterations


def test_limits_bend_the_path(world: World) -> None:
    bent = 0
    for number, asked in enumerate(problems(world, "level_cup", 60)):
        if bent and number >= 12:
            break
        wide = TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=1)).plan(asked, 0)
        if wide.status != "solved":
            continue
        # a limit halfway between the ends and where the path goes beyond them
        ends = np.minimum(asked.start, asked.goal)
        room = ends - wide.joints.min(axis=0)
        joint = int(room.argmax())
        if not 0.04 < room[joint] < 0.4:
            continue
        lower = asked.manifold.robot.lower.copy()
        lower[joint] = ends[joint] - 0.5 * room[joint]
        robot = replace(asked.manifold.robot, lower=lower)
        narrow = replace(asked, manifold=replace(asked.manifold, robot=robot))
        path, band = (
            TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=1)).plan(narrow, 0),
            StraightBand().plan(narrow, 0),
        )
        assert path.status == band.status
        if path.status == "not_found":  # there may be no other way near the line
            continue
        assert robot.limit_distance(path.joints).min() >= -1e-9
        assert length(path.joints) > length(wide.joints)
        bent += 1
    assert bent


def test_a_pillar_is_kept_clear_of(scene: Scene) -> None:
    around = Scene(scene.robot, (*scene.workcell, PILLAR))
    manifold = manifold_of(packaged_planner(), "level_cup")
    judged = 0
    with around.world() as loaded, Certifier(around, Limits()) as judge:
        clearance = clearance_model(around)
        for start, goal in pairs_of("level_cup", 30, 5):
            known = loaded.is_free, clearance, judge.collisions.is_clear
            asked = PlanningProblem(start, goal, manifold, *known)
            if not loaded.free(np.stack([start, goal])).all():
                continue
            blind = TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=1)).plan(
                replace(asked, clearance=None), 0
            )
            path = TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=1)).plan(asked, 0)
            if blind.status == "not_found" and path.status == "solved":
                assert_sound(path, asked, judge)
                judged += 1
    assert judged


TOLERANCES = {"exact": (0.0, 0.0, 0.0), "cone": (0.1, 0.1, 0.0), "mixed": (0.1, 0.2, 0.03)}


def demands(name: str, asked: PlanningProblem) -> list[Demand]:
    roll, pitch, height = TOLERANCES[name]
    pose = Pose(*asked.manifold.robot.forward(asked.start))
    constraint = Constraint((0, 0, 1, 1, 1, 0), (0, 0, height, roll, pitch, 0), pose)
    manifold = ConstraintManifold(asked.manifold.robot, constraint)
    beyond = np.array([[True, False] * 3, [False, True, True] * 2])
    return demands_of(task_of(replace(asked, manifold=manifold), BandSettings()), beyond, near=True)


@pytest.mark.parametrize("name", TOLERANCES)
def test_derivatives_are_those_of_finite_differences(name: str, world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    t = np.linspace(0.0, 1.0, 6)[:, None]
    course = Course.through((1.0 - t) * asked.start + t * asked.goal)
    rng = np.random.default_rng(0)
    y, direction, h = course.start, rng.normal(size=course.start.size), 1e-6
    bent = y + 0.1 * rng.normal(size=y.size)  # the straight line has no slope
    energy, gradient = course.energy(bent)
    assert energy == pytest.approx(0.5 * np.square(np.diff(course.nodes(bent), axis=0)).sum())
    ahead, behind = (course.energy(bent + side * direction)[0] for side in (h, -h))
    slope = (ahead - behind) / (2 * h)
    assert slope == pytest.approx(gradient @ direction, rel=1e-6)
    found = demands(name, asked)
    assert len(found) == {"exact": 3, "cone": 4, "mixed": 3}[name]
    for demand in found:
        values = course.values(demand)
        slopes = (values(y + h * direction) - values(y - h * direction)) / (2 * h)
        np.testing.assert_allclose(
            course.jacobian(demand)(y) @ direction, slopes, rtol=1e-5, atol=1e-6
        )


@pytest.mark.parametrize("name", TOLERANCES)
def test_demands_are_met_where_the_constraint_is(name: str, world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    roll, pitch, height = TOLERANCES[name]
    pose = Pose(*asked.manifold.robot.forward(asked.start))
    manifold = ConstraintManifold(
        world.robot, Constraint((0, 0, 1, 1, 1, 0), (0, 0, height, roll, pitch, 0), pose)
    )
    q = asked.start + np.random.default_rng(0).normal(scale=0.05, size=(200, 6))
    q[0] = asked.start
    task = task_of(replace(asked, manifold=manifold), BandSettings())
    met = np.ones(len(q), bool)
    for demand in demands_of(task, np.zeros((2, 6), bool), near=False):
        values = demand.linearise(q)[0]
        met &= (np.abs(values) < 1e-9).all(axis=1) if demand.equal else (values >= 0.0).all(axis=1)
    assert met[0]
    np.testing.assert_array_equal(met, manifold.violation(q) <= 1e-9)
    assert sum(map(len, manifold.rows.loose_groups)) == np.count_nonzero(TOLERANCES[name])
