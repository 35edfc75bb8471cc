"""Stage: Rerun recordings of the paths and executions that other stages kept; it computes none."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "record_paths"
WHOSE = ("train_geodesics", "benchmark_planners", "execute_paths")


@dataclass(frozen=True)
class Recordable:
    """A stage's table of one constraint; an empty manifold: the paths were sampled."""

    params: Params
    layout: Layout
    constraint: str
    manifold: str = ""


def main(params: Params, layout: Layout) -> None:
    """Write data/recordings/<stage>/ of train_geodesics, benchmark_planners and execute_paths."""
    tables = [Recordable(params, layout, c, manifold) for manifold, c in params.searched_items]
    tables += [Recordable(params, layout, constraint) for constraint in params.constraints]
    own = ("manifolds", "submanifolds", "geodesics", "benchmark", "executions")
    read = [layout.root / "data" / name for name in own]
    work = Work(STAGE, STAGE, {"frames": params.recording.frames}, read)
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        record_executed(params, layout, params.studies.constraint)
        parallel_map(record_table, tables, params.compute, description="record")
        folders = {own: layout.root / "data" / "recordings" / own for own in WHOSE}
        run.mirror({own: len(list(f.rglob("*.rrd"))) for own, f in folders.items()})


def record_table(table: Recordable) -> None:
    """Record the paths that one table names."""
    from constraint_geodesics.constraints.constraint import constraint_manifold
    from constraint_geodesics.learning.learned_manifold import LearnedManifold
    from constraint_geodesics.learning.submanifold import load_submanifold
    from constraint_geodesics.pipeline.paths import read_paths
    from constraint_geodesics.recording.recorder import RowRecorder
    from constraint_geodesics.scene.scene import Scene

    params, layout, constraint = table.params, table.layout, table.constraint
    manifold = table.manifold or params.geodesics.searched[0]
    if table.manifold:
        file = layout.report("train_geodesics", f"{manifold}-{constraint}", "csv")
        folder = layout.geodesics(manifold, constraint)
    else:
        file = layout.report("benchmark_planners", constraint, "csv")
        folder = layout.benchmark(constraint)
    rows, scene = named_rows(file), Scene.from_params(params, constraint)
    recorder = RowRecorder(
        constraint,
        constraint_manifold(scene.robot, params.constraints[constraint]),
        scene,
        LearnedManifold.load(layout.manifold(manifold)),
        load_submanifold(layout.submanifold(manifold, constraint)),
        params.recording.frames,
        params.judge.violation_tolerance,
    )
    recorder.record(rows, read_paths(rows, folder))


def record_executed(params: Params, layout: Layout, constraint: str) -> None:
    """Record what became of executed paths."""
    from constraint_geodesics.constraints.constraint import constraint_from
    from constraint_geodesics.recording.execution_recording import ExecutionRecord, record_execution
    from constraint_geodesics.scene.scene import Scene
    from constraint_geodesics.studies.cup import CupSettings
    from constraint_geodesics.studies.execution import load_execution

    cup, scene = CupSettings(spheres=params.execution.spheres), Scene.from_params(params)
    kept = constraint_from(params.constraints[constraint], scene.robot)
    for row in named_rows(layout.report("execute_paths", constraint, "csv")):
        file = Path(row["recording"])
        execution = load_execution(layout.executions(constraint) / f"{file.stem}.npz")
        record = ExecutionRecord(row["kind"], constraint, row["query"], execution, cup, kept)
        record_execution(file, record, scene.robot, scene.workcell, meshes=False)


def named_rows(file: Path) -> list[dict[str, Any]]:
    """The rows of a table whose paths are to be recorded."""
    table = pd.read_csv(file, dtype={"recording": str})
    rows: Any = table[table["recording"].notna()].to_dict("records")
    return list(rows)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
