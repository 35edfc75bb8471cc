"""Policy search of geodesics (eqs. 13-15): PPO over random ends, then a batch of roll-outs for each
query.

PPO comes from stable-baselines3; what leaves this module is a small actor network in safetensors.
"""

import json
import sys
import time
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from constraint_geodesics.geodesics.environment import CurveVecEnv
from constraint_geodesics.geodesics.episodes import CurveStates, moved, observation_size, observe
from constraint_geodesics.geodesics.problem import (
    ChartProblem,
    Ends,
    Geodesic,
    GeodesicProblem,
    Phi,
)
from constraint_geodesics.geodesics.proposals import MeanPolicy, Met, random_round, rounds
from constraint_geodesics.geodesics.solver import goal_images
from constraint_geodesics.geometry.manifold import GeometryError
from constraint_geodesics.params import GeodesicParams, PpoParams
from constraint_geodesics.pipeline.code import code_digest
from constraint_geodesics.text_files import DamagedFileError, reading, write_bytes, written

MOST_CHECKED = 40
"""Candidates given to the exact check at most: those behind them are no shorter and mostly alike.
"""

REPORTS = 50
"""Rows of a learning curve, about."""
DIAGNOSTICS = {
    "approx_kl": "kl",
    "entropy_loss": "entropy_loss",
    "value_loss": "value_loss",
    "explained_variance": "explained_variance",
    "clip_fraction": "clipped",
}
"""PPO's own figures of its last update, by stable-baselines3's names and by ours."""

Report = Callable[[int, dict[str, float]], None]
Accept = Callable[[Float[np.ndarray, "p"]], bool]


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

    @property
    def mean(self) -> MeanPolicy:
        """The actor's mean action, in numpy."""
        return MeanPolicy.from_arrays({n: v.numpy() for n, v in self.actor.state_dict().items()})


