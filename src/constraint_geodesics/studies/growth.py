"""How cost grows: seconds of planning, of curve lengths and of training against the size of what is
asked.

Six axes, each a row of sizes with everything else held fixed: joints, held task axes (the
codimension), obstacles, queries, latent dimension, dataset rows.  Everything runs on one thread,
compiled code has answered once before it is timed, and what is compared is timed in turn, so that a
slow spell of the machine hits all.  A query without an answer is timed like any other; `solved`
says how many have one, by the planner's own word: validity is judged elsewhere.

The growth in each size is summed up as the exponent p of seconds ∝ size^p, the slope of a straight
line in log-log.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float, Int

from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_manifold,
)
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.length import Collocation, curve_length
from constraint_geodesics.learning.dataset import Queries, draw_queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.training import train_manifold
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.params import ManifoldParams, Params
from constraint_geodesics.peers.elastic_band import free_rows, nothing, settled, task_of
from constraint_geodesics.pipeline.progress import progress
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.report.results import markdown_table
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import Sphere, World
from constraint_geodesics.search.band import BandSettings
from constraint_geodesics.search.candidates import Answer, candidates
from constraint_geodesics.search.roadmap import build_roadmap
from constraint_geodesics.search.space import space_of
from constraint_geodesics.studies.geometry import one_thread

AXES = ("joints", "codimension", "obstacles", "queries", "latent dimension", "dataset rows")
HELD = (
    (0, 0, 0, 0, 0, 0),
    (0, 0, 1, 0, 0, 0),
    (0, 0, 0, 1, 1, 0),
    (0, 0, 1, 1, 1, 0),
    (1, 0, 1, 1, 1, 0),
    (1, 0, 1, 1, 1, 1),
)
"""Task axes held at codimension 0 to 5: from 2 on each mask is part of the next, from a level tool
at any place to one that keeps its orientation on a straight line.
"""
LEVEL = HELD[2]
CONSTRAINT = "level_cup"
"""The constraint of params.yaml under which obstacles, queries and roadmap nodes are counted."""
PLANNER = "planner"
"""What the planner's batches are listed under."""
CURVE_DEGREE = 3
BEND = 0.3
"""Standard deviation of the cubics' coefficients; the ends' is 1."""
AWAY_M = 0.02
"""Free room between an obstacle and the arm at either end of a query: ends that touch something ask
for no search.
"""
TRIES = 500
"""Random configurations among which free ones, or places for spheres, are looked for."""

Batch = Callable[[Float[np.ndarray, "B D"], Float[np.ndarray, "B D"]], Sequence[bool]]
"""Answers B queries of `CONSTRAINT`, given their starts and goals [rad]; which of them are solved.
"""


