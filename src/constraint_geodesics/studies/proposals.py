"""What a policy adds, with one curve and no refinement, to random curves and to a descent that are
given the same time.

Every method offers curves of one family for a query at a time.  They are checked alike, the
cheapest first: sampled, drawn as the rows that a robot executes, and certified; the first that is
certified is the method's answer.  `family_optimum` looks for the shortest curve of the family, and
the planner for any path at all.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import judge_limits, problem_of
from constraint_geodesics.benchmark.queries import TABLE, Query, draw_benchmark, shortest_of
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold, constraint_manifold
from constraint_geodesics.geodesics.descent import INFEASIBLE, beginning, ranks, stepped
from constraint_geodesics.geodesics.learned_method import LatentCurve, sampled
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import Costs, Ends, Phi, repeated
from constraint_geodesics.geodesics.proposals import MeanPolicy, rounds
from constraint_geodesics.learning.dataset import ShardTask, draw_free, seed_of
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import GeodesicParams, Params
from constraint_geodesics.peers.registry import BaselineBuilder
from constraint_geodesics.peers.wrappers import band_after
from constraint_geodesics.problem import PathPlanner, PlanningProblem
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search.band import BandSettings
from constraint_geodesics.search.candidates import ROW_SAFETY, Candidate, Task, refined, rows_of
from constraint_geodesics.studies.geodesic_search import policy_problem
from constraint_geodesics.studies.optimum import OptimumSettings, family_optimum
from constraint_geodesics.studies.statistics import (
    bootstrap_interval,
    interquartile_mean,
    probability_of_improvement,
)

STRAIGHT, POLICY, OWN = "straight line", "policy", "policy, its own branches alone"
STILL = "the same search, no policy"
RANDOM, DESCENT = "random curves, same time", "random curves and descent, same time"
CONTROLS = 5
"""Seeds of the methods that use chance but no policy."""
MOST_CHECKED = 12
"""Curves of one offer that are checked at most: those behind them are mostly alike."""
DRAWN, KEPT = 32, 8
"""Curves that the controls draw at once, and how many of them go down the descent together."""
DRAWING = 0.5
"""Share of its time in which the descent looks for so many curves that are feasible."""
MOST_OFFERS = 5
"""Offers of a control that are checked, as many as a policy has rounds."""
SPHERES = 60
"""Queries of each constraint with a sphere on the way."""
PEER_QUERIES, PEER_SEEDS = 20, 2
"""Queries of each constraint and scene that slow planners are asked, and how often."""
PAST_ROWS = 1000
"""Configurations of the constraint that random curves are bent past."""
PLANNER = "planner"
"""Of the benchmark: it solves all that any other of its planners solves."""
PEERS = (PLANNER, "path diffusion", "receding horizon")
"""Planners of the benchmark that are asked besides, all but the first of them PEER_QUERIES."""


class Offer(NamedTuple):
    """Curves (n, p) of one method in the order in which they are checked, and how many it looked at
    to find them.
    """

    phi: Phi
    curves: int


Offers = Iterator[Offer]
Method = Callable[["Asked", float], Offers]
"""Offers for a query; the time [s] is what the controls may spend on their search: all that the
policy of the same number took, its checks too.
"""


@dataclass(frozen=True)
class Asked:
    """One query, what the methods see of it, and who certifies their answers."""

    problem: LearnedProblem
    ends: Ends
    number: int
    certifier: Certifier

    @property
    def task(self) -> Task:
        """The query's constraint and surroundings, as the planner knows them."""
        return Task(self.problem.manifold, self.problem.clearance, lambda: None)

    def certified_length(self, phi: Float[np.ndarray, "p"]) -> float | None:
        """Length of a curve's path [rad]; None unless it is certified."""
        return self._certified(sampled(self.task, LatentCurve(self.problem, self.ends, phi)))

    def refined_length(self, phi: Float[np.ndarray, "p"]) -> float | None:
        """The same of what the planner's elastic band makes of the curve; of the curve itself where
        that is not certified.
        """
        task = self.task
        t = np.linspace(0.0, 1.0, task.settings.segments + 1)
        curve = LatentCurve(self.problem, self.ends, phi)
        banded = self._certified(refined(task, "policy", curve.decoded(t)))
        return self.certified_length(phi) if banded is None else banded

    def _certified(self, candidate: Candidate | None) -> float | None:
        if candidate is None:
            return None
        allowed = ROW_SAFETY * self.certifier.limits.violation_tolerance
        return self.length_of(rows_of(candidate, allowed))

    def length_of(self, joints: Float[np.ndarray, "T D"]) -> float | None:
        """The same of any path's waypoints."""
        constraint = self.problem.manifold.constraint
        start, goal = self.ends.q_start[0], self.ends.q_goal[0]
        found = self.certifier.certify(joints, constraint, start, goal)
        return found.length_rad if found.valid else None


