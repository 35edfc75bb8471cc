"""Stage: the planner's files, from parameters alone; MLflow's registry has them as a model."""

import sys
from pathlib import Path

import numpy as np

import constraint_geodesics
from constraint_geodesics.bundle import Bundle
from constraint_geodesics.constraints.constraint import constraint_from
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search.preparation import named_roadmaps
from constraint_geodesics.tracking.experiment import Work, subject_of, tracked_stage
from constraint_geodesics.tracking.registry import register_planner
from constraint_geodesics.tracking.store import TrackingError

STAGE = "build_planner"
CODE = Path(constraint_geodesics.__file__).parent / "tracking" / "served_model.py"


def planner_files(params: Params) -> Bundle:
    """Everything the planner is made of; nothing in it is trained."""
    scene = Scene.from_params(params)
    constraints = {n: constraint_from(c, scene.robot) for n, c in params.constraints.items()}
    roadmaps = named_roadmaps(scene, constraints, params.planner)
    return Bundle(
        params.robot, params.workcell, params.constraints, params.planner, params.judge, roadmaps
    )


def main(params: Params, layout: Layout) -> None:
    """Write data/planner/ and register the planner."""
    about, experiment = subject_of(params), params.tracking.experiment
    with tracked_stage(
        Work(STAGE, "planner", params.planner, [], about), experiment, layout.root
    ) as run:
        bundle = planner_files(params)
        bundle.write(layout.planner)
        shown = params.studies.constraint
        roadmap = bundle.roadmaps[shown]
        nodes = roadmap.joints[roadmap.labels == np.bincount(roadmap.labels).argmax()]
        ends = {"start": nodes[0].tolist(), "goal": nodes[-1].tolist()}
        try:
            register_planner(run, layout.planner, CODE, ends | {"constraint": shown})
        except TrackingError as error:  # the planner itself is whole
            again = "`dvc repro --single-item --force build_planner` registers this planner"
            print(f"{error}; {again}", file=sys.stderr)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
