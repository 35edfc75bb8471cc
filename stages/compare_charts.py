"""Stage: a policy's search in learned charts of 2 to 8 dimensions and in joint space, and the
variance term where the data has a hole; five seeds each, half an hour on two cores.
"""

import shutil
import sys

from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies.charts import measure, summary, table_of, tasks_of
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "compare_charts"


def main(params: Params, layout: Layout) -> None:
    """Write reports/compare_charts.csv.gz and compare_charts.json."""
    own, reports = params.compare_charts, layout.root / "reports"
    sources = [layout.joints("free"), layout.joints(own.constraint)]
    with tracked_stage(
        Work(STAGE, STAGE, own, sources), params.tracking.experiment, layout.root
    ) as run:
        tasks = tasks_of(params, layout)
        found = parallel_map(measure, tasks, params.compute, description="charts")
        table = table_of([row for rows in found for row in rows])
        about = run_header(layout.root)
        write_table(table.round(8), reports / f"{STAGE}.csv.gz", about)
        run.report({**summary(table), "machine": about}, reports / f"{STAGE}.json")
        for task in tasks:  # finished: the next run of this stage starts from nothing
            shutil.rmtree(task.scratch, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
