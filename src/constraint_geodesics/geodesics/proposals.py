"""Proposals of trained policies for new queries, with numpy alone and without noise."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from constraint_geodesics.array_files import read_weights
from constraint_geodesics.geodesics.descent import beginning, descended
from constraint_geodesics.geodesics.episodes import (
    CurveStates,
    begin,
    displaced,
    moved,
    observe,
    placed,
)
from constraint_geodesics.geodesics.problem import Costs, Ends, GeodesicProblem, Phi, repeated
from constraint_geodesics.params import GeodesicParams
from constraint_geodesics.text_files import reading


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
        file = folder / f"policy-{seed}.safetensors"
        with reading(file):
            return cls.from_arrays(read_weights(file))

    @classmethod
    def from_arrays(cls, weights: Mapping[str, np.ndarray]) -> "MeanPolicy":
        """From the actor's state: body.0, body.2, … (a tanh stands between two) and mean.  Raises
        KeyError or ValueError where a layer is missing or does not fit the one before.
        """
        hidden = sum(name.startswith("body.") and name.endswith(".weight") for name in weights)
        names, width = [f"body.{2 * k}" for k in range(hidden)] + ["mean"], None
        for name in names:
            weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
            if (
                weight.ndim != 2
                or bias.shape != (len(weight),)
                or width not in (None, *weight.shape[1:])
            ):
                raise ValueError(f"layer {name!r}: {weight.shape} and {bias.shape} after {width}")
            width = len(weight)
        return cls(tuple((weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names))


MOST_LOOKS = 8
"""Times that random curves are drawn for one round."""
HALVED_AFTER = (1, 2)
"""Moves after which the better half of the curves that are followed goes on."""
SETTLED, SETTLING = 4, 5
"""Curves that are brought to rest at the end of a round, and the steps of descent they take: the
policy chooses the way, whose last permille is the descent's.
"""


@dataclass(frozen=True)
class Met:
    """n curves met for one query.

    rollout: which of the kept ones met each, −1 for the others of the first look.  last: whether
    the last step met it, so that another one might shorten it further.  looks: curves measured for
    it, some of them twice.
    """

    phi: Float[np.ndarray, "n p"]
    length: Float[np.ndarray, "n"]
    cost: Float[np.ndarray, "n"]
    feasible: Bool[np.ndarray, "n"]
    rollout: Int[np.ndarray, "n"]
    last: Bool[np.ndarray, "n"]
    looks: int = 0

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
    the network, are looked at with as many random curves as make up `rollouts`, and more while
    fewer than `kept` of all are feasible.  The `kept` cheapest follow the policy's mean, fewer and
    fewer of them; the best SETTLED of what they met go on down the problem's descent alone.  Later
    rounds look at random curves alone.
    """
    straight = begin(problem, ends, np.zeros((1, problem.curve.coefficients)))
    heads = replace(straight[np.zeros(params.heads, dtype=int)], head=np.arange(params.heads))
    moves = displaced(params, heads, policy.act(observe(params, heads)))
    moves = moves[moves.any(axis=1)]  # one that stays where it is is the straight line again
    known = [_met(straight.phi, straight, -1)]
    if len(moves):
        known.append(_looked_at(problem, ends, moves))
    for _ in range(params.rounds):
        number = params.rollouts - params.heads
        looked = _many_looked_at(problem, ends, known, number, params.kept, rng)
        yield _followed(problem, policy, params, straight, looked)
        known = known[:1]


def _many_looked_at(
    problem: GeodesicProblem,
    ends: Ends,
    known: Sequence[Met],
    number: int,
    wanted: int,
    rng: np.random.Generator,
) -> Met:
    """Known curves and random ones, so many at a time until `wanted` are feasible, MOST_LOOKS times
    at most: where few are, the way has to be looked for.
    """
    met = list(known)
    for _ in range(MOST_LOOKS if number else 0):
        met.append(_looked_at(problem, ends, _drawn(problem, ends, number, rng)))
        if sum(int(part.feasible.sum()) for part in met) >= wanted:
            break
    return _joined(met)


def random_round(problem: GeodesicProblem, ends: Ends, count: int, rng: np.random.Generator) -> Met:
    """The straight line and random curves, `count` in all."""
    zero = np.zeros((1, problem.curve.coefficients))
    phi = np.concatenate([zero, _drawn(problem, ends, count - 1, rng)])
    return _looked_at(problem, ends, phi)


def _drawn(problem: GeodesicProblem, ends: Ends, count: int, rng: np.random.Generator) -> Phi:
    return problem.sample_curves(repeated(ends, count), rng)


def _followed(
    problem: GeodesicProblem,
    policy: MeanPolicy,
    params: GeodesicParams,
    straight: CurveStates,
    looked: Met,
) -> Met:
    """What was looked at, and what the policy's mean makes of the cheapest: fewer of them each time
    that HALVED_AFTER says, and the last brought to rest.
    """
    kept = np.lexsort((looked.cost, ~looked.feasible))[: params.kept]
    rollout = np.arange(len(kept))
    looked.rollout[kept] = rollout
    # the straight line comes first, then the heads' moves, then random curves, shared out
    head = np.maximum(kept - 1, 0) % params.heads
    begun = replace(straight[np.zeros(len(kept), dtype=int)], head=head)
    states, visited = placed(problem, begun, looked.phi[kept]), [looked]
    for step in range(1, params.episode_steps):
        states = moved(problem, params, states, policy.act(observe(params, states)))
        visited.append(_met(states.phi, states, rollout))
        if step in HALVED_AFTER:
            order = np.lexsort((states.best_cost, states.best_feasible))
            better = np.sort(order[: max(SETTLED, len(order) // 2)])
            states, rollout = states[better], rollout[better]
    visited[-1].last[:] = True
    met = _joined(visited)
    met = replace(met, looks=len(met.phi) + len(kept))
    if not straight.descent.shape[1]:
        return met
    rows = met.best_of_each[:SETTLED]
    few = repeated(straight.ends, len(rows))
    rest = descended(problem, beginning(problem, met.phi[rows], few), few, SETTLING)
    settled = _met(rest.phi, rest.now.costs, met.rollout[rows])
    settled.last[:] = True
    looks = met.looks + len(rows) * (1 + SETTLING)
    return replace(_joined([met, settled]), looks=looks)


def _looked_at(problem: GeodesicProblem, ends: Ends, phi: Phi) -> Met:
    return _met(phi, problem.evaluate(phi, repeated(ends, len(phi))), -1)


def _met(phi: Phi, costs: Costs | CurveStates, rollout: int | Int[np.ndarray, "n"]) -> Met:
    """Curves as met by one roll-out each, none at its last step."""
    of, never = np.full(len(phi), rollout), np.zeros(len(phi), dtype=bool)
    return Met(phi, costs.length, costs.cost, costs.feasible, of, never)


def _joined(parts: Sequence[Met]) -> Met:
    """What was met, one after another."""
    return Met(
        np.concatenate([part.phi for part in parts]),
        np.concatenate([part.length for part in parts]),
        np.concatenate([part.cost for part in parts]),
        np.concatenate([part.feasible for part in parts]),
        np.concatenate([part.rollout for part in parts]),
        np.concatenate([part.last for part in parts]),
    )
