"""Stage: every planner on the benchmark's queries; goes on where an earlier run of it stopped."""

import sys

from constraint_geodesics.benchmark.entries import answered, committed_run
from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage


def main(params: Params, layout: Layout) -> None:
    """Write data/benchmark_rows/ as they come, then reports/benchmark.csv, and some recordings."""
    run = committed_run(params, layout, layout.benchmark_rows, layout.benchmark_recordings)
    write_table(answered(run), layout.benchmark_table, run_header(layout.root))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
