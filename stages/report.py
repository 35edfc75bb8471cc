"""Stage: the result table, the figures, and the page that opens offline."""

import sys
from typing import Any

import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.report.pipeline_page import write_report
from constraint_geodesics.tracking.comparison import REPORT, cells_of
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "report"


def main(params: Params, layout: Layout) -> None:
    """Write reports/table.csv, *.md that docs quote, figures/ and index.html."""
    sources = [
        layout.report("benchmark_planners", constraint, "csv") for constraint in params.constraints
    ]
    with tracked_stage(
        Work(STAGE, STAGE, {}, sources), params.tracking.experiment, layout.root
    ) as run:
        for figure in write_report(params, layout):
            run.figure(figure)
        table = pd.read_csv(layout.root / "reports" / "table.csv")
        shown = table[table["manifold"] == params.geodesics.searched[0]]
        rows: Any = shown.to_dict("records")
        run.cells(cells_of(rows, ("constraint", "planner"), REPORT))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