@dataclass(frozen=True)
class Answer:
    """A method's answer to one query: the curve (p,) and its length [rad], nan where none was
    certified; seconds spent on the search and on the checks, curves looked at and checked.
    """

    phi: Float[np.ndarray, "p"]
    length: float
    search_s: float
    check_s: float
    curves: int
    checked: int

    @property
    def solved(self) -> bool:
        """Whether a curve was certified."""
        return bool(np.isfinite(self.length))


def answered(asked: Asked, offers: Offers) -> Answer:
    """The first certified curve of the offers."""
    search = check = 0.0
    curves = checked = 0
    began = time.perf_counter()
    for offer in offers:
        found = time.perf_counter()
        search, curves = search + found - began, curves + offer.curves
        for phi in offer.phi[:MOST_CHECKED]:
            length, checked = asked.certified_length(phi), checked + 1
            if length is not None:
                check += time.perf_counter() - found
                return Answer(phi, length, search, check, curves, checked)
        began = time.perf_counter()
        check += began - found
    nothing = np.zeros(asked.problem.curve.coefficients)
    return Answer(nothing, np.nan, search, check, curves, checked)


def by_policy(policy: MeanPolicy, settings: GeodesicParams, seed: int) -> Method:
    """The policy's rounds."""

    def offers(asked: Asked, _: float) -> Offers:
        rng = np.random.default_rng((seed, asked.number))
        for met in rounds(asked.problem, policy, settings, asked.ends, rng):
            yield Offer(met.phi[met.usable], met.looks)

    return offers


def straight(asked: Asked, _: float) -> Offers:
    """The straight line of the chart."""
    phi = np.zeros((1, asked.problem.curve.coefficients))
    yield Offer(phi[asked.problem.evaluate(phi, asked.ends).feasible], 1)


def at_random(seed: int) -> Method:
    """Random curves until the time is over, the straight line among them."""

    def offers(asked: Asked, seconds: float) -> Offers:
        problem, many = asked.problem, repeated(asked.ends, DRAWN)
        began, rng = time.perf_counter(), np.random.default_rng((seed, asked.number))
        met: list[tuple[Phi, Costs]] = []
        while not met or time.perf_counter() - began < seconds:
            drawn = problem.sample_curves(many, rng)
            drawn[0] *= bool(met)
            met.append((drawn, problem.evaluate(drawn, many)))
        phi = np.concatenate([drawn for drawn, _ in met])
        cost = np.concatenate([np.where(c.feasible, c.cost, np.inf) for _, c in met])
        order = np.argsort(cost, kind="stable")[: int(np.isfinite(cost).sum())]
        yield from _in_turn(phi[order], len(phi))

    return offers


def _in_turn(phi: Phi, curves: int) -> Offers:
    """As many curves at a time as are checked of one offer, in as many offers as a policy has."""
    yield Offer(phi[:MOST_CHECKED], curves)
    for begin in range(MOST_CHECKED, min(len(phi), MOST_OFFERS * MOST_CHECKED), MOST_CHECKED):
        yield Offer(phi[begin : begin + MOST_CHECKED], 0)


def by_descent(seed: int) -> Method:
    """The cheapest of random curves, and the straight line among those, down the problem's own
    descent until the time is over; random curves are drawn until KEPT of them are feasible or
    DRAWING of the time is over.
    """

    def offers(asked: Asked, seconds: float) -> Offers:
        problem, many = asked.problem, repeated(asked.ends, DRAWN)
        began, rng = time.perf_counter(), np.random.default_rng((seed, asked.number))
        met: list[tuple[Phi, Costs]] = []
        while not met or (
            sum(int(own.feasible.sum()) for _, own in met) < KEPT
            and time.perf_counter() - began < DRAWING * seconds
        ):
            drawn = problem.sample_curves(many, rng)
            drawn[0] *= bool(met)
            met.append((drawn, problem.evaluate(drawn, many)))
        phi = np.concatenate([drawn for drawn, _ in met])
        first = np.concatenate([ranks(costs) for _, costs in met])
        order = np.argsort(first, kind="stable")
        few, curves = repeated(asked.ends, KEPT), len(phi) + KEPT
        now = beginning(problem, phi[order[:KEPT]], few)
        while time.perf_counter() - began < seconds:
            now, curves = stepped(problem, now, few), curves + KEPT
        best = np.argsort(now.rank)[: int((now.rank < INFEASIBLE).sum())]
        others = order[: int((first < INFEASIBLE).sum())]
        yield from _in_turn(np.concatenate([now.phi[best], phi[others]]), curves)

    return offers


