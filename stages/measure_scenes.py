"""Stage: what changes of a scene cost and what the planner answers to them: spheres on the way, a
cup that is carried, spheres that come up while the arm moves.
"""

import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.bundle import read_bundle
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies import changing_scenes as study
from constraint_geodesics.studies.problem_runs import quantiles
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "measure_scenes"
SEED, SPHERES, CUPS, SUDDEN, STOPS, CHANGES, MESHES = 103, 100, 200, 100, 100, 20, 5
LOADED = "level_cup"
MOVING = ("level_cup", "free", "slide")
"""Where spheres come up."""
AMONG = (1, 100)


def main(params: Params, layout: Layout) -> None:
    """Write reports/scenes.csv.gz and reports/scenes.json."""
    settings = {"seed": SEED, "spheres": SPHERES, "cups": CUPS, "sudden": SUDDEN}
    settings |= {"changes": CHANGES, "stops": STOPS, "meshes": MESHES}
    work = Work(STAGE, STAGE, settings, [layout.planner], watched=False)
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        file = layout.root / "reports" / "scenes.json"
        run.mirror(measured(params, layout, file), file)


def measured(params: Params, layout: Layout, file: Path) -> dict[str, Any]:
    """Write the rows, and their figures to a file; returns these."""
    carrying = Scene.from_params(params, LOADED)
    with Planner(read_bundle(layout.planner), str(layout.planner)) as planner:
        for name in params.constraints:
            planner.prepare(name)
        tables = {
            "changes": [row for n in AMONG for row in study.changes(planner, n, CHANGES, SEED)],
            "meshes": list(study.large_meshes(planner, MESHES, SEED)),
            "cup": list(study.loaded(planner, carrying, LOADED, CUPS, SEED)),
            "sudden": _each(study.sudden, planner, MOVING, SUDDEN),
            "stops": _each(study.stops, planner, params.constraints, STOPS),
            "sphere": _each(study.beside_a_sphere, planner, params.constraints, SPHERES),
            # last: it leaves another scene
            "first shape gone": list(study.after_a_first_shape(planner, [*params.constraints])),
        }
    frames = {name: pd.DataFrame(rows) for name, rows in tables.items()}
    about = run_header(layout.root)
    found = {
        "machine": about,
        "changes_ms": study.change_figures(frames["changes"]),
        "mesh_of_5000_triangles": study.mesh_figures(frames["meshes"]),
        "roadmap_once_a_first_shape_is_gone": quantiles("ms", frames["first shape gone"].ms),
        "cup_carried": study.answer_figures(frames["cup"]),
        "sudden_spheres": study.by_constraint(frames["sudden"]),
        "stops": study.by_constraint(frames["stops"]),
        "beside_a_sphere": study.sphere_figures(frames["sphere"]),
    }
    rows = pd.concat([frame.assign(study=name) for name, frame in frames.items()])
    write_table(rows, file.with_name("scenes.csv.gz"), about)
    write_text(file, json.dumps(found, indent=1) + "\n")
    return found


def _each(
    work: Callable[[Planner, str, int, int], study.Rows],
    planner: Planner,
    names: Iterable[str],
    count: int,
) -> list[dict[str, Any]]:
    return [row for name in names for row in work(planner, name, count, SEED)]


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
