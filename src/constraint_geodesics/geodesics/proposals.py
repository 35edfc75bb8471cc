"""Proposals of trained policies for new queries, with numpy alone and without noise."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from safetensors.numpy import load_file

from constraint_geodesics.geodesics.episodes import (
    CurveStates,
    begin,
    displaced,
    moved,
    observe,
    placed,
)
from constraint_geodesics.geodesics.problem import Ends, GeodesicProblem, Phi, repeated
from constraint_geodesics.params import GeodesicParams


@dataclass(frozen=True)
class MeanPolicy:
    """A policy's mean action as a plain network: tanh layers, then a linear one, on
    `episodes.observe`.

    layers: weights (out, in) and biases (out,), in their order.
    """

    layers: tuple[tuple[Float[np.ndarray, "o i"], Float[np.ndarray, "o"]], ...]

    @property
    def actions(self) -> int:
        """How many coefficients it changes."""
        return len(self.layers[-1][1])

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


AGAIN = 2
"""How many times as many curves a later round looks at as the first."""


@dataclass(frozen=True)
class Met:
    """n curves met for one query.

    rollout: which of the kept ones met each, −1 for the others of the first look.  last: whether
    the last step met it, so that another one might shorten it further.
    """

    phi: Float[np.ndarray, "n p"]
    length: Float[np.ndarray, "n"]
    cost: Float[np.ndarray, "n"]
    feasible: Bool[np.ndarray, "n"]
    rollout: Int[np.ndarray, "n"]
    last: Bool[np.ndarray, "n"]

    @cached_property
    def best_of_each(self) -> Int[np.ndarray, "k"]:
        """Rows of the best curve of every roll-out, feasible ones first, then the cheaper ones."""
        order = np.lexsort((self.cost, ~self.feasible))
        rows = order[self.rollout[order] >= 0]
        _, first = np.unique(self.rollout[rows], return_index=True)
        return rows[np.sort(first)]

    @cached_property
    def usable(self) -> Int[np.ndarray, "k"]:
        """Rows of feasible curves in the order in which they deserve an exact check: the best of
        every roll-out, then those of the first look, each the cheapest first.  What lies between is
        too like them to be accepted where they are not.
        """
        best = self.best_of_each[self.feasible[self.best_of_each]]
        others = np.flatnonzero((self.rollout < 0) & self.feasible)
        return np.concatenate([best, others[np.argsort(self.cost[others], kind="stable")]])


def rounds(
    problem: GeodesicProblem,
    policy: MeanPolicy,
    params: GeodesicParams,
    ends: Ends,
    rng: np.random.Generator,
) -> Iterator[Met]:
    """What one query's rounds of roll-outs meet, for as long as the caller asks for another.

    In the first round the straight line and each head's own first move from it, all in one pass of
    the network, are looked at with as many random curves as make up `rollouts`.  The `kept`
    cheapest follow the policy's mean to the end of the episode.  Later rounds look at random curves
    alone, AGAIN times as many.
    """
    straight = begin(problem, ends, np.zeros((1, problem.curve.coefficients)))
    heads = replace(straight[np.zeros(params.heads, dtype=int)], head=np.arange(params.heads))
    moves = displaced(params, heads, policy.act(observe(params, heads)))
    drawn = _drawn(problem, ends, params.rollouts - params.heads, rng)
    yield _followed(problem, policy, params, straight, np.concatenate([moves, drawn]))
    for _ in range(params.rounds - 1):
        drawn = _drawn(problem, ends, AGAIN * params.rollouts, rng)
        yield _followed(problem, policy, params, straight, drawn)


def random_round(problem: GeodesicProblem, ends: Ends, count: int, rng: np.random.Generator) -> Met:
    """The straight line and random curves, `count` in all."""
    zero = np.zeros((1, problem.curve.coefficients))
    phi = np.concatenate([zero, _drawn(problem, ends, count - 1, rng)])
    costs = problem.evaluate(phi, repeated(ends, count))
    nowhere, never = np.full(count, -1), np.zeros(count, dtype=bool)
    return Met(phi, costs.length, costs.cost, costs.feasible, nowhere, never)


def _drawn(problem: GeodesicProblem, ends: Ends, count: int, rng: np.random.Generator) -> Phi:
    return problem.sample_curves(repeated(ends, count), rng)


def _followed(
    problem: GeodesicProblem,
    policy: MeanPolicy,
    params: GeodesicParams,
    straight: CurveStates,
    drawn: Phi,
) -> Met:
    """The straight line and other curves, and what the policy's mean makes of the cheapest."""
    first = problem.evaluate(drawn, repeated(straight.ends, len(drawn)))
    phi, length, cost, feasible = (
        np.concatenate(pair)
        for pair in (
            (straight.phi, drawn),
            (straight.length, first.length),
            (straight.cost, first.cost),
            (straight.feasible, first.feasible),
        )
    )
    kept = np.lexsort((cost, ~feasible))[: params.kept]
    from_straight = straight[np.zeros(len(kept), dtype=int)]
    states = placed(problem, replace(from_straight, head=kept % params.heads), phi[kept])
    visited = []
    for _ in range(params.episode_steps - 1):
        states = moved(problem, params, states, policy.act(observe(params, states)))
        visited.append(states)
    rollout = np.full(len(phi), -1)
    rollout[kept] = np.arange(len(kept))
    last = np.arange(len(phi) + len(kept) * len(visited))
    return Met(
        np.concatenate([phi, *(s.phi for s in visited)]),
        np.concatenate([length, *(s.length for s in visited)]),
        np.concatenate([cost, *(s.cost for s in visited)]),
        np.concatenate([feasible, *(s.feasible for s in visited)]),
        np.concatenate([rollout, *(np.arange(len(kept)) for _ in visited)]),
        (last >= len(last) - len(kept)) & (len(visited) > 0),
    )
