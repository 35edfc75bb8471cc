import numpy as np
import pytest

from constraint_geodesics.geodesics.problem import LearnedProblem, repeated
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.dataset import ShardTask, draw_shard, free_rows, joints_of
from constraint_geodesics.learning.training import train_manifold


@pytest.fixture(scope="module")
def problem(scene, params, tmp_path_factory):
    level = scene.manifold(params.constraints["level_cup"])
    everything = scene.manifold(params.constraints["free"])
    joints, on_level = (
        joints_of(frame)[free_rows(frame)]
        for frame in (draw_shard(ShardTask(scene, m, 4000, (1,))).frame for m in (everything, level))
    )
    small = params.manifolds["planner"].model_copy(update={"epochs": 4, "variance_epochs": 1, "variance_centres": 32})
    folder = tmp_path_factory.mktemp("manifold")
    chart = train_manifold(joints, scene.robot, small, folder, lambda *_: None, progress=False).manifold
    return LearnedProblem(chart, level, PinnedPolynomial(6, 3), on_level, 25, True, 1.0)


def test_paths_keep_the_constraint_and_both_ends(problem) -> None:
    rng = np.random.default_rng(0)
    ends = problem.sample_ends(40, rng)
    phi = np.zeros((40, problem.curve.coefficients))
    feasible = np.flatnonzero(problem.evaluate(phi, ends).feasible)
    assert 10 < len(feasible) < 40, "some straight latent lines jump between branches, most do not"
    for row in feasible[:5]:
        one = ends[np.array([row])]
        path = problem.path(phi[row], one, 0.05)
        np.testing.assert_array_equal(path[[0, -1]], np.concatenate([one.q_start, one.q_goal]))
        assert problem.manifold.violation(path).max() <= 1e-9
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 0.05


def test_a_jump_costs_more_than_it_saves(problem) -> None:
    rng = np.random.default_rng(1)
    ends = problem.sample_ends(60, rng)
    costs = problem.evaluate(np.zeros((60, problem.curve.coefficients)), ends)
    assert (costs.cost >= costs.length).all()
    assert (costs.cost[costs.feasible] - costs.length[costs.feasible]).max() < 1e-2
    assert np.median(costs.cost[~costs.feasible] - costs.length[~costs.feasible]) > 0.5


def test_random_curves_find_a_way_where_the_straight_line_does_not(problem) -> None:
    rng = np.random.default_rng(2)
    ends = problem.sample_ends(30, rng)
    straight = problem.evaluate(np.zeros((30, problem.curve.coefficients)), ends).feasible
    found = 0
    for row in np.flatnonzero(~straight):
        many = repeated(ends[np.array([row])], 200)
        found += problem.evaluate(problem.sample_curves(many, rng), many).feasible.any()
    assert found >= 0.5 * (~straight).sum()


def test_the_fingerprint_knows_its_inputs(problem, scene, params) -> None:
    relaxed = scene.manifold(params.constraints["level_cup_relaxed"])
    other = LearnedProblem(problem.chart, relaxed, problem.curve, problem.joints, 25, True, 1.0)
    same = LearnedProblem(problem.chart, problem.manifold, problem.curve, problem.joints.copy(), 25, True, 1.0)
    assert problem.fingerprint() == same.fingerprint() != other.fingerprint()