@dataclass(frozen=True)
class Compared:
    """Policies by seed, and how they are asked."""

    policies: Mapping[int, MeanPolicy]
    settings: GeodesicParams

    def methods(self) -> list[tuple[str, int, Method]]:
        """Name, seed and offers of each.  The policies come first: the time of each is what the
        controls of its number get.
        """
        own = own_branches(self.settings)
        found: list[tuple[str, int, Method]] = [
            (POLICY, seed, by_policy(policy, self.settings, seed))
            for seed, policy in self.policies.items()
        ]
        controls = list(self.policies)[:CONTROLS]
        found += [(OWN, seed, by_policy(self.policies[seed], own, seed)) for seed in controls]
        still = without_actions(next(iter(self.policies.values())), self.settings.heads)
        alone = self.settings.model_copy(update={"heads": 1})  # several would look at one curve
        found += [(STILL, seed, by_policy(still, alone, seed)) for seed in controls]
        found.append((STRAIGHT, controls[0], straight))
        found += [(RANDOM, seed, at_random(seed)) for seed in controls]
        return found + [(DESCENT, seed, by_descent(seed)) for seed in controls]


def without_actions(policy: MeanPolicy, heads: int) -> MeanPolicy:
    """A policy of one head that never acts: what the search around one of several does alone."""
    seen = policy.layers[0][0].shape[1] - heads * (heads > 1)
    return MeanPolicy(((np.zeros((policy.actions, seen)), np.zeros(policy.actions)),))


def own_branches(settings: GeodesicParams) -> GeodesicParams:
    """The same with the heads' own first moves alone, and no second round."""
    own = settings.heads
    return settings.model_copy(update={"rollouts": own, "kept": own, "rounds": 1})


def query_answers(asked: Asked, compared: Compared) -> list[tuple[str, int, Answer]]:
    """Name, seed and answer of every method."""
    answers: list[tuple[str, int, Answer]] = []
    spent: dict[int, float] = {}
    for name, seed, method in compared.methods():
        found = answered(asked, method(asked, spent.get(seed, 0.0)))
        spent.setdefault(seed, found.search_s + found.check_s)
        answers.append((name, seed, found))
    return answers


@dataclass(frozen=True)
class PolicyTask:
    """One constraint's queries in one scene; picklable.  policies: folder of the trained ones."""

    name: str
    scene: str
    params: Params
    root: Path
    chart: LearnedManifold
    policies: Path


def policy_rows(task: PolicyTask) -> list[dict[str, Any]]:
    """The rows of `run_policies` as JSON holds them."""
    rows = run_policies(task).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def run_policies(task: PolicyTask) -> pd.DataFrame:
    """One row a query, method and seed, in the workcell or with a sphere on the way.

    Columns: constraint, scene, query, method, seed, solved, length_rad (nan where not solved),
    best_rad (of the shortest certified path that is known, the planner's or an answer's; nan where
    there is none), optimum_rad (of the family's shortest curve that is known; under the studied
    constraint, without a sphere), refined_rad (of what the planner's band makes of the answer; nan
    where that is not certified), curves (looked at), checked, search_ms and time_ms (with the
    check).
    """
    params, settings = task.params, task.params.policy_settings()
    scene, constraint = Scene.from_params(params, task.name), params.all_constraints[task.name]
    manifold = constraint_manifold(scene.robot, constraint)
    seed = (*seed_of(task.name, params.studies.seed), 2)
    past = draw_free(ShardTask(scene, manifold, PAST_ROWS, seed))
    problem = policy_problem(params, task.chart, scene, manifold, past)
    policies = {own: MeanPolicy.load(task.policies, own) for own in settings.seeds}
    compared, rows, phi = Compared(policies, settings), list[dict[str, Any]](), list[Phi]()
    build = partial(BaselineBuilder(params, task.root), PEERS)
    with build(scene, task.name, manifold) as (peers, _):
        drawn = _queries(params, scene, manifold, task.name, peers[PLANNER])
        queries = [query for query in drawn if query.scene == task.scene]
        queries = queries if task.scene == TABLE else queries[:SPHERES]
        for place, query in enumerate(queries):
            with ExitStack() as opened:
                own = peers
                if query.obstacle is not None:  # planners know the scene that they were made in
                    made = build(query.in_scene(scene), task.name, manifold)
                    own, _ = opened.enter_context(made)
                if place >= PEER_QUERIES:
                    own = {PLANNER: own[PLANNER]}
                found, answers = _query_rows(query, problem, compared, params, own)
            rows += found
            phi.append(np.array([answer.phi for answer in answers]))
    table = pd.DataFrame(rows).assign(optimum_rad=np.nan)
    if (task.name, task.scene) != (params.studies.constraint, TABLE):
        return table
    starts, goals = (np.array([getattr(query, name) for query in queries]) for name in _ENDS)
    ends = problem.ends(starts, goals)
    shortest = family_optimum(problem, ends, np.array(phi), OptimumSettings())
    curves = table[~table["method"].isin(PEERS)]
    met = curves.groupby("query")["length_rad"].min()
    known = pd.Series(np.fmin(met.to_numpy(), shortest.length), index=met.index)
    return table.assign(optimum_rad=table["query"].map(known))


