"""Stage: the benchmark's queries of one constraint, half of them with a sphere on the way."""

import sys

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import judge_limits
from constraint_geodesics.benchmark.queries import draw_cases
from constraint_geodesics.benchmark.runner import write_cases
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.params import Params
from constraint_geodesics.peers.registry import PeerBuilder
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.problem import PlanningProblem
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene


def main(params: Params, layout: Layout, constraint: str) -> None:
    """Write data/benchmark_queries/<constraint>.csv: spheres stand on the shortest path of several
    planners.
    """
    settings, scene = params.bench, Scene.from_params(params)
    manifold = constraint_manifold(scene.robot, params.constraints[constraint])
    with (
        PeerBuilder(params, layout.root)(settings.placed_by, scene, constraint, manifold) as (
            planners,
            _,
        ),
        Certifier(scene, judge_limits(params.judge)) as certifier,
        scene.world() as world,
    ):
        clearance = clearance_model(scene.robot, scene.workcell)

        def plan(
            start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"]
        ) -> Float[np.ndarray, "T D"]:
            problem = PlanningProblem(start, goal, manifold, world.is_free, clearance)
            shortest, length = np.empty((0, len(start))), np.inf
            for planner in planners.values():
                joints = planner.plan(problem, 0).joints
                if len(joints) < 2:
                    continue
                certificate = certifier.certify(joints, manifold.constraint, start, goal)
                if certificate.valid and certificate.length_rad < length:
                    shortest, length = joints, certificate.length_rad
            return shortest

        cases = draw_cases(
            scene, manifold, constraint, settings.queries, settings.radius_m, plan, settings.seed
        )
    write_cases(cases, layout.benchmark_queries(constraint))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
