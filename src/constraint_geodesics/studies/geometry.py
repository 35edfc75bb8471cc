"""What the geometry core costs and how exact it is: rates, errors, solver times.

Everything is timed on one thread.  Rates are medians of rounds in which the compared sides run in
turn; a solver's times are those of one warm pass.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits
from torch import Tensor

from constraint_geodesics.geodesics.environment import CurveEnv, CurveVecEnv, scalar_environments
from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.graph_search import CombinedSolver, GraphSolver
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.policy_search import PolicySolver, ppo_model
from constraint_geodesics.geodesics.problem import (
    ChartProblem,
    Ends,
    GeodesicProblem,
    GeodesicSolver,
)
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geometry.curves import Curves
from constraint_geodesics.geometry.length import (
    Collocation,
    Quadrature,
    chord_length,
    curve_length,
    estimate_length,
)
from constraint_geodesics.geometry.manifold import EmbeddedManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import corrected, retracted
from constraint_geodesics.params import GeodesicParams, GeometryParams
from constraint_geodesics.progress import progress
from constraint_geodesics.studies.geodesic_search import (
    MANIFOLDS,
    PAIRS,
    analytic_problem,
    curve_family,
    unseen_pairs,
)
from constraint_geodesics.studies.walls import walls_figures

SMALL_BATCHES = (1, 64)
NAIVE_POINTS = 101
REFERENCE_POINTS = 2000
REFERENCE_DEGREE = 256
"""Degree of the polynomials that retracted lengths are compared with."""
SINGLE = 10
"""Queries that each solver is asked one at a time."""
NAIVE_CURVES = 40
"""Curves a round of the naive implementation measures, one at a time."""
RULES = (4, 6, 8, 12, 16, 24, 32, 48)
"""Points a curve, apart from its start, of the rules whose error and cost are compared."""
GRID = (60, 60)
SEED = 5
LEARNED_ROLLOUTS = 10
"""Rollouts of the batched environment for one of the scalar environments, whose rate is as steady.
"""


@dataclass(frozen=True)
class GeometryBenchmark:
    """The two problems measured, the same manifold without and with retraction, and how."""

    plain: ChartProblem
    retracted: LearnedProblem
    geodesics: GeodesicParams
    settings: GeometryParams

    @property
    def manifold(self) -> LearnedManifold:
        """The learned manifold."""
        return self.retracted.chart

    def figures(self, policies: Mapping[str, MeanPolicy]) -> dict[str, Any]:
        """Rates, errors and solvers.  policies: a trained policy of every analytic manifold."""
        parts: dict[str, Callable[[], Any]] = {
            "curve_length": self.curve_length,
            "curve_length_retracted": self.curve_length_retracted,
            "environment": lambda: self.environment(self.plain),
            "environment_retracted": lambda: self.environment(self.retracted),
        }
        parts |= {
            f"solvers/{name}": partial(self.analytic_solvers, name, policy)
            for name, policy in policies.items()
        }
        parts["solvers/learned"] = self.learned_solvers
        parts["grids_with_walls"] = lambda: walls_figures(2 * self.settings.pairs)
        found: dict[str, Any] = {}
        with one_thread(), progress("geometry benchmark", len(parts)) as advance:
            for name, measure in parts.items():
                found[name] = measure()
                advance()
        solvers = {name.split("/")[1]: found.pop(name) for name in list(found) if "/" in name}
        return found | {"solvers": solvers}

    def curve_length(self) -> dict[str, Any]:
        """Lengths a second at the default accuracy, ratio to the naive way, and the error."""
        curves, _ = random_curves(self.plain, self.settings.batch)
        with torch.no_grad():
            ours = {
                batch: partial(curve_length, self.manifold, curves[:batch])
                for batch in self._batches()
            }
            few = curves[:NAIVE_CURVES]
            usual = {
                "naive": partial(naive_length, self.manifold, few),
                "naive_batched": partial(naive_length_batched, self.manifold, few),
                "chords_batched": partial(_chords, self.manifold, few, NAIVE_POINTS - 1),
            }
            rates = self._rates(ours, usual)
            naive_error = _relative(
                naive_length(self.manifold, few), reference_length(self.manifold, few)
            )
        return rates | {"error": self.length_errors(), "naive_error": _spread(naive_error)}

    def curve_length_retracted(self) -> dict[str, Any]:
        """The same for curves decoded, corrected at their ends and retracted."""
        curves, ends = random_curves(self.retracted, self.settings.batch)
        phi = curves.phi.numpy()
        ours = {
            batch: partial(self.retracted.evaluate, phi[:batch], ends[np.arange(batch)])
            for batch in self._batches()
        }
        naive = partial(naive_retracted_length, self.retracted, curves[:NAIVE_CURVES], ends)
        return self._rates(ours, {"naive": naive}) | {"error": self.retracted_errors()}

    def retracted_errors(self) -> dict[str, float]:
        """Relative error of retracted lengths (degree of params.yaml) against degree
        REFERENCE_DEGREE, for the curves that both find feasible; a third of random ones jump
        between branches and have no length.
        """
        curves, ends = random_curves(self.retracted, self.settings.checked)
        fine = replace(self.retracted, degree=REFERENCE_DEGREE)
        found, reference = (
            problem.evaluate(curves.phi.numpy(), ends) for problem in (self.retracted, fine)
        )
        both = found.feasible & reference.feasible
        error = np.abs(found.length[both] - reference.length[both]) / reference.length[both]
        return {**_spread(error), "curves": len(error), "share_feasible": float(both.mean())}

    def _batches(self) -> tuple[int, ...]:
        return (*SMALL_BATCHES, self.settings.batch)

    def _rates(
        self, ours: Mapping[int, Callable[[], Any]], usual: Mapping[str, Callable[[], Any]]
    ) -> dict[str, Any]:
        runs = {**{str(batch): run for batch, run in ours.items()}, **usual}
        seconds = alternately(runs, self.settings.rounds)
        rates, largest = {batch: batch / seconds[str(batch)] for batch in ours}, max(ours)
        theirs = {f"{name}_per_second": NAIVE_CURVES / seconds[name] for name in usual}
        return {
            "batch": largest,
            "per_second": rates[largest],
            **theirs,
            "ratio_to_naive": rates[largest] / theirs["naive_per_second"],
            "per_second_by_batch": {str(batch): rate for batch, rate in rates.items()},
        }

    def length_errors(self) -> dict[str, float]:
        """Relative error of default lengths against 2 000 chords in double precision.

        share_above_estimate: how often the error exceeds its own estimate.
        """
        curves, _ = random_curves(self.plain, self.settings.checked)
        reference = reference_length(self.manifold, curves)
        with torch.no_grad():
            found = estimate_length(self.manifold, curves)
        error, estimate = _relative(found.length, reference), (found.error / reference).numpy()
        return {
            **_spread(error),
            "share_above_estimate": float((error > estimate + SINGLE_PRECISION).mean()),
            "curves": len(error),
            "reference_points": REFERENCE_POINTS,
        }

    def quadrature_rows(self) -> list[dict[str, Any]]:
        """Error and cost of three rules by the number of points: why the default is what it is."""
        curves, _ = random_curves(self.plain, self.settings.checked)
        reference, rows = reference_length(self.manifold, curves), []
        with one_thread(), torch.no_grad():
            for count in RULES:
                gauss, own = Quadrature.gauss_legendre(count + 1), Collocation.chebyshev(count)
                measures = {
                    "chords": partial(_chords, self.manifold, curves, count),
                    "gauss_legendre": partial(curve_length, self.manifold, curves, gauss),
                    "collocation": partial(curve_length, self.manifold, curves, own),
                }
                seconds = alternately(measures, self.settings.rounds)
                for rule, measure in measures.items():
                    errors = _spread(_relative(measure(), reference))
                    cost = 1e6 * seconds[rule] / len(reference)
                    row = {"rule": rule, "points": count + 1, "microseconds": cost}
                    rows.append(row | {f"error_{name}": value for name, value in errors.items()})
        return rows

    def environment(self, problem: GeodesicProblem) -> dict[str, float]:
        """Environment steps a second with PPO's learning: in one batch, and one by one."""
        params = self.geodesics
        count, rollout = params.environments, params.environments * params.ppo.rollout_steps
        batched = ppo_model(CurveVecEnv(problem, params, count, seed=0), params, seed=0)
        scalar = ppo_model(
            scalar_environments(lambda: CurveEnv(problem, params), count), params, seed=0
        )
        learn = {
            # going on where the last round stopped: a reset would cost the scalar side one more
            # evaluation a copy
            "batched": partial(
                batched.learn, LEARNED_ROLLOUTS * rollout, reset_num_timesteps=False
            ),
            "scalar": partial(scalar.learn, rollout, reset_num_timesteps=False),
        }
        seconds = alternately(learn, self.settings.rounds)
        ours, usual = LEARNED_ROLLOUTS * rollout / seconds["batched"], rollout / seconds["scalar"]
        return {
            "environments": count,
            "steps_per_second": ours,
            "dummy_vec_env_steps_per_second": usual,
            "ratio_to_dummy_vec_env": ours / usual,
        }

    def analytic_solvers(self, name: str, policy: MeanPolicy) -> dict[str, dict[str, float]]:
        """Every solver on an analytic manifold; the graph stands on random points of the domain."""
        problem, box = analytic_problem(name, curve_family(2, self.geodesics)), MANIFOLDS[name].box
        ends, exact = unseen_pairs(name, problem)
        points = box.sample(self.settings.graph_points, np.random.default_rng(SEED))
        graph = GraphSolver.over_points(problem.manifold, points)
        solvers: dict[str, GeodesicSolver] = {
            "policy_search": PolicySolver(policy, self.geodesics.on_analytic()),
            "gradient": GradientSolver(),
            "graph": graph,
            "grid": GraphSolver.over_grid(problem.manifold, box.low, box.high, GRID),
            "combined": CombinedSolver(graph),
        }
        return solver_figures(problem, ends, exact, solvers)

    def learned_solvers(self) -> dict[str, dict[str, float]]:
        """The solvers that need no training, on the learned manifold; the graph on its data."""
        rng, problem = np.random.default_rng(SEED), self.plain
        graph = GraphSolver.over_points(
            problem.manifold, problem.domain.sample(self.settings.graph_points, rng)
        )
        solvers: dict[str, GeodesicSolver] = {
            "gradient": GradientSolver(),
            "graph": graph,
            "combined": CombinedSolver(graph),
        }
        return solver_figures(problem, problem.sample_ends(self.settings.pairs, rng), None, solvers)


