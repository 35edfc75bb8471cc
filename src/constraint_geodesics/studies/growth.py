"""How cost grows: seconds of planning, of curve lengths and of training against the size asked.

Six axes, each a row of sizes with all else fixed: joints, held task axes (the codimension),
obstacles, queries, latent dimension, dataset rows.  One thread; compiled code is warm; what is
compared is timed in turn.  A query without an answer is timed like any other; `solved` says how
many have one, by the planner's own word.  The growth is summed up as the exponent p of
seconds ∝ size^p, the slope of a straight line in log-log.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float, Int

from constraint_geodesics.benchmark.judge import problem_of
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_manifold,
)
from constraint_geodesics.geometry.curves import Curves, PinnedPolynomial
from constraint_geodesics.geometry.length import Collocation, curve_length
from constraint_geodesics.learning.dataset import Queries, draw_queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.training import TrainingRun, train_manifold
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.params import ManifoldParams, Params
from constraint_geodesics.peers.elastic_band import answer, first_free, settled, task_of
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.progress import progress
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.world import World
from constraint_geodesics.search.band import BandSettings
from constraint_geodesics.search.candidates import Candidate, candidates
from constraint_geodesics.search.roadmap import build_roadmap
from constraint_geodesics.search.space import space_of
from constraint_geodesics.studies.geometry import one_thread, seconds_of

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

MOST = 0.9
"""Share of the queries that must be solved for a time to tell how solving grows."""

Batch = Callable[[Float[np.ndarray, "B D"], Float[np.ndarray, "B D"]], Sequence[bool]]
"""Answers B queries of `CONSTRAINT`, given their starts and goals [rad]; which of them are solved.
"""


@dataclass(frozen=True)
class GrowthSizes:
    """The sizes along each axis, and how often each is measured.

    references: poses for the axes joints and codimension, with `queries_each`.  layouts: of
    spheres, with `obstacle_queries_each`.  batches, peer_batches: of the planner and its peer, each
    timed `batch_repeats` times at least, and until `batch_queries` were asked.  curves: measured at
    once, `length_repeats` times.  rows: trained on for `epochs`, `training_repeats` times.  nodes:
    of a roadmap, built `roadmap_repeats` times.
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
    """One timing: of what, at which size of which axis; solved share, nan if nothing is asked."""

    axis: str
    value: int
    what: str
    seconds: float
    solved: float = np.nan


