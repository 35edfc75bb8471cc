"""Policy search of geodesics (eqs. 13-15): PPO over random ends, then a batch of roll-outs for each
query.

PPO comes from stable-baselines3; what leaves this module is a small actor network in safetensors.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from torch import Tensor, nn

from constraint_geodesics.geodesics.environment import CurveVecEnv
from constraint_geodesics.geodesics.episodes import (
    CurveStates,
    advance,
    begin,
    observation_size,
    observe,
)
from constraint_geodesics.geodesics.problem import (
    ChartProblem,
    Costs,
    Ends,
    Geodesic,
    GeodesicProblem,
    Phi,
    SearchStatus,
    repeated,
)
from constraint_geodesics.geodesics.solver import to_nearest_images
from constraint_geodesics.geometry.manifold import GeometryError
from constraint_geodesics.params import GeodesicParams, PpoParams

DRAWN_A_START = 16
"""Random curves drawn for each of those that roll-outs start from."""
MOST_CHECKED = 40
"""Candidates given to the exact check at most: those behind them are no shorter and mostly alike.
"""

Report = Callable[[int, dict[str, float]], None]
Accept = Callable[[Float[np.ndarray, "p"]], bool]
_Measured = tuple[Phi, Costs]
"""Candidates of one query that were measured together: one step of the search."""


class Actor(nn.Module):
    """The policy alone: observation → mean action, with one standard deviation an action."""

    def __init__(self, observation: int, hidden: Sequence[int], actions: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = observation
        for size in hidden:
            layers += [nn.Linear(width, size), nn.Tanh()]
            width = size
        self.body = nn.Sequential(*layers)
        self.mean = nn.Linear(width, actions)
        self.log_std = nn.Parameter(torch.zeros(actions))
        self.sizes = {"observation": observation, "hidden": list(hidden), "actions": actions}

    def forward(self, observation: Float[Tensor, "B o"]) -> Float[Tensor, "B p"]:
        """Mean actions."""
        return self.mean(self.body(observation))

    def act(self, observation: Float[np.ndarray, "B o"], noise: Phi) -> Phi:
        """Mean actions plus the given multiples of the standard deviation."""
        with torch.no_grad():
            mean = self(torch.from_numpy(observation)).numpy()
            return mean + noise * self.log_std.exp().numpy()


@dataclass(frozen=True)
class TrainedPolicy:
    """An actor and its learning curve, one row a report."""

    actor: Actor
    curve: list[dict[str, float]]


def train_policy(
    problem: GeodesicProblem, params: GeodesicParams, seed: int, scratch: Path, report: Report
) -> TrainedPolicy:
    """Train one policy on random ends.

    scratch: of the checkpoints, from which an interrupted training goes on as if it had never
    stopped.
    report: called with (environment steps, figures) after every rollout.
    """
    torch.manual_seed(seed)
    environment = CurveVecEnv(problem, params, params.environments, seed)
    model = ppo_model(environment, params, seed)
    log = _Progress(environment, params, seed, scratch, report)
    log.restore(model)
    remaining = params.steps - model.num_timesteps
    if remaining > 0:
        # with reset_num_timesteps=False stable-baselines3 adds the steps already done to this total
        # itself
        model.learn(remaining, callback=log, reset_num_timesteps=False)
        log.save()
    actor = Actor(observation_size(problem), params.ppo.hidden, problem.curve.coefficients)
    actor.load_state_dict(actor_weights(model.policy.state_dict()))
    return TrainedPolicy(actor.eval().requires_grad_(False), log.rows)


@dataclass(frozen=True)
class PolicySolver:
    """Policy search as a solver: roll-outs for every query, the same seed for each."""

    actor: Actor
    params: GeodesicParams
    seed: int = 0

    def solve(self, problem: ChartProblem, ends: Ends) -> list[Geodesic]:
        """The shortest curve that `search` meets between each start and the nearest image of its
        goal.

        Raises GeometryError if the policy was trained for another family or dimension.
        """
        wanted, trained = problem.curve.coefficients, self.actor.mean.out_features
        if wanted != trained:
            raise GeometryError(
                f"the policy changes {trained} coefficients: must be those of the curve, {wanted}"
            )
        near = to_nearest_images(problem, ends)
        rows = [near[np.array([row])] for row in range(len(ends))]
        return [self.search(problem, row, lambda _: True) for row in rows]

    def search(self, problem: GeodesicProblem, ends: Ends, accept: Accept) -> Geodesic:
        """The shortest acceptable curve that a batch of roll-outs meets between one pair of ends.

        The first roll-out follows the policy's mean from the straight line, the others sample its
        actions, half of them from the cheapest of many random curves.  Every curve met counts, the
        straight line and the random ones included.
        accept: an exact check (collision, say) of the feasible candidates, shortest first.
        """
        began, rng, params = time.perf_counter(), np.random.default_rng(self.seed), self.params
        count, size = params.rollouts, problem.curve.coefficients
        drawn = _random_curves(problem, ends, DRAWN_A_START * (count // 2), rng)
        starts = drawn[0][np.argsort(drawn[1].cost, kind="stable")[: count // 2]]
        phi = np.concatenate([np.zeros((count - len(starts), size)), starts])
        noise = rng.normal(size=(params.episode_steps, count, size))
        noise[:, 0] = 0.0
        first = begin(problem, repeated(ends, count), phi)
        visited = follow(problem, self.actor, params, first, noise)
        met = [(s.phi, Costs(s.length, s.cost, s.feasible)) for s in visited]
        return _first_accepted(problem, ends, [drawn, *met], accept, began)

    def search_at_random(self, problem: GeodesicProblem, ends: Ends, accept: Accept) -> Geodesic:
        """The control of `search`: as many curves, none by a policy, chosen by the same rule."""
        began, count = time.perf_counter(), self.params.rollouts
        number = DRAWN_A_START * (count // 2) + (self.params.episode_steps + 1) * count
        drawn = _random_curves(problem, ends, number, np.random.default_rng(self.seed))
        return _first_accepted(problem, ends, [drawn], accept, began)


def _random_curves(
    problem: GeodesicProblem, ends: Ends, count: int, rng: np.random.Generator
) -> _Measured:
    """Many random curves and their costs: in one batch they cost next to nothing."""
    many = repeated(ends, count)
    drawn = problem.sample_curves(many, rng)
    return drawn, problem.evaluate(drawn, many)


def follow(
    problem: GeodesicProblem,
    actor: Actor,
    params: GeodesicParams,
    states: CurveStates,
    noise: Float[np.ndarray, "I B p"],
) -> list[CurveStates]:
    """The I + 1 states of B roll-outs; noise in standard deviations of the policy."""
    visited = [states]
    for step_noise in noise:
        action = actor.act(observe(params, visited[-1]), step_noise)
        visited.append(advance(problem, params, visited[-1], action)[0])
    return visited


def _first_accepted(
    problem: GeodesicProblem, ends: Ends, steps: Sequence[_Measured], accept: Accept, began: float
) -> Geodesic:
    """The cheapest feasible candidate that passes the exact check, the straight line among them.

    It has not converged if the last of several steps met it: another one might shorten it further.
    """
    zero = np.zeros((1, problem.curve.coefficients))
    straight = problem.evaluate(zero, ends)
    phi = np.concatenate([zero, *(phi for phi, _ in steps)])
    cost = np.concatenate([straight.cost, *(costs.cost for _, costs in steps)])
    feasible = np.concatenate([straight.feasible, *(costs.feasible for _, costs in steps)])
    order = np.argsort(cost, kind="stable")
    candidates = order[feasible[order]][:MOST_CHECKED]
    if feasible[0] and 0 not in candidates:
        candidates = np.append(candidates, 0)
    row = next((int(row) for row in candidates if accept(phi[row])), None)
    if row is None:
        status: SearchStatus = "not_found"
        row, length = int(order[0]), float("nan")
    else:
        late = len(steps) > 1 and row >= len(phi) - len(steps[-1][0])
        status = "iteration_limit" if late else "converged"
        length = float(problem.evaluate(phi[row][None], ends).length[0])
    found = status, problem.curve, phi[row], ends.z_start[0], ends.z_goal[0], length
    work = len(steps), len(phi), time.perf_counter() - began
    return Geodesic(*found, float(straight.length[0]), *work)


def save_policy(policy: TrainedPolicy, folder: Path, seed: int) -> None:
    """Weights (safetensors) and layer sizes (JSON) of one seed."""
    folder.mkdir(parents=True, exist_ok=True)
    save_file(policy.actor.state_dict(), folder / f"policy-{seed}.safetensors")
    sizes = json.dumps(policy.actor.sizes, sort_keys=True)
    (folder / f"policy-{seed}.json").write_text(sizes + "\n")


def load_policy(folder: Path, seed: int) -> Actor:
    """Read what `save_policy` wrote."""
    actor = Actor(**json.loads((folder / f"policy-{seed}.json").read_text()))
    actor.load_state_dict(load_file(folder / f"policy-{seed}.safetensors"))
    return actor.eval().requires_grad_(False)


def actor_weights(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The actor's part of a stable-baselines3 policy, under this module's names."""
    prefix = "mlp_extractor.policy_net."
    names = {name: "body." + name.removeprefix(prefix) for name in state if name.startswith(prefix)}
    names |= {f"action_net.{part}": f"mean.{part}" for part in ("weight", "bias")}
    names["log_std"] = "log_std"
    return {own: state[name].detach().clone() for name, own in names.items()}


