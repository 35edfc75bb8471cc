import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.episodes import begin, observation_size, observe
from constraint_geodesics.geodesics.learned_problem import LearnedProblem, ProblemSet
from constraint_geodesics.geodesics.policy_search import (
    follow,
    load_policy,
    save_policy,
    train_policy,
)
from constraint_geodesics.geodesics.proposals import MeanPolicy, propose
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.manifold import GeometryError
from constraint_geodesics.learning.dataset import ShardTask, draw_free


def ignore(step, figures) -> None:
    pass


@pytest.fixture(scope="module")
def problems(scene, params, trained):
    members = []
    for name in ("level_cup", "level_cup_relaxed", "free"):
        manifold = constraint_manifold(scene.robot, params.constraints[name])
        joints = draw_free(ShardTask(scene, manifold, 1000, (1,)))
        curve = PinnedPolynomial(6, 3)
        members.append(LearnedProblem(trained.manifold, manifold, curve, joints, 16, True, 1.0))
    return ProblemSet(tuple(members))


@pytest.fixture(scope="module")
def small(params):
    ppo = params.geodesics.ppo.model_copy(update={"batch_size": 80, "hidden": (32, 32)})
    return params.geodesics.model_copy(
        update={
            "steps": 1600,
            "environments": 16,
            "checkpoint_steps": 600,
            "episode_steps": 6,
            "ppo": ppo,
        }
    )


@pytest.fixture(scope="module")
def policy(problems, small, tmp_path_factory):
    return train_policy(problems, small, 0, tmp_path_factory.mktemp("scratch"), ignore)


def test_a_set_measures_each_row_as_its_member_does(problems) -> None:
    rng = np.random.default_rng(0)
    ends = problems.sample_ends(60, rng)
    phi = problems.sample_curves(ends, rng)
    whole, costs = problems.observed(phi, ends), problems.evaluate(phi, ends)
    np.testing.assert_array_equal(whole.costs.cost, costs.cost)
    for k, member in enumerate(problems.members):
        rows = np.flatnonzero(ends.member == k)
        assert len(rows) > 5
        assert member.manifold.violation(ends.q_start[rows]).max() < 1e-6
        one = member.observed(phi[rows], ends[rows])
        # batches of another size round differently in single precision, which a retraction may
        # magnify
        close = np.isclose(one.costs.cost, costs.cost[rows], rtol=1e-3)
        assert close.mean() > 0.9
        np.testing.assert_allclose(one.descent[close], whole.descent[rows][close], atol=0.02)
        np.testing.assert_array_equal(one.features[:, -12:], whole.features[rows, -12:])


def test_a_set_of_different_charts_or_families_is_refused(problems) -> None:
    first = problems.members[0]
    other = LearnedProblem(
        first.chart, first.manifold, PinnedPolynomial(6, 4), first.joints, 16, True, 1.0
    )
    with pytest.raises(GeometryError, match="members of a problem set"):
        ProblemSet((first, other))


def test_steps_along_the_descent_shorten_curves(problems) -> None:
    rng = np.random.default_rng(1)
    ends = problems.sample_ends(90, rng)
    phi = np.zeros((90, problems.curve.coefficients))
    first = problems.observed(phi, ends)
    now = first
    for _ in range(6):
        phi = phi + 0.7 * now.descent
        now = problems.observed(phi, ends)
    both = first.costs.feasible & now.costs.feasible & (ends.member < 2)
    assert both.sum() > 25
    ratio = now.costs.length[both] / first.costs.length[both]
    assert (ratio < 1.002).mean() > 0.9
    assert ratio.mean() < 0.995
    sizes = [
        np.linalg.norm(look.descent[both], axis=1) / ends.distance[both] for look in (first, now)
    ]
    assert np.median(sizes[1]) < 0.3 * np.median(sizes[0])


def test_observations_have_the_size_announced_and_are_finite(problems, small) -> None:
    rng = np.random.default_rng(2)
    ends = problems.sample_ends(40, rng)
    states = begin(problems, ends, 3 * problems.sample_curves(ends, rng))
    seen = observe(small, states)
    assert (
        seen.shape
        == (40, observation_size(problems))
        == (40, observation_size(problems.members[2]))
    )
    assert np.isfinite(seen).all()
    assert np.abs(seen).max() < 40


def test_numpy_acts_as_the_trained_network_does(problems, policy, small, tmp_path) -> None:
    save_policy(policy, tmp_path, 0)
    mean = MeanPolicy.load(tmp_path, 0)
    ends = problems.sample_ends(30, np.random.default_rng(3))
    seen = observe(small, begin(problems, ends, np.zeros((30, problems.curve.coefficients))))
    theirs = load_policy(tmp_path, 0).act(seen, np.zeros((30, problems.curve.coefficients)))
    np.testing.assert_allclose(mean.act(seen), theirs, rtol=1e-4, atol=1e-5)


def test_proposals_are_the_best_of_each_policys_own_roll_out(
    problems, policy, small, tmp_path
) -> None:
    save_policy(policy, tmp_path, 0)
    count = 25
    ends = problems.sample_ends(count, np.random.default_rng(4))
    first = begin(problems, ends, np.zeros((count, problems.curve.coefficients)))
    found = propose(problems, [MeanPolicy.load(tmp_path, 0)] * 2, small, ends)
    noise = np.zeros((small.episode_steps, *first.phi.shape))
    visited = follow(problems, policy.actor, small, first, noise)
    assert (found.feasible[0] >= first.feasible).all()
    assert (found.cost[0][first.feasible] <= first.cost[first.feasible] * (1 + 1e-6)).all()
    np.testing.assert_array_equal(found.feasible[0], found.feasible[1])
    feasible = np.array([states.feasible for states in visited]).any(0)
    assert (feasible == found.feasible[0]).mean() > 0.9
    costs = problems.evaluate(found.phi[0], ends)
    np.testing.assert_allclose(costs.cost[costs.feasible], found.cost[0][costs.feasible], rtol=1e-2)


def test_interrupted_training_on_a_set_goes_on_as_if_it_had_never_stopped(
    problems, policy, small, tmp_path
) -> None:
    def interrupt(step, figures) -> None:
        if step > 1000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_policy(problems, small, 0, tmp_path, interrupt)
    assert train_policy(problems, small, 0, tmp_path, ignore).curve == policy.curve
