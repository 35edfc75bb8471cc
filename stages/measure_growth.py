"""Stage: how planning, curve lengths and training grow with what is asked; a few minutes on one
thread.
"""

import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import read_joints
from constraint_geodesics.params import Params
from constraint_geodesics.peers.registry import BaselineBuilder
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.planner import Planner
from constraint_geodesics.recording.png import save_png
from constraint_geodesics.report.growth_figure import growth_figure, slopes_markdown
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.urdf import find_urdf
from constraint_geodesics.studies.growth import (
    CONSTRAINT,
    BandAndTrees,
    GrowthSizes,
    Subject,
    measure_growth,
    slopes,
)
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "measure_growth"
SEVEN_JOINTS = ("kuka_iiwa/model.urdf", "lbr_iiwa_link_7")
"""A robot of pybullet_data: its URDF and its tool's link."""
BASELINES = ("straight + band", "BiRRT, tangent bundle", "BiRRT")
"""Of params.yaml's benchmark.planners: those that need nothing learned."""
IN_BATCHES = BASELINES[1]


def configurations(file: Path, robot: SerialRobot, count: int) -> Float[np.ndarray, "n D"]:
    """Free configurations of the data; where there are fewer than `count`, random ones, which take
    the same time.
    """
    drawn = read_joints(file).free_joints if file.is_file() else np.empty((0, robot.dof))
    return drawn if len(drawn) >= count else robot.sample(count, np.random.default_rng(0))


def main(params: Params, layout: Layout) -> None:
    """Write growth.csv, slopes.csv, growth.md and growth.png in reports/growth/."""
    folder, sizes = layout.root / "reports" / "growth", GrowthSizes()
    work = Work(STAGE, STAGE, asdict(sizes), [layout.planner], watched=False)
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        table = measured(params, layout, sizes)
        fits, about = slopes(table), run_header(layout.root)
        write_table(table, folder / "growth.csv", about)
        write_table(fits, folder / "slopes.csv", about)
        write_text(folder / "growth.md", slopes_markdown(fits))
        save_png(growth_figure(table, fits), folder / "growth.png")
        run.figure(folder / "growth.png")
        slope = {f"{row['axis']}/{row['what']}": row["slope"] for row in fits.to_dict("records")}
        run.mirror({"slope": slope}, folder / "slopes.csv")


def measured(params: Params, layout: Layout, sizes: GrowthSizes) -> pd.DataFrame:
    """The rows of growth.csv."""
    scene = Scene.from_params(params)
    manifold = constraint_manifold(scene.robot, params.constraints[CONSTRAINT])
    with (
        Planner(read_bundle(layout.planner), str(layout.planner)) as planner,
        BaselineBuilder(params, layout.root)(BASELINES, scene, CONSTRAINT, manifold) as (
            baselines,
            _,
        ),
    ):

        def batch(starts: Float[np.ndarray, "B D"], goals: Float[np.ndarray, "B D"]) -> list[bool]:
            return [
                path.status == "solved"
                for path in planner.plan_batch(starts, goals, manifold.constraint)
            ]

        own = BandAndTrees(planner.band)
        subject = Subject(
            params,
            scene,
            load_robot(find_urdf(SEVEN_JOINTS[0]), SEVEN_JOINTS[1]),
            {own.name: own, **baselines},
            batch,
            IN_BATCHES,
            configurations(layout.joints("free"), scene.robot, max(sizes.rows)),
            layout.scratch(STAGE, CONSTRAINT),
        )
        return measure_growth(subject, sizes)


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
