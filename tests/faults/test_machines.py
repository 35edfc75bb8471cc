"""Labels, seeds and a benchmark on a real Dask scheduler with workers in processes of their own:
the same seed gives the same results wherever the work runs, and whoever dies in it.
"""

import hashlib
import math
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from constraint_geodesics.benchmark.queries import read_queries
from constraint_geodesics.benchmark.row import table_of
from constraint_geodesics.benchmark.runner import (
    Baseline,
    QueryBatch,
    batch_rows,
    rows_to_do,
    run_batch,
)
from constraint_geodesics.bundle import PACKAGED
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import Shard, ShardTask, draw_shard, shard_tasks
from constraint_geodesics.params import ComputeParams, Params
from constraint_geodesics.peers.registry import BaselineBuilder
from constraint_geodesics.pipeline.compute import ComputeError, as_finished, parallel_map
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.geodesic_search import (
    AnalyticResult,
    AnalyticTask,
    curve_family,
    run_analytic,
)
from tests.faults.effort import Effort, counting
from tests.pipeline.cluster import cluster

pytestmark = [pytest.mark.timeout(900), pytest.mark.long]

ROOT = Path(__file__).resolve().parents[2]
CONSTRAINT = "level_cup"
SHARDS, SEEDS, QUERIES = 12, 4, 6
PLANNERS = ("planner", "straight + band", "BiRRT")
MEASURED = ["time_s", "core_share", "scene_s", "peak_memory_mb"]
"""Columns of the benchmark that tell of the machine."""
ONE = ComputeParams(backend="loky", workers=1)
LOST = "lost the Dask scheduler at tcp://127.0.0.1"


class Quiet:
    """A run that keeps nothing."""

    def log(self, step: int, metrics: dict[str, float]) -> None:
        pass


@dataclass(frozen=True)
class Job:
    """One task of any stage, for lists of several kinds."""

    function: Callable[[Any], Any]
    item: Any

    def __call__(self) -> Any:
        return self.function(self.item)


def do(job: Job) -> Any:
    return job()


def labels(scene: Scene, params: Params, shards: int) -> list[Job]:
    """Small shards of labelled configurations."""
    manifold = constraint_manifold(scene.robot, params.constraints[CONSTRAINT])
    tasks = shard_tasks(ShardTask(scene, manifold, 100 * shards, (1,)), 100)
    return [Job(draw_shard, task) for task in tasks]


def seeds(params: Params, folder: Path, number: int) -> list[Job]:
    """Short trainings by PPO in the plane."""
    small = params.geodesics.model_copy(
        update={
            "steps": 960,
            "environments": 32,
            "checkpoint_steps": 480,
            "ppo": params.geodesics.ppo.model_copy(update={"batch_size": 320}),
        }
    )
    family = curve_family(2, small)
    return [
        Job(
            run_analytic,
            AnalyticTask("plane", family, small, seed, folder / f"{seed}", nullcontext(Quiet())),
        )
        for seed in range(number)
    ]


def batches(scene: Scene, params: Params, folder: Path, number: int) -> list[QueryBatch]:
    """The benchmark's own planners on its own queries, one a batch.  folder: of their rows, and of
    the planner's files, where the pipeline would have them.
    """
    shutil.copytree(PACKAGED, folder / "data" / "planner", dirs_exist_ok=True)
    manifold = constraint_manifold(scene.robot, params.constraints[CONSTRAINT])
    asked = [
        query
        for query in read_queries(ROOT / "data/benchmark_queries" / f"{CONSTRAINT}.csv")
        if query.obstacle is None
    ]
    planners = tuple(Baseline(name=name, seeds=(0,), fingerprint=name) for name in PLANNERS)
    return [
        QueryBatch(
            scene=scene,
            manifold=manifold,
            queries=(query,),
            baselines=planners,
            build=BaselineBuilder(params, folder),
            judge=params.judge,
            file=folder / f"{place}.jsonl",
        )
        for place, query in enumerate(asked[:number])
    ]


def rows(asked: Sequence[QueryBatch]) -> pd.DataFrame:
    """All rows that are there, less what tells of the machine."""
    return table_of([row for batch in asked for row in batch_rows(batch)]).drop(columns=MEASURED)


def digest(result: Any) -> str:
    """Of every bit of a result, times aside."""
    parts: list[bytes] = []
    if isinstance(result, Shard):
        parts = [result.frame.to_csv(index=False, float_format="%.17g").encode()]
    if isinstance(result, AnalyticResult):
        arrays = [result.first_ratio, result.ratio, result.descent_ratio, result.sampled]
        weights = result.policy.actor.state_dict()
        parts = [own.tobytes() for own in (*arrays, result.learned)]
        parts += [weights[name].numpy().tobytes() for name in sorted(weights)]
        timed = ("seconds", "steps_per_s")
        parts += [
            repr([value for name, value in row.items() if name not in timed]).encode()
            for row in result.policy.curve
        ]
    return hashlib.sha256(b"".join(parts)).hexdigest() if parts else repr(result)


