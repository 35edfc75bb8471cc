"""Stage: every planner on the benchmark's queries; goes on where an earlier run of the same
stopped.
"""

import sys

from constraint_geodesics.benchmark.entries import answered, blocks_of
from constraint_geodesics.benchmark.runner import write_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage


def main(params: Params, layout: Layout) -> None:
    """Write data/benchmark_rows/ as they come, then reports/benchmark.csv, and recordings of some
    paths.
    """
    table = answered(
        blocks_of(params, layout, layout.benchmark_rows, layout.benchmark_recordings),
        params.compute,
    )
    write_table(table, layout.benchmark_table, run_header(layout.root))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
