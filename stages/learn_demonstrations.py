"""Stage: what networks, a VAE and policies learn of demonstrations whose formula is hidden; goes on
where an earlier run of it stopped.
"""

import shutil
import sys

import pandas as pd

from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.kept import kept_folder, kept_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies.demonstrations import by_cell, cells_of, summary
from constraint_geodesics.studies.learned_demonstrations import measure, trainings_of
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "learn_demonstrations"


def main(params: Params, layout: Layout) -> None:
    """Write reports/learned_demonstrations.csv.gz and learned_demonstrations.json."""
    own, reports = params.demonstrations, layout.root / "reports"
    work = Work(STAGE, STAGE, own, [layout.planner])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        kept = kept_folder(params, layout, STAGE, layout.planner)
        tasks = trainings_of(cells_of(params, layout), kept / "training")
        found = kept_map(measure, tasks, kept, params.compute, description="learned of rows")
        table = pd.DataFrame([row for rows in found for row in rows])
        about = run_header(layout.root)
        write_table(table.round(8), reports / "learned_demonstrations.csv.gz", about)
        figures = {"cells": summary(table, own.peer_pairs), "machine": about}
        run.cells(by_cell(figures["cells"]))
        run.report(figures, reports / "learned_demonstrations.json")
        shutil.rmtree(kept, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
