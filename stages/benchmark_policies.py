"""Stage: what policies propose, against straight line, descent, random curves and the best of their
family.
"""

import sys

import pandas as pd

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.proposals import (
    PolicyTask,
    policy_figures,
    policy_table,
    run_policies,
)
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_policies"


def main(params: Params, layout: Layout, manifold: str) -> None:
    """Write the rows of each constraint and the figures of all, trained on and not."""
    scene, chart = Scene.from_params(params), LearnedManifold.load(layout.manifold(manifold))
    seen = [params.studies.constraint]
    described = {name: params.constraints[name] for name in seen} | params.unseen
    shared = [layout.policies(manifold)]
    tasks = [
        PolicyTask(
            name,
            scene,
            constraint_manifold(scene.robot, constraint),
            chart,
            params.policy_settings(),
            layout.policies(manifold),
            layout.geodesics(manifold, name) if name in seen else None,
            params.studies.queries,
            params.studies.seed,
        )
        for name, constraint in described.items()
    ]
    with tracked_stage(
        Work(STAGE, manifold, params.policies, shared), params.tracking.experiment, layout.root
    ) as run:
        rows = parallel_map(
            run_policies, tasks, params.compute, description=f"policies' proposals {manifold}"
        )
        table = pd.concat(
            [policy_table(r).assign(constraint=t.name) for t, r in zip(tasks, rows, strict=True)]
        )
        for task, own in zip(tasks, rows, strict=True):
            file = layout.report(STAGE, f"{manifold}-{task.name}", "csv")
            file.parent.mkdir(parents=True, exist_ok=True)
            own.to_csv(file, index=False)
        run.report(policy_figures(table), layout.report(STAGE, manifold))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