@dataclass
class Work:
    """Labels, seeds and a small benchmark.  folder: of checkpoints and rows."""

    scene: Scene
    params: Params
    folder: Path

    @property
    def batches(self) -> list[QueryBatch]:
        return batches(self.scene, self.params, self.folder, QUERIES)

    @property
    def jobs(self) -> list[Job]:
        found = labels(self.scene, self.params, SHARDS)
        found += seeds(self.params, self.folder, SEEDS)
        return found + [Job(run_batch, batch) for batch in self.batches]

    def results(self, compute: ComputeParams) -> "Results":
        found = parallel_map(do, self.jobs, compute)
        return [digest(own) for own in found[:-QUERIES]], rows(self.batches)


Results = tuple[list[str], pd.DataFrame]
"""Digests of labels and seeds, and the benchmark's rows."""


def differing(ours: Results, theirs: Results) -> int:
    """How many results are not the same to the bit; those that only one has differ."""
    pairs = (ours[0], theirs[0]), tuple(own.to_dict("records") for own in (ours[1], theirs[1]))
    return sum(
        repr(own) != repr(other) for two in pairs for own, other in zip_longest(*two)
    )  # by what they say: two numbers that are none are the same


def same(ours: Results, theirs: Results) -> None:
    assert ours[0] == theirs[0]
    pd.testing.assert_frame_equal(ours[1], theirs[1], check_exact=True)


def test_the_same_seed_is_the_same_on_any_number_of_workers_and_on_dask(
    scene: Scene, params: Params, tmp_path: Path, effort: Effort
) -> None:
    with counting("determinism", effort) as row:
        plain = Work(scene, params, tmp_path / "plain").results(ONE)
        assert len(plain[1]) == QUERIES * len(PLANNERS)
        others = list[Results]()
        for workers in (2, 4):
            own = ComputeParams(backend="loky", workers=workers)
            others.append(Work(scene, params, tmp_path / f"loky {workers}").results(own))
        for workers in (1, 2, 4):
            folder = tmp_path / f"dask {workers}"
            folder.mkdir()
            with cluster(folder, workers) as machines:
                others.append(Work(scene, params, folder / "work").results(machines.compute))
        row["results"] = len(plain[0]) + len(plain[1])
        row["ways"] = 1 + len(others)
        row["different"] = sum(differing(own, plain) for own in others)
        for own in others:
            same(own, plain)


def test_work_goes_on_without_a_worker_that_was_killed(
    scene: Scene, params: Params, tmp_path: Path, effort: Effort
) -> None:
    with counting("dask_worker_killed", effort) as row:
        plain = Work(scene, params, tmp_path / "plain").results(ONE)
        with cluster(tmp_path, allowed_failures=3) as machines:
            work = Work(scene, params, tmp_path / "work")
            found = {}
            for place, result in as_finished(do, work.jobs, machines.compute):
                found[place] = result
                if len(found) == 4:
                    machines.workers[0].send_signal(signal.SIGKILL)
        row["tasks"] = len(work.jobs)
        row["lost"] = len(work.jobs) - len(found)
        assert not row["lost"]
        ordered = [digest(found[place]) for place in range(len(found) - QUERIES)]
        row["different"] = differing((ordered, rows(work.batches)), plain)
        same((ordered, rows(work.batches)), plain)


def test_a_scheduler_that_was_killed_is_one_line_and_a_repeated_call_finishes(
    scene: Scene, params: Params, tmp_path: Path, effort: Effort
) -> None:
    with counting("dask_scheduler_killed", effort) as row:
        plain = Work(scene, params, tmp_path / "plain").results(ONE)
        work = Work(scene, params, tmp_path / "work")
        done = list[int]()
        for folder in (tmp_path / "first", tmp_path / "second"):
            folder.mkdir()
        with cluster(tmp_path / "first") as machines:
            began = math.nan
            with pytest.raises(ComputeError, match=LOST) as caught:
                for place, _ in as_finished(do, list(reversed(work.jobs)), machines.compute):
                    done.append(place)
                    if len(done) == 2:
                        machines.scheduler.send_signal(signal.SIGKILL)
                        began = time.monotonic()
            took = time.monotonic() - began
        assert "\n" not in str(caught.value)
        assert took < 30.0
        left = sum(rows_to_do(batch) for batch in work.batches)
        assert left < len(plain[1]), "what was done is not done again"
        with cluster(tmp_path / "second") as machines:
            again = work.results(machines.compute)
        row["tasks"] = len(work.jobs)
        row["lost"] = sum(rows_to_do(batch) for batch in work.batches)
        row["different"] = differing(again, plain)
        assert not row["lost"]
        same(again, plain)
