"""One seed of policy search, from training to measured paths: the task that the seeds of a stage
run in parallel.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from constraint_geodesics.benchmark.judge import Free, PathMeasures, judge_limits, measure_path
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.geodesics.policy_search import (
    TrainedPolicy,
    save_policy,
    search,
    search_at_random,
    train_policy,
)
from constraint_geodesics.geodesics.problem import Ends, Geodesic, LearnedProblem, ProblemSet
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.dataset import Queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import GraphSubmanifold, Submanifold, component_of
from constraint_geodesics.params import GeodesicParams, JudgeParams, Params, SubmanifoldParams
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.scene.scene import Scene

PLANNER, RANDOM, STRAIGHT = "learned_geodesic", "random_curves", "straight_latent_line"


class SeedLog(Protocol):
    """Where a seed reports while it trains."""

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """Figures at an environment step."""
        ...


@dataclass(frozen=True)
class SeedTask:
    """Everything one seed needs; picklable, so that it may run in another process or on another
    machine.
    """

    problem: LearnedProblem
    scene: Scene
    params: GeodesicParams
    judge: JudgeParams
    chart_name: str
    queries: Queries
    connected: Bool[np.ndarray, "Q"]
    connection_s: Float[np.ndarray, "Q"]
    """What the answer in `connected` took; part of every query's planning time."""
    seed: int
    scratch: Path
    run: AbstractContextManager[SeedLog]
    policy: TrainedPolicy | None = None
    """A policy trained before, on all constraints together for example; None trains one on this
    problem.
    """


@dataclass(frozen=True)
class SeedResult:
    """A trained policy, rows and joint paths (each query's with the policy, then without), and the
    coefficients that the policy found (Q, p).
    """

    seed: int
    policy: TrainedPolicy
    rows: list[dict[str, Any]]
    paths: list[Float[np.ndarray, "T D"]]
    phi: Float[np.ndarray, "Q p"]

    def figures(self) -> dict[str, float]:
        """What is compared between seeds."""
        learned, random = (
            [row for row in self.rows if row["planner"] == name] for name in (PLANNER, RANDOM)
        )
        lengths = [row["length_rad"] for row in learned if row["valid"]]
        return {
            "success": float(np.mean([row["valid"] for row in learned])),
            "success_at_random": float(np.mean([row["valid"] for row in random])),
            "length_median_rad": float(np.median(lengths)) if lengths else float("nan"),
            "final_saving": self.policy.curve[-1]["saving"] if self.policy.curve else float("nan"),
        }


@dataclass(frozen=True)
class TrainingTask:
    """One seed of a policy for several constraints; picklable."""

    problem: ProblemSet
    params: GeodesicParams
    seed: int
    scratch: Path
    run: AbstractContextManager[SeedLog]


def train_seed(task: TrainingTask) -> TrainedPolicy:
    """Train one policy."""
    with task.run as run:
        return train_policy(task.problem, task.params, task.seed, task.scratch, run.log)


def run_seed(task: SeedTask) -> SeedResult:
    """Train one policy, search every query's geodesic with it and, as a control, without it;
    measure what was found.
    """
    with task.run as run:
        policy = task.policy or train_policy(
            task.problem, task.params, task.seed, task.scratch, run.log
        )
    rows, paths, coefficients = [], [], []
    with Certifier(task.scene, judge_limits(task.judge)) as certifier:
        for query in range(len(task.queries)):
            ends = query_ends(task.problem, task.queries, query)
            accept = exact_check(task, ends, certifier)
            for planner in (PLANNER, RANDOM):
                if not task.connected[query]:
                    found = Geodesic.nothing(
                        "not_connected", task.problem.curve, ends.z_start[0], ends.z_goal[0]
                    )
                elif planner == PLANNER:
                    found = search(task.problem, policy.actor, task.params, ends, task.seed, accept)
                else:
                    found = search_at_random(task.problem, task.params, ends, task.seed, accept)
                row, path = measured(task, found, ends, certifier)
                row["time_s"] += task.connection_s[query]
                rows.append({"planner": planner, "query": query, "seed": task.seed, **row})
                paths.append(path)
                if planner == PLANNER:
                    coefficients.append(found.phi)
    return SeedResult(task.seed, policy, rows, paths, np.array(coefficients))


def straight_rows(task: SeedTask) -> tuple[list[dict[str, Any]], list[Float[np.ndarray, "T D"]]]:
    """The same rows and paths for the straight latent line, no policy: what policy search has to
    beat.
    """
    phi = np.zeros(task.problem.curve.coefficients)
    rows, paths = [], []
    with Certifier(task.scene, judge_limits(task.judge)) as certifier:
        for query in range(len(task.queries)):
            ends = query_ends(task.problem, task.queries, query)
            length = float(task.problem.evaluate(phi[None], ends).length[0])
            found = Geodesic(
                "converged",
                task.problem.curve,
                phi,
                ends.z_start[0],
                ends.z_goal[0],
                length,
                length,
                0,
                1,
                np.nan,
            )
            row, path = measured(task, found, ends, certifier)
            rows.append({"planner": STRAIGHT, "query": query, "seed": 0, **row})
            paths.append(path)
    return rows, paths


