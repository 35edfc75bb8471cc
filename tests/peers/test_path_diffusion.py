"""Paths drawn by a diffusion model: what is asked of the planner, whatever the model."""

import numpy as np
import pytest
from tests.planner_fixtures import assert_sound, length, packaged_planner, problems

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.learning.path_diffusion import PathDiffusion
from constraint_geodesics.peers.elastic_band import task_of
from constraint_geodesics.peers.path_diffusion import DiffusionPlanner, PathDiffusionSettings
from constraint_geodesics.peers.wrappers import BandAfter
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World

PILLAR = Box("pillar", (0.45, 0.0, 0.5), (0.1, 0.1, 1.0))


def test_free_motion_is_the_straight_line(blank_diffusion: PathDiffusion, world: World) -> None:
    """A model that knows nothing draws the straight line first, and no other is shorter."""
    free = ConstraintManifold(world.robot, Constraint((0,) * 6))
    start, goal = np.array([-0.5, 0, -1.0, 0, 0, 0]), np.array([0.5, -0.3, -1.0, 0, 0.2, 0])
    path = DiffusionPlanner(blank_diffusion).plan(
        PlanningProblem(start, goal, free, world.is_free), 0
    )
    assert path.status == "solved"
    assert length(path.joints) == pytest.approx(np.linalg.norm(goal - start), rel=1e-12)


def test_projection_pushes_what_is_drawn_out_of_a_pillar(blank_diffusion: PathDiffusion) -> None:
    """The straight line leads through it."""
    planner = packaged_planner()
    scene = Scene(planner.scene.robot, (*planner.scene.workcell, PILLAR))
    free = ConstraintManifold(scene.robot, Constraint((0,) * 6))
    # off the plane in which links are as deep on either side
    start = np.array([-0.49, 0.02, -0.99, -0.04, 0.03, 0.01])
    goal = np.array([0.48, 0.02, -0.99, 0.01, 0.0, 0.02])
    clearance = clearance_model(scene)
    with scene.world() as world, Certifier(scene) as certifier:
        known = world.is_free, clearance, certifier.collisions.is_clear
        asked = PlanningProblem(start, goal, free, *known)
        assert not asked.keeps_clear(np.linspace(start, goal, 50))
        found = DiffusionPlanner(blank_diffusion, PathDiffusionSettings(proposals=64)).plan(
            asked, 0
        )
        assert_sound(found, asked, certifier)


def test_a_band_after_it_is_no_longer(
    blank_diffusion: PathDiffusion, world: World, certifier: Certifier
) -> None:
    planner = DiffusionPlanner(blank_diffusion, PathDiffusionSettings(projected=0))
    shortened = 0
    for asked in problems(world, "level_cup", 4):
        bare, banded = planner.plan(asked, 0), BandAfter(planner).plan(asked, 0)
        if bare.status == "solved":
            assert_sound(banded, asked, certifier)
            assert length(banded.joints) <= length(bare.joints) + 1e-9
            shortened += length(banded.joints) < 0.999 * length(bare.joints)
    assert shortened


def test_another_arm_is_not_its_own(blank_diffusion: PathDiffusion, world: World) -> None:
    seven = {**blank_diffusion.arrays, "scale": np.ones((4, 7), np.float32)}
    path = DiffusionPlanner(PathDiffusion(seven)).plan(problems(world, "level_cup", 1)[0], 0)
    assert (path.status, path.joints.shape) == ("not_applicable", (0, 6))
    assert path.explanation == "the model is that of 7 joints, the robot has 6"


def test_the_seed_draws_other_paths(blank_diffusion: PathDiffusion, world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    planner = DiffusionPlanner(blank_diffusion, PathDiffusionSettings(projected=0, steps=4))
    task = task_of(asked, planner.band)
    drawn = [planner.proposed(asked, task, seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    np.testing.assert_allclose(drawn[0][0], drawn[2][0], atol=1e-9)  # the one without noise
    assert np.abs(drawn[0][1:] - drawn[2][1:]).max() > 0.05
