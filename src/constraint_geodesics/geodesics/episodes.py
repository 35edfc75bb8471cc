"""Episodes of the search for a curve, eqs. 9-15, as pure functions of numpy arrays.

A state is a curve, an action changes its coefficients.  Training and planning share these
functions.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from constraint_geodesics.geodesics.problem import Ends, GeodesicProblem, Phi
from constraint_geodesics.params import GeodesicParams, RewardParams

LEAST_STRIDE = 1e-3
"""Least change of a coefficient by an action of 1, in units of the ends' distance: at a minimum the
descent is 0.
"""
NOTHING_FOUND = 3.0
"""What a set without a feasible curve is worth, as a cost in units of the straight line's."""


@dataclass(frozen=True)
class CurveStates:
    """B curves under way, and the cheapest one that each has met.

    phi: in the chart's unit.  descent, features: of what is `Observed` at it.  step: steps taken.
    best_feasible: cost of the cheapest feasible curve met, inf before there is one.  head: which of
    the policy's ways of answering a query each curve follows.
    """

    phi: Phi
    ends: Ends
    length: Float[np.ndarray, "B"]
    cost: Float[np.ndarray, "B"]
    feasible: Bool[np.ndarray, "B"]
    descent: Float[np.ndarray, "B d"]
    features: Float[np.ndarray, "B f"]
    straight_cost: Float[np.ndarray, "B"]
    step: Int[np.ndarray, "B"]
    best_phi: Phi
    best_cost: Float[np.ndarray, "B"]
    best_feasible: Float[np.ndarray, "B"]
    head: Int[np.ndarray, "B"]

    def __getitem__(self, rows: np.ndarray) -> "CurveStates":
        return CurveStates(**{name: values[rows] for name, values in vars(self).items()})

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


def begin(
    problem: GeodesicProblem, ends: Ends, phi: Phi, head: Int[np.ndarray, "B"] | None = None
) -> CurveStates:
    """First states of B episodes; head 0 unless given."""
    now = problem.observed(phi, ends)
    costs, straight_cost = now.costs, now.costs.cost.copy()
    bent = np.flatnonzero(phi.any(axis=1))
    if len(bent):
        straight_cost[bent] = problem.evaluate(np.zeros_like(phi[bent]), ends[bent]).cost
    better = costs.cost < straight_cost
    return CurveStates(
        phi,
        ends,
        costs.length,
        costs.cost,
        costs.feasible,
        now.descent,
        now.features,
        straight_cost,
        np.zeros(len(phi), dtype=np.int64),
        np.where(better[:, None], phi, 0.0),
        np.minimum(costs.cost, straight_cost),
        np.where(costs.feasible, costs.cost, np.inf),
        np.zeros(len(phi), dtype=np.int64) if head is None else head,
    )


def draw_episodes(
    problem: GeodesicProblem, params: GeodesicParams, count: int, rng: np.random.Generator
) -> CurveStates:
    """Episodes on random ends, a set of `heads` for each pair; a share of the sets starts from
    random curves, to meet bad ones.
    """
    sets = count // params.heads
    ends = problem.sample_ends(sets, rng)[np.repeat(np.arange(sets), params.heads)]
    bent = np.repeat(rng.random(sets) < params.random_starts, params.heads)
    phi = problem.sample_curves(ends, rng) * bent[:, None]
    return begin(problem, ends, phi, np.tile(np.arange(params.heads), sets))


def advance(
    problem: GeodesicProblem, params: GeodesicParams, states: CurveStates, actions: Phi
) -> tuple[CurveStates, Float[np.ndarray, "B"]]:
    """One step of B episodes: new states and rewards (eq. 15, and what `RewardParams` adds)."""
    after, settings = moved(problem, params, states, actions), params.reward
    reward = rewards(settings, states.cost, after.cost, states.straight_cost)
    reward += settings.feasible_weight * after.feasible
    if settings.set_weight > 0.0:
        reward += settings.set_weight * contributions(params.heads, after)
    return after, reward


def moved(
    problem: GeodesicProblem, params: GeodesicParams, states: CurveStates, actions: Phi
) -> CurveStates:
    """B curves after one action each."""
    return placed(problem, states, displaced(params, states, actions))


def displaced(params: GeodesicParams, states: CurveStates, actions: Phi) -> Phi:
    """Coefficients after one action each.

    A feasible curve that is under way takes its problem's descent, where that knows one: without
    an action it would go on like this.  An action of 1 adds `strides` to a coefficient: a near pair
    needs as fine a bend, in proportion, as a far one, and a curve near its minimum as small a step,
    in proportion, as one far from it.
    """
    changed = states.phi + strides(params, states)[:, None] * np.clip(actions, -1.0, 1.0)
    if states.descent.shape[1]:
        changed += np.where(_under_way(states)[:, None], states.descent, 0.0)
    return changed


