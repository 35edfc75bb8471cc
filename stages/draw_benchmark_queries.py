"""Draw the benchmark's queries of some constraints again: `make draw-queries`.

They are kept in git and every row refers to them, so this is no stage of a pipeline.
"""

import sys

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import judge_limits, problem_of
from constraint_geodesics.benchmark.queries import (
    QueryError,
    draw_benchmark,
    shortest_of,
    write_queries,
)
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.params import Params
from constraint_geodesics.peers.registry import BaselineBuilder
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene

ASKED = sys.argv[1:]
"""Constraints; none: those without queries."""


def main(params: Params, layout: Layout) -> None:
    """Write data/benchmark_queries/<constraint>.csv of the constraints named, by default of those
    that have none.
    """
    known = list(params.all_constraints)
    for name in ASKED:
        if name not in known:
            raise QueryError(f"there is no constraint {name!r}: must be one of {', '.join(known)}")
    wanted = ASKED or [name for name in known if not layout.benchmark_queries(name).is_file()]
    if not wanted:
        sys.exit()  # before the time of this is kept as that of drawing all
    for constraint in wanted:
        draw(params, layout, constraint)


def draw(params: Params, layout: Layout, constraint: str) -> None:
    """Spheres stand on the shortest path that some planners find."""
    settings, scene = params.benchmark, Scene.from_params(params, constraint)
    manifold = constraint_manifold(scene.robot, params.all_constraints[constraint])
    build = BaselineBuilder(params, layout.root)
    with (
        build(settings.placed_by, scene, constraint, manifold) as (planners, _),
        Certifier(scene, judge_limits(params.judge)) as certifier,
    ):
        clearance = clearance_model(scene, certifier.collisions.apart)

        def plan(
            start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
        ) -> Float[np.ndarray, "T D"]:
            problem = problem_of(start, goal, manifold, certifier, clearance)
            return shortest_of(planners, problem, certifier)

        queries = draw_benchmark(scene, manifold, constraint, settings, plan)
    file = layout.benchmark_queries(constraint)
    write_queries(queries, file)
    print(f"{file}: {len(queries)} queries")


if __name__ == "__main__":
    run_stage(main, [])
