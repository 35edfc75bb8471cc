"""Stage: one policy a seed for all constraints together, conditioned on the constraint."""

import shutil
import sys

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.policy_search import save_policy
from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.geodesic_search import (
    TrainingTask,
    shared_problem,
    train_seed,
    write_rows,
)
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "train_policies"


def main(params: Params, layout: Layout, manifold: str) -> None:
    """Write data/policies/<manifold>/, learning curves and figures."""
    scene, settings = Scene.from_params(params), params.policy_settings()
    sources = [layout.joints(name) for name in params.constraints]
    manifolds = {
        name: constraint_manifold(scene.robot, constraint)
        for name, constraint in params.constraints.items()
    }
    joints = {name: read_joints(layout.joints(name)).free_joints for name in params.constraints}
    problem = shared_problem(
        params, LearnedManifold.load(layout.manifold(manifold)), manifolds, joints, manifold
    )
    about = subject_of(params, manifold=manifold, reward=settings.reward)
    with tracked_stage(
        Work(STAGE, manifold, settings.of_training("length_degree"), sources, about),
        params.tracking.experiment,
        layout.root,
    ) as run:
        tasks = [
            TrainingTask(
                problem,
                settings,
                seed,
                layout.scratch(STAGE, f"{manifold}-{seed}"),
                run.child(f"seed {seed}", {"seed": seed}),
            )
            for seed in settings.seeds
        ]
        policies = parallel_map(
            train_seed, tasks, params.compute, description=f"policies {manifold}"
        )
        learning = [
            {"seed": task.seed, **row}
            for task, p in zip(tasks, policies, strict=True)
            for row in p.curve
        ]
        for task, policy in zip(tasks, policies, strict=True):
            save_policy(policy, layout.policies(manifold), task.seed)
        write_rows(learning, layout.report(STAGE, f"{manifold}-learning", "csv"))
        figures = [{"final_saving": policy.curve[-1]["saving"]} for policy in policies]
        run.summarise(figures, [policy.curve for policy in policies])
        run.report(
            {"final_saving_mean": sum(f["final_saving"] for f in figures) / len(figures)},
            layout.report(STAGE, manifold),
        )
        for task in tasks:  # finished: the next run of this stage starts from nothing
            shutil.rmtree(task.scratch, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