@dataclass(frozen=True)
class Subject:
    """What is measured on.

    scene: params.yaml's robot and workcell.  other: a robot with another number of joints.
    planners: asked one query at a time.  batch: answers many queries of `CONSTRAINT`; peer: the
    planner that it is compared with.  joints: to train on [rad].  scratch: for checkpoints of
    training.
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
    """The project's own search, nothing learned: the straight line's band, then two trees."""

    settings: BandSettings = field(default_factory=BandSettings)
    name: str = "trees + band"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        """The first candidate that touches nothing; `seed` is ignored, trees have their own."""
        began = time.perf_counter()
        early = settled(problem, began)
        if early is not None:
            return early
        task = task_of(problem, self.settings)
        found = candidates(task, problem.start, problem.goal)
        curves = (candidate for candidate in found if isinstance(candidate, Candidate))
        rows, tried = first_free(problem, curves)
        return answer(rows, problem, began, tried)


def measure_growth(
    subject: Subject, sizes: GrowthSizes | None = None, description: str = "growth"
) -> pd.DataFrame:
    """Measure all axes, with progress under `description` (none if it is empty).

    Columns: axis; value, the size; what is timed; seconds, the median, between the quartiles low
    and high; repeats; solved, nan where nothing is asked; mean of the seconds, far above the median
    where some queries take a search.  Seconds are of one query on the axes joints, codimension and
    obstacles, of all queries together on queries, of a batch of curves on latent dimension, of one
    training epoch or roadmap on dataset rows.

    joints: a level tool, no workcell; codimension: params.yaml's workcell and `HELD`.  Several
    references are taken, each the tool pose of a random free configuration, the same for all
    codimensions, and several layouts, where more spheres hold the fewer.
    Raises DatasetError if hardly any configuration under a constraint is free, ValueError if hardly
    any is without one or there is no room for the spheres.
    """
    sizes = sizes or GrowthSizes()
    axes = (_joints, _codimension, _obstacles, _queries, _latent_dimension, _epochs, _roadmaps)
    samples: list[Sample] = []
    with one_thread(), progress(description, sizes.steps) as advance:
        for axis in axes:
            for found in axis(subject, sizes):
                samples += found
                advance()
    return _summary(samples)


def _summary(samples: Sequence[Sample]) -> pd.DataFrame:
    """The table of `measure_growth`, by axis in their order, then by size, then as they came."""
    by = pd.DataFrame(samples).groupby(["axis", "value", "what"], sort=False)
    low, median, high = (by["seconds"].quantile(q) for q in (0.25, 0.5, 0.75))
    columns = {"seconds": median, "low": low, "high": high, "repeats": by.size()}
    columns |= {"solved": by["solved"].mean(), "mean": by["seconds"].mean()}
    return (
        pd.DataFrame(columns)
        .reset_index()
        .sort_values(["axis", "value"], key=_in_order, kind="stable", ignore_index=True)
    )


def _in_order(column: "pd.Series[Any]") -> "pd.Series[Any]":
    return column.map(AXES.index) if column.name == "axis" else column


def slopes(table: pd.DataFrame) -> pd.DataFrame:
    """Exponents: for each (axis, what) the least-squares line of log seconds over log value.

    Columns: axis, what, slope, standard_error (nan with two points), seconds_at_1 and points.
    Values of 0, times that are not positive and finite, and those of which less than MOST was
    solved, where the median is also that of giving up, are left out; all nan where fewer than two
    distinct values remain.
    """
    rows = []
    for (axis, what), own in table.groupby(["axis", "what"], sort=False):
        value, seconds = own["value"].to_numpy(float), own["seconds"].to_numpy(float)
        used = (value > 0) & (seconds > 0) & np.isfinite(seconds)
        used &= ~(own["solved"].to_numpy(float) < MOST)
        line = _line(np.log(value[used]), np.log(seconds[used]))
        rows.append((axis, what, *line, int(used.sum())))
    columns = ["axis", "what", "slope", "standard_error", "seconds_at_1", "points"]
    return pd.DataFrame(rows, columns=columns)


def _line(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Slope of a least-squares line, its standard error, and exp of the intercept."""
    if len(np.unique(x)) < 2:
        return np.nan, np.nan, np.nan
    slope, intercept = np.polyfit(x, y, 1)
    error = np.sqrt(np.polyfit(x, y, 1, cov=True)[1][0, 0]) if len(x) > 2 else np.nan
    return float(slope), float(error), float(np.exp(intercept))


def epoch_seconds(
    joints: Float[np.ndarray, "n D"],
    robot: SerialRobot,
    settings: ManifoldParams,
    epochs: int,
    scratch: Path,
) -> dict[str, list[float]]:
    """Seconds of single epochs of both training phases, between the reports of successive ones."""
    stamps: list[float] = []
    # one more, since the first is not counted
    longer = {"epochs": epochs + 1, "variance_epochs": epochs + 1, "patience": epochs + 2}
    run = TrainingRun(scratch, lambda *_: stamps.append(time.perf_counter()), progress=False)
    train_manifold(joints, robot, settings.model_copy(update=longer), run)
    phases = np.diff(np.reshape(stamps, (2, epochs + 1)), axis=1)
    return dict(zip(("mean", "variance"), phases.tolist(), strict=True))


