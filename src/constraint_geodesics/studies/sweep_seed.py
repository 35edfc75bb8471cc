"""One seed of one configuration of a sweep: a policy trained and judged, as a task to run in
parallel.

All that a sweep knows of policies is in this module.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.policy_search import train_policy
from constraint_geodesics.geodesics.problem import Ends, LearnedProblem
from constraint_geodesics.geodesics.proposals import MeanPolicy, propose
from constraint_geodesics.learning.dataset import draw_queries, read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import GeodesicParams, Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.geodesic_search import SeedLog, geodesic_problem, shared_problem
from constraint_geodesics.studies.proposals import family_optimum, measured

Record = dict[str, Any]


@dataclass(frozen=True)
class OptimumTask:
    """The shortest curves of one family for one constraint's queries; picklable.

    params: of any configuration with this family.
    """

    params: Params
    layout: Layout
    constraint: str


@dataclass(frozen=True)
class SweepTask:
    """One seed of one configuration; picklable.

    optimum: of the configuration's family, by constraint: lengths [rad], nan where none was found.
    scratch: of its checkpoints, from which an interrupted training goes on.
    """

    params: Params
    layout: Layout
    seed: int
    optimum: Mapping[str, Float[np.ndarray, "Q"]]
    scratch: Path
    run: AbstractContextManager[SeedLog]


def judged_constraints(params: Params) -> list[str]:
    """Those that policies are trained on and judged by: all that hold something."""
    return [name for name, own in params.constraints.items() if not own.is_free]


def training_settings(params: Params) -> GeodesicParams:
    """How a configuration's policies are trained: those of the pipeline, on fewer steps."""
    return params.policy_settings().model_copy(update={"steps": params.sweep.steps})


def optimum_lengths(task: OptimumTask) -> list[float]:
    """The family's shortest length of each query [rad], nan where no feasible curve was found."""
    problem, ends = _queries(task.params, task.layout, task.constraint)
    straight = np.zeros((len(ends), 1, problem.curve.coefficients))
    lengths: list[float] = family_optimum(problem, ends, straight).length.tolist()
    return lengths


def train_and_judge(task: SweepTask) -> Record:
    """Train one seed's policy, then answer each query with the best curve that its mean meets.

    Returns steps_per_second, and by constraint of each query: feasible, length_rad (nan where not
    feasible), optimum_rad (of the family), time_ms.
    """
    params, layout, settings = task.params, task.layout, training_settings(task.params)
    pace = Pace()
    with task.run as run:
        problem = shared_problem(
            params, _chart(params, layout), *_constraints(params, layout), _manifold(params)
        )
        trained = train_policy(problem, settings, task.seed, task.scratch, pace.also(run.log))
        state = trained.actor.state_dict()
        policy = MeanPolicy.from_arrays({name: value.numpy() for name, value in state.items()})
        judged = {
            name: _judged(policy, settings, *_queries(params, layout, name))
            | {"optimum_rad": list(task.optimum[name])}
            for name in judged_constraints(params)
        }
    return {"steps_per_second": pace.steps_per_second, "constraints": judged}


@dataclass
class Pace:
    """Steps a second between the first report and the last: a resumed training counts its own."""

    marks: list[tuple[int, float]] = field(default_factory=list)

    def also(self, report: Callable[[int, dict[str, float]], None]) -> Callable[..., None]:
        """A report that is timed besides."""

        def reported(step: int, figures: dict[str, float]) -> None:
            self.marks = [*self.marks[:1], (step, time.perf_counter())]
            report(step, figures)

        return reported

    @property
    def steps_per_second(self) -> float:
        """Nan with fewer than two reports."""
        if len(self.marks) < 2:
            return float("nan")
        (first, began), (last, ended) = self.marks
        return (last - first) / (ended - began)


def _judged(
    policy: MeanPolicy, settings: GeodesicParams, problem: LearnedProblem, ends: Ends
) -> Record:
    phi, claimed, times = np.empty((len(ends), problem.curve.coefficients)), [], []
    propose(problem, [policy], settings, ends[np.arange(1)])  # what is loaded late is no query's
    for query in range(len(ends)):
        began = time.perf_counter()
        found = propose(problem, [policy], settings, ends[np.array([query])])
        times.append(1e3 * (time.perf_counter() - began))
        phi[query] = found.phi[0, 0]
        claimed.append(bool(found.feasible[0, 0]))
    costs = measured(problem, phi, ends)
    feasible = np.array(claimed) & costs.feasible
    lengths = np.where(feasible, costs.length, np.nan)
    return {"feasible": feasible.tolist(), "length_rad": lengths.tolist(), "time_ms": times}


def _queries(params: Params, layout: Layout, constraint: str) -> tuple[LearnedProblem, Ends]:
    """One constraint's problem, and the queries that the sweep judges by."""
    scene, sweep = Scene.from_params(params), params.sweep
    manifold = constraint_manifold(scene.robot, params.constraints[constraint])
    queries = draw_queries(scene, manifold, constraint, sweep.queries, sweep.query_seed)
    joints = read_joints(layout.joints(constraint)).free_joints
    chart = _chart(params, layout)
    problem = geodesic_problem(params, chart, manifold, joints, _manifold(params))
    return problem, problem.ends(queries.starts, queries.goals)


def _constraints(params: Params, layout: Layout) -> tuple[dict[str, Any], dict[str, Any]]:
    """Manifolds and data of all constraints, by name."""
    robot = Scene.from_params(params).robot
    manifolds = {name: constraint_manifold(robot, own) for name, own in params.constraints.items()}
    return manifolds, {name: read_joints(layout.joints(name)).free_joints for name in manifolds}


def _manifold(params: Params) -> str:
    return params.geodesics.searched[0]


def _chart(params: Params, layout: Layout) -> LearnedManifold:
    return LearnedManifold.load(layout.manifold(_manifold(params)))