@dataclass(frozen=True)
class GrowthSizes:
    """What is measured: the sizes along each axis, and how often.

    references: reference poses for the axes `joints` and `codimension`, each with `queries_each`
    queries.  layouts: of the spheres, each with `obstacle_queries_each`.  batches: of the planner,
    and peer_batches of its peer, each timed `batch_repeats` times at least, and until
    `batch_queries` were asked.  curves: measured at once, `length_repeats` times.  rows: trained on
    for `epochs` that are timed, `training_repeats` times.  nodes: of a roadmap, built
    `roadmap_repeats` times.
    """

    references: int = 8
    queries_each: int = 2
    codimensions: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    spheres: tuple[int, ...] = (0, 1, 2, 4, 8, 16)
    radius_m: float = 0.06
    layouts: int = 5
    obstacle_queries_each: int = 3
    batches: tuple[int, ...] = (1, 4, 16, 64, 256)
    peer_batches: tuple[int, ...] = (1, 4, 16, 64)
    batch_repeats: int = 3
    batch_queries: int = 32
    latent_dims: tuple[int, ...] = (2, 3, 4, 6, 8)
    curves: int = 256
    length_repeats: int = 50
    rows: tuple[int, ...] = (2000, 4000, 8000, 16000, 32000)
    epochs: int = 2
    training_repeats: int = 3
    nodes: tuple[int, ...] = (500, 1000, 2000, 4000)
    roadmap_repeats: int = 3
    seed: int = 23

    @property
    def steps(self) -> int:
        """How many times progress is made."""
        planned = self.references * (2 + len(self.codimensions)) + self.layouts * len(self.spheres)
        trained = self.training_repeats * len(self.rows) + self.roadmap_repeats * len(self.nodes)
        return planned + max(map(self.turns, self.all_batches)) + 1 + trained

    @property
    def all_batches(self) -> tuple[int, ...]:
        """Numbers of queries that anyone is asked."""
        return tuple(sorted({*self.batches, *self.peer_batches}))

    def turns(self, batch: int) -> int:
        """How often a batch of so many queries is timed."""
        return max(self.batch_repeats, -(-self.batch_queries // batch))


class Sample(NamedTuple):
    """One timing: of what, at which size of which axis, and whether the query was solved, or the
    share of a batch that was; nan where nothing is asked.
    """

    axis: str
    value: int
    what: str
    seconds: float
    solved: float = np.nan


@dataclass(frozen=True)
class Subject:
    """What is measured on.

    scene: the robot of params.yaml in its workcell.  other: a robot with another number of joints.
    planners: asked one query at a time, by name.  batch: answers many queries of `CONSTRAINT`;
    peer: which of the planners it is compared with.  joints (n, D): configurations to train on
    [rad].  scratch: where training keeps its checkpoints.
    """

    params: Params
    scene: Scene
    other: SerialRobot
    planners: Mapping[str, PathPlanner]
    batch: Batch
    peer: str
    joints: Float[np.ndarray, "n D"]
    scratch: Path

    @property
    def manifold(self) -> ConstraintManifold:
        """That of `CONSTRAINT`."""
        return constraint_manifold(self.scene.robot, self.params.constraints[CONSTRAINT])

    @property
    def learned(self) -> ManifoldParams:
        """Layer sizes and training of the manifold that is searched."""
        return self.params.manifolds[self.params.geodesics.searched[0]]


@dataclass(frozen=True)
class BandAndTrees:
    """The project's own search without anything learned: the straight line's band, and two trees
    where that fails.
    """

    settings: BandSettings = field(default_factory=BandSettings)
    name: str = "band and trees"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The first candidate whose rows touch nothing.  The trees have seeds of their own: `seed`
        is ignored.
        """
        began = time.perf_counter()
        del seed
        early = settled(problem, began)
        if early is not None:
            return early
        task = task_of(problem, self.settings)
        tried = 0
        for candidate in candidates(task, problem.start, problem.goal, lambda: None):
            if isinstance(candidate, Answer):
                break
            tried += 1
            rows = free_rows(problem, task, candidate)
            if rows is not None:
                return Solution("solved", rows, time.perf_counter() - began, tried)
        return nothing(problem, began, tried)


def measure_growth(
    subject: Subject, sizes: GrowthSizes | None = None, description: str = "growth"
) -> pd.DataFrame:
    """Measure all axes, with progress under `description` (none if it is empty).

    Columns: axis; value, the size; what, whose time it is; seconds, the median, between the
    quartiles low and high; repeats, how many timings these are of; solved, the share of queries
    with an answer, nan where none is asked; mean, of the same seconds, which is far above the
    median where some queries are easy and others take a search. Seconds are of one query on the
    axes joints, codimension and obstacles; of all queries together on the axis queries, where the
    median of one query leaves out the slow ones that a large batch holds, so that its slope may
    exceed 1; of a whole batch of curves on latent dimension; of one training epoch or one roadmap
    on dataset rows.

    joints: a level tool (roll and pitch held), no workcell; codimension: params.yaml's workcell and
    `HELD`.  What a query costs depends on where the constraint is held and where the spheres stand,
    so several references are taken, each the tool pose of a random free configuration and the same
    for all codimensions, and several layouts, of which a larger number of spheres holds the smaller
    ones.
    Raises DatasetError if hardly any configuration under such a constraint is free, ValueError if
    hardly any is without one, if there is no room for the spheres, or if there are fewer
    configurations than are to be trained on.
    """
    sizes = sizes or GrowthSizes()
    axes = (_joints, _codimension, _obstacles, _queries, _latent_dimension, _epochs, _roadmaps)
    samples: list[Sample] = []
    if len(subject.joints) < max(sizes.rows):
        raise ValueError(
            f"{len(subject.joints)} configurations: training on {max(sizes.rows)} needs as many"
        )
    with one_thread(), progress(description, sizes.steps) as advance:
        for axis in axes:
            for found in axis(subject, sizes):
                samples += found
                advance()
    return _summary(samples)


def _summary(samples: Sequence[Sample]) -> pd.DataFrame:
    """The table of `measure_growth`, by axis in their order, then by size, then as they came."""
    every = pd.DataFrame(samples)
    rows = []
    for (axis, value, what), own in every.groupby(["axis", "value", "what"], sort=False):
        low, median, high = np.quantile(own["seconds"], [0.25, 0.5, 0.75])
        rows.append(
            {
                "axis": axis,
                "value": value,
                "what": what,
                "seconds": median,
                "low": low,
                "high": high,
                "repeats": len(own),
                "solved": own["solved"].mean(),
                "mean": own["seconds"].mean(),
            }
        )
    rows.sort(key=lambda row: (AXES.index(row["axis"]), row["value"]))
    return pd.DataFrame(rows)


def slopes(table: pd.DataFrame) -> pd.DataFrame:
    """Exponents: for each (axis, what) the least-squares line of log seconds over log value.

    Columns: axis, what, slope, its standard_error (nan with two points, which leave no residual),
    seconds_at_1 (the line at value 1) and points.  A value of 0 (no obstacle, no held axis) has no
    logarithm and is left out of the fit, as are times that are not positive and finite.  All nan
    where fewer than 2 distinct positive values remain.
    """
    rows = []
    for (axis, what), own in table.groupby(["axis", "what"], sort=False):
        value, seconds = own["value"].to_numpy(float), own["seconds"].to_numpy(float)
        used = (value > 0) & (seconds > 0) & np.isfinite(seconds)
        slope, error, intercept = _line(np.log(value[used]), np.log(seconds[used]))
        rows.append(
            {
                "axis": axis,
                "what": what,
                "slope": slope,
                "standard_error": error,
                "seconds_at_1": float(np.exp(intercept)),
                "points": int(used.sum()),
            }
        )
    return pd.DataFrame(
        rows, columns=["axis", "what", "slope", "standard_error", "seconds_at_1", "points"]
    )


def slopes_markdown(fits: pd.DataFrame) -> str:
    """The exponents as a table, axis by axis."""
    rows: list[Sequence[str]] = [("grows with", "what", "exponent", "± standard error", "points")]
    for row in fits.to_dict("records"):
        slope, error = (
            f"{row[name]:.2f}" if np.isfinite(row[name]) else "–"
            for name in ("slope", "standard_error")
        )
        rows.append((row["axis"], row["what"], slope, error, str(row["points"])))
    return f"{markdown_table(rows)}\n"


def _line(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Slope, its standard error and the intercept of a least-squares line."""
    if len(np.unique(x)) < 2:
        return np.nan, np.nan, np.nan
    from_mean = x - x.mean()
    spread = float(from_mean @ from_mean)
    slope = float(from_mean @ y) / spread
    intercept = float(y.mean() - slope * x.mean())
    residual = y - intercept - slope * x
    error = np.sqrt(float(residual @ residual) / (len(x) - 2) / spread) if len(x) > 2 else np.nan
    return slope, float(error), intercept


def epoch_seconds(
    joints: Float[np.ndarray, "n D"],
    robot: SerialRobot,
    settings: ManifoldParams,
    epochs: int,
    scratch: Path,
) -> dict[str, list[float]]:
    """Seconds of single epochs of both training phases, mean and variance: training, validation,
    checkpoint.

    Taken between the reports of successive epochs, so that neither what comes before the first
    epoch nor what comes after the last one is part of them.
    """
    stamps: list[float] = []
    longer = {
        "epochs": epochs + 1,
        "variance_epochs": epochs + 1,
        "patience": epochs + 2,
    }  # the first is not counted
    train_manifold(
        joints,
        robot,
        settings.model_copy(update=longer),
        scratch,
        lambda *_: stamps.append(time.perf_counter()),
        progress=False,
    )
    phases = np.diff(np.reshape(stamps, (2, epochs + 1)), axis=1)
    return dict(zip(("mean", "variance"), phases.tolist(), strict=True))


def place_spheres(
    scene: Scene,
    queries: Queries,
    count: int,
    radius_m: float,
    rng: np.random.Generator,
    tries: int = TRIES,
) -> list[Sphere]:
    """Spheres around random places that the tool can be at, none within AWAY_M of the arm at an end
    of a query.

    Raises ValueError if `tries` random configurations are not enough.
    """
    ends, kept = np.concatenate([queries.starts, queries.goals]), list[Sphere]()
    for q in _free_configurations(scene, rng, tries):
        if len(kept) == count:
            break
        x, y, z = scene.robot.forward(q)[0].tolist()
        with World(scene.robot, [Sphere("wider", (x, y, z), radius_m + AWAY_M)]) as world:
            if not world.label(ends).workcell_collision.any():
                kept.append(Sphere(f"sphere_{len(kept)}", (x, y, z), radius_m))
    if len(kept) < count:
        raise ValueError(
            f"no room for {count} spheres of {radius_m} m beside the ends of {len(queries)} queries"
        )
    return kept


@dataclass(frozen=True)
class _Case:
    """Some queries of one constraint in one scene."""

    scene: Scene
    manifold: ConstraintManifold
    queries: Queries

    def problems(self, world: World) -> list[PlanningProblem]:
        """As the planners are asked; world: of the same scene."""
        clearance = clearance_model(self.scene.robot, self.scene.workcell)
        _ = clearance.arrays  # made once for a workcell, not once a query
        ends = zip(self.queries.starts, self.queries.goals, strict=True)
        return [
            PlanningProblem(start, goal, self.manifold, world.is_free, clearance)
            for start, goal in ends
        ]


def _joints(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    robots = sorted((subject.scene.robot, subject.other), key=lambda robot: robot.dof)
    scenes = [Scene(robot) for robot in robots]
    poses = [_references(scene, sizes) for scene in scenes]
    for k in range(sizes.references):
        for scene, own in zip(scenes, poses, strict=True):
            case = _held(scene, LEVEL, own[k], k, sizes)
            if k == 0:
                _warmed(subject, case)
            yield _planned(subject, "joints", scene.robot.dof, case)


def _codimension(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    for k, pose in enumerate(_references(subject.scene, sizes)):
        for count in sizes.codimensions:
            case = _held(subject.scene, HELD[count], pose, k, sizes)
            if k == 0:
                _warmed(subject, case)
            yield _planned(subject, "codimension", count, case)


def _obstacles(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    scene, manifold, rng = subject.scene, subject.manifold, np.random.default_rng(sizes.seed)
    for k in range(sizes.layouts):
        queries = draw_queries(
            scene, manifold, f"layout_{k}", sizes.obstacle_queries_each, sizes.seed
        )
        spheres = place_spheres(scene, queries, max(sizes.spheres), sizes.radius_m, rng)
        for count in sizes.spheres:
            case = _Case(Scene(scene.robot, (*scene.workcell, *spheres[:count])), manifold, queries)
            if k == 0:
                _warmed(subject, case)
            yield _planned(subject, "obstacles", count, case)


def _queries(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    scene, manifold, peer = subject.scene, subject.manifold, subject.planners[subject.peer]
    pool = draw_queries(scene, manifold, CONSTRAINT, max(sizes.all_batches), sizes.seed)
    with scene.world() as world:
        problems = _Case(scene, manifold, pool).problems(world)

        def one_by_one(rows: Int[np.ndarray, "B"]) -> Sequence[bool]:
            return [
                peer.plan(replace(problems[row]), seed=int(row)).status == "solved" for row in rows
            ]

        def together(rows: Int[np.ndarray, "B"]) -> Sequence[bool]:
            return subject.batch(pool.starts[rows], pool.goals[rows])

        together(
            np.arange(len(pool))
        )  # all of them: some parts are loaded by the first query that needs them
        one_by_one(np.arange(1))
        asked = ((PLANNER, together, sizes.batches), (subject.peer, one_by_one, sizes.peer_batches))
        most = max(map(sizes.turns, sizes.all_batches))
        for turn in range(most):
            found = []
            for count in sizes.all_batches:
                own, late = divmod(
                    turn, most // sizes.turns(count)
                )  # the large ones are spread over the time as well
                if late or own >= sizes.turns(count):
                    continue
                rows = (own * count + np.arange(count)) % len(
                    pool
                )  # other queries, as long as there are any
                for name, answer, counts in asked:
                    if count in counts:
                        began = time.perf_counter()
                        solved = answer(rows)
                        spent = time.perf_counter() - began
                        found.append(Sample("queries", count, name, spent, float(np.mean(solved))))
            yield found


def _latent_dimension(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    """Lengths of random cubics by the rule that searches use, on networks with untrained weights:
    with the rule given, the arithmetic is the same whatever the weights.
    """
    settings, dof = subject.learned, subject.scene.robot.dof
    rule = Collocation.chebyshev(subject.params.geodesics.length_degree)
    generator = torch.Generator().manual_seed(sizes.seed)
    runs: dict[int, Callable[[], object]] = {}
    for dim in sizes.latent_dims:
        vae = (
            JointVae(dof, dim, settings.hidden, settings.variance_centres)
            .eval()
            .requires_grad_(False)
        )
        family = PinnedPolynomial(dim, CURVE_DEGREE)
        shapes = (family.coefficients, dim, dim)
        phi, start, goal = (
            torch.randn(sizes.curves, width, generator=generator, dtype=torch.float64)
            for width in shapes
        )
        runs[dim] = partial(
            curve_length, LearnedManifold(vae), family, BEND * phi, start, goal, rule
        )
    what = f"{sizes.curves} curve lengths"
    with torch.no_grad():
        turns = [
            [Sample("latent dimension", dim, what, _seconds(run)) for dim, run in runs.items()]
            for _ in range(sizes.length_repeats + 1)
        ]
    yield [sample for turn in turns[1:] for sample in turn]


def _epochs(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    robot, settings = subject.scene.robot, subject.learned
    for _ in range(sizes.training_repeats):
        for count in sizes.rows:
            found = epoch_seconds(
                subject.joints[:count], robot, settings, sizes.epochs, subject.scratch
            )
            yield [
                Sample("dataset rows", count, f"training epoch, {phase}", seconds)
                for phase, epochs in found.items()
                for seconds in epochs
            ]


def _roadmaps(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    scene, manifold, settings = subject.scene, subject.manifold, subject.params.planner
    drawn = draw_queries(scene, manifold, CONSTRAINT, -(-max(sizes.nodes) // 2), sizes.seed)
    nodes = np.concatenate([drawn.starts, drawn.goals])
    clearance = clearance_model(scene.robot, scene.workcell)
    space = space_of(manifold, clearance, settings.clearance_m)
    build_roadmap(space, nodes[: min(sizes.nodes)], settings.roadmap_neighbours)
    for _ in range(sizes.roadmap_repeats):
        for count in sizes.nodes:
            build = partial(build_roadmap, space, nodes[:count], settings.roadmap_neighbours)
            yield [Sample("dataset rows", count, "roadmap", _seconds(build))]


def _free_configurations(
    scene: Scene, rng: np.random.Generator, tries: int
) -> Iterator[Float[np.ndarray, "D"]]:
    """Those of so many random configurations [rad] that touch nothing."""
    with scene.world() as world:
        yield from (q for q in scene.robot.sample(tries, rng) if world.is_free(q))


def _references(scene: Scene, sizes: GrowthSizes) -> list[Pose]:
    """Tool poses of random free configurations."""
    found = list(
        islice(
            _free_configurations(scene, np.random.default_rng(sizes.seed), TRIES), sizes.references
        )
    )
    if len(found) < sizes.references:
        raise ValueError(
            f"only {len(found)} of {TRIES} random configurations are free: {sizes.references} "
            f"are needed"
        )
    return [Pose(*scene.robot.forward(q)) for q in found]


def _held(scene: Scene, axes: tuple[int, ...], pose: Pose, k: int, sizes: GrowthSizes) -> _Case:
    """Queries with some axes held at a pose, the k-th of the references."""
    manifold = ConstraintManifold(scene.robot, Constraint(axes, reference=pose))
    return _Case(
        scene, manifold, draw_queries(scene, manifold, f"held_{k}", sizes.queries_each, sizes.seed)
    )


def _warmed(subject: Subject, case: _Case) -> None:
    """One query that does not count: it loads compiled code."""
    with case.scene.world() as world:
        problem = case.problems(world)[0]
        for planner in subject.planners.values():
            planner.plan(problem, seed=0)


def _planned(subject: Subject, axis: str, value: int, case: _Case) -> list[Sample]:
    """Every planner on every query of a case, the planners in turn."""
    found = []
    with case.scene.world() as world:
        for seed, problem in enumerate(case.problems(world)):
            for name, planner in subject.planners.items():
                own = replace(problem)  # a planner may remember the very problem that it answered
                began = time.perf_counter()
                solved = planner.plan(own, seed).status == "solved"
                found.append(Sample(axis, value, name, time.perf_counter() - began, float(solved)))
    return found


def _seconds(run: Callable[[], object]) -> float:
    began = time.perf_counter()
    run()
    return time.perf_counter() - began
