"""One seed of one configuration of a sweep: a policy trained and judged, as a task to run in
parallel.

All that a sweep knows of policies is in this module.
"""

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import judge_limits
from constraint_geodesics.certification.certificate import Limits
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.learned_problem import LearnedProblem, ProblemSet
from constraint_geodesics.geodesics.policy_search import train_policy
from constraint_geodesics.geodesics.problem import Ends
from constraint_geodesics.learning.dataset import draw_queries, read_joints
from constraint_geodesics.learning.learned_manifold import chart_named
from constraint_geodesics.params import GeodesicParams, Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.geodesic_search import SeedLog, policy_problem, training_problem
from constraint_geodesics.studies.optimum import family_optimum
from constraint_geodesics.studies.proposals import Asked, Method, answered, by_policy

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
    _, problem, ends = _queries(task.params, task.layout, task.constraint)
    straight = np.zeros((len(ends), 1, problem.curve.coefficients))
    lengths: list[float] = family_optimum(problem, ends, straight).length.tolist()
    return lengths


def train_and_judge(task: SweepTask) -> Record:
    """Train one seed's policy, then answer each query with its first certified curve.

    Returns steps_per_second, and by constraint of each query: feasible (certified), length_rad (nan
    where not), optimum_rad (of the family), time_ms (with the check).
    """
    params, layout, settings = task.params, task.layout, training_settings(task.params)
    pace, limits = Pace(), judge_limits(params.judge)
    with task.run as run:
        problem = _training(params, layout)
        trained = train_policy(problem, settings, task.seed, task.scratch, pace.also(run.log))
        answer = by_policy(trained.mean, settings, task.seed)
        judged = {
            name: _judged(answer, limits, *_queries(params, layout, name))
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
    answer: Method, limits: Limits, scene: Scene, problem: LearnedProblem, ends: Ends
) -> Record:
    feasible, lengths, times = list[bool](), list[float](), list[float]()
    with Certifier(scene, limits) as certifier:
        for query in range(len(ends)):
            asked = Asked(problem, ends[np.array([query])], query, certifier)
            if not query:
                answered(asked, answer(asked, 0.0))  # what is loaded late is no query's
            found = answered(asked, answer(asked, 0.0))
            feasible.append(found.solved)
            lengths.append(found.length)
            times.append(1e3 * (found.search_s + found.check_s))
    return {"feasible": feasible, "length_rad": lengths, "time_ms": times}


def _queries(params: Params, layout: Layout, constraint: str) -> tuple[Scene, LearnedProblem, Ends]:
    """One constraint's scene and problem, and the queries that the sweep judges by."""
    sweep = params.sweep
    scene, problem = _alone(params, layout, constraint)
    name, manifold = constraint, problem.manifold
    queries = draw_queries(scene, manifold, name, sweep.queries, sweep.query_seed)
    return scene, problem, problem.ends(queries.starts, queries.goals)


def _alone(params: Params, layout: Layout, constraint: str) -> tuple[Scene, LearnedProblem]:
    scene, name = Scene.from_params(params, constraint), params.policies.chart
    chart = chart_named(name, layout.manifold(name), scene.robot)
    manifold = constraint_manifold(scene.robot, params.constraints[constraint])
    joints = read_joints(layout.joints(constraint)).free_joints
    return scene, policy_problem(params, chart, scene, manifold, joints)


_KEPT: dict[str, ProblemSet] = {}
"""What a worker has trained on last: spheres take longer to place than few steps to train."""


def _training(params: Params, layout: Layout) -> ProblemSet:
    """What policies train on; the same for configurations that differ in nothing it depends on."""
    own = params.policies
    trained = own.model_dump(exclude={"reward", "ppo", "seeds", "steps"})
    described = params.model_dump(include={"robot", "workcell", "carried", "constraints"})
    files = [layout.joints(name).stat() for name in params.constraints]
    data = [(file.st_mtime_ns, file.st_size) for file in files]
    key = str((layout.root, params.geodesics.degree, trained, described, data))
    if key not in _KEPT:
        # one robot and one chart for all: members of a set share them
        robot, asked = Scene.from_params(params).robot, list[tuple[Scene, LearnedProblem]]()
        for name in params.constraints:
            scene, problem = _alone(params, layout, name)
            manifold = replace(problem.manifold, robot=robot)
            chart = asked[0][1].chart if asked else problem.chart
            asked.append((scene, replace(problem, manifold=manifold, chart=chart)))
        _KEPT.clear()
        _KEPT[key] = training_problem(params, asked)
    return _KEPT[key]
