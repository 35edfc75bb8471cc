"""Stage: the sampling-based planners on the queries of one constraint."""

import sys

from constraint_geodesics.benchmark.planner_benchmark import (
    PlannerTask,
    planner_figures,
    run_planner,
)
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import read_queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.paths import named_recordings, save_paths
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.geodesic_search import write_table
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "benchmark_planners"


def main(params: Params, layout: Layout, constraint: str) -> None:
    """Write data/benchmark/<constraint>/, its rows and figures."""
    source, settings = layout.queries(constraint), params.benchmark
    scene = Scene.from_params(params)
    manifold = constraint_manifold(scene.robot, params.constraints[constraint])
    charts = {name: LearnedManifold.load(layout.manifold(name)) for name in params.manifolds}
    queries = read_queries(source)
    about = subject_of(params, constraint=constraint)
    with tracked_stage(
        Work(STAGE, constraint, settings, [source], about), params.tracking.experiment, layout.root
    ) as run:
        tasks = [
            PlannerTask(planner, seed, scene, manifold, charts, queries, settings, params.judge)
            for planner in settings.planners
            for seed in settings.seeds
        ]
        results = parallel_map(
            run_planner, tasks, params.compute, description=f"planners {constraint}"
        )
        rows = [row for result in results for row in result.rows]
        paths = [path for result in results for path in result.paths]
        save_paths(rows, paths, layout.benchmark(constraint))
        folder = layout.recordings(STAGE, constraint)
        rows = named_recordings(rows, paths, folder, params.recording.queries)
        run.recordings(rows)
        write_table(rows, layout.report(STAGE, constraint, "csv"), constraint=constraint)
        run.report(planner_figures(results), layout.report(STAGE, constraint))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