_ENDS = ("start", "goal")


def _queries(
    params: Params, scene: Scene, manifold: ConstraintManifold, name: str, planner: PathPlanner
) -> list[Query]:
    """The study's own, spheres on the planner's way."""
    studies = params.studies
    changed = {"queries": studies.queries, "seed": studies.seed}
    with Certifier(scene, judge_limits(params.judge)) as certifier:
        clearance = clearance_model(scene, certifier.collisions.apart)

        def plan(
            start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
        ) -> Float[np.ndarray, "T D"]:
            problem = problem_of(start, goal, manifold, certifier, clearance)
            return shortest_of({PLANNER: planner}, problem, certifier)

        settings = params.benchmark.model_copy(update=changed)
        return draw_benchmark(scene, manifold, name, settings, plan)


def _query_rows(
    query: Query,
    problem: LearnedProblem,
    compared: Compared,
    params: Params,
    peers: Mapping[str, PathPlanner],
) -> tuple[list[dict[str, Any]], list[Answer]]:
    """One query's rows, and the answers that are curves of the family."""
    scene = query.in_scene(Scene.from_params(params, query.constraint))
    manifold, ends = problem.manifold, problem.ends(query.start[None], query.goal[None])
    with Certifier(scene, judge_limits(params.judge)) as certifier:
        clearance = clearance_model(scene, certifier.collisions.apart)
        asked = Asked(replace(problem, clearance=clearance), ends, query.number, certifier)
        answered(asked, straight(asked, 0.0))  # what is loaded late is no method's
        answers = query_answers(asked, compared)
        known = problem_of(query.start, query.goal, manifold, certifier, clearance)
        band = [_or_nan(asked.refined_length, answer) for _, _, answer in answers]
        every = list(answers)
        for name, planner in peers.items():
            for seed in range(PEER_SEEDS) if name != PLANNER else (0,):
                answer, refined_rad = _planned(asked, known, planner, seed, name != PLANNER)
                every.append((name, seed, answer))
                band.append(refined_rad)
    best = float(np.fmin.reduce([*(answer.length for _, _, answer in every), *band]))
    about = {"constraint": query.constraint, "scene": query.scene, "query": query.number}
    rows = [
        about
        | {"method": name, "seed": seed, "solved": answer.solved, "length_rad": answer.length}
        | {"best_rad": best, "curves": answer.curves, "checked": answer.checked}
        | {"search_ms": 1e3 * answer.search_s, "time_ms": 1e3 * (answer.search_s + answer.check_s)}
        | {"refined_rad": refined_rad}
        for (name, seed, answer), refined_rad in zip(every, band, strict=True)
    ]
    return rows, [answer for _, _, answer in answers]


def _or_nan(length: Callable[[np.ndarray], float | None], answer: Answer) -> float:
    """A length of an answer's curve, nan where there is none."""
    found = length(answer.phi) if answer.solved else None
    return np.nan if found is None else found


def _planned(
    asked: Asked, problem: PlanningProblem, planner: PathPlanner, seed: int, is_raw: bool
) -> tuple[Answer, float]:
    """Another planner's answer, certified as all are, and its length after a band [rad], that of
    the answer where it has had one; its path is no curve of the family.
    """
    began = time.perf_counter()
    planned = planner.plan(problem, seed)
    found = time.perf_counter()
    length = asked.length_of(planned.joints) if len(planned.joints) > 1 else None
    checked_s, nothing = time.perf_counter() - found, np.zeros(asked.problem.curve.coefficients)
    banded = None
    if is_raw and len(planned.joints) > 1:
        banded = asked.length_of(band_after(problem, planned, BandSettings()).joints)
    raw, refined_rad = (np.nan if x is None else x for x in (length, banded or length))
    return Answer(nothing, raw, found - began, checked_s, 0, 1), refined_rad


