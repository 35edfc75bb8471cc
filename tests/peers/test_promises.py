"""What all planners of the benchmark promise: certified paths, fixed by the seed, or a reason."""

from dataclasses import replace

import numpy as np
import pytest
from tests.planner_fixtures import (
    NAMES,
    assert_sound,
    packaged_chart,
    packaged_learned,
    problem,
    problems,
    untrained_diffusion,
    walled,
)

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.peers.bayesian_optimisation import BayesianPlanner, BayesianSettings
from constraint_geodesics.peers.decoder_sampling import DecoderSampling, DecoderSettings
from constraint_geodesics.peers.gradient_geodesic import GradientGeodesic, GradientGeodesicSettings
from constraint_geodesics.peers.many_bands import MultiStartBand
from constraint_geodesics.peers.ompl import SamplingPlanner
from constraint_geodesics.peers.ompl_settings import OmplSettings
from constraint_geodesics.peers.path_diffusion import DiffusionPlanner
from constraint_geodesics.peers.receding_horizon import RecedingHorizon, RecedingHorizonSettings
from constraint_geodesics.peers.straight_band import StraightBand
from constraint_geodesics.peers.straight_latent import StraightLatent
from constraint_geodesics.peers.trajectory_optimisation import (
    TrajectoryOptimisation,
    TrajectoryOptimisationSettings,
)
from constraint_geodesics.peers.wrappers import BandAfter
from constraint_geodesics.problem import PathPlanner
from constraint_geodesics.scene.world import World

BIRRT = SamplingPlanner("birrt", OmplSettings(budget_s=60.0, iterations=300))
BANDS: tuple[PathPlanner, ...] = (StraightBand(), MultiStartBand(8), BandAfter(BIRRT))
SLSQP = TrajectoryOptimisation(TrajectoryOptimisationSettings(starts=6))
TRUST = TrajectoryOptimisation(
    TrajectoryOptimisationSettings(method="trust-constr", starts=2, iterations=100)
)
DECODER = DecoderSampling(
    FrozenManifold(packaged_learned().manifold), DecoderSettings(budget_s=60.0, iterations=200)
)
RECEDING = RecedingHorizon(RecedingHorizonSettings(vias=2))
DIFFUSION = DiffusionPlanner(untrained_diffusion())
FEW = GradientGeodesicSettings(drawn=32, starts=4, rounds=1)
ON_THE_CHART: tuple[PathPlanner, ...] = (
    StraightLatent(packaged_chart()),
    GradientGeodesic(packaged_chart(), FEW),
    BayesianPlanner(BayesianSettings(drawn=256, initial=10, evaluations=6)),
)


def each(*planners: PathPlanner) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("planner", planners, ids=lambda planner: planner.name)


@pytest.mark.parametrize("name", NAMES)
@each(*BANDS, SLSQP, RECEDING, DIFFUSION, DECODER)
def test_paths_are_certified(
    planner: PathPlanner, name: str, world: World, certifier: Certifier
) -> None:
    solved = 0
    for asked in problems(world, name, 3):
        path = planner.plan(asked, seed=1)
        if path.status == "solved":
            assert_sound(path, asked, certifier)
            solved += 1
        else:
            assert (path.status, path.joints.shape) == ("not_found", (0, 6))
    assert solved


@each(*BANDS, SLSQP, TRUST, RECEDING, DIFFUSION)
def test_seed_fixes_the_path(planner: PathPlanner, world: World) -> None:
    first, other = problems(world, "level_cup", 2)
    once = planner.plan(first, seed=5)
    planner.plan(other, seed=6)
    again = planner.plan(first, seed=5)
    assert once.status == "solved"
    np.testing.assert_array_equal(once.joints, again.joints)


@each(*BANDS, SLSQP, RECEDING, DIFFUSION, DECODER, BIRRT, *ON_THE_CHART)
def test_refused_problems_say_why(planner: PathPlanner, world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    tilted = asked.start + np.array([0, 0, 0, 0, 0.3, 0])
    free = ConstraintManifold(world.robot, Constraint((0,) * 6))
    beyond, in_table = np.array([0, 0, -1.0, 0, 0, 3.6]), np.array([0, 1.5, -0.3, 0, 0, 0])
    assert not world.is_free(in_table)
    for wrong, status in (
        (replace(asked, start=tilted), "start_violates"),
        (replace(asked, goal=tilted), "goal_violates"),
        (replace(asked, goal=beyond, manifold=free), "out_of_limits"),
        (replace(asked, start=in_table, manifold=free), "in_collision"),
        (replace(asked, goal=in_table, manifold=free), "in_collision"),
    ):
        path = planner.plan(wrong, seed=0)
        assert (path.status, path.joints.shape, path.iterations) == (status, (0, 6), 0)


@each(StraightBand(), MultiStartBand(4), RECEDING, DIFFUSION)
def test_ends_that_coincide_are_a_path(planner: PathPlanner, world: World) -> None:
    asked = problems(world, "level_cup", 1)[0]
    path = planner.plan(replace(asked, goal=asked.start.copy()), seed=0)
    assert path.status == "solved"
    np.testing.assert_array_equal(path.joints, [asked.start, asked.start])


@each(StraightBand(), MultiStartBand(4), SLSQP, RECEDING, DIFFUSION)
def test_what_the_boxes_do_not_say_is_checked(planner: PathPlanner, world: World) -> None:
    path = planner.plan(walled(world.robot, lambda q: bool(abs(q[0]) > 0.2)), seed=0)
    assert (path.status, path.joints.shape) == ("not_found", (0, 6))


@each(*ON_THE_CHART)
def test_what_collides_everywhere_is_not_found(planner: PathPlanner, world: World) -> None:
    asked = problem(world, "level_cup", 0)

    def only_ends(q: np.ndarray) -> bool:
        return any(np.array_equal(q, end) for end in (asked.start, asked.goal))

    path = planner.plan(replace(asked, is_free=only_ends), seed=0)
    assert (path.status, path.joints.shape) == ("not_found", (0, 6))