def connected_queries(
    submanifold: Submanifold,
    problem: LearnedProblem,
    queries: Queries,
    free: Free,
    params: SubmanifoldParams,
) -> tuple[Bool[np.ndarray, "Q"], Float[np.ndarray, "Q"]]:
    """Which queries have both ends in one component, as far as the sampled graph knows, and the
    time each took [s].

    A drawn latent plane says nothing about the exact set; an end that no edge reaches counts as
    connected.
    """
    if not isinstance(submanifold, GraphSubmanifold):
        return np.ones(len(queries), dtype=bool), np.zeros(len(queries))
    connected, seconds = [], []
    for pair in zip(queries.starts, queries.goals, strict=True):
        began = time.perf_counter()
        a, b = (
            component_of(submanifold, problem.chart, problem.manifold, q, free, params)
            for q in pair
        )
        connected.append(a == b or min(a, b) < 0)
        seconds.append(time.perf_counter() - began)
    return np.array(connected), np.array(seconds)


def geodesic_problem(
    params: Params,
    chart: LearnedManifold,
    manifold: ConstraintManifold,
    joints: Float[np.ndarray, "n D"],
    name: str,
) -> LearnedProblem:
    """The problem that params.yaml describes on the learned manifold `name`."""
    geodesics = params.geodesics
    curve = PinnedPolynomial(chart.dim, geodesics.degree)
    retract, weight = params.manifolds[name].retract, geodesics.reward.inclusion_weight
    return LearnedProblem(chart, manifold, curve, joints, geodesics.length_degree, retract, weight)


def shared_problem(
    params: Params,
    chart: LearnedManifold,
    manifolds: Mapping[str, ConstraintManifold],
    joints: Mapping[str, Float[np.ndarray, "n D"]],
    name: str,
) -> ProblemSet:
    """One problem of all the given constraints on the learned manifold `name`: what a single policy
    is trained on.

    manifolds, joints: of each constraint, under the same names.
    """
    return ProblemSet(
        tuple(
            geodesic_problem(params, chart, manifolds[each], joints[each], name)
            for each in manifolds
        )
    )


def query_ends(problem: LearnedProblem, queries: Queries, query: int) -> Ends:
    """One query as ends of a batch of one."""
    return problem.ends(queries.starts[query][None], queries.goals[query][None])


def exact_check(task: SeedTask, ends: Ends, certifier: Certifier) -> Callable[[np.ndarray], bool]:
    """The judge itself as the last check of a candidate; the paper's latent curves are taken as
    they come.
    """

    def accept(phi: np.ndarray) -> bool:
        if not task.problem.retract:
            return True
        path = task.problem.path(phi, ends, task.judge.row_spacing_rad)
        return certifier.certify(
            path, task.problem.manifold.constraint, ends.q_start[0], ends.q_goal[0]
        ).valid

    return accept


def judged(task: SeedTask, path: np.ndarray, ends: Ends, certifier: Certifier) -> PathMeasures:
    """The path's measures, with the latent length on the manifold it was searched on."""
    charts = {task.chart_name: task.problem.chart}
    return measure_path(
        path,
        ends.q_start[0],
        ends.q_goal[0],
        task.problem.manifold,
        charts,
        certifier,
        task.judge.spacing_rad,
    )


def measured(
    task: SeedTask, found: Geodesic, ends: Ends, certifier: Certifier
) -> tuple[dict[str, Any], Float[np.ndarray, "T D"]]:
    """A result as a row of the table, and its joint path (empty where nothing was found)."""
    empty = np.zeros((0, ends.q_start.shape[1]))
    path = task.problem.path(found.phi, ends, task.judge.row_spacing_rad) if found.found else empty
    status = "solved" if found.found else found.status
    row = {"status": status, "time_s": found.time_s, "evaluations": found.evaluations}
    return row | judged(task, path, ends, certifier).row(), path


def save_seeds(
    results: Sequence[SeedResult],
    queries: Queries,
    layout: Layout,
    stage: str,
    manifold: str,
    constraint: str,
) -> None:
    """Weights and curves under data/, learning curves under reports/."""
    folder, item = layout.geodesics(manifold, constraint), f"{manifold}-{constraint}"
    folder.mkdir(parents=True, exist_ok=True)
    for result in results:
        save_policy(result.policy, folder, result.seed)
    with (folder / "curves.npz").open("wb") as file:
        np.savez_compressed(
            file,
            phi=np.array([result.phi for result in results]),
            seeds=np.array([r.seed for r in results]),
            starts=queries.starts,
            goals=queries.goals,
        )
    learning = [{"seed": result.seed, **row} for result in results for row in result.policy.curve]
    write_table(learning, layout.report(stage, f"{item}-learning", "csv"))


def write_table(rows: Sequence[Mapping[str, Any]], file: Path, **columns: str) -> None:
    """Rows as CSV, with the same text in the given columns of each."""
    file.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).assign(**columns).to_csv(file, index=False)


def geodesic_figures(
    results: Sequence[SeedResult], connected: Bool[np.ndarray, "Q"]
) -> dict[str, float]:
    """Means and spreads over the seeds."""
    per_seed = pd.DataFrame([result.figures() for result in results])
    figures = {f"{name}_mean": float(per_seed[name].mean()) for name in per_seed}
    figures |= {f"{name}_std": float(per_seed[name].std(ddof=0)) for name in per_seed}
    return figures | {"queries_connected": float(connected.mean()), "seeds": float(len(results))}
