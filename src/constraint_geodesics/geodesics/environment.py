"""The Markov decision process of `episodes`, batched for stable-baselines3.

`CurveVecEnv` only keeps the state, and `CurveEnv` is one copy of it with the usual interface.
"""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from constraint_geodesics.geodesics.episodes import (
    CurveStates,
    advance,
    draw_episodes,
    observation_size,
    observe,
)
from constraint_geodesics.geodesics.problem import GeodesicProblem
from constraint_geodesics.params import GeodesicParams


def _spaces(problem: GeodesicProblem, params: GeodesicParams) -> tuple[spaces.Box, spaces.Box]:
    observation = spaces.Box(-np.inf, np.inf, (observation_size(problem, params),), np.float32)
    return observation, spaces.Box(-1.0, 1.0, (problem.curve.coefficients,), np.float32)


class CurveVecEnv(VecEnv):
    """Many curves at once, as many of each set as the policy has heads.

    Episodes end by time alone, which the policy sees: an end like any other, after which nothing
    can be earned.  They restart by themselves.  Raises ValueError unless `count` is a multiple of
    the heads.
    """

    def __init__(
        self, problem: GeodesicProblem, params: GeodesicParams, count: int, seed: int
    ) -> None:
        if count % params.heads:
            raise ValueError(f"environments={count}: must be a multiple of heads={params.heads}")
        super().__init__(count, *_spaces(problem, params))
        self.problem, self.params = problem, params
        self.rng = np.random.default_rng(seed)
        self.states = draw_episodes(problem, params, count, self.rng)
        self.savings: list[float] = []
        self.solved: list[bool] = []
        self.returns = np.zeros(count)
        self.episode_returns: list[float] = []
        self._actions = np.zeros((count, problem.curve.coefficients))

    def reset(self) -> np.ndarray:
        """Fresh episodes everywhere; one stream, the first seed's, serves all curves."""
        if self._seeds and self._seeds[0] is not None:
            self.rng = np.random.default_rng(self._seeds[0])
        self._reset_seeds()
        self.states = draw_episodes(self.problem, self.params, self.num_envs, self.rng)
        self.returns[:] = 0.0
        return observe(self.params, self.states)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = np.array(actions, np.float64)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance all curves; finished ones restart, their last observation is in the infos."""
        self.states, reward = advance(self.problem, self.params, self.states, self._actions)
        self.returns += reward
        done = self.states.step >= self.params.episode_steps
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        observation = observe(self.params, self.states)
        if done.any():
            rows = np.flatnonzero(done)
            for row in rows:
                infos[row] = {"terminal_observation": observation[row]}
            self.savings += (
                1.0 - self.states.best_cost[rows] / self.states.straight_cost[rows]
            ).tolist()
            usable = np.isfinite(self.states.best_feasible[rows]).reshape(-1, self.params.heads)
            self.solved += usable.any(axis=1).tolist()
            self.episode_returns += self.returns[rows].tolist()
            self.returns[rows] = 0.0
            self.states = self.states.replaced(
                rows, draw_episodes(self.problem, self.params, len(rows), self.rng)
            )
            observation = observe(self.params, self.states)
        return observation, reward.astype(np.float32), done, infos

    def pop_figures(self) -> dict[str, float]:
        """Mean saving over the straight line, and return, of episodes finished since last time; and
        the share of their sets that met a feasible curve.
        """
        figures = {
            "saving": float(np.mean(self.savings)) if self.savings else 0.0,
            "return": float(np.mean(self.episode_returns)) if self.episode_returns else 0.0,
            "feasible": float(np.mean(self.solved)) if self.solved else 0.0,
        }
        self.savings, self.episode_returns, self.solved = [], [], []
        return figures

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same attribute for every curve."""
        return [getattr(self, attr_name, None) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """One attribute for all curves."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method once for each curve named."""
        return [
            getattr(self, method_name)(*method_args, **method_kwargs)
            for _ in self._get_indices(indices)
        ]

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None
    ) -> list[bool]:
        """No copy is wrapped by itself."""
        return [False for _ in self._get_indices(indices)]


class CurveEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One curve with gymnasium's interface, on the same functions; a set of one head."""

    def __init__(self, problem: GeodesicProblem, params: GeodesicParams) -> None:
        self.problem, self.params = problem, params.model_copy(update={"heads": 1})
        self.observation_space, self.action_space = _spaces(problem, self.params)
        self.states: CurveStates | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """A fresh episode."""
        super().reset(seed=seed)
        self.states = draw_episodes(self.problem, self.params, 1, self.np_random)
        return observe(self.params, self.states)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """One change of the curve; the last of an episode ends it for good, since the observation
        says how many are left.
        """
        if self.states is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self.states, reward = advance(
            self.problem, self.params, self.states, np.asarray(action, np.float64)[None]
        )
        observation = observe(self.params, self.states)[0]
        return (
            observation,
            float(reward[0]),
            bool(self.states.step[0] >= self.params.episode_steps),
            False,
            {},
        )


def scalar_environments(make: Callable[[], gymnasium.Env], count: int) -> VecEnv:
    """One scalar environment a copy, stepped in turn: the usual way."""
    return DummyVecEnv([make] * count)
