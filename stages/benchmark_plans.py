"""Stage: the planner, its parts and its peers on queries that no training saw, unseen constraints
among them.
"""

import sys

import pandas as pd

from constraint_geodesics.benchmark.plan_benchmark import (
    batch_rate,
    figures_of,
    plan_rows,
    plan_table,
    save_arrays,
)
from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.constraints.constraint import ConstraintManifold, constraint_from
from constraint_geodesics.learning.dataset import draw_queries, write_queries
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.planner import Planner
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_plans"


def main(params: Params, layout: Layout) -> None:
    """Write data/plans/ (queries and valid paths), the rows of each constraint and the figures of
    all.
    """
    settings, tables, batches = params.plans, [], {}
    layout.report(STAGE, "plans").parent.mkdir(parents=True, exist_ok=True)
    names = [settings.constraint, *settings.unseen]
    described = {**params.constraints, **settings.unseen}
    with (
        tracked_stage(
            Work(STAGE, settings.constraint, settings, []), params.tracking.experiment, layout.root
        ) as run,
        Planner(read_bundle(layout.planner), "the pipeline's outputs") as planner,
    ):
        for name in names:
            constraint = constraint_from(described[name], planner.scene.robot)
            manifold = ConstraintManifold(planner.scene.robot, constraint)
            queries = draw_queries(planner.scene, manifold, name, settings.queries, settings.seed)
            write_queries(queries, layout.plans / f"{name}.csv")
            planner.prepare(constraint)
            rows, paths = plan_rows(
                planner,
                planner.scene,
                name,
                constraint,
                queries,
                settings,
                planner.band,
                params.benchmark,
                params.judge,
            )
            batches[name] = batch_rate(planner, constraint, queries, settings.batch)
            save_arrays(layout.plans / f"{name}.npz", paths)
            rows.to_csv(layout.report(STAGE, name, "csv"), index=False)
            tables.append(plan_table(rows))
        table = pd.concat(tables, ignore_index=True)
        measured = {"machine": machine(), "plans": figures_of(table), "batch": batches}
        run.report(measured, layout.report(STAGE, "plans"))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
