"""What a task, a worker, a run and a stage cost beside the work itself: the figures of
docs/scaling.md.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import cloudpickle
import pytest

from constraint_geodesics.benchmark.queries import read_queries
from constraint_geodesics.params import ComputeParams, Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.tracking.experiment import Work, tracked_stage
from tests.faults.effort import Effort, counting
from tests.faults.test_machines import batches, labels, seeds
from tests.faults.test_servers import dvc
from tests.pipeline.cluster import cluster
from tests.planner_fixtures import packaged_planner
from tests.tracking.test_experiment import git

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]

ROOT = Path(__file__).resolve().parents[2]
TWO = ComputeParams(backend="loky", workers=2)
TASKS, RUNS, REPORTS, STAGES, OF_EACH = 1000, 20, 100, 10, 20
FIRST_PLAN = """
import sys
from constraint_geodesics import Planner
Planner.load(sys.argv[1]).prepare("level_cup")
"""


def took(work: Callable[[], object]) -> float:
    """Seconds of the second call: the first one starts and loads what is kept."""
    work()
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def sent(items: list[object]) -> float:
    """kB of the largest."""
    return round(max(len(cloudpickle.dumps(own)) for own in items) / 1e3, 1)


def test_what_is_paid_beside_the_work(
    scene: Scene, params: Params, tmp_path: Path, effort: Effort, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with counting("scaling", effort) as row:
        row |= {
            **_tasks(tmp_path),
            "worker_start_s": round(took(_first_plan), 2),
            "sent_shard_kb": sent(list(labels(scene, params, 2))),
            "sent_seed_kb": sent(list(seeds(params, tmp_path, 2))),
            "sent_query_batch_kb": sent(list(batches(scene, params, tmp_path, 2))),
            **_runs(tmp_path),
            "dvc_stage_s": _stages(tmp_path),
            **_queries(),
        }
        assert max(row["loky_task_ms"], row["dask_task_ms"]) < 100.0, "a batch takes a second"
        assert row["sent_query_batch_kb"] < 10_000.0
        assert row["dvc_stage_s"] < 5.0


def _tasks(folder: Path) -> dict[str, float]:
    items = list(range(TASKS))
    loky = took(lambda: parallel_map(abs, items, TWO))
    (folder / "dask").mkdir()
    with cluster(folder / "dask") as machines:
        dask = took(lambda: parallel_map(abs, items, machines.compute))
    return {
        "loky_task_ms": round(1e3 * loky / TASKS, 2),
        "dask_task_ms": round(1e3 * dask / TASKS, 2),
    }


def _first_plan() -> None:
    source = ROOT / "src/constraint_geodesics/pretrained"
    subprocess.run([sys.executable, "-c", FIRST_PLAN, str(source)], check=True)


def _runs(folder: Path) -> dict[str, float]:
    """In the checkout's own SQLite store."""
    with tracked_stage(Work("train", "cup"), "costs", folder) as stage:
        with stage.child("first", {}) as run:
            run.log(0, {"loss": 1.0})
        began = time.perf_counter()
        for number in range(RUNS):
            with stage.child(f"seed {number}", {"seed": number}):
                pass
        run_ms = 1e3 * (time.perf_counter() - began) / RUNS
        with stage.child("reports", {}) as run:
            began = time.perf_counter()
            for step in range(REPORTS):
                run.log(step, {"loss": 1.0, "return": 2.0})
            report_ms = 1e3 * (time.perf_counter() - began) / REPORTS
    return {"mlflow_run_ms": round(run_ms, 1), "mlflow_report_ms": round(report_ms, 1)}


def _stages(folder: Path) -> float:
    """Seconds that DVC adds to a stage of many."""
    seconds = []
    for number in (1, 1 + STAGES):
        own = folder / f"{number} stages"
        own.mkdir()
        git(own, "init", "--quiet")
        dvc(own, "init", "--quiet")
        lines = [
            f"  stage{k}:\n    cmd: echo {k} > out{k}\n    outs: [out{k}]\n" for k in range(number)
        ]
        (own / "dvc.yaml").write_text("stages:\n" + "".join(lines))
        began = time.perf_counter()
        dvc(own, "repro", "--quiet")
        seconds.append(time.perf_counter() - began)
    return round((seconds[1] - seconds[0]) / STAGES, 3)


def _queries() -> dict[str, float]:
    """Means over the benchmark's queries without an obstacle, of all the planner's constraints."""
    planner, found = packaged_planner(), list[tuple[bool, float]]()
    for name in planner.constraints:
        planner.prepare(name)
        for query in read_queries(ROOT / "data/benchmark_queries" / f"{name}.csv"):
            if query.obstacle is None and query.number < OF_EACH:
                began = time.perf_counter()
                path = planner.plan(query.start, query.goal, name)
                found.append((path.status == "solved", 1e3 * (time.perf_counter() - began)))
    solved = [own for good, own in found if good]
    return {
        "query_ms": round(fmean(own for _, own in found), 2),
        "query_solved_ms": round(fmean(solved), 2),
        "query_unsolved_ms": round(fmean(own for good, own in found if not good), 2),
        "query_solved_share": round(len(solved) / len(found), 3),
    }
