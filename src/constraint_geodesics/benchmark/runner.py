"""Every planner on the same queries: one row a planner, query and seed, judged by the certifier and
kept as it comes.

Rows are appended to one file for each batch of queries, and each carries a fingerprint of all it
depends on: a benchmark that was killed goes on where it stopped, and after a change only the rows
it touches are run again.  All planners answer a query one after another, in one process on one
thread, so that a slow spell of the machine hits them alike; but for rows that may have ended the
processes before, which have one of their own.
"""

import ctypes
import hashlib
import json
import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import (
    PathMeasures,
    judge_limits,
    measure_path,
    problem_of,
)
from constraint_geodesics.benchmark.queries import Query
from constraint_geodesics.benchmark.row import KEY, key_of, read_rows, row_line
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.params import ComputeParams, JudgeParams
from constraint_geodesics.pipeline.compute import end_after, parallel_map
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene

if TYPE_CHECKING:
    from constraint_geodesics.learning.learned_manifold import LearnedManifold

_INTERRUPTED = json.dumps({"interrupted": True})
_WARM = set[tuple[str, str, str]]()
"""Planners, scenes and constraints that this process has asked before."""


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """A planner of the benchmark as it is asked.

    settings: a digest of them.  fingerprint: of all that its rows depend on.  queries: how many of
    a batch's it answers, the first ones; by default all.  after: name of the planner whose
    remembered path it shortens, if so: the memory is that of both.  uses_clearance: whether it
    needs the model of distances, whose making then counts as its preparation for the scene.
    """

    name: str
    seeds: tuple[int, ...]
    fingerprint: str
    kind: str = ""
    settings: str = ""
    queries: int | None = None
    after: str = ""
    uses_clearance: bool = True


Builder = Callable[
    [Sequence[str], Scene, str, ConstraintManifold],
    AbstractContextManager[tuple[Mapping[str, PathPlanner], Mapping[str, float]]],
]
"""Makes planners by name for a scene and a constraint's name and manifold, closed again when the
context ends; with the seconds that making each took.  Picklable.
"""


@dataclass(frozen=True)
class Answer:
    """A path that a planner found for a query, and what it is worth."""

    query: Query
    planner: str
    seed: int
    joints: Float[np.ndarray, "T D"]
    measures: PathMeasures
    scene: Scene
    manifold: ConstraintManifold


Recorder = Callable[[Answer], str]
"""Keeps some of the paths; the recording's file, or "" where there is none.  Picklable."""


Look = Callable[[Answer], Mapping[str, Any]]
"""Says more of an answer, with a path or without one, as columns of its row."""
Watch = Callable[[Query, Scene], AbstractContextManager[Look]]
"""Looks at all answers to a query, in whatever it opens for that.  Picklable."""


@dataclass(frozen=True, kw_only=True)
class QueryBatch:
    """Some queries of one constraint and scene, with the planners that answer them; picklable.

    file: where the rows are kept, one JSON record a line.  record: called with every path that
    there is.  learned: manifolds on which the paths' lengths are measured as well.  watch: what
    more is said of answers.
    """

    scene: Scene
    manifold: ConstraintManifold
    queries: tuple[Query, ...]
    baselines: tuple[Baseline, ...]
    build: Builder
    judge: JudgeParams
    file: Path
    learned: Mapping[str, "LearnedManifold"] = field(default_factory=dict)
    record: Recorder | None = None
    watch: Watch | None = None

    @property
    def fingerprints(self) -> dict[str, str]:
        """Each planner's."""
        return {baseline.name: baseline.fingerprint for baseline in self.baselines}


@dataclass(frozen=True)
class _Job:
    """One row that is to be made."""

    query: Query
    baseline: Baseline
    seed: int

    @property
    def key(self) -> dict[str, Any]:
        """The row's key."""
        query, name = self.query, self.baseline.name
        values = (name, query.constraint, query.scene, query.number, self.seed)
        return dict(zip(KEY, values, strict=True))


def make_rows(batches: Sequence[QueryBatch], compute: ComputeParams, description: str) -> None:
    """Make the rows that are not there yet, several batches side by side.  description: names the
    work where its progress is shown.

    An interrupt is noted, so that the rows that were begun are not taken for such as end their
    process.
    """
    left = [batch for batch in batches if rows_to_do(batch)]
    try:
        parallel_map(run_batch, left, compute, description=description)
    except KeyboardInterrupt:
        for batch in left:
            if batch.file.is_file():
                _append(batch.file, f"\n{_INTERRUPTED}")
        raise


