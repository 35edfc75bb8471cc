"""Stage: policy search on a manifold whose distances are known (Fig. 3), one policy a seed."""

import shutil
import sys

import numpy as np

from constraint_geodesics.geodesics.policy_search import save_policy
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies.geodesic_search import (
    MANIFOLDS,
    AnalyticTask,
    curve_family,
    run_analytic,
    write_rows,
)
from constraint_geodesics.text_files import written
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "train_analytic"


def main(params: Params, layout: Layout, analytic: str) -> None:
    """Write data/analytic/<analytic>/, its learning curves and figures."""
    settings = params.geodesics.on_analytic()
    about = subject_of(params, manifold=analytic, reward=settings.reward)
    with tracked_stage(
        Work(STAGE, analytic, settings.of_training(), [], about),
        params.tracking.experiment,
        layout.root,
    ) as run:
        tasks = [
            AnalyticTask(
                analytic,
                curve_family(MANIFOLDS[analytic].manifold.dim, settings),
                settings,
                seed,
                layout.scratch(STAGE, f"{analytic}-{seed}"),
                run.child(f"seed {seed}", {"seed": seed}),
            )
            for seed in settings.seeds
        ]
        results = parallel_map(
            run_analytic, tasks, params.compute, description=f"policy search {analytic}"
        )
        run.summarise(
            [result.figures() for result in results], [result.policy.curve for result in results]
        )
        folder = layout.analytic(analytic)
        for result in results:
            save_policy(result.policy, folder, result.seed)
        first = results[0]
        with written(folder / "curves.npz") as part:
            np.savez_compressed(part, sampled=first.sampled, learned=first.learned)
        learning = [
            {"seed": result.seed, **row} for result in results for row in result.policy.curve
        ]
        write_rows(learning, layout.report(STAGE, f"{analytic}-learning", "csv"))
        figures = {name: [result.figures()[name] for result in results] for name in first.figures()}
        means = {
            f"{name}_mean": float(np.mean(values)) for name, values in figures.items()
        }  # DVC compares no lists
        run.report(figures | means, layout.report(STAGE, analytic))
        for task in tasks:  # finished: the next run of this stage starts from nothing
            shutil.rmtree(task.scratch, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