def train_policy(
    problem: GeodesicProblem, params: GeodesicParams, seed: int, scratch: Path, report: Report
) -> TrainedPolicy:
    """Train one policy on random ends.

    scratch: of the checkpoints, from which an interrupted training goes on as if it had never
    stopped.
    report: called with (environment steps, figures) about REPORTS times.
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
    size = observation_size(problem, params)
    actor = Actor(size, params.ppo.hidden, problem.curve.coefficients)
    actor.load_state_dict(actor_weights(model.policy.state_dict()))
    return TrainedPolicy(actor.eval().requires_grad_(False), log.rows)


@dataclass(frozen=True)
class PolicySolver:
    """Policy search as a solver: rounds of roll-outs for every query, the same seed for each."""

    policy: MeanPolicy
    params: GeodesicParams
    seed: int = 0

    def solve(self, problem: ChartProblem, ends: Ends) -> list[Geodesic]:
        """The shortest curve that `search` meets between each start and any image of its goal.

        Raises GeometryError if the policy was trained for another family or dimension.
        """
        wanted, trained = problem.curve.coefficients, self.policy.actions
        if wanted != trained:
            raise GeometryError(
                f"the policy changes {trained} coefficients: must be those of the curve, {wanted}"
            )
        query, goal = goal_images(problem, ends)
        asked = Ends(ends.z_start[query], goal, ends.z_start[query], goal)
        found = [
            self.search(problem, asked[np.array([k])], lambda _: True) for k in range(len(asked))
        ]
        return [
            _shortest([found[k] for k in np.flatnonzero(query == row)]) for row in range(len(ends))
        ]

    def search(self, problem: GeodesicProblem, ends: Ends, accept: Accept) -> Geodesic:
        """The shortest acceptable curve of the first round that meets one (`proposals.rounds`).

        accept: an exact check (collision, say) of the feasible candidates, shortest first.
        """
        began, rng = time.perf_counter(), np.random.default_rng(self.seed)
        asked = rounds(problem, self.policy, self.params, ends, rng)
        return _first_accepted(problem, ends, asked, accept, began)

    def search_at_random(
        self, problem: GeodesicProblem, ends: Ends, accept: Accept, curves: int = 0
    ) -> Geodesic:
        """A control of `search`: no curve is by a policy, chosen by the same rule; as many as a
        first round has without a look for feasible ones, or `curves` if these are more.
        """
        began, params = time.perf_counter(), self.params
        number = max(params.rollouts + params.kept * params.episode_steps, curves)
        drawn = random_round(problem, ends, number, np.random.default_rng(self.seed))
        return _first_accepted(problem, ends, [drawn], accept, began)


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
        visited.append(moved(problem, params, visited[-1], action))
    return visited


def _first_accepted(
    problem: GeodesicProblem, ends: Ends, asked: Iterable[Met], accept: Accept, began: float
) -> Geodesic:
    """The cheapest feasible candidate of the first round with one that passes the exact check."""
    evaluations = 0
    for met in asked:
        evaluations += met.looks or len(met.phi)
        row = next((int(r) for r in met.usable[:MOST_CHECKED] if accept(met.phi[r])), None)
        if row is None:
            continue
        zero = np.zeros((1, problem.curve.coefficients))
        return Geodesic(
            "iteration_limit" if met.last[row] else "converged",
            problem.curve,
            met.phi[row],
            ends.z_start[0],
            ends.z_goal[0],
            float(met.length[row]),
            float(problem.evaluate(zero, ends).length[0]),
            evaluations=evaluations,
            time_s=time.perf_counter() - began,
        )
    none = Geodesic.nothing("not_found", problem.curve, ends.z_start[0], ends.z_goal[0])
    return replace(none, evaluations=evaluations, time_s=time.perf_counter() - began)


def _shortest(found: Sequence[Geodesic]) -> Geodesic:
    """The shortest answer to one query, with the work of all; the first is to the nearest image."""
    best = min(found, key=lambda one: one.length if one.found else np.inf)
    return replace(
        best,
        straight_length=found[0].straight_length,
        evaluations=sum(one.evaluations for one in found),
        time_s=sum(one.time_s for one in found),
    )


def save_policy(policy: TrainedPolicy, folder: Path, seed: int) -> None:
    """Weights (safetensors) of one seed; `MeanPolicy.load` reads them."""
    write_bytes(folder / f"policy-{seed}.safetensors", save(policy.actor.state_dict()))


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
        environment,
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
            # the last rollout goes beyond the steps asked for: what is left is negative then
            ppo.learning_rate_end + max(left, 0.0) * (ppo.learning_rate - ppo.learning_rate_end)
        ),
        policy_kwargs={"net_arch": list(ppo.hidden), "log_std_init": -0.5},
    )
    model.set_logger(Logger(None, []))  # its own would leave a folder in /tmp for every training
    return model


def write_checkpoint(content: Mapping[str, Any], file: Path) -> None:
    """Into an open file: by a name torch says of a full disk neither that nor the name."""
    with written(file) as part, part.open("wb") as opened:
        torch.save(content, opened)


def _checkpoint(file: Path) -> dict[str, Any]:
    """Raises DamagedFileError; torch itself does not look at the checksums that it writes."""
    with reading(file), zipfile.ZipFile(file) as whole:
        if bad := whole.testzip():
            raise DamagedFileError(f"{file}: damaged: the checksum of {bad} differs")
        content: dict[str, Any] = torch.load(file, weights_only=True)
        return content


def _code_of(problem: Any) -> list[str]:
    """The modules that a training hangs on: this one, and the problem's if it is of the package."""
    package, _, own = type(problem).__module__.partition(".")
    return ["geodesics.policy_search", *([own] if package == __name__.partition(".")[0] else [])]


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
        self.total = params.steps
        # a checkpoint belongs to its inputs: with other data, parameters, seed or code it is not
        # found
        code, problem = code_digest(*_code_of(environment.problem)), environment.problem
        key = joblib.hash((problem.fingerprint(), params.model_dump(), seed, code))
        self.file = scratch / f"{key}.pt"
        self.rows: list[dict[str, float]] = []
        self._saved_at = self._reported_at = 0
        self._began, self._before_s, self._reported_s = time.perf_counter(), 0.0, 0.0
        self._before: dict[str, float] = {}

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._saved_at >= self.every:
            self.save()

    def _on_rollout_end(self) -> None:
        """Report once in a while: episodes since last time, and the update before this rollout."""
        done = int(REPORTS * self.num_timesteps / self.total)
        if done == int(REPORTS * self._reported_at / self.total):
            return
        figures, seconds = self.environment.pop_figures(), self._seconds()
        rate = (self.num_timesteps - self._reported_at) / max(seconds - self._reported_s, 1e-9)
        figures |= {"seconds": seconds, "steps_per_s": rate}
        self._reported_at, self._reported_s = self.num_timesteps, seconds
        figures |= self._diagnostics()
        self.rows.append({"steps": float(self.num_timesteps), **figures})
        self.report(self.num_timesteps, figures)

    def _diagnostics(self) -> dict[str, float]:
        """PPO's figures of its last update."""
        met = self.logger.name_to_value
        found = {own: met.get(f"train/{name}") for name, own in DIAGNOSTICS.items()}
        return self._before | {own: float(v) for own, v in found.items() if v is not None}

    def _seconds(self) -> float:
        """Time spent on this training, before an interruption too."""
        return self._before_s + time.perf_counter() - self._began

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
            "seconds": self._seconds(),
            "diagnostics": self._diagnostics(),
            "reported": [float(self._reported_at), self._reported_s],
            "unreported": [environment.savings, environment.episode_returns, environment.solved],
            "rows": self.rows,
        }
        write_checkpoint(content, self.file)
        self._saved_at = self.num_timesteps

    def restore(self, model: PPO) -> None:
        """Put the last checkpoint, if there is one, back into the model and the environment."""
        if not self.file.is_file():
            return
        try:
            content = _checkpoint(self.file)
        except DamagedFileError as error:
            print(f"{error}: training begins anew", file=sys.stderr, flush=True)
            return
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
        self.rows, self._before = content["rows"], content["diagnostics"]
        self._before_s, self._began = content["seconds"], time.perf_counter()
        self._reported_at, self._reported_s = int(content["reported"][0]), content["reported"][1]
        environment.savings, environment.episode_returns, environment.solved = content["unreported"]
