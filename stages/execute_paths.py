"""Stage: planned paths of one constraint executed with an open cup of spheres, beside straight
joint lines.
"""

import sys
from functools import partial

from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings, execution_name
from constraint_geodesics.studies.execution import (
    Carrying,
    execute_queries,
    execution_figures,
    save_execution,
    tipping_queries,
)
from constraint_geodesics.text_files import written
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "execute_paths"


def main(params: Params, layout: Layout, constraint: str) -> None:
    """Write reports/execute_paths/<constraint>.csv and .json, and the executions to
    record.
    """
    scene, settings = Scene.from_params(params, constraint), params.execution
    manifold, cup = (
        constraint_manifold(scene.robot, params.constraints[constraint]),
        CupSettings(spheres=settings.spheres),
    )
    about = subject_of(params, constraint=constraint)
    with tracked_stage(
        Work(STAGE, constraint, settings, [layout.planner], about),
        params.tracking.experiment,
        layout.root,
    ) as run:
        found = tipping_queries(scene, manifold, constraint, settings)
        carrying = Carrying(constraint, scene, manifold, params.planner.acceleration_rad_s2, cup)
        with Planner(read_bundle(layout.planner), str(layout.planner)) as planner:
            planner.scene.become(scene)
            plan = partial(planner.plan, constraint=constraint)
            table, executed = execute_queries(plan, carrying, found.queries)
        files = []
        for one in executed:
            name = execution_name(one.query, one.kind)
            recorded = one.execution is not None and one.query < settings.recorded
            if one.execution is not None and recorded:
                save_execution(layout.executions(constraint) / f"{name}.npz", one.execution)
            file = layout.recordings(STAGE, constraint) / f"{name}.rrd"
            files.append(file.as_posix() if recorded else "")
        file = layout.report(STAGE, constraint, "csv")
        with written(file) as part:
            table.assign(recording=files).to_csv(part, index=False)
        run.report(execution_figures(table, found), layout.report(STAGE, constraint))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
