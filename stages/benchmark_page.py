"""Stage: the benchmark's page that opens offline, from the tables and figures of the stages before
it.
"""

import sys

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.report.benchmark_page import write_benchmark_page
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_page"


def main(params: Params, layout: Layout) -> None:
    """Write reports/benchmark.html."""
    work = Work(STAGE, STAGE, {"drawn": params.benchmark.drawn}, [layout.benchmark_table])
    with tracked_stage(work, params.tracking.experiment, layout.root):
        write_benchmark_page(params, layout)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
