from dataclasses import replace

import numpy as np
import pytest
from tests.planner_fixtures import (
    NAMES,
    manifold_of,
    packaged_learned,
    packaged_planner,
    problems,
    walled,
)

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.learning.inference import FrozenManifold
from constraint_geodesics.peers.decoder_sampling import (
    BATCH,
    DecoderSampling,
    DecoderSettings,
    decoded_samples,
)
from constraint_geodesics.peers.ompl import SamplingPlanner, birrt_with_sampler
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World

SETTINGS = DecoderSettings(budget_s=60.0, iterations=200)
PLANNER = DecoderSampling(FrozenManifold(packaged_learned().manifold), SETTINGS)


def hard(world: World) -> PlanningProblem:
    """A problem that chance decides: two seeds give two paths."""
    for asked in problems(world, "level_cup", 20):
        first, second = (PLANNER.plan(asked, seed) for seed in (0, 1))
        if first.status == second.status == "solved" and not np.array_equal(
            first.joints, second.joints
        ):
            return asked
    pytest.fail("every query is solved by the straight walk")


def test_seed_fixes_the_path_whatever_was_planned_before(world: World) -> None:
    asked = hard(world)
    once, other = PLANNER.plan(asked, seed=0), PLANNER.plan(asked, seed=1)
    SamplingPlanner("birrt", SETTINGS).plan(asked, 2)
    again = PLANNER.plan(asked, seed=0)
    np.testing.assert_array_equal(once.joints, again.joints)
    assert not np.array_equal(once.joints, other.joints)


def test_every_iteration_draws_one_sample_from_the_decoder(world: World) -> None:
    asked = hard(world)
    samples = decoded_samples(PLANNER.chart, asked.manifold, np.random.default_rng(0))
    drawn: list[np.ndarray] = []

    def counted() -> np.ndarray:
        drawn.append(next(samples))
        return drawn[-1]

    joints, iterations = birrt_with_sampler(asked, SETTINGS, counted, 0, np.inf)
    assert joints is not None
    assert 1 < len(drawn) <= iterations


def walled_below(world: World, low: float) -> PlanningProblem:
    return walled(world.robot, lambda q: bool(abs(q[0]) > 0.2 or q[1] < low))


def test_trees_grow_towards_the_samples(world: World) -> None:
    asked = walled_below(world, -0.9)
    corner = np.array([0.0, -1.2, -1.0, 0, 0, 0])
    joints, iterations = birrt_with_sampler(asked, SETTINGS, lambda: corner, 0, np.inf)
    assert joints is not None
    assert iterations <= 5
    assert joints[:, 1].min() < -0.9
    assert birrt_with_sampler(asked, SETTINGS, lambda: asked.start, 0, np.inf) == (
        None,
        SETTINGS.iterations,
    )


@pytest.mark.parametrize("name", NAMES)
def test_samples_are_on_the_constraint(name: str) -> None:
    manifold = manifold_of(packaged_planner(), name)
    samples = decoded_samples(PLANNER.chart, manifold, np.random.default_rng(0))
    drawn = np.array([next(samples) for _ in range(2 * BATCH)])
    assert manifold.violation(drawn).max() <= 1e-8
    assert manifold.robot.limit_distance(drawn).min() >= 0.0
    assert len(np.unique(drawn, axis=0)) == len(drawn)


def test_decoded_samples_are_more_often_free_than_uniform_ones(world: World) -> None:
    manifold = manifold_of(packaged_planner(), "level_cup")
    samples = decoded_samples(PLANNER.chart, manifold, np.random.default_rng(0))
    decoded = world.free(np.array([next(samples) for _ in range(400)])).mean()
    assert decoded > world.free(manifold.robot.sample(400, np.random.default_rng(0))).mean() + 0.1


def test_another_robot_s_decoder_is_not_applicable(kuka_scene: Scene) -> None:
    free = ConstraintManifold(kuka_scene.robot, Constraint((0,) * 6))
    with kuka_scene.world() as loaded:
        start = next(
            q for q in kuka_scene.robot.sample(100, np.random.default_rng(0)) if loaded.is_free(q)
        )
        path = PLANNER.plan(PlanningProblem(start, start + 0.01, free, loaded.is_free), seed=0)
    assert path.status == "not_applicable"
    assert "6 joints" in path.explanation
    assert path.joints.shape == (0, 7)


def test_isolated_points_are_not_applicable(world: World) -> None:
    asked = problems(world, "free", 1)[0]
    pose = Pose(*world.robot.forward(asked.start))
    held = ConstraintManifold(world.robot, Constraint((1,) * 6, reference=pose))
    # within what counts as kept, and away from the limits
    turned = asked.start - 1e-5 * np.sign(asked.start)
    path = PLANNER.plan(replace(asked, goal=turned, manifold=held), seed=0)
    assert path.status == "not_applicable"
    assert "isolated" in path.explanation


def test_search_without_a_way_ends_after_its_iterations(world: World) -> None:
    few = SETTINGS.model_copy(update={"iterations": 40})
    path = replace(PLANNER, settings=few).plan(walled_below(world, -np.inf), seed=0)
    assert (path.status, path.joints.shape) == ("not_found", (0, 6))
    assert 35 < path.iterations <= 40