def place_spheres(
    scene: Scene, queries: Queries, count: int, radius_m: float, rng: np.random.Generator
) -> list[Sphere]:
    """Spheres around random places that the tool can be at, none within AWAY_M of the arm at an end
    of a query.

    Raises ValueError if TRIES random configurations are not enough.
    """
    ends, kept = np.concatenate([queries.starts, queries.goals]), list[Sphere]()
    for q in _free_configurations(scene, rng):
        if len(kept) == count:
            break
        x, y, z = scene.robot.forward(q)[0].tolist()
        with World(scene.robot, [Sphere("wider", (x, y, z), radius_m + AWAY_M)]) as world:
            if not world.label(ends).workcell_collision.any():
                kept.append(Sphere(f"sphere_{len(kept)}", (x, y, z), radius_m))
    if len(kept) < count:
        raise ValueError(
            f"no room for {count} spheres of {radius_m} m near the ends of {len(queries)} queries"
        )
    return kept


@dataclass(frozen=True)
class _Asked:
    """Some queries of one constraint in one scene."""

    scene: Scene
    manifold: ConstraintManifold
    queries: Queries

    def problems(self, certifier: Certifier) -> list[PlanningProblem]:
        """As the planners are asked; certifier: of the same scene."""
        clearance = clearance_model(self.scene, certifier.collisions.apart)
        ends = zip(self.queries.starts, self.queries.goals, strict=True)
        return [problem_of(*own, self.manifold, certifier, clearance) for own in ends]