def ppo_model(environment: VecEnv, params: GeodesicParams, seed: int) -> PPO:
    """PPO as params.yaml describes it, before its first step."""
    ppo: PpoParams = params.ppo
    model = PPO(
        "MlpPolicy",
        VecMonitor(environment),
        seed=seed,
        device="cpu",
        verbose=0,
        n_steps=ppo.rollout_steps,
        batch_size=ppo.batch_size,
        n_epochs=ppo.epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip,
        ent_coef=ppo.entropy,
        learning_rate=lambda left: (
            ppo.learning_rate_end + left * (ppo.learning_rate - ppo.learning_rate_end)
        ),
        policy_kwargs={"net_arch": list(ppo.hidden), "log_std_init": -0.5},
    )
    model.set_logger(Logger(None, []))  # its own would leave a folder in /tmp for every training
    return model


class _Progress(BaseCallback):
    """Reports each rollout and keeps a checkpoint from which training goes on exactly."""

    def __init__(
        self,
        environment: CurveVecEnv,
        params: GeodesicParams,
        seed: int,
        scratch: Path,
        report: Report,
    ) -> None:
        super().__init__()
        self.environment, self.every, self.report = environment, params.checkpoint_steps, report
        # a checkpoint belongs to its inputs: with other data, parameters or seed it is not found
        key = joblib.hash((environment.problem.fingerprint(), params.model_dump(), seed))
        self.file = scratch / f"{key}.pt"
        self.rows: list[dict[str, float]] = []
        self._saved_at = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._saved_at >= self.every:
            self.save()

    def _on_rollout_end(self) -> None:
        figures = self.environment.pop_figures()
        self.rows.append({"steps": float(self.num_timesteps), **figures})
        self.report(self.num_timesteps, figures)

    def save(self) -> None:
        """Called where all that is still to come depends on this state alone."""
        environment, model = self.environment, self.model
        _, words, place, *_ = np.random.get_state(legacy=True)  # noqa: NPY002
        states = environment.states
        arrays = {name: value for name, value in vars(states).items() if name != "ends"}
        content: dict[str, Any] = {
            "policy": model.policy.state_dict(),
            "optimiser": model.policy.optimizer.state_dict(),
            "torch_rng": torch.get_rng_state(),
            "numpy_rng": np.asarray(words).tolist(),
            "numpy_rng_place": place,
            "environment_rng": json.dumps(environment.rng.bit_generator.state),
            "states": {name: torch.from_numpy(value) for name, value in arrays.items()},
            "ends": {name: torch.from_numpy(value) for name, value in vars(states.ends).items()},
            "returns": torch.from_numpy(environment.returns),
            "steps": self.num_timesteps,
            "rows": self.rows,
        }
        self.file.parent.mkdir(parents=True, exist_ok=True)
        torch.save(content, self.file.with_suffix(".new"))
        # an interruption leaves the old or the new, never half
        self.file.with_suffix(".new").replace(self.file)
        self._saved_at = self.num_timesteps

    def restore(self, model: PPO) -> None:
        """Put the last checkpoint, if there is one, back into the model and the environment."""
        if not self.file.is_file():
            return
        content = torch.load(self.file, weights_only=True)
        model.policy.load_state_dict(content["policy"])
        model.policy.optimizer.load_state_dict(content["optimiser"])
        torch.set_rng_state(content["torch_rng"])
        words = np.array(content["numpy_rng"], np.uint32)
        np.random.set_state(("MT19937", words, content["numpy_rng_place"], 0, 0.0))  # noqa: NPY002
        environment = self.environment
        environment.rng.bit_generator.state = json.loads(content["environment_rng"])
        ends = Ends(**{name: value.numpy() for name, value in content["ends"].items()})
        arrays = {name: value.numpy() for name, value in content["states"].items()}
        environment.states = CurveStates(ends=ends, **arrays)
        environment.returns = content["returns"].numpy()
        model.num_timesteps = self._saved_at = content["steps"]
        model._last_obs = observe(environment.params, environment.states)
        model._last_episode_starts = environment.states.step == 0
        self.rows = content["rows"]
