"""The receding horizon: its energy, what it finds where the answer is known, and where it is
caught.
"""

import numpy as np
import pytest
from scipy.optimize import check_grad, minimize
from tests.planner_fixtures import (
    assert_sound,
    length,
    manifold_of,
    packaged_planner,
    problems,
    walled,
)

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.peers.elastic_band import task_of
from constraint_geodesics.peers.receding_horizon import (
    Legs,
    RecedingHorizon,
    RecedingHorizonSettings,
    drawn_energy,
    open_course,
)
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World
from constraint_geodesics.search.band import BandSettings

PILLAR = Box("pillar", (0.45, 0.0, 0.5), (0.1, 0.1, 1.0))


def test_the_minimum_of_a_horizon_are_even_steps_straight_to_the_goal() -> None:
    rng = np.random.default_rng(0)
    ends = np.stack([np.zeros(6), rng.normal(size=6)])
    course = open_course(ends, 0.1 * rng.normal(size=(5, 6)))

    def energy(y: np.ndarray) -> tuple[float, np.ndarray]:
        return drawn_energy(course, y, 0.1)

    assert check_grad(lambda y: energy(y)[0], lambda y: energy(y)[1], course.start) < 1e-5
    found = course.nodes(minimize(energy, course.start, jac=True, tol=1e-12).x)
    direction = ends[1] / np.linalg.norm(ends[1])
    np.testing.assert_allclose(found[:-1], 0.1 * np.arange(6)[:, None] * direction, atol=1e-5)


def test_free_motion_is_the_straight_line(world: World) -> None:
    free = ConstraintManifold(world.robot, Constraint((0,) * 6))
    start, goal = np.array([-1.5, 0, -1.0, 0, 0, 0]), np.array([1.5, -0.3, -1.0, 0, 0.2, 0])
    path = RecedingHorizon().plan(PlanningProblem(start, goal, free, world.is_free), 0)
    assert path.status == "solved"
    assert path.iterations > 1
    assert length(path.joints) == pytest.approx(np.linalg.norm(goal - start), rel=1e-5)


def test_where_it_is_not_caught_its_paths_are_about_as_short_as_a_band(
    world: World, certifier: Certifier
) -> None:
    compared, planner = 0, RecedingHorizon(RecedingHorizonSettings(vias=1))
    for asked in problems(world, "level_cup", 4):
        band, found = StraightBand().plan(asked, 0), planner.plan(asked, 0)
        if band.status == found.status == "solved":
            assert_sound(found, asked, certifier)
            assert length(found.joints) < 1.3 * length(band.joints)
            compared += 1
    assert compared >= 2


def test_waypoints_keep_the_constraint_and_their_distance(world: World) -> None:
    asked = problems(world, "level_cup", 2)[0]
    task, settings = task_of(asked, BandSettings()), RecedingHorizonSettings()
    nodes, moves = Legs(task, asked.goal, settings, asked.keeps_clear).from_(asked.start)
    assert nodes is not None
    assert moves <= settings.moves
    np.testing.assert_array_equal(nodes[[0, -1]], [asked.start, asked.goal])
    assert manifold_of(packaged_planner(), "level_cup").violation(nodes).max() < 1e-3
    assert np.linalg.norm(np.diff(nodes, axis=0), axis=1).max() < 2.0 * settings.step_rad


def test_a_pillar_is_passed() -> None:
    planner = packaged_planner()
    scene = Scene(planner.scene.robot, (*planner.scene.workcell, PILLAR))
    free = ConstraintManifold(scene.robot, Constraint((0,) * 6))
    start, goal = np.array([-0.5, 0, -1.0, 0, 0, 0]), np.array([0.5, 0, -1.0, 0, 0, 0])
    clearance = clearance_model(scene)
    with scene.world() as world, Certifier(scene) as certifier:
        known = world.is_free, clearance, certifier.collisions.is_clear
        asked = PlanningProblem(start, goal, free, *known)
        assert not asked.keeps_clear(np.linspace(start, goal, 50))
        assert_sound(RecedingHorizon().plan(asked, 0), asked, certifier)


def test_what_nothing_leads_through_is_not_found(world: World) -> None:
    planner = RecedingHorizon(RecedingHorizonSettings(vias=2))
    path = planner.plan(walled(world.robot, lambda q: bool(abs(q[0]) > 0.2)), 0)
    assert (path.status, path.joints.shape) == ("not_found", (0, 6))
    assert path.iterations > 0