SINGLE_PRECISION = 1e-6
"""Relative error that the network's single precision leaves in a length, whatever the rule."""


def random_curves(problem: GeodesicProblem, count: int) -> tuple[Curves, Ends]:
    """Curves as the problem draws them, always the same."""
    rng = np.random.default_rng(SEED)
    ends = problem.sample_ends(count, rng)
    arrays = (problem.sample_curves(ends, rng), ends.z_start, ends.z_goal)
    return Curves(
        problem.curve, *(torch.from_numpy(np.asarray(values, np.float64)) for values in arrays)
    ), ends


def naive_length(manifold: EmbeddedManifold, curves: Curves) -> Float[Tensor, "B"]:
    """Eq. 2 as written: per curve the full Jacobian at 101 points, M = JᵀJ, trapezium rule."""
    t = torch.linspace(0.0, 1.0, NAIVE_POINTS, dtype=curves.phi.dtype)
    jacobian_at = torch.func.vmap(torch.func.jacfwd(manifold.embed))
    lengths = []
    for row in range(len(curves.phi)):
        z, velocity = curves[row].at(t)
        jacobian = jacobian_at(z).to(z)
        metric = jacobian.mT @ jacobian
        speed = (velocity[:, None] @ metric @ velocity[..., None]).squeeze().sqrt()
        lengths.append(torch.trapezoid(speed, t))
    return torch.stack(lengths)


