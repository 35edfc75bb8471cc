"""Stage: what policies propose with one curve and no refinement, against random curves and descent
in the same time, and the shortest of their family; goes on where an earlier run of it stopped.
"""

import shutil
import sys

import pandas as pd

from constraint_geodesics.benchmark.queries import KEEP_OUT, TABLE
from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.learning.learned_manifold import chart_named
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.kept import kept_folder, kept_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.studies.proposals import PolicyTask, grouped_figures, policy_rows
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
        kept, about = kept_folder(params, layout, STAGE, *read), run_header(layout.root)
        words = f"policies' proposals {name}"
        found = kept_map(policy_rows, tasks, kept, params.compute, description=words)
        tables = [pd.DataFrame(rows) for rows in found]
        for task, rows in zip(tasks, tables, strict=True):
            file = layout.report(STAGE, f"{task.name}-{task.scene}", "csv.gz")
            write_table(rows.round(6), file, about)
        every = pd.concat(tables, ignore_index=True)
        told = grouped_figures(every, params) | {"machine": about}
        run.report(told, layout.report(STAGE, "policies"))
        shutil.rmtree(kept, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