def _joints(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    robots = sorted((subject.scene.robot, subject.other), key=lambda robot: robot.dof)
    scenes = [Scene(robot) for robot in robots]
    poses = [_references(scene, sizes) for scene in scenes]
    for k in range(sizes.references):
        for scene, own in zip(scenes, poses, strict=True):
            asked = _held(scene, LEVEL, own[k], k, sizes)
            if k == 0:
                _warmed(subject, asked)
            yield _planned(subject, "joints", scene.robot.dof, asked)


def _codimension(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    for k, pose in enumerate(_references(subject.scene, sizes)):
        for count in sizes.codimensions:
            asked = _held(subject.scene, HELD[count], pose, k, sizes)
            if k == 0:
                _warmed(subject, asked)
            yield _planned(subject, "codimension", count, asked)


def _obstacles(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    scene, manifold, rng = subject.scene, subject.manifold, np.random.default_rng(sizes.seed)
    for k in range(sizes.layouts):
        queries = draw_queries(
            scene, manifold, f"layout_{k}", sizes.obstacle_queries_each, sizes.seed
        )
        spheres = place_spheres(scene, queries, max(sizes.spheres), sizes.radius_m, rng)
        for count in sizes.spheres:
            asked = _Asked(
                Scene(scene.robot, (*scene.workcell, *spheres[:count])), manifold, queries
            )
            if k == 0:
                _warmed(subject, asked)
            yield _planned(subject, "obstacles", count, asked)


def _queries(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    scene, manifold, peer = subject.scene, subject.manifold, subject.planners[subject.peer]
    pool = draw_queries(scene, manifold, CONSTRAINT, max(sizes.all_batches), sizes.seed)
    with Certifier(scene) as certifier:
        problems = _Asked(scene, manifold, pool).problems(certifier)

        def one_by_one(rows: Int[np.ndarray, "B"]) -> Sequence[bool]:
            answers = [peer.plan(replace(problems[row]), seed=int(row)) for row in rows]
            return [answer.status == "solved" for answer in answers]

        def together(rows: Int[np.ndarray, "B"]) -> Sequence[bool]:
            return subject.batch(pool.starts[rows], pool.goals[rows])

        # all of them: some parts are loaded by the first query that needs them
        together(np.arange(len(pool)))
        one_by_one(np.arange(1))
        asked = ((PLANNER, together, sizes.batches), (subject.peer, one_by_one, sizes.peer_batches))
        most = max(map(sizes.turns, sizes.all_batches))
        for turn in range(most):
            found = []
            for count in sizes.all_batches:
                # the large ones are spread over the time as well
                own, late = divmod(turn, most // sizes.turns(count))
                if late or own >= sizes.turns(count):
                    continue
                # other queries, as long as there are any
                rows = (own * count + np.arange(count)) % len(pool)
                for name, answer, counts in asked:
                    if count in counts:
                        began = time.perf_counter()
                        solved = answer(rows)
                        spent = time.perf_counter() - began
                        found.append(Sample("queries", count, name, spent, float(np.mean(solved))))
            yield found


def _latent_dimension(subject: Subject, sizes: GrowthSizes) -> Iterator[list[Sample]]:
    """Lengths of random cubics on untrained networks: the arithmetic is the same."""
    settings, dof = subject.learned, subject.scene.robot.dof
    rule = Collocation.chebyshev(subject.params.geodesics.length_degree)
    generator = torch.Generator().manual_seed(sizes.seed)
    runs: dict[int, Callable[[], object]] = {}
    for dim in sizes.latent_dims:
        vae = JointVae(dof, dim, settings.hidden, settings.variance_centres)
        manifold = LearnedManifold(vae.eval().requires_grad_(False))
        family = PinnedPolynomial(dim, CURVE_DEGREE)
        phi, start, goal = (
            torch.randn(sizes.curves, width, generator=generator, dtype=torch.float64)
            for width in (family.coefficients, dim, dim)
        )
        curves = Curves(family, BEND * phi, start, goal)
        runs[dim] = partial(curve_length, manifold, curves, rule)
    what = f"{sizes.curves} curve lengths"
    with torch.no_grad():
        turns = [
            [Sample("latent dimension", dim, what, seconds_of(run)) for dim, run in runs.items()]
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
    clearance = clearance_model(scene)
    space = space_of(manifold, clearance, settings.clearance_m)
    build_roadmap(space, nodes[: min(sizes.nodes)], settings.roadmap_neighbours)
    for _ in range(sizes.roadmap_repeats):
        for count in sizes.nodes:
            build = partial(build_roadmap, space, nodes[:count], settings.roadmap_neighbours)
            yield [Sample("dataset rows", count, "roadmap", seconds_of(build))]


def _free_configurations(
    scene: Scene, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, "D"]]:
    """Those of TRIES random configurations [rad] that touch nothing."""
    with scene.world() as world:
        yield from (q for q in scene.robot.sample(TRIES, rng) if world.is_free(q))


def _references(scene: Scene, sizes: GrowthSizes) -> list[Pose]:
    """Tool poses of random free configurations."""
    free, count = _free_configurations(scene, np.random.default_rng(sizes.seed)), sizes.references
    found = list(islice(free, count))
    if len(found) < count:
        raise ValueError(
            f"only {len(found)} of {TRIES} random configurations are free, not {count}"
        )
    return [Pose(*scene.robot.forward(q)) for q in found]


def _held(scene: Scene, axes: tuple[int, ...], pose: Pose, k: int, sizes: GrowthSizes) -> _Asked:
    """Queries with some axes held at a pose, the k-th of the references."""
    manifold = ConstraintManifold(scene.robot, Constraint(axes, reference=pose))
    return _Asked(
        scene, manifold, draw_queries(scene, manifold, f"held_{k}", sizes.queries_each, sizes.seed)
    )


def _warmed(subject: Subject, asked: _Asked) -> None:
    """One query that does not count: it loads compiled code."""
    with Certifier(asked.scene) as certifier:
        problem = asked.problems(certifier)[0]
        for planner in subject.planners.values():
            planner.plan(problem, seed=0)


def _planned(subject: Subject, axis: str, value: int, asked: _Asked) -> list[Sample]:
    """Every planner on every query, the planners in turn."""
    found = []
    with Certifier(asked.scene) as certifier:
        for seed, problem in enumerate(asked.problems(certifier)):
            for name, planner in subject.planners.items():
                own = replace(problem)  # a planner may remember the very problem that it answered
                began = time.perf_counter()
                solved = planner.plan(own, seed).status == "solved"
                found.append(Sample(axis, value, name, time.perf_counter() - began, float(solved)))
    return found
