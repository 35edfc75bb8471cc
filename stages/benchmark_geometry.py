"""Stage: what the geometry core costs and how exact it is, on one thread."""

import json
import sys
from dataclasses import replace

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.problem import ChartProblem, Samples
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.studies.geodesic_search import geodesic_problem, write_rows
from constraint_geodesics.studies.geometry import GeometryBenchmark, policy_search_figures
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_geometry"


def main(params: Params, layout: Layout, manifold: str, constraint: str) -> None:
    """Write reports/geometry.json and reports/benchmark_geometry/quadrature.csv."""
    sources = [layout.joints("free"), layout.joints(constraint)]
    chart, settings = LearnedManifold.load(layout.manifold(manifold)), params.geodesics
    robot = robot_from(params.robot)
    constrained = constraint_manifold(robot, params.constraints[constraint])
    searched = geodesic_problem(
        params, chart, constrained, read_joints(sources[1]).free_joints, manifold
    )
    retracted = replace(searched, retract=True)
    plain = ChartProblem(
        chart, retracted.curve, Samples(chart.encode(read_joints(sources[0]).free_joints))
    )
    names = [str(name) for name in settings.analytic]
    read = [*sources, layout.manifold(manifold), *(layout.analytic(name) for name in names)]
    with tracked_stage(
        Work(STAGE, manifold, params.geometry, read), params.tracking.experiment, layout.root
    ) as run:
        benchmark = GeometryBenchmark(plain, retracted, settings, params.geometry)
        figures = benchmark.figures(
            {name: MeanPolicy.load(layout.analytic(name), settings.seeds[0]) for name in names}
        )
        trained = {
            name: json.loads(layout.report("train_analytic", name).read_text()) for name in names
        }
        figures["policy_search"] = policy_search_figures(trained)
        write_rows(benchmark.quadrature_rows(), layout.report(STAGE, "quadrature", "csv"))
        run.report(
            {
                "machine": run_header(layout.root),
                "manifold": manifold,
                "constraint": constraint,
                **figures,
            },
            layout.root / "reports/geometry.json",
        )


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
