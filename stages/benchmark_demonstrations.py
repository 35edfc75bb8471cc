"""Stage: constraints from demonstrations whose formula is hidden, held against the formula and
against other methods; goes on where an earlier run of it stopped.
"""

import shutil
import sys
from typing import Any

import pandas as pd

from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.kept import kept_folder, kept_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.report.demonstrations_figure import demonstrations_figure
from constraint_geodesics.studies.demonstrations import (
    by_cell,
    cells_of,
    example,
    free_arms,
    free_motion,
    measure,
    ranks,
    summary,
)
from constraint_geodesics.text_files import written
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_demonstrations"


def main(params: Params, layout: Layout) -> None:
    """Write reports/demonstrations.csv.gz, demonstrations.json and demonstrations.png."""
    own, reports = params.demonstrations, layout.root / "reports"
    work = Work(STAGE, STAGE, own, [layout.planner])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        kept = kept_folder(params, layout, STAGE, layout.planner)
        cells = cells_of(params, layout)
        found = kept_map(measure, cells, kept, params.compute, description="demonstrations")
        table = pd.DataFrame([row for rows in found for row in rows])
        about = run_header(layout.root)
        write_table(table.round(8), reports / "demonstrations.csv.gz", about)
        figures: dict[str, Any] = {
            "cells": summary(table, own.peer_pairs),
            "ranks": ranks(table),
            "free_motion": free_motion(free_arms(), own.seeds),
            "machine": about,
        }
        picture = demonstrations_figure(example(params, layout))
        with written(reports / "demonstrations.png") as part:
            picture.savefig(part, dpi=110)
        run.cells(by_cell(figures["cells"]))
        run.report(figures, reports / "demonstrations.json")
        shutil.rmtree(kept, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