SHARES = (
    *("solved", "ratio_median", "ratio_p95", "ratio_p95_all", "optimum_median", "optimum_p95"),
    *("refined", "refined_p95", "time_ms"),
)
"""Figures of one seed: solved share of what anything solves; length over the best known path, of
the seed's own answers and (`_all`) with failures infinite, and over the family's shortest curve;
the same of refined answers; median time [ms].
"""


CASES = ["constraint", "query"]
"""Columns that tell queries of one scene apart."""


def seed_figures(rows: pd.DataFrame) -> pd.DataFrame:
    """One row a method and seed, of any rows of `run_policies`: the columns of SHARES."""
    able = rows[rows["best_rad"].notna()]
    # of some queries alone it would be no figure of all
    optimum = able["optimum_rad"] if able["optimum_rad"].notna().all() else np.nan
    able = able.assign(
        ratio=able["length_rad"] / able["best_rad"],
        over_optimum=able["length_rad"] / optimum,
        refined_ratio=able["refined_rad"] / able["best_rad"],
    )
    able = able.assign(
        ratio_all=able["ratio"].fillna(np.inf), is_refined=able["refined_ratio"].notna()
    )
    groups = able.groupby(["method", "seed"], sort=False)
    return groups.agg(
        solved=("solved", "mean"),
        ratio_median=("ratio", "median"),
        ratio_p95=("ratio", _p95),
        ratio_p95_all=("ratio_all", _p95_all),
        refined=("is_refined", "mean"),
        refined_p95=("refined_ratio", _p95),
        optimum_median=("over_optimum", "median"),
        optimum_p95=("over_optimum", _p95),
        time_ms=("time_ms", "median"),
        curves=("curves", "median"),
    ).reset_index()


def policy_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """Method → figures of any rows of `run_policies`, over seeds.

    Each of SHARES has its mean, interquartile mean and the 95 % bootstrap interval of the latter;
    beaten_in_*: probability that a seed of the policy solves more, or has a smaller p95 with
    failures infinite, than one of the method, on the queries that the method was asked (Agarwal et
    al. 2021).
    """
    seeds, figures = seed_figures(rows), dict[str, Any]()
    scores = {str(name): own for name, own in seeds.groupby("method", sort=False)}
    able = rows[rows["best_rad"].notna()]
    counts = {
        "queries": int(rows.groupby(CASES).ngroups),
        "solvable": int(able.groupby(CASES).ngroups),
    }
    for name, own in scores.items():
        asked = able[able["method"] == name].groupby(CASES).ngroups
        found: dict[str, Any] = counts | {"seeds": len(own), "asked": asked}
        found["curves"] = float(own["curves"].mean())
        for column in SHARES:
            values = own[column].to_numpy(float)
            low = high = np.nan
            if len(values) > 1 and np.isfinite(values).all():  # of one run there is no spread
                low, high = bootstrap_interval(values, interquartile_mean)
            found |= {f"{column}_mean": float(values.mean()), f"{column}_low": low}
            found |= {f"{column}_iqm": interquartile_mean(values), f"{column}_high": high}
        if name != POLICY:
            same = rows[rows["method"] == name][CASES].drop_duplicates()
            policy = seed_figures(rows[rows["method"] == POLICY].merge(same))
            # a failure is longer than any length
            for column, sign, score in (
                ("solved", 1.0, "solved"),
                ("ratio_p95", -1.0, "ratio_p95_all"),
            ):
                mine, theirs = (sign * s[score].to_numpy(float) for s in (policy, own))
                found[f"beaten_in_{column}"] = probability_of_improvement(mine, theirs)
        figures[name] = {key: _json(value) for key, value in found.items()}
    return figures


def grouped_figures(rows: pd.DataFrame, params: Params) -> dict[str, Any]:
    """`policy_figures` by group and scene: of every constraint alone, of those that policies were
    trained on together, and of those that they were not.
    """
    own = {name: [name] for name in params.all_constraints}
    groups = own | {"trained on": list(params.constraints), "never seen": list(params.unseen)}
    return {
        group: {
            str(scene): policy_figures(found)
            for scene, found in rows[rows["constraint"].isin(names)].groupby("scene")
        }
        for group, names in groups.items()
    }


def _p95(values: pd.Series) -> float:
    return float(values.quantile(0.95))


def _p95_all(values: pd.Series) -> float:
    """Without interpolation: between a number and infinity there is none."""
    return float(np.quantile(values, 0.95, method="higher"))


def _json(value: Any) -> Any:
    """Neither infinity nor not a number is there in JSON."""
    return None if isinstance(value, float) and not np.isfinite(value) else value
