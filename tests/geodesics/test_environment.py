import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_gymnasium
from stable_baselines3.common.env_checker import check_env as check_stable_baselines

from constraint_geodesics.geodesics.environment import CurveEnv, CurveVecEnv, scalar_environments
from constraint_geodesics.geodesics.episodes import advance, begin, gompertz, observe, rewards
from constraint_geodesics.geodesics.problem import Ends
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.studies.geodesic_search import analytic_problem, curve_family


@pytest.fixture(scope="module")
def problem(params):
    return analytic_problem("sphere", curve_family(2, params.geodesics))


@pytest.fixture(scope="module")
def settings(params):
    ppo = params.geodesics.ppo.model_copy(update={"action_scale": 0.25})
    return params.geodesics.model_copy(update={"episode_steps": 5, "ppo": ppo})


def test_gompertz_rises_from_nought_to_one() -> None:
    x = np.linspace(-0.3, 2, 9)
    values = gompertz(x, 3.0, 8.0)
    assert (np.diff(values) > 0).all()
    assert gompertz(np.zeros(1), 3.0, 8.0)[0] == pytest.approx(np.exp(-3.0))
    assert np.isfinite(gompertz(np.array([-1e6, 1e6]), 3.0, 8.0)).all()


def test_the_corrected_reward_pays_for_short_curves_the_printed_one_for_long(params) -> None:
    straight, before = np.full(3, 2.0), np.full(3, 2.0)
    after = np.array([1.0, 1.5, 1.9])
    corrected = rewards(params.geodesics.reward, before, after, straight)
    assert (np.diff(corrected) < 0).all()
    assert (np.abs(corrected) <= 1).all()
    by_length = params.geodesics.reward.model_copy(
        update={"form": "printed", "length_weight": 1.0, "reduction_weight": 0.0, "c": 1.0}
    )
    assert (np.diff(rewards(by_length, before, after, straight)) > 0).all()


def test_a_longer_curve_earns_no_reduction(params) -> None:
    only_reduction = params.geodesics.reward.model_copy(
        update={"length_weight": 0.0, "reduction_weight": 1.0}
    )
    reward = rewards(only_reduction, np.array([1.0, 1.0]), np.array([1.1, 0.9]), np.ones(2))
    assert reward[0] == 0.0
    assert reward[1] > 0.0


def test_one_curve_and_many_give_the_same(problem, settings) -> None:
    rng = np.random.default_rng(0)
    ends = problem.sample_ends(7, rng)
    phi, action = (
        problem.sample_curves(ends, rng),
        rng.uniform(-1, 1, (7, problem.curve.coefficients)),
    )
    states, reward = advance(problem, settings, begin(problem, ends, phi), action)
    for i in range(7):
        one = np.array([i])
        single, single_reward = advance(
            problem, settings, begin(problem, ends[one], phi[one]), action[one]
        )
        np.testing.assert_allclose(single_reward, reward[one], rtol=1e-12)
        np.testing.assert_allclose(
            observe(settings, single), observe(settings, states)[one], rtol=1e-6
        )


def test_the_single_environment_passes_both_checkers(problem, settings) -> None:
    check_gymnasium(CurveEnv(problem, settings), skip_render_check=True)
    check_stable_baselines(CurveEnv(problem, settings))


def test_episodes_end_by_time_and_restart(problem, settings) -> None:
    environment = CurveVecEnv(problem, settings, 4, seed=0)
    environment.reset()
    zero = np.zeros((4, problem.curve.coefficients))
    for step in range(settings.episode_steps):
        before = environment.states
        observation, _, done, infos = environment.step(zero)
        assert done.all() == (step == settings.episode_steps - 1)
    last = advance(problem, settings, before, zero)[0]
    np.testing.assert_array_equal(infos[2]["terminal_observation"], observe(settings, last)[2])
    assert (environment.states.step == 0).all()
    assert not np.array_equal(observation[2], infos[2]["terminal_observation"])


def test_the_seed_decides(problem, settings) -> None:
    def first(seed):
        environment = CurveVecEnv(problem, settings, 3, seed=9)
        environment.seed(seed)
        return environment.reset()

    np.testing.assert_array_equal(first(1), first(1))
    assert not np.array_equal(first(1), first(2))


def test_the_best_curve_is_never_worse_than_the_straight_one(problem, settings) -> None:
    rng = np.random.default_rng(3)
    ends = problem.sample_ends(50, rng)
    states = begin(problem, ends, problem.sample_curves(ends, rng))
    for _ in range(4):
        states, _ = advance(problem, settings, states, rng.uniform(-1, 1, states.phi.shape))
        assert (states.best_cost <= states.straight_cost).all()
        np.testing.assert_allclose(
            problem.evaluate(states.best_phi, ends).cost, states.best_cost, rtol=1e-12
        )


def test_a_near_and_a_far_pair_look_alike(settings) -> None:
    problem = analytic_problem("plane", PinnedPolynomial(2, 3))
    start = np.zeros((2, 2))
    ends = Ends(*2 * (start, np.array([[1.0, 0.0], [0.01, 0.0]])))
    phi = np.tile([0.3, -0.2, 0.1, 0.4], (2, 1)) * ends.distance[:, None]
    states, reward = advance(
        problem, settings, begin(problem, ends, phi), np.tile([0.5, -1.0, 0.2, 0.1], (2, 1))
    )
    far, near = observe(settings, states)
    assert reward[0] == pytest.approx(reward[1], rel=1e-9)
    coefficients = problem.curve.coefficients
    np.testing.assert_allclose(far[:coefficients], near[:coefficients], rtol=1e-5)
    np.testing.assert_allclose(far[-3:], near[-3:], rtol=1e-5)


def test_scalar_environments_step_like_the_batched_one(problem, settings) -> None:
    batched, scalar = (
        CurveVecEnv(problem, settings, 3, seed=0),
        scalar_environments(lambda: CurveEnv(problem, settings), 3),
    )
    batched.reset(), scalar.reset()
    for row, environment in enumerate(scalar.envs):
        assert isinstance(environment, CurveEnv)
        one = np.array([row])
        environment.states = begin(problem, batched.states.ends[one], batched.states.phi[one])
    actions = (
        np.random.default_rng(0).uniform(-1, 1, (3, problem.curve.coefficients)).astype(np.float32)
    )
    for ours, theirs in zip(batched.step(actions)[:2], scalar.step(actions)[:2], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)
