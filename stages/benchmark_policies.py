"""Stage: what policies propose with one curve and no refinement, against random curves and descent
in the same time, and the shortest of their family.
"""

import sys

import pandas as pd

from constraint_geodesics.benchmark.queries import KEEP_OUT, TABLE
from constraint_geodesics.learning.learned_manifold import chart_named
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.studies.proposals import PolicyTask, grouped_figures, run_policies
from constraint_geodesics.text_files import written
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_policies"


def main(params: Params, layout: Layout) -> None:
    """Write the rows of each constraint and the figures of each and of all, trained on and not."""
    name, folder = params.policies.chart, layout.policies(params.policies.chart)
    chart = chart_named(name, layout.manifold(name), robot_from(params.robot))
    tasks = [
        PolicyTask(constraint, scene, params, layout.root, chart, folder)
        for scene in (KEEP_OUT, TABLE)
        for constraint in params.all_constraints
    ]
    read = [folder, layout.planner, layout.path_diffusion, layout.root / "data" / "manifolds"]
    with tracked_stage(
        Work(STAGE, name, params.policies, read), params.tracking.experiment, layout.root
    ) as run:
        tables = parallel_map(
            run_policies, tasks, params.compute, description=f"policies' proposals {name}"
        )
        for task, rows in zip(tasks, tables, strict=True):
            file = layout.report(STAGE, f"{task.name}-{task.scene}", "csv.gz")
            with written(file) as part:
                rows.round(6).to_csv(part, index=False, compression={"method": "gzip", "mtime": 0})
        every = pd.concat(tables, ignore_index=True)
        told = grouped_figures(every, params) | {"machine": run_header(layout.root)}
        run.report(told, layout.report(STAGE, "policies"))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
