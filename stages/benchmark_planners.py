"""Stage: some planners of the benchmark on the pipeline's queries of one constraint (Table I)."""

import shutil
import sys
from pathlib import Path
from typing import Any

import pandas as pd

from constraint_geodesics.benchmark.entries import Run, answered, with_planners
from constraint_geodesics.benchmark.queries import TABLE, Query
from constraint_geodesics.benchmark.recorder import PathKeeper
from constraint_geodesics.benchmark.statistics import comparison_figures
from constraint_geodesics.learning.dataset import read_queries
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.paths import named_recordings, save_paths
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.text_files import written
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "benchmark_planners"


def asked_of(file: Path, constraint: str) -> list[Query]:
    """The pipeline's queries as the benchmark asks them."""
    pairs = read_queries(file)
    ends = enumerate(zip(pairs.starts, pairs.goals, strict=True))
    return [Query(constraint, TABLE, number, start, goal) for number, (start, goal) in ends]


def main(params: Params, layout: Layout, constraint: str) -> None:
    """Write data/benchmark/<constraint>/, its rows and figures."""
    source, compared = layout.queries(constraint), params.benchmark.compared
    queries, scratch = asked_of(source, constraint), layout.scratch(STAGE, constraint)
    asked = {"queries": len(queries), "seeds": compared.seeds}
    entries = {
        name: params.benchmark.planners[name].model_copy(update=asked) for name in compared.planners
    }
    dof = len(queries[0].start)
    every = params.benchmark.model_copy(update={"queries": len(queries)})
    own = with_planners(params.model_copy(update={"benchmark": every}), entries)
    kept = PathKeeper(scratch / "paths")
    whole = Run(own, layout, queries, scratch, list(params.manifolds), kept)
    read = [source, *(layout.manifold(name) for name in whole.measured_on)]
    about = subject_of(params, constraint=constraint)
    with tracked_stage(
        Work(STAGE, constraint, compared, read, about), params.tracking.experiment, layout.root
    ) as run:
        table = answered(whole)
        rows: list[Any] = table.to_dict("records")
        paths = [kept.path(row, dof) for row in rows]
        # one planner of each kind stands next to the learned geodesics: its kind is its name there
        rows = [row | {"planner": row["kind"]} for row in rows]
        save_paths(rows, paths, layout.benchmark(constraint))
        folder = layout.recordings(STAGE, constraint)
        rows = named_recordings(rows, paths, folder, params.recording.queries)
        run.recordings(rows)
        file = layout.report(STAGE, constraint, "csv")
        table = pd.DataFrame(rows)
        with written(file) as part:
            table.to_csv(part, index=False)
        run.report(comparison_figures(table), layout.report(STAGE, constraint))
    shutil.rmtree(scratch, ignore_errors=True)  # asked again, it measures again


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
