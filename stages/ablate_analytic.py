"""Stage: policy search where the answer is known, with the reward as printed and with other curve
families.
"""

import shutil
import sys

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies.ablation import by_variant, family_ratios, policy_variants
from constraint_geodesics.studies.geodesic_search import AnalyticTask, run_analytic
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "ablate_analytic"


def main(params: Params, layout: Layout, analytic: str) -> None:
    """Write reports/ablate_analytic/<analytic>.json."""
    settings = params.geodesics.on_analytic()
    with tracked_stage(
        Work(STAGE, analytic, settings.of_training("ablated_segments"), []),
        params.tracking.experiment,
        layout.root,
    ) as run:
        variants = policy_variants(settings)
        cases = [(variant, seed) for variant in variants for seed in settings.seeds]
        tasks = [
            AnalyticTask(
                analytic,
                *variants[variant],
                seed,
                layout.scratch(STAGE, f"{analytic}-{variant}-{seed}"),
                run.child(f"{variant}, seed {seed}", {"variant": variant, "seed": seed}),
            )
            for variant, seed in cases
        ]
        results = parallel_map(
            run_analytic, tasks, params.compute, description=f"ablation {analytic}"
        )
        ratios: dict[str, list[float]] = {}
        for (variant, _), result in zip(cases, results, strict=True):
            ratios.setdefault(variant, []).append(result.figures()["mean_ratio"])
        run.report(
            by_variant(ratios, family_ratios(analytic, settings)), layout.report(STAGE, analytic)
        )
        for task in tasks:  # finished: the next run of this stage starts from nothing
            shutil.rmtree(task.scratch, ignore_errors=True)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
