"""Stage: the VAE, a GPLVM, a GAN and uniform joints on the same configurations, five seeds each; a
third of an hour on two cores; goes on where an earlier run of it stopped.
"""

import shutil
import sys

from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.kept import kept_folder, kept_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies.manifolds import measure, summary, table_of, tasks_of
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "compare_manifolds"


def main(params: Params, layout: Layout) -> None:
    """Write reports/compare_manifolds.csv and compare_manifolds.json."""
    source, reports = layout.joints("free"), layout.root / "reports"
    with tracked_stage(
        Work(STAGE, STAGE, params.compare_manifolds, [source]),
        params.tracking.experiment,
        layout.root,
    ) as run:
        joints = read_joints(source).free_joints
        tasks = tasks_of(params, joints, layout.scratch(STAGE, "vae"))
        kept = kept_folder(params, layout, STAGE, source.parent)
        found = kept_map(measure, tasks, kept, params.compute, description="learners")
        table = table_of([row for rows in found for row in rows])
        about = run_header(layout.root)
        write_table(table, reports / f"{STAGE}.csv", about)
        counts = {"rows": len(tasks[0].rows), "held_out": len(tasks[0].held_out)}
        figures = {**summary(table), **counts, "machine": about}
        run.report(figures, reports / f"{STAGE}.json")
        shutil.rmtree(kept, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
