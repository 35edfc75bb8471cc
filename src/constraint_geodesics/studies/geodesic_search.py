"""One seed of policy search, from training to measured paths, as a task to run in parallel.

Under constraints on a learned manifold; and on manifolds with known distances (Fig. 3), which check
the search against exact answers.
"""

import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool, Float

from constraint_geodesics.benchmark.judge import judge_limits, measure_path
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.geodesics.episodes import begin, moved
from constraint_geodesics.geodesics.learned_problem import LearnedProblem, ProblemSet
from constraint_geodesics.geodesics.obstacles import with_spheres
from constraint_geodesics.geodesics.policy_search import (
    PolicySolver,
    TrainedPolicy,
    follow,
    save_policy,
    train_policy,
)
from constraint_geodesics.geodesics.problem import (
    ChartBox,
    ChartProblem,
    Ends,
    Everywhere,
    Geodesic,
    repeated,
)
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.geodesics.solver import goal_images
from constraint_geodesics.geometry.analytic import Plane, Sphere, Torus
from constraint_geodesics.geometry.curves import CurveFamily, Curves, PinnedPolynomial, PinnedSpline
from constraint_geodesics.geometry.manifold import MeasuredManifold
from constraint_geodesics.learning.dataset import Queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import (
    GraphSubmanifold,
    Submanifold,
    Surface,
    components_of,
)
from constraint_geodesics.params import GeodesicParams, JudgeParams, Params, SubmanifoldParams
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.text_files import written

OBSTACLES_SEED = 5
"""Of the spheres that policies are trained with."""
PLANNER, RANDOM, STRAIGHT = "learned_geodesic", "random_curves", "straight_latent_line"


class SeedLog(Protocol):
    """Where a seed reports while it trains."""

    def log(self, step: int, metrics: dict[str, float]) -> None:
        """Figures at an environment step."""
        ...


@dataclass(frozen=True)
class SeedTask:
    """Everything one seed needs; picklable, to run elsewhere.

    manifold: learned, on which the lengths of paths are measured besides.
    """

    problem: LearnedProblem
    manifold: LearnedManifold
    scene: Scene
    params: GeodesicParams
    judge: JudgeParams
    manifold_name: str
    queries: Queries
    connected: Bool[np.ndarray, "Q"]
    connection_s: Float[np.ndarray, "Q"]
    """What the answer in `connected` took; part of every query's planning time."""
    seed: int
    scratch: Path
    run: AbstractContextManager[SeedLog]
    policy: MeanPolicy | None = None
    """A policy trained before, on all constraints together; None trains one on this problem."""


@dataclass(frozen=True)
class SeedResult:
    """Rows and joint paths (with the policy, then without) and its curves; the policy itself where
    it was trained here.
    """

    seed: int
    policy: TrainedPolicy | None
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