def run_batch(batch: QueryBatch) -> int:
    """Answer what of the batch is not answered yet; returns the number of rows that it added."""
    jobs, added = _open_jobs(batch), 0
    batch.file.parent.mkdir(parents=True, exist_ok=True)
    if batch.file.is_file() and not batch.file.read_bytes().endswith(b"\n"):
        _append(batch.file, "")  # it was killed while a line was written
    for query in batch.queries:
        own = [job for job in jobs if job.query is query]
        for row in _answered(batch, query, own) if own else ():
            _append(batch.file, row_line(row))
            added += 1
    return added


def rows_to_do(batch: QueryBatch) -> int:
    """How many rows `run_batch` would add."""
    return len(_open_jobs(batch))


def batch_rows(batch: QueryBatch) -> list[dict[str, Any]]:
    """The batch's rows that are there: of its own queries, planners and seeds, one each."""
    asked = {key_of(job.key) for job in _jobs(batch)}
    rows = read_rows(batch.file, batch.fingerprints)
    return [row for row in rows if key_of(row) in asked]


def fingerprint(*parts: Any) -> str:
    """A short hash of what a row depends on: anything that JSON takes, and bytes."""
    text = json.dumps(
        parts, sort_keys=True, default=lambda value: hashlib.sha256(bytes(value)).hexdigest()
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _jobs(batch: QueryBatch) -> Iterator[_Job]:
    for position, query in enumerate(batch.queries):
        for baseline in batch.baselines:
            if baseline.queries is None or position < baseline.queries:
                yield from (_Job(query, baseline, seed) for seed in baseline.seeds)


def _open_jobs(batch: QueryBatch) -> list[_Job]:
    """The rows that are not there."""
    done = {key_of(row) for row in read_rows(batch.file, batch.fingerprints)}
    return [job for job in _jobs(batch) if key_of(job.key) not in done]


def _append(file: Path, line: str) -> None:
    with file.open("a") as lines:
        lines.write(line + "\n")


@dataclass(frozen=True)
class _Opened:
    """A query with what answers and judges it, and the seconds that making each part took.  All
    baselines ask the certifier's compiled check, of configurations, lines and whole paths.
    """

    scene: Scene
    certifier: Certifier
    planners: Mapping[str, PathPlanner]
    made_s: Mapping[str, float]
    problem: PlanningProblem
    clearance_s: float


@contextmanager
def _opened(batch: QueryBatch, query: Query, names: Sequence[str]) -> Iterator[_Opened]:
    scene, manifold = query.in_scene(batch.scene), batch.manifold
    with (
        # first the planners, by a clock of their own: what the judge makes of a scene is kept
        batch.build(names, scene, query.constraint, manifold) as (planners, made_s),
        Certifier(scene, judge_limits(batch.judge)) as certifier,
    ):
        began = time.perf_counter()
        clearance = clearance_model(scene, certifier.collisions.apart)
        clearance_s = time.perf_counter() - began
        problem = problem_of(query.start, query.goal, manifold, certifier, clearance)
        yield _Opened(scene, certifier, planners, made_s, problem, clearance_s)


def _answered(batch: QueryBatch, query: Query, jobs: Sequence[_Job]) -> Iterator[dict[str, Any]]:
    """Rows of one query."""
    names = list(dict.fromkeys(job.baseline.name for job in jobs))
    with _opened(batch, query, names) as opened, _watched(batch, query, opened.scene) as look:
        scene, manifold, certifier = opened.scene, batch.manifold, opened.certifier
        grown_by: dict[tuple[str, int], float] = {}
        for job in jobs:
            baseline = job.baseline
            found, grown, share = _asked(batch, job, opened)
            grown = max(grown, grown_by.get((baseline.after, job.seed), 0.0))
            grown_by[baseline.name, job.seed] = grown
            measures = measure_path(
                found.joints,
                query.start,
                query.goal,
                manifold,
                batch.learned,
                certifier,
                batch.judge.spacing_rad,
            )
            answer = Answer(query, baseline.name, job.seed, found.joints, measures, scene, manifold)
            recording = ""
            if batch.record is not None and len(found.joints) > 1:
                recording = batch.record(answer)
            prepared_s = opened.clearance_s if baseline.uses_clearance else 0.0
            more = {
                "peak_memory_mb": grown,
                "scene_s": opened.made_s.get(baseline.name, 0.0) + prepared_s,
                "recording": recording,
                "core_share": share,
                **look(answer),
            }
            yield _row(job, found, measures, more)


@contextmanager
def _core_share() -> Iterator[list[float]]:
    """The share of a core that this process has within: on a busy machine times are longer by as
    much.
    """
    found, began, used = [math.nan], time.perf_counter(), time.process_time()
    yield found
    found[0] = (time.process_time() - used) / (time.perf_counter() - began)


def _watched(batch: QueryBatch, query: Query, scene: Scene) -> AbstractContextManager[Look]:
    return nullcontext(_nothing_more) if batch.watch is None else batch.watch(query, scene)


def _nothing_more(_answer: Answer) -> Mapping[str, Any]:
    return {}


_Asked = tuple[Solution, float, float]
"""A planner's answer, the memory it took [MB] and the share of a core that it had."""


def _asked(batch: QueryBatch, job: _Job, opened: _Opened) -> _Asked:
    """A row that was begun twice without an end is answered by a process of its own: it may have
    ended the ones before, or went down with them.
    """
    if _started(batch, job) > 1:
        return _asked_alone(batch, job)
    return _timed(job, opened)


def _asked_alone(batch: QueryBatch, job: _Job) -> _Asked:
    if multiprocessing.current_process().daemon:  # may start none: a worker of Dask's nanny
        return _failed(len(job.query.start), "processes died in it"), math.nan, math.nan
    spawning = multiprocessing.get_context("spawn")
    answers, answering = spawning.Pipe(duplex=False)
    own = spawning.Process(target=_answer_alone, args=(batch, job, answering, os.getpid()))
    own.start()
    answering.close()  # so that its end is seen
    try:
        found: _Asked = answers.recv()
        return found
    except EOFError:
        return _failed(len(job.query.start), "its process died in it"), math.nan, math.nan
    finally:
        own.kill()
        own.join()


def _answer_alone(batch: QueryBatch, job: _Job, answering: Connection, parent: int) -> None:
    """An interrupt is its parent's to take, with which it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_after(parent)
    with _opened(batch, job.query, [job.baseline.name]) as opened:
        answering.send(_timed(job, opened))


def _timed(job: _Job, opened: _Opened) -> _Asked:
    """One that is new to this process answers once before it is timed: that loads its code."""
    planner, problem = opened.planners[job.baseline.name], opened.problem
    warm = (job.baseline.name, job.query.scene, job.query.constraint)
    if warm not in _WARM:
        _planned(planner, replace(problem), job.seed)  # another object: not to be remembered
        _WARM.add(warm)
    with _core_share() as share:
        found, grown = _measured_memory(lambda: _planned(planner, problem, job.seed))
    return found, grown, share[0]


def _started(batch: QueryBatch, job: _Job) -> int:
    """Note that a row is begun; how often it was before, without an end, since an interrupt."""
    mark = json.dumps({"started": job.key, "fingerprint": job.baseline.fingerprint})
    text = batch.file.read_text() if batch.file.is_file() else ""
    _append(batch.file, mark)
    return text.rpartition(_INTERRUPTED)[2].splitlines().count(mark)


def _planned(planner: PathPlanner, problem: PlanningProblem, seed: int) -> Solution:
    """The planner's answer; one that raises has failed on this query, which is a row as well."""
    began = time.perf_counter()
    try:
        return planner.plan(problem, seed)
    except Exception as error:  # a baseline's library may raise anything
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return _failed(problem.manifold.robot.dof, text, time.perf_counter() - began)


def _failed(dof: int, why: str, spent_s: float = 0.0) -> Solution:
    return Solution("not_found", np.empty((0, dof)), spent_s, 0, why)


def _row(
    job: _Job, found: Solution, measures: PathMeasures, more: Mapping[str, Any]
) -> dict[str, Any]:
    baseline = job.baseline
    row = {
        **job.key,
        "kind": baseline.kind,
        "settings": baseline.settings,
        "status": found.status,
        **measures.row(),
        "time_s": found.time_s,
        "iterations": found.iterations,
        **more,
        "reason": found.explanation or measures.reason,
        "fingerprint": baseline.fingerprint,
    }
    return {
        name: None if isinstance(value, float) and not np.isfinite(value) else value
        for name, value in row.items()
    }


def _measured_memory(work: Callable[[], Solution]) -> tuple[Solution, float]:
    """What the work returns, and by how much the process's memory grew at its peak [MB]; nan but on
    Linux.

    What earlier work has freed is given back to the system before, so that taking it again counts.
    """
    reset, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    try:
        ctypes.CDLL(None).malloc_trim(0)
        reset.write_text("5")  # resets the peak
        before = _kilobytes(status, "VmRSS")
    except (OSError, AttributeError):
        return work(), math.nan
    found = work()
    return found, max(_kilobytes(status, "VmHWM") - before, 0.0) / 1024.0


def _kilobytes(status: Path, name: str) -> float:
    line = next(line for line in status.read_text().splitlines() if line.startswith(f"{name}:"))
    return float(line.split()[1])
