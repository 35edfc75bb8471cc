from dataclasses import fields, replace

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.descent import beginning, ranks
from constraint_geodesics.geodesics.episodes import (
    advance,
    begin,
    contributions,
    draw_episodes,
    observation_size,
    observe,
)
from constraint_geodesics.geodesics.learned_problem import LearnedProblem, ProblemSet
from constraint_geodesics.geodesics.policy_search import follow, save_policy, train_policy
from constraint_geodesics.geodesics.problem import repeated
from constraint_geodesics.geodesics.proposals import MeanPolicy, Met, rounds
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.manifold import GeometryError
from constraint_geodesics.learning.dataset import ShardTask, draw_free


def ignore(step, figures) -> None:
    pass


def untimed(curve: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{k: v for k, v in row.items() if k not in ("seconds", "steps_per_s")} for row in curve]


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
    sizes = {observation_size(own, small) for own in (problems, problems.members[2])}
    assert sizes == {seen.shape[1]}
    assert np.isfinite(seen).all()
    assert np.abs(seen).max() < 40


def test_numpy_acts_as_the_trained_network_does(problems, policy, small, tmp_path) -> None:
    save_policy(policy, tmp_path, 0)
    mean = MeanPolicy.load(tmp_path, 0)
    ends = problems.sample_ends(30, np.random.default_rng(3))
    seen = observe(small, begin(problems, ends, np.zeros((30, problems.curve.coefficients))))
    theirs = policy.actor.act(seen, np.zeros((30, problems.curve.coefficients)))
    np.testing.assert_allclose(mean.act(seen), theirs, rtol=1e-4, atol=1e-5)


def test_a_rounds_roll_outs_are_the_policys_own(problems, policy, small) -> None:
    asked = small.model_copy(update={"rollouts": 6, "kept": 3, "rounds": 2})
    problem, rng = problems.members[0], np.random.default_rng(4)
    ends = problem.sample_ends(1, rng)
    first, second = rounds(problem, policy.mean, asked, ends, np.random.default_rng(1))
    for met, own in ((first, asked.heads), (second, 0)):
        looked = len(met.phi) - 3 * (asked.episode_steps - 1) - 3  # roll-outs, and their rest
        drawn, more = divmod(looked - 1 - own, asked.rollouts - asked.heads)
        assert more == 0
        assert drawn == 1 or met.feasible[: looked - asked.rollouts + asked.heads].sum() < 3
    np.testing.assert_array_equal(first.phi[0], 0.0)
    costs = problem.evaluate(first.phi, ends[np.zeros(len(first.phi), dtype=int)])
    np.testing.assert_allclose(costs.cost, first.cost, rtol=1e-6)
    np.testing.assert_array_equal(costs.feasible, first.feasible)
    for own in range(3):
        rows = np.flatnonzero(first.rollout == own)
        states = begin(problem, ends, first.phi[rows[:1]])
        noise = np.zeros((asked.episode_steps - 1, 1, problem.curve.coefficients))
        visited = follow(problem, policy.actor, asked, replace(states, step=states.step + 1), noise)
        np.testing.assert_allclose(visited[1].phi[0], first.phi[rows[1]], atol=1e-3)


def test_fewer_and_fewer_curves_are_followed_and_the_last_come_to_rest(
    problems, policy, small
) -> None:
    asked = small.model_copy(update={"rollouts": 40, "kept": 24})
    problem, rng = problems.members[1], np.random.default_rng(9)
    better, arrays = [], [field.name for field in fields(Met) if field.name != "looks"]
    for _ in range(5):
        ends = problem.sample_ends(1, rng)
        met = next(rounds(problem, policy.mean, asked, ends, rng))
        counts = np.bincount(met.rollout[met.rollout >= 0], minlength=24)
        steps = asked.episode_steps - 1
        assert (np.sort(counts)[::-1][:4] >= 1 + steps).all(), "some are followed to the end"
        assert counts.sum() == 24 + 24 + 12 + 6 * (steps - 2) + 4
        np.testing.assert_array_equal(np.flatnonzero(met.last), np.arange(-10, 0) + len(met.phi))
        # measured again in the batch that went down: another size rounds differently
        before = Met(*(getattr(met, name)[:-4] for name in arrays))
        rows = before.best_of_each[:4]
        np.testing.assert_array_equal(met.rollout[-4:], before.rollout[rows])
        begun = beginning(problem, before.phi[rows], repeated(ends, 4)).rank
        rested = ranks(met)[-4:]
        assert (rested <= begun).all(), "the descent makes nothing worse"
        better.append((rested < begun).any())
    assert sum(better) >= 3, "it makes most better"


def test_what_deserves_a_check_is_diverse_and_feasible(problems, policy, small) -> None:
    asked = small.model_copy(update={"rollouts": 16, "kept": 3})
    problem, rng = problems.members[1], np.random.default_rng(5)
    for _ in range(5):
        ends = problem.sample_ends(1, rng)
        met = next(rounds(problem, policy.mean, asked, ends, rng))
        assert met.feasible[met.usable].all()
        best = met.best_of_each
        assert len(best) == 3
        assert len(set(met.rollout[best])) == 3
        several = best[met.feasible[best]]
        np.testing.assert_array_equal(met.usable[: len(several)], several)
        assert (np.diff(met.cost[several]) >= 0).all()
        for row in several:
            same = (met.rollout == met.rollout[row]) & met.feasible
            assert met.cost[row] == met.cost[same].min()


def test_heads_of_one_pass_part_and_are_paid_for_it(problems, small) -> None:
    several = small.model_copy(
        update={
            "heads": 4,
            "reward": small.reward.model_copy(update={"set_weight": 1.0, "feasible_weight": 0.1}),
        }
    )
    rng = np.random.default_rng(6)
    states = draw_episodes(problems, several, 16, rng)
    np.testing.assert_array_equal(states.head, np.tile(np.arange(4), 4))
    for name in ("z_start", "z_goal", "member"):
        values = getattr(states.ends, name).reshape(4, 4, -1)
        assert (values == values[:, :1]).all(), "a set shares its ends"
    size = observation_size(problems, several)
    assert size == observation_size(problems, small) + 4
    price = np.array(
        [[1.0, 1.2, np.inf, 2.0], [np.inf] * 4, [0.9, 0.9, 1.0, 3.0], [1.0] + [np.inf] * 3]
    )
    paid = contributions(
        4, replace(states, best_feasible=price.ravel(), straight_cost=np.ones(16))
    ).reshape(4, 4)
    np.testing.assert_allclose(paid[0], [0.2, 0.0, 0.0, 0.0])
    np.testing.assert_array_equal(paid[1:3], 0.0)
    np.testing.assert_allclose(paid[3], [1.0, 0.0, 0.0, 0.0])
    actions = rng.uniform(-1, 1, states.phi.shape)
    after, reward = advance(problems, several, states, actions)
    plain = advance(problems, small, states, actions)[1]
    np.testing.assert_allclose(
        reward - plain, 0.1 * after.feasible + contributions(4, after), atol=1e-9
    )


def test_interrupted_training_on_a_set_goes_on_as_if_it_had_never_stopped(
    problems, policy, small, tmp_path
) -> None:
    def interrupt(step, figures) -> None:
        if step > 1000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_policy(problems, small, 0, tmp_path, interrupt)
    again = train_policy(problems, small, 0, tmp_path, ignore)
    assert untimed(again.curve) == untimed(policy.curve)
