"""Stage: part of the benchmark once more, held against the first time: lengths, validity, times."""

import shutil
import sys

import pandas as pd

from constraint_geodesics.benchmark.entries import answered, at_most, committed_run, with_planners
from constraint_geodesics.benchmark.row import read_table
from constraint_geodesics.benchmark.statistics import repeated
from constraint_geodesics.params import Params
from constraint_geodesics.peers.registry import all_settings
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.report.benchmark_tables import repeated_cells
from constraint_geodesics.report.cells import markdown_table
from constraint_geodesics.text_files import write_text, written
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "repeat_benchmark"
SEEDS = 2


def main(params: Params, layout: Layout) -> None:
    """Write repeat.csv and repeat.md in reports/benchmark_repeat/: planners whose search no clock
    ends.
    """
    asked = {"repeated": params.benchmark.repeated, "seeds": SEEDS}
    work = Work(STAGE, STAGE, asked, [layout.benchmark_table])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        compared = repeat(params, layout)
        file = layout.root / "reports" / "benchmark_repeat" / "repeat.csv"
        run.mirror(
            {
                "planners": len(compared),
                "same_validity": compared["same_validity"].mean(),
                "length_difference_max": compared["length_difference"].max(),
                "time_ratio_median": compared["ratio"].median(),
            },
            file,
        )


def repeat(params: Params, layout: Layout) -> pd.DataFrame:
    """Both files' rows."""
    folder, scratch = layout.root / "reports" / "benchmark_repeat", layout.scratch(STAGE, "rows")
    shutil.rmtree(scratch, ignore_errors=True)
    planners, settings = params.benchmark.planners, all_settings(params)
    again = {
        name: at_most(entry, params.benchmark.repeated, SEEDS)
        for name, entry in planners.items()
        if settings[name].ends_by_counting
    }
    table = answered(committed_run(with_planners(params, again), layout, scratch, scratch))
    first, _ = read_table(layout.benchmark_table)
    compared = repeated(first, table)
    order = {name: k for k, name in enumerate(again)}
    compared = compared.sort_values("planner", key=lambda names: names.map(order))
    with written(folder / "repeat.csv") as part:
        compared.to_csv(part, index=False, float_format="%.6g")
    write_text(folder / "repeat.md", f"{markdown_table(repeated_cells(compared))}\n")
    return compared


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
