"""Stage: the proof of freedom from collision against PyBullet at dense configurations, on 20,000
paths of two robots, and ways among thin shapes; about a quarter of an hour on two cores.
"""

import json
import sys
from dataclasses import asdict
from typing import Any

from constraint_geodesics.benchmark.queries import TABLE, read_queries
from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.planner import Planner
from constraint_geodesics.robot.kinematics import load_robot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.urdf import find_urdf
from constraint_geodesics.studies.collision_proof import (
    KINDS,
    Trial,
    graze,
    grazings,
    summed,
    try_scene,
)
from constraint_geodesics.studies.thin_shapes import Thicket, try_thicket
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "check_collision_proof"
SEVEN_JOINTS = ("kuka_iiwa/model.urdf", "lbr_iiwa_link_7", "lbr_iiwa_link_0")
"""A robot of pybullet_data: its URDF, its tool's link and the one that stands on the table."""
SCENES, LINES, GRAZED = 10, 230, 650
"""Scenes of each kind and robot, straight lines in each, and shapes that are tried for grazing."""
AMONG_THIN, THICKETS, THIN_QUERIES = ("free", "level_cup"), 25, 5
"""Constraints of the queries among thin shapes, scenes of these, and queries of each in a scene."""


def main(params: Params, layout: Layout) -> None:
    """Write reports/collision_proof.json."""
    settings = {"scenes": SCENES, "lines": LINES, "grazed": GRAZED, "thickets": THICKETS}
    work = Work(STAGE, STAGE, settings, [layout.planner])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        report = {"machine": run_header(layout.root), **proved(params, layout)}
        file = layout.root / "reports" / "collision_proof.json"
        write_text(file, json.dumps(report, indent=1) + "\n")
        counts = ("paths", "free", "certified", "wrongly_certified", "undecided", "refused")
        totals = {name: sum(row[name] for row in report["paths"]) for name in counts}
        run.mirror({**report, "all_paths": totals}, file)


def proved(params: Params, layout: Layout) -> dict[str, Any]:
    """What stands in the report."""
    scene = Scene.from_params(params)
    urdf, tool, base = SEVEN_JOINTS
    table = Box("table", (0.0, 0.0, -0.05), (2.4, 2.4, 0.1), (base,))
    other = Scene(load_robot(find_urdf(urdf), tool), (table,))
    paths = []
    bundle = read_bundle(layout.planner)
    with Planner(bundle, str(layout.planner)) as planner:
        for name in params.constraints:
            queries = read_queries(layout.benchmark_queries(name))
            alone = [query for query in queries if query.scene == TABLE]
            answers = [planner.plan(query.start, query.goal, name) for query in alone]
            paths += [answer.joints for answer in answers if answer.status == "solved"]
    trials = [
        Trial(own, own.robot.name, kind, k, LINES, tuple(paths[k::SCENES]) if own is scene else ())
        for own in (scene, other)
        for kind in KINDS
        for k in range(SCENES)
    ]
    counts = parallel_map(try_scene, trials, params.compute, description="certified paths")
    tasks = grazings(scene, paths, GRAZED, seed=0)
    found = parallel_map(graze, tasks, params.compute, description="grazed shapes")
    grazed = [each for each in found if each is not None]
    thickets = [Thicket(bundle, AMONG_THIN, THIN_QUERIES, seed) for seed in range(THICKETS)]
    among = parallel_map(
        try_thicket, thickets, params.compute, description="ways among thin shapes"
    )
    return {
        "paths": [asdict(each) for each in summed([each for own in counts for each in own])],
        "grazed": len(grazed),
        "certified_beside_smaller": sum(each.beside_smaller for each in grazed),
        "certified_beside_larger": sum(each.beside_larger for each in grazed),
        "among_thin_shapes": {
            "asked": sum(each.asked for each in among),
            "solved_by_birrt": sum(each.sampled for each in among),
            "of_these_by_planner": sum(each.both for each in among),
            "by_planner": sum(each.planned for each in among),
        },
    }


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