def training_figures(curve: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """What is compared between trainings: saving and share of feasible sets at the end, and how
    fast it was.
    """
    last = curve[-1]
    rate = float(np.median([row["steps_per_s"] for row in curve]))
    return {
        "final_saving": last["saving"],
        "final_feasible": last["feasible"],
        "steps_per_s": rate,
        "seconds": last["seconds"],
    }


def run_seed(task: SeedTask) -> SeedResult:
    """Train one policy; search every query with it and, as a control, without it; measure."""
    policy, mean = None, task.policy
    with task.run as run:
        if mean is None:
            policy = train_policy(task.problem, task.params, task.seed, task.scratch, run.log)
            mean = policy.mean
    rows, paths, coefficients = [], [], []
    problem, solver = task.problem, PolicySolver(mean, task.params, task.seed)
    with Certifier(task.scene, judge_limits(task.judge)) as certifier:
        for query in np.flatnonzero(task.connected)[:1]:
            # once before the clock: a worker's first search also loads compiled code
            ends = query_ends(problem, task.queries, int(query))
            for search in (solver.search, solver.search_at_random):
                search(problem, ends, partial(_accepted, task, ends, certifier))
        for query in range(len(task.queries)):
            ends = query_ends(problem, task.queries, query)
            accept = partial(_accepted, task, ends, certifier)
            if task.connected[query]:
                learned = solver.search(problem, ends, accept)
                at_random = solver.search_at_random(problem, ends, accept, learned.evaluations)
            else:
                pair = ends.z_start[0], ends.z_goal[0]
                learned = at_random = Geodesic.nothing("not_connected", problem.curve, *pair)
            for planner, found in ((PLANNER, learned), (RANDOM, at_random)):
                row, path = _measured(task, found, ends, certifier)
                row["time_s"] += task.connection_s[query]
                rows.append({"planner": planner, "query": query, "seed": task.seed, **row})
                paths.append(path)
                if planner == PLANNER:
                    coefficients.append(found.phi)
    return SeedResult(task.seed, policy, rows, paths, np.array(coefficients))


def straight_rows(task: SeedTask) -> tuple[list[dict[str, Any]], list[Float[np.ndarray, "T D"]]]:
    """The same rows and paths for the straight latent line: what a search has to beat."""
    phi = np.zeros(task.problem.curve.coefficients)
    rows, paths = [], []
    with Certifier(task.scene, judge_limits(task.judge)) as certifier:
        for query in range(len(task.queries)):
            ends = query_ends(task.problem, task.queries, query)
            length = float(task.problem.evaluate(phi[None], ends).length[0])
            line = phi, ends.z_start[0], ends.z_goal[0], length, length
            found = Geodesic("converged", task.problem.curve, *line, evaluations=1, time_s=np.nan)
            row, path = _measured(task, found, ends, certifier)
            rows.append({"planner": STRAIGHT, "query": query, "seed": 0, **row})
            paths.append(path)
    return rows, paths


def connected_queries(
    submanifold: Submanifold, surface: Surface, queries: Queries, params: SubmanifoldParams
) -> tuple[Bool[np.ndarray, "Q"], Float[np.ndarray, "Q"]]:
    """Which queries have both ends in one component of the sampled graph, and the time it took [s].

    A drawn latent plane says nothing about the exact set; an end that no edge reaches counts as
    joined.
    """
    if not isinstance(submanifold, GraphSubmanifold):
        return np.ones(len(queries), dtype=bool), np.zeros(len(queries))
    connected, seconds = [], []
    for pair in zip(queries.starts, queries.goals, strict=True):
        began = time.perf_counter()
        a, b = (components_of(submanifold, surface, q, params) for q in pair)
        connected.append(bool(a & b) or not (a and b))
        seconds.append(time.perf_counter() - began)
    return np.array(connected), np.array(seconds)


def geodesic_problem(
    params: Params,
    chart: LearnedManifold,
    manifold: ConstraintManifold,
    joints: Float[np.ndarray, "n D"],
    name: str,
) -> LearnedProblem:
    """The problem that params.yaml describes on the learned manifold `name`: the paper's, where
    curves are not retracted.
    """
    geodesics = params.geodesics
    curve = PinnedPolynomial(chart.dim, geodesics.degree)
    retract, weight = params.manifolds[name].retract, geodesics.inclusion_weight
    return LearnedProblem(chart, manifold, curve, joints, geodesics.length_degree, retract, weight)


def policy_problem(
    params: Params,
    chart: LearnedManifold,
    scene: Scene,
    manifold: ConstraintManifold,
    joints: Float[np.ndarray, "n D"],
) -> LearnedProblem:
    """What policies are asked under one constraint in a workcell, in their chart."""
    settings = params.policy_settings()
    curve = PinnedPolynomial(chart.dim, settings.degree)
    clearance = clearance_model(scene)
    space = chart, manifold, curve, joints, settings.length_degree, True, 0.0
    return LearnedProblem(*space, clearance=clearance)


def training_problem(params: Params, asked: Sequence[tuple[Scene, LearnedProblem]]) -> ProblemSet:
    """All constraints as one problem, each in its scene, alone and with spheres on the way, as it
    is measured while training.
    """
    settings, rng = params.policies.obstacles, np.random.default_rng(OBSTACLES_SEED)
    degree = params.policies.training_length_degree
    problems = [replace(own, degree=degree) for _, own in asked]
    around = [
        member
        for (scene, _), problem in zip(asked, problems, strict=True)
        for member in with_spheres(problem, scene, settings.count, settings.radii_m, rng)
    ]
    alone = np.full(len(problems), (1.0 - settings.share) / len(problems))
    beset = np.full(len(around), settings.share / max(len(around), 1))
    return ProblemSet((*problems, *around), np.concatenate([alone, beset]))


def query_ends(problem: LearnedProblem, queries: Queries, query: int) -> Ends:
    """One query as ends of a batch of one."""
    return problem.ends(queries.starts[query][None], queries.goals[query][None])


def _accepted(task: SeedTask, ends: Ends, certifier: Certifier, phi: np.ndarray) -> bool:
    """The judge as the last check of a candidate; the paper's latent curves are taken as is."""
    if not task.problem.retract:
        return True
    path = task.problem.path(phi, ends, task.judge.row_spacing_rad)
    constraint = task.problem.manifold.constraint
    return certifier.certify(path, constraint, ends.q_start[0], ends.q_goal[0]).valid


def _measured(
    task: SeedTask, found: Geodesic, ends: Ends, certifier: Certifier
) -> tuple[dict[str, Any], Float[np.ndarray, "T D"]]:
    """A result as a row of the table, and its joint path (empty where nothing was found)."""
    problem, path = task.problem, np.zeros((0, ends.q_start.shape[1]))
    if found.found:
        path = problem.path(found.phi, ends, task.judge.row_spacing_rad)
    measures = measure_path(
        path,
        ends.q_start[0],
        ends.q_goal[0],
        problem.manifold,
        {task.manifold_name: task.manifold},
        certifier,
        task.judge.spacing_rad,
    )
    status = "solved" if found.found else found.status
    row = {"status": status, "time_s": found.time_s, "evaluations": found.evaluations}
    return row | measures.row(), path


def save_seeds(
    results: Sequence[SeedResult], queries: Queries, folder: Path, learning: Path
) -> None:
    """Curves, and weights trained here, into a folder, the latter's learning into a table."""
    trained = [(result.seed, result.policy) for result in results if result.policy is not None]
    for seed, policy in trained:
        save_policy(policy, folder, seed)
    phi, seeds = np.array([r.phi for r in results]), np.array([r.seed for r in results])
    with written(folder / "curves.npz") as part:
        np.savez_compressed(part, phi=phi, seeds=seeds, starts=queries.starts, goals=queries.goals)
    rows = [{"seed": seed, **row} for seed, policy in trained for row in policy.curve]
    if rows:
        write_rows(rows, learning)


def write_rows(rows: Sequence[Mapping[str, Any]], file: Path, **columns: str) -> None:
    """Rows as CSV, with the same text in the given columns of each."""
    with written(file) as part:
        pd.DataFrame(rows).assign(**columns).to_csv(part, index=False)


def geodesic_figures(
    results: Sequence[SeedResult], connected: Bool[np.ndarray, "Q"]
) -> dict[str, float]:
    """Means and spreads over the seeds."""
    per_seed = pd.DataFrame([result.figures() for result in results])
    means, spreads = per_seed.mean().to_dict(), per_seed.std(ddof=0).to_dict()
    figures = {f"{name}_mean": float(value) for name, value in means.items()}
    figures |= {f"{name}_std": float(value) for name, value in spreads.items()}
    return figures | {"queries_connected": float(connected.mean()), "seeds": float(len(results))}


PAIRS = 200
PAIRS_SEED = 11
DRAWN_ROLLOUTS = 12
DRAWN = 65
"""Points of a drawn curve."""


@dataclass(frozen=True)
class Member:
    """A manifold with a known answer, and the box of its chart that all of it, or a piece of it, is
    the image of.
    """

    manifold: MeasuredManifold
    box: ChartBox
    domain: str


MANIFOLDS = {
    "plane": Member(Plane(), ChartBox((-1.5, -1.5), (1.5, 1.5)), "|x|, |y| ≤ 1.5"),
    "sphere": Member(
        Sphere(), ChartBox((-np.pi / 2, -np.pi), (np.pi / 2, np.pi)), "all of it, uniform by area"
    ),
    "torus": Member(
        Torus(),
        ChartBox((-np.pi, -np.pi), (np.pi, np.pi)),
        "all of it, uniform by area; R = 2, r = 1",
    ),
}


@dataclass(frozen=True)
class AnalyticTask:
    """One seed on one analytic manifold, with one curve family."""

    name: str
    curve: CurveFamily
    params: GeodesicParams
    seed: int
    scratch: Path
    run: AbstractContextManager[SeedLog]


@dataclass(frozen=True)
class AnalyticResult:
    """Length over exact distance for unseen pairs, and curves to draw.

    first_ratio: of a random curve to each image of the goal, the shortest of them.  ratio: of the
    shortest one that the policy's mean meets from there.  descent_ratio: the same without its
    actions.  sampled: curves met while the policy searched the first pair.  learned: the best one.
    """

    seed: int
    policy: TrainedPolicy
    first_ratio: Float[np.ndarray, "P"]
    ratio: Float[np.ndarray, "P"]
    descent_ratio: Float[np.ndarray, "P"]
    sampled: Float[np.ndarray, "n T 2"]
    learned: Float[np.ndarray, "T 2"]

    def figures(self) -> dict[str, float]:
        """What is compared between seeds."""
        return {
            "mean_ratio": float(self.ratio.mean()),
            "p95_ratio": float(np.quantile(self.ratio, 0.95)),
            "first_mean_ratio": float(self.first_ratio.mean()),
            "descent_mean_ratio": float(self.descent_ratio.mean()),
            "descent_p95_ratio": float(np.quantile(self.descent_ratio, 0.95)),
        }


def curve_family(dim: int, params: GeodesicParams, segments: int = 0) -> CurveFamily:
    """The polynomials that params.yaml names, or C² splines of some segments."""
    return PinnedSpline(dim, segments) if segments else PinnedPolynomial(dim, params.degree)


def analytic_problem(name: str, curve: CurveFamily) -> ChartProblem:
    """Geodesics on an analytic manifold by name."""
    member = MANIFOLDS[name]
    return ChartProblem(member.manifold, curve, Everywhere(member.manifold, member.box))


def unseen_pairs(name: str, problem: ChartProblem) -> tuple[Ends, Float[np.ndarray, "P"]]:
    """The pairs that every solver is compared on, and their exact distances."""
    ends = problem.sample_ends(PAIRS, np.random.default_rng(PAIRS_SEED))
    start, goal = torch.from_numpy(ends.z_start), torch.from_numpy(ends.z_goal)
    return ends, MANIFOLDS[name].manifold.distance(start, goal).numpy()


def run_analytic(task: AnalyticTask) -> AnalyticResult:
    """Train a policy, then follow its mean on unseen pairs, from curves that are anything but
    straight to every image of the goal.

    The straight line is no start here: in the plane it is the answer.
    """
    problem = analytic_problem(task.name, task.curve)
    with task.run as run:
        policy = train_policy(problem, task.params, task.seed, task.scratch, run.log)
    ends, exact = unseen_pairs(task.name, problem)
    query, goal = goal_images(problem, ends)
    asked = Ends(ends.z_start[query], goal, ends.z_start[query], goal)
    rng, params = np.random.default_rng(PAIRS_SEED + 1), task.params
    first = begin(problem, asked, problem.sample_curves(asked, rng))
    still = np.zeros((params.episode_steps, len(asked), problem.curve.coefficients))
    visited = follow(problem, policy.actor, params, first, still)
    descended = [first]
    for actions in still:
        descended.append(moved(problem, params, descended[-1], actions))
    first_ratio, ratio, descent_ratio = (
        np.array([states.length for states in met]).min(axis=0).reshape(PAIRS, -1).min(axis=1)
        / exact
        for met in ([first], visited, descended)
    )
    lengths = np.array([states.length[query == 0] for states in visited])
    step, image = np.unravel_index(lengths.argmin(), lengths.shape)
    drawn = asked[np.array([image])]
    best = visited[step].phi[image : image + 1]
    pair = repeated(drawn, DRAWN_ROLLOUTS)
    first = begin(problem, pair, problem.sample_curves(pair, rng))
    noise = rng.normal(size=(params.episode_steps, DRAWN_ROLLOUTS, problem.curve.coefficients))
    met = follow(problem, policy.actor, params, first, noise)
    sampled = np.concatenate([_points(problem, states.phi, drawn) for states in met])
    ratios, learned = (first_ratio, ratio, descent_ratio), _points(problem, best, drawn)[0]
    return AnalyticResult(task.seed, policy, *ratios, sampled, learned)


def _points(
    problem: ChartProblem, phi: Float[np.ndarray, "n p"], ends: Ends
) -> Float[np.ndarray, "n T 2"]:
    """Points of curves between the first pair of ends."""
    t = torch.linspace(0.0, 1.0, DRAWN, dtype=torch.float64)
    arrays = (torch.from_numpy(x) for x in (phi, ends.z_start[:1], ends.z_goal[:1]))
    return Curves(problem.curve, *arrays).at(t)[0].numpy()
