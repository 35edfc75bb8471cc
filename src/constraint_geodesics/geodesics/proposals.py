"""Proposals of trained policies for new queries, with numpy alone and without noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from safetensors.numpy import load_file

from constraint_geodesics.geodesics.episodes import advance, begin, observe
from constraint_geodesics.geodesics.problem import Ends, GeodesicProblem
from constraint_geodesics.params import GeodesicParams


@dataclass(frozen=True)
class MeanPolicy:
    """A policy's mean action as a plain network: tanh layers, then a linear one, on
    `episodes.observe`.

    layers: weights (out, in) and biases (out,), in their order.
    """

    layers: tuple[tuple[Float[np.ndarray, "o i"], Float[np.ndarray, "o"]], ...]

    def act(self, observation: Float[np.ndarray, "B o"]) -> Float[np.ndarray, "B p"]:
        """Mean actions."""
        hidden = observation
        for weight, bias in self.layers[:-1]:
            hidden = np.tanh(hidden @ weight.T + bias)
        weight, bias = self.layers[-1]
        return hidden @ weight.T + bias

    @classmethod
    def load(cls, folder: Path, seed: int) -> "MeanPolicy":
        """Read what `policy_search.save_policy` wrote."""
        return cls.from_arrays(load_file(folder / f"policy-{seed}.safetensors"))

    @classmethod
    def from_arrays(cls, weights: Mapping[str, np.ndarray]) -> "MeanPolicy":
        """From the actor's state: body.0, body.2, … (a tanh stands between two) and mean."""
        hidden = sum(name.startswith("body.") and name.endswith(".weight") for name in weights)
        names = [f"body.{2 * k}" for k in range(hidden)] + ["mean"]
        return cls(tuple((weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names))


@dataclass(frozen=True)
class BestCurves:
    """The best curve of each of A policies for each of B queries: feasible, then cheap."""

    phi: Float[np.ndarray, "A B p"]
    cost: Float[np.ndarray, "A B"]
    feasible: Bool[np.ndarray, "A B"]


def propose(
    problem: GeodesicProblem, policies: Sequence[MeanPolicy], params: GeodesicParams, ends: Ends
) -> BestCurves:
    """Follow every policy's mean from the straight line, which counts too, for one episode."""
    count, queries = len(policies), len(ends)
    states = begin(
        problem,
        ends[np.tile(np.arange(queries), count)],
        np.zeros((count * queries, problem.curve.coefficients)),
    )
    phi, cost, feasible = states.phi, states.cost, states.feasible
    for _ in range(params.episode_steps):
        seen = observe(params, states).reshape(count, queries, -1)
        actions = np.concatenate(
            [policy.act(rows) for policy, rows in zip(policies, seen, strict=True)]
        )
        states, _ = advance(problem, params, states, actions)
        better = (states.feasible & ~feasible) | (
            (states.feasible == feasible) & (states.cost < cost)
        )
        phi = np.where(better[:, None], states.phi, phi)
        cost, feasible = np.where(better, states.cost, cost), feasible | states.feasible
    return BestCurves(
        phi.reshape(count, queries, -1),
        cost.reshape(count, queries),
        feasible.reshape(count, queries),
    )
