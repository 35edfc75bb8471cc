"""Stage: the diffusion model of paths, a baseline, trained on certified paths of the planner."""

import sys

import pandas as pd

from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.learning.path_diffusion_training import (
    Examples,
    PathTask,
    planned_examples,
    train_path_diffusion,
)
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.text_files import written
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE, ITEM = "train_path_diffusion", "paths"


def main(params: Params, layout: Layout) -> None:
    """Write data/path_diffusion/, its held-out loss and its learning curve."""
    settings, bundle = params.path_diffusion, read_bundle(layout.planner)
    work = Work(STAGE, ITEM, settings, [layout.planner], subject_of(params))
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        tasks = [
            PathTask(bundle, Scene.from_params(params, name), name, settings)
            for name in params.constraints
        ]
        parts = parallel_map(planned_examples, tasks, params.compute, description="planned paths")
        trained = train_path_diffusion(Examples.joined(parts), settings, run.metric_logger())
        trained.model.save(layout.path_diffusion)
        paths = sum(part.paths.shape[1] for part in parts)
        run.report({"paths": paths, **trained.history[-1]}, layout.report(STAGE, ITEM))
        table = pd.DataFrame(trained.history)
        with written(layout.report(STAGE, ITEM, "csv")) as part:
            table.to_csv(part, index=False)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
