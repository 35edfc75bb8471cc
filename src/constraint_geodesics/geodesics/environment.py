"""The Markov decision process of eqs. 9-15, batched: a state is a curve, an action changes its coefficients.

The pure functions at the top hold the whole of it; `CurveVecEnv` only keeps the state for stable-baselines3, and
`CurveEnv` is one copy of it with the usual interface.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Bool, Float, Int
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from constraint_geodesics.geodesics.problem import Costs, Ends, GeodesicProblem
from constraint_geodesics.params import RewardParams


@dataclass(frozen=True)
class EpisodeSettings:
    """Length of an episode, size of an action, reward."""

    steps: int
    action_scale: float
    reward: RewardParams


@dataclass(frozen=True)
class CurveStates:
    """B curves under way: coefficients (in the chart's unit), ends, length, cost and feasibility now, cost of the
    straight line, steps taken, and the cheapest curve met so far.
    """

    phi: Float[np.ndarray, "B p"]
    ends: Ends
    length: Float[np.ndarray, "B"]
    cost: Float[np.ndarray, "B"]
    feasible: Bool[np.ndarray, "B"]
    straight_cost: Float[np.ndarray, "B"]
    step: Int[np.ndarray, "B"]
    best_phi: Float[np.ndarray, "B p"]
    best_cost: Float[np.ndarray, "B"]

    def replaced(self, rows: np.ndarray, other: "CurveStates") -> "CurveStates":
        """A copy with the given rows taken from `other`."""
        fields: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Ends):
                fields[name] = value.replaced(rows, other.ends)
            else:
                fields[name] = value.copy()
                fields[name][rows] = getattr(other, name)
        return CurveStates(**fields)


def begin(problem: GeodesicProblem, ends: Ends, phi: Float[np.ndarray, "B p"]) -> CurveStates:
    """First states of B episodes."""
    straight = problem.evaluate(np.zeros_like(phi), ends)
    bent = np.flatnonzero(phi.any(axis=1))
    now = Costs(straight.length.copy(), straight.cost.copy(), straight.feasible.copy())
    if len(bent):
        costs = problem.evaluate(phi[bent], ends[bent])
        now.length[bent], now.cost[bent], now.feasible[bent] = costs.length, costs.cost, costs.feasible
    better = now.cost < straight.cost
    return CurveStates(
        phi, ends, now.length, now.cost, now.feasible, straight.cost, np.zeros(len(phi), dtype=np.int64),
        np.where(better[:, None], phi, 0.0), np.minimum(now.cost, straight.cost),
    )  # fmt: skip


def draw_episodes(problem: GeodesicProblem, count: int, rng: np.random.Generator) -> CurveStates:
    """Episodes on random ends; every other one starts from a random curve, so that bad ones are met as well."""
    ends = problem.sample_ends(count, rng)
    phi = problem.sample_curves(ends, rng) * rng.integers(2, size=(count, 1))
    return begin(problem, ends, phi)


def advance(
    problem: GeodesicProblem, settings: EpisodeSettings, states: CurveStates, actions: Float[np.ndarray, "B p"]
) -> tuple[CurveStates, Float[np.ndarray, "B"]]:
    """One step of B episodes: new states and rewards (eq. 15).

    An action of 1 changes a coefficient by `action_scale` times the distance of the ends: a near pair needs as fine a
    bend, in proportion, as a far one, and the policy sees all of them at one scale.
    """
    phi = states.phi + settings.action_scale * states.ends.distance[:, None] * np.clip(actions, -1.0, 1.0)
    costs = problem.evaluate(phi, states.ends)
    reward = rewards(settings.reward, states.cost, costs.cost, states.straight_cost)
    better = costs.cost < states.best_cost
    moved = replace(
        states, phi=phi, length=costs.length, cost=costs.cost, feasible=costs.feasible, step=states.step + 1,
        best_phi=np.where(better[:, None], phi, states.best_phi), best_cost=np.minimum(states.best_cost, costs.cost),
    )  # fmt: skip
    return moved, reward


def rewards(
    params: RewardParams, before: Float[np.ndarray, "B"], after: Float[np.ndarray, "B"],
    straight: Float[np.ndarray, "B"],
) -> Float[np.ndarray, "B"]:  # fmt: skip
    """Eq. 15, r = K_L R_L + K_Δ R_Δ with R(x) = exp(−b exp(−c x)), and R_Δ only where the curve became shorter.

    "corrected" does what the paper's text says: R rises with x, so R_L takes the saving against the straight line,
    1 − L/L_straight, and R_Δ the relative reduction.  "printed" is R_L = R(L), R_Δ = R(Δ), which pays for long curves.
    """
    reduction = before - after
    if params.form == "printed":
        saved = after
    else:
        saved = 1.0 - after / np.maximum(straight, 1e-9)
        reduction = reduction / np.maximum(before, 1e-9)
    by_length = gompertz(saved, params.b, params.c)
    by_reduction = np.where(reduction > 0.0, gompertz(reduction, params.b, params.c), 0.0)
    return params.length_weight * by_length + params.reduction_weight * by_reduction


def gompertz(x: Float[np.ndarray, "*batch"], b: float, c: float) -> Float[np.ndarray, "*batch"]:
    """R(x) = exp(−b exp(−c x)) of eq. 15, rising from 0 to 1."""
    return np.exp(-b * np.exp(np.clip(-c * x, -50.0, 50.0)))


def observe(settings: EpisodeSettings, states: CurveStates) -> Float[np.ndarray, "B o"]:
    """What the policy sees: coefficients in units of the ends' distance, both ends, saving against the straight line,
    best saving, time left.
    """
    scale = np.maximum(states.straight_cost, 1e-9)
    columns = [
        states.phi / states.ends.distance[:, None],
        states.ends.z_start,
        states.ends.z_goal,
        np.clip(states.cost / scale - 1.0, -2.0, 2.0)[:, None],
        np.clip(states.best_cost / scale - 1.0, -2.0, 2.0)[:, None],
        1.0 - states.step[:, None] / settings.steps,
    ]
    return np.concatenate(columns, axis=1).astype(np.float32)


def observation_size(problem: GeodesicProblem) -> int:
    """Length of an observation."""
    return problem.curve.coefficients + 2 * problem.curve.dim + 3


def _spaces(problem: GeodesicProblem) -> tuple[spaces.Box, spaces.Box]:
    observation = spaces.Box(-np.inf, np.inf, (observation_size(problem),), np.float32)
    return observation, spaces.Box(-1.0, 1.0, (problem.curve.coefficients,), np.float32)


class CurveVecEnv(VecEnv):
    """Many curves at once.  Episodes end by time only, so every end is a truncation, and restarts are automatic."""

    def __init__(self, problem: GeodesicProblem, settings: EpisodeSettings, count: int, seed: int) -> None:
        super().__init__(count, *_spaces(problem))
        self.problem, self.settings = problem, settings
        self.rng = np.random.default_rng(seed)
        self.states = draw_episodes(problem, count, self.rng)
        self.savings: list[float] = []
        self.returns = np.zeros(count)
        self.episode_returns: list[float] = []
        self._actions = np.zeros((count, problem.curve.coefficients))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset; one stream serves all curves."""
        super().seed(seed)
        return list(self._seeds)

    def reset(self) -> np.ndarray:
        """Fresh episodes everywhere."""
        if self._seeds and self._seeds[0] is not None:
            self.rng = np.random.default_rng(self._seeds[0])
        self._reset_seeds()
        self.states = draw_episodes(self.problem, self.num_envs, self.rng)
        self.returns[:] = 0.0
        return observe(self.settings, self.states)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = np.array(actions, np.float64)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all curves; finished episodes restart, their last observation stands in the infos."""
        self.states, reward = advance(self.problem, self.settings, self.states, self._actions)
        self.returns += reward
        done = self.states.step >= self.settings.steps
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        observation = observe(self.settings, self.states)
        if done.any():
            rows = np.flatnonzero(done)
            for row in rows:
                infos[row] = {"terminal_observation": observation[row].copy(), "TimeLimit.truncated": True}
            self.savings += (1.0 - self.states.best_cost[rows] / self.states.straight_cost[rows]).tolist()
            self.episode_returns += self.returns[rows].tolist()
            self.returns[rows] = 0.0
            self.states = self.states.replaced(rows, draw_episodes(self.problem, len(rows), self.rng))
            observation = observe(self.settings, self.states)
        return observation, reward.astype(np.float32), done, infos

    def pop_figures(self) -> dict[str, float]:
        """Means over the episodes finished since the last call: the best curve's saving over the straight, return."""
        figures = {
            "saving": float(np.mean(self.savings)) if self.savings else 0.0,
            "return": float(np.mean(self.episode_returns)) if self.episode_returns else 0.0,
        }
        self.savings, self.episode_returns = [], []
        return figures

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same attribute for every curve."""
        return [getattr(self, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:  # noqa: ARG002
        """One attribute for all curves."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method once for each curve named."""
        return [getattr(self, method_name)(*method_args, **method_kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None) -> list[bool]:  # noqa: ARG002
        """No copy is wrapped by itself."""
        return [False for _ in self._get_indices(indices)]


class CurveEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One curve with gymnasium's interface, on the same functions."""

    def __init__(self, problem: GeodesicProblem, settings: EpisodeSettings) -> None:
        self.problem, self.settings = problem, settings
        self.observation_space, self.action_space = _spaces(problem)
        self.states: CurveStates | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:  # noqa: ARG002
        """A fresh episode."""
        super().reset(seed=seed)
        self.states = draw_episodes(self.problem, 1, self.np_random)
        return observe(self.settings, self.states)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One change of the curve; episodes are only ever truncated."""
        if self.states is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self.states, reward = advance(self.problem, self.settings, self.states, np.asarray(action, np.float64)[None])
        observation = observe(self.settings, self.states)[0]
        return observation, float(reward[0]), False, bool(self.states.step[0] >= self.settings.steps), {}


def scalar_environments(make: Callable[[], gymnasium.Env], count: int) -> VecEnv:
    """One scalar environment a copy, stepped one after another: the usual way, and the measure of `CurveVecEnv`."""
    return DummyVecEnv([make] * count)
