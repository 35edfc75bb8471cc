"""Stage: search the queries' geodesics under one constraint with a policy a seed: the shared ones
where curves are retracted, their own where they are not, as in the paper.
"""

import shutil
import sys

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.learning.dataset import read_joints, read_queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold, chart_named
from constraint_geodesics.learning.submanifold import Surface, load_submanifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.paths import named_recordings, save_paths
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.geodesic_search import (
    PLANNER,
    SeedTask,
    connected_queries,
    geodesic_figures,
    geodesic_problem,
    policy_problem,
    run_seed,
    save_seeds,
    straight_rows,
    write_rows,
)
from constraint_geodesics.tracking.comparison import of_seeds
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "train_geodesics"
SEARCHED: tuple[str, ...] = ("length_degree", "rollouts", "kept", "rounds")
"""What a search is told besides what its policy is trained with."""


def main(params: Params, layout: Layout, manifold: str, constraint: str) -> None:
    """Write data/geodesics/<manifold>-<constraint>/, its rows and figures."""
    item, sources = (
        f"{manifold}-{constraint}",
        [layout.joints(constraint), layout.queries(constraint)],
    )
    scene = Scene.from_params(params, constraint)
    constrained = constraint_manifold(scene.robot, params.constraints[constraint])
    learned, joints = (
        LearnedManifold.load(layout.manifold(manifold)),
        read_joints(sources[0]).free_joints,
    )
    policies: dict[int, MeanPolicy] = {}
    settings, read, told = params.geodesics, [layout.manifold(manifold)], SEARCHED
    if params.manifolds[manifold].retract:
        name = params.policies.chart
        chart = chart_named(name, layout.manifold(name), scene.robot)
        problem = policy_problem(params, chart, scene, constrained, joints)
        folder = layout.policies(name)
        read.append(folder)
        policies = {seed: MeanPolicy.load(folder, seed) for seed in settings.seeds}
        settings = params.policy_settings().model_copy(update={"seeds": settings.seeds})
    else:
        told = (*SEARCHED, "inclusion_weight")
        problem = geodesic_problem(params, learned, constrained, joints, manifold)
    queries = read_queries(sources[1])
    read.append(layout.submanifold(manifold, constraint))
    submanifold = load_submanifold(read[-1])
    with scene.world() as world:
        surface = Surface(learned, constrained, world.free)
        connected, connection_s = connected_queries(
            submanifold, surface, queries, params.submanifold
        )
    about = subject_of(params, constraint=constraint, manifold=manifold, reward=settings.reward)
    with tracked_stage(
        Work(STAGE, item, settings.of_training(*told), [*sources, *read], about),
        params.tracking.experiment,
        layout.root,
    ) as run:
        tasks = [
            SeedTask(
                problem,
                learned,
                scene,
                settings,
                params.judge,
                manifold,
                queries,
                connected,
                connection_s,
                seed,
                layout.scratch(STAGE, f"{item}-{seed}"),
                run.child(f"seed {seed}", {"seed": seed, "planner": PLANNER}),
                policies.get(seed),
            )
            for seed in settings.seeds
        ]
        results = parallel_map(run_seed, tasks, params.compute, description=f"policy search {item}")
        curves = [result.policy.curve for result in results if result.policy is not None]
        run.summarise([result.figures() for result in results], curves)
        folder = layout.geodesics(manifold, constraint)
        save_seeds(results, queries, folder, layout.report(STAGE, f"{item}-learning", "csv"))
        rows, paths = straight_rows(tasks[0])
        rows += [row for result in results for row in result.rows]
        paths += [path for result in results for path in result.paths]
        save_paths(rows, paths, layout.geodesics(manifold, constraint))
        folder = layout.recordings(STAGE, item)
        rows = named_recordings(rows, paths, folder, params.recording.queries)
        run.recordings(rows, shown=PLANNER)
        run.compared(of_seeds(rows, PLANNER, settings.seeds))
        write_rows(
            rows, layout.report(STAGE, item, "csv"), manifold=manifold, constraint=constraint
        )
        run.report(geodesic_figures(results, connected), layout.report(STAGE, item))
        for task in tasks:  # finished: the next run of this stage starts from nothing
            shutil.rmtree(task.scratch, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
