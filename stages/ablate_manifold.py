"""Stage: geodesics on a learned manifold with other curve families, and without the variance term
of its metric.
"""

import sys

from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.ablation import LearnedAblation
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "ablate_manifold"


def main(params: Params, layout: Layout, manifold: str) -> None:
    """Write reports/ablate_manifold/<manifold>.json."""
    source, own = layout.joints("free"), {"degree", "ablated_segments"}
    learned = layout.manifold(manifold)
    about = params.geodesics.model_dump(include=own) | {"pairs": params.geometry.pairs}
    with (
        tracked_stage(
            Work(STAGE, manifold, about, [source, learned]), params.tracking.experiment, layout.root
        ) as run,
        Scene.from_params(params).world() as world,
    ):
        chart = LearnedManifold.load(learned)
        joints = read_joints(source).free_joints
        ablation = LearnedAblation(
            chart, joints, params.geodesics, params.geometry.pairs, world.free
        )
        run.report(ablation.figures(), layout.report(STAGE, manifold))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
