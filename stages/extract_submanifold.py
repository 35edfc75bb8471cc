"""Stage: find the part of one learned manifold on which one constraint holds; the manifold is used
as it is.
"""

import sys

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import (
    Surface,
    extract,
    save_submanifold,
    submanifold_figures,
)
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage

STAGE = "extract_submanifold"


def main(params: Params, layout: Layout, manifold: str, constraint: str) -> None:
    """Write data/submanifolds/<manifold>-<constraint>/ and its figures."""
    item = f"{manifold}-{constraint}"
    sources = [layout.joints("free"), layout.joints(constraint)]
    learned = layout.manifold(manifold)
    scene = Scene.from_params(params, constraint)
    constrained = constraint_manifold(scene.robot, params.constraints[constraint])
    about = subject_of(params, constraint=constraint, manifold=manifold)
    with (
        tracked_stage(
            Work(STAGE, item, params.submanifold, [*sources, learned], about),
            params.tracking.experiment,
            layout.root,
        ) as run,
        scene.world() as world,
    ):
        chart = LearnedManifold.load(learned)
        free, on_constraint = (read_joints(source).free_joints for source in sources)
        surface = Surface(chart, constrained, world.free)
        found = extract(surface, free, on_constraint, params.submanifold)
        save_submanifold(found, layout.submanifold(manifold, constraint))
        figures = submanifold_figures(found, surface, free, on_constraint, params.submanifold)
        run.report(figures, layout.report(STAGE, item))


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