def naive_length_batched(manifold: EmbeddedManifold, curves: Curves) -> Float[Tensor, "B"]:
    """The naive formula on all curves at once: what batching alone is worth."""
    t = torch.linspace(0.0, 1.0, NAIVE_POINTS, dtype=curves.phi.dtype)
    z, velocity = curves.at(t)
    jacobian = torch.func.vmap(torch.func.vmap(torch.func.jacfwd(manifold.embed)))(z).to(z)
    metric = jacobian.mT @ jacobian
    speed = (velocity[..., None, :] @ metric @ velocity[..., None]).squeeze((-1, -2)).sqrt()
    return torch.trapezoid(speed, t)


def naive_retracted_length(
    problem: LearnedProblem, curves: Curves, ends: Ends
) -> Float[np.ndarray, "B"]:
    """The same with retraction, one curve at a time: chords through 101 decoded and retracted
    points.

    The retraction itself is the compiled one of both sides.
    """
    t, dof = np.linspace(0.0, 1.0, NAIVE_POINTS), problem.manifold.robot.dof
    lengths = []
    for row in range(len(curves.phi)):
        one = ends[np.array([row])]
        embedded = problem.chart.embed_points(
            problem.latent_points(curves.phi[row : row + 1].numpy(), one, t)
        )
        decoded = embedded[..., :dof].astype(np.float64)
        line = corrected(decoded, t, one.q_start, one.q_goal)
        lifted = retracted(problem.manifold, line, problem.retraction)
        path = np.concatenate([lifted.joints, embedded[..., dof:]], axis=-1)
        lengths.append(np.linalg.norm(np.diff(path, axis=1), axis=-1).sum())
    return np.array(lengths)