def placed(problem: GeodesicProblem, states: CurveStates, phi: Phi) -> CurveStates:
    """The same episodes one step on, at other curves."""
    now = problem.observed(phi, states.ends)
    costs = now.costs
    better = costs.cost < states.best_cost
    usable = np.where(costs.feasible, costs.cost, np.inf)
    return replace(
        states,
        phi=phi,
        length=costs.length,
        cost=costs.cost,
        feasible=costs.feasible,
        descent=now.descent,
        features=now.features,
        step=states.step + 1,
        best_phi=np.where(better[:, None], phi, states.best_phi),
        best_cost=np.minimum(states.best_cost, costs.cost),
        best_feasible=np.minimum(states.best_feasible, usable),
    )


def contributions(heads: int, states: CurveStates) -> Float[np.ndarray, "B"]:
    """What each curve of a set adds to it: how much cheaper the set's best feasible curve is for
    it, in units of the straight line's cost, at most 1; 0 for all but the best, and for one alone.

    Heads that answer a query alike earn nothing from each other's company, so that they part.
    """
    if heads == 1:
        return np.zeros(len(states.best_feasible))
    usable = np.isfinite(states.best_feasible)
    price = states.best_feasible / np.maximum(states.straight_cost, 1e-9)
    price = np.where(usable, price, NOTHING_FOUND).reshape(-1, heads)
    ordered = np.sort(price, axis=1)
    saved = np.clip(ordered[:, 1:2] - ordered[:, :1], 0.0, 1.0)
    return np.where(price == ordered[:, :1], saved, 0.0).ravel()


def strides(params: GeodesicParams, states: CurveStates) -> Float[np.ndarray, "B"]:
    """What an action of 1 changes a coefficient by, in the chart's unit: `action_scale` times the
    ends' distance, for a feasible curve whose problem knows a descent at most `descent_scale` times
    the descent's step.  From the straight line the first move chooses the way round, and is long.
    """
    longest = params.ppo.action_scale * states.ends.distance
    if not states.descent.shape[1]:
        return longest
    fine = (
        params.ppo.descent_scale * np.sqrt((states.descent**2).sum(axis=1))
        + LEAST_STRIDE * states.ends.distance
    )
    return np.where(_under_way(states), np.minimum(fine, longest), longest)


def _under_way(states: CurveStates) -> Bool[np.ndarray, "B"]:
    """Feasible curves that are no longer straight."""
    return states.feasible & states.phi.any(axis=1)


def rewards(
    params: RewardParams,
    before: Float[np.ndarray, "B"],
    after: Float[np.ndarray, "B"],
    straight: Float[np.ndarray, "B"],
) -> Float[np.ndarray, "B"]:
    """Eq. 15, r = K_L R_L + K_Δ R_Δ with R(x) = exp(−b exp(−c x)), and R_Δ only where the curve
    became shorter.

    "corrected" does what the paper's text says: R rises with x, so R_L takes the saving against the
    straight line, 1 − L/L_straight, and R_Δ the relative reduction.  "printed" is R_L = R(L), R_Δ =
    R(Δ), which pays for long curves.
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


def observe(params: GeodesicParams, states: CurveStates) -> Float[np.ndarray, "B o"]:
    """What the policy sees, in this order: coefficients in units of the ends' distance (p), both
    ends in the chart (2 N), cost and best cost over the straight line's, less 1, time left, whether
    the curve is straight (4); where the problem knows a descent, its direction (p) and the
    logarithm of its size in units of the ends' distance, and the problem's features; which head it
    is, of several.
    """
    scale = np.maximum(states.straight_cost, 1e-9)
    far = states.ends.distance[:, None]
    columns = [
        states.phi / far,
        states.ends.z_start,
        states.ends.z_goal,
        np.clip(states.cost / scale - 1.0, -2.0, 2.0)[:, None],
        np.clip(states.best_cost / scale - 1.0, -2.0, 2.0)[:, None],
        1.0 - states.step[:, None] / params.episode_steps,
        ~states.phi.any(axis=1, keepdims=True),
    ]
    if states.descent.shape[1]:
        size = np.sqrt((states.descent**2).sum(axis=1, keepdims=True))
        columns += [
            states.descent / np.maximum(size, 1e-9),
            np.log10(size / far + 1e-4) + 2.0,
            states.features,
        ]
    if params.heads > 1:
        columns.append(np.eye(params.heads)[states.head])
    return np.concatenate(columns, axis=1).astype(np.float32)


def observation_size(problem: GeodesicProblem, params: GeodesicParams) -> int:
    """Length of an observation."""
    ends = problem.sample_ends(1, np.random.default_rng(0))
    return observe(params, begin(problem, ends, np.zeros((1, problem.curve.coefficients)))).shape[1]
