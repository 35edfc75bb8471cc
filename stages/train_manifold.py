"""Stage: train one learned manifold on the collision-free configurations of no constraint."""

import sys

import pandas as pd

from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.learning.training import TrainingRun, train_manifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import robot_from
from constraint_geodesics.text_files import written
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "train_manifold"


def main(params: Params, layout: Layout, manifold: str) -> None:
    """Write data/manifolds/<manifold>/, its held-out figures and its learning curve."""
    source = layout.joints("free")
    settings, about = params.manifolds[manifold], subject_of(params, manifold=manifold)
    with tracked_stage(
        Work(STAGE, manifold, {"manifold": settings}, [source], about),
        params.tracking.experiment,
        layout.root,
    ) as run:
        joints = read_joints(source).free_joints
        trained = train_manifold(
            joints,
            robot_from(params.robot),
            settings,
            TrainingRun(layout.scratch(STAGE, manifold), run.metric_logger()),
        )
        trained.manifold.save(layout.manifold(manifold))
        run.report({"rows": len(joints), **trained.metrics}, layout.report(STAGE, manifold))
        with written(layout.report(STAGE, manifold, "csv")) as part:
            pd.DataFrame(trained.history).to_csv(part, index=False)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
