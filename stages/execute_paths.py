"""Stage: planned paths of one constraint executed with an open cup of spheres, beside straight
joint lines.
"""

import sys
from functools import partial

from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.cli import run_stage
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.planner import Planner
from constraint_geodesics.recording.execution_recording import ExecutionRecord, record_executions
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings
from constraint_geodesics.studies.execution import (
    execute_queries,
    execution_figures,
    tipping_queries,
)
from constraint_geodesics.tracking.experiment import subject_of, tracked_stage

STAGE = "execute_paths"


def main(params: Params, layout: Layout, constraint: str) -> None:
    """Write reports/execute_paths/<constraint>.csv and .json, and recordings of the first
    queries.
    """
    scene, settings = Scene.from_params(params), params.execution
    manifold, cup = (
        constraint_manifold(scene.robot, params.constraints[constraint]),
        CupSettings(spheres=settings.spheres),
    )
    about = subject_of(params, constraint=constraint)
    with tracked_stage(
        STAGE,
        constraint,
        settings,
        [layout.planner],
        experiment=params.tracking.experiment,
        root=layout.root,
        subject=about,
    ) as run:
        found = tipping_queries(
            scene, manifold, constraint, settings.queries, settings.least_tilt_rad, settings.seed
        )
        with Planner(read_bundle(layout.planner), str(layout.planner)) as planner:
            table, executed = execute_queries(
                partial(planner.plan, constraint=constraint),
                scene,
                manifold,
                constraint,
                found.queries,
                params.planner.acceleration_rad_s2,
                cup,
            )
        records = [
            None
            if one.execution is None or one.query >= settings.recorded
            else ExecutionRecord(one.kind, constraint, one.query, one.execution, cup)
            for one in executed
        ]
        files = record_executions(
            layout.recordings(STAGE, constraint), records, scene.robot, scene.workcell
        )
        file = layout.report(STAGE, constraint, "csv")
        file.parent.mkdir(parents=True, exist_ok=True)
        table.assign(recording=files).to_csv(file, index=False)
        run.report(execution_figures(table, found), layout.report(STAGE, constraint))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