def reference_length(manifold: LearnedManifold, curves: Curves) -> Float[Tensor, "B"]:
    """Chords through 2 000 points of every curve, with the network in double precision."""
    exact, t = manifold.double(), torch.linspace(0.0, 1.0, REFERENCE_POINTS, dtype=torch.float64)
    with torch.no_grad():
        return torch.stack([chord_length(exact.embed(points)) for points in curves.at(t)[0]])


def _chords(manifold: EmbeddedManifold, curves: Curves, count: int) -> Float[Tensor, "B"]:
    t = torch.linspace(0.0, 1.0, count + 1, dtype=torch.float64)
    return chord_length(manifold.embed(curves.at(t)[0]))


def _relative(found: Float[Tensor, "B"], reference: Float[Tensor, "B"]) -> Float[np.ndarray, "B"]:
    return ((found - reference).abs() / reference).numpy()


def _spread(error: Float[np.ndarray, "B"]) -> dict[str, float]:
    return {
        "median": float(np.median(error)),
        "p95": float(np.quantile(error, 0.95)),
        "max": float(error.max()),
    }


def solver_figures(
    problem: ChartProblem,
    ends: Ends,
    exact: Float[np.ndarray, "P"] | None,
    solvers: Mapping[str, GeodesicSolver],
) -> dict[str, dict[str, float]]:
    """Length over the exact distance, or the shortest found, and the cost of a query, by solver.

    Ratios are over the pairs that every solver found a curve for.  milliseconds: one query at a
    time, the first SINGLE pairs; milliseconds_in_batch: a pair's share of all at once.
    """
    found, single, together = {}, {}, {}
    for name, solver in solvers.items():
        pairs = [
            (ends.z_start[k : k + 1], ends.z_goal[k : k + 1]) for k in range(min(SINGLE, len(ends)))
        ]
        geodesics_between(solver, problem, *pairs[0])  # warm: what is built once is built
        asked = [partial(geodesics_between, solver, problem, *pair) for pair in pairs]
        single[name] = np.median([seconds_of(ask) for ask in asked])
        began = time.perf_counter()
        found[name] = geodesics_between(solver, problem, ends.z_start, ends.z_goal)
        together[name] = (time.perf_counter() - began) / len(ends)
    lengths = {name: np.array([geodesic.length for geodesic in found[name]]) for name in solvers}
    shared = np.isfinite(list(lengths.values())).all(axis=0)
    best = np.min(list(lengths.values()), axis=0) if exact is None else exact
    return {
        name: {
            **_ratios(lengths[name][shared] / best[shared]),
            "found": float(np.mean([geodesic.found for geodesic in found[name]])),
            "converged": float(
                np.mean([geodesic.status == "converged" for geodesic in found[name]])
            ),
            "milliseconds": 1e3 * float(single[name]),
            "milliseconds_in_batch": 1e3 * together[name],
        }
        for name in solvers
    }


def _ratios(ratio: Float[np.ndarray, "P"]) -> dict[str, float]:
    if not len(ratio):
        return dict.fromkeys(("mean_ratio", "p95_ratio", "max_ratio"), np.nan)
    return {
        "mean_ratio": float(ratio.mean()),
        "p95_ratio": float(np.quantile(ratio, 0.95)),
        "max_ratio": float(ratio.max()),
    }


def seconds_of(run: Callable[[], object]) -> float:
    """What one run takes."""
    began = time.perf_counter()
    run()
    return time.perf_counter() - began


def policy_search_figures(metrics: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """What training on the analytic manifolds reported, with the domain of the pairs."""
    shown = ("mean_ratio", "p95_ratio", "first_mean_ratio", "descent_mean_ratio")
    return {
        name: {key: found[key] for key in shown}
        | {"pairs": PAIRS, "domain": MANIFOLDS[name].domain}
        for name, found in metrics.items()
    }


def alternately(runs: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of each run over several rounds in turn, so that slow spells hit all."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(rounds + 1):
        for name, run in runs.items():
            spent = seconds_of(run)
            if turn:  # the first round warms up: compiled kernels, caches, allocated memory
                times[name].append(spent)
    return {name: float(np.median(values)) for name, values in times.items()}


@contextmanager
def one_thread() -> Iterator[None]:
    """Everything on one thread: what is compared must not differ by what else runs."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)
