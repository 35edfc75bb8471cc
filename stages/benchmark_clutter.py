"""Stage: the planner and its baselines among random shapes of every kind and thin plates, under
four constraints; goes on where an earlier run of it stopped.
"""

import sys

from constraint_geodesics.benchmark.arm_source import PipelineArm
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.code import code_digest, data_digest
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.report.problems_page import report_answers
from constraint_geodesics.studies.clutter import cluttered
from constraint_geodesics.studies.problem_runs import MEASURED_BY, Asked
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_clutter"


def main(params: Params, layout: Layout) -> None:
    """Write data/clutter_rows/ as answers come, then reports/clutter.csv.gz, .json and .md."""
    own, rows = params.clutter, layout.clutter_rows
    drawn = list(
        cluttered(
            PipelineArm(layout.planner),
            own.constraints,
            own.scenes,
            own.queries,
            own.seed,
            layout.scratch(STAGE, "shapes"),
        )
    )
    code = f"{code_digest(*MEASURED_BY)} {data_digest(layout.planner)}"
    of = Asked(params, params.problems.planners, own.limit_s, {}, rows, code)
    about = [
        f"the arm of params.yaml in its workcell among random shapes, {own.scenes} scenes of each "
        f"kind, {own.queries} queries of each kind and constraint; {own.limit_s:g} s for a query"
    ]
    title = "Queries among clutter"
    work = Work(STAGE, STAGE, own, [layout.planner])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        report_answers(run, layout, "clutter", title, about, drawn, of)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
