"""Stage: every planner on the benchmark's queries; goes on where an earlier run of it stopped."""

import json
import sys

from constraint_geodesics.benchmark.entries import answered, committed_run, training_times
from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "run_benchmark"


def main(params: Params, layout: Layout) -> None:
    """Write data/benchmark_rows/ as they come, then reports/benchmark.csv, benchmark_training.json
    and some recordings.
    """
    asked = params.benchmark.model_dump(mode="json", exclude={"planners"})
    read = [layout.planner, layout.learned, layout.submanifolds, layout.path_diffusion]
    read += [layout.manifold(name) for name in params.manifolds]
    read += [layout.benchmark_queries(name) for name in params.all_constraints]
    work = Work(STAGE, STAGE, asked, [path for path in read if path.exists()])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        own = committed_run(params, layout, layout.benchmark_rows, layout.benchmark_recordings)
        table = answered(own)
        write_table(table, layout.benchmark_table, run_header(layout.root))
        trained = json.dumps(training_times(params, layout), indent=1)
        write_text(layout.training_times, trained + "\n")
        counts = table["planner"].nunique(), len(table), table["valid"].sum()
        run.mirror(dict(zip(("planners", "rows", "valid"), counts, strict=True)))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
