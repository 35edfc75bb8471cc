"""Stage: one policy a seed for all constraints together, with and without an obstacle."""

import shutil
import sys

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.policy_search import save_policy
from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.learning.learned_manifold import chart_named
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.geodesic_search import (
    TrainingTask,
    policy_problem,
    train_seed,
    training_figures,
    training_problem,
    write_rows,
)
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "train_policies"


def main(params: Params, layout: Layout) -> None:
    """Write data/policies/<chart>/, learning curves and figures."""
    robot = Scene.from_params(params).robot
    settings, chart = params.policy_settings(), params.policies.chart
    sources = [layout.joints(name) for name in params.constraints]
    space = chart_named(chart, layout.manifold(chart), robot)
    asked = []
    for name, constraint in params.constraints.items():
        scene, manifold = Scene.from_params(params, name), constraint_manifold(robot, constraint)
        joints = read_joints(layout.joints(name)).free_joints
        asked.append((scene, policy_problem(params, space, scene, manifold, joints)))
    problem = training_problem(params, asked)
    about = subject_of(params, manifold=chart, reward=settings.reward)
    more = params.policies.model_dump(mode="json", include={"training_length_degree", "obstacles"})
    with tracked_stage(
        Work(STAGE, chart, settings.of_training("length_degree") | more, sources, about),
        params.tracking.experiment,
        layout.root,
    ) as run:
        tasks = [
            TrainingTask(
                problem,
                settings,
                seed,
                layout.scratch(STAGE, f"{chart}-{seed}"),
                run.child(f"seed {seed}", {"seed": seed}),
            )
            for seed in settings.seeds
        ]
        policies = parallel_map(train_seed, tasks, params.compute, description=f"policies {chart}")
        learning = [
            {"seed": task.seed, **row}
            for task, p in zip(tasks, policies, strict=True)
            for row in p.curve
        ]
        for task, policy in zip(tasks, policies, strict=True):
            save_policy(policy, layout.policies(chart), task.seed)
        write_rows(learning, layout.report(STAGE, f"{chart}-learning", "csv"))
        figures = [training_figures(policy.curve) for policy in policies]
        run.summarise(figures, [policy.curve for policy in policies])
        means = {name: [own[name] for own in figures] for name in figures[0]}
        run.report(
            {f"{name}_mean": sum(values) / len(values) for name, values in means.items()},
            layout.report(STAGE, chart),
        )
        for task in tasks:  # finished: the next run of this stage starts from nothing
            shutil.rmtree(task.scratch, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
