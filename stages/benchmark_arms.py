"""Stage: eight arms from their URDFs, tool poses as goals and single held angles; goes on where an
earlier run of it stopped.
"""

import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from constraint_geodesics.benchmark.queries import TABLE, read_queries
from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.benchmark.runner import fingerprint
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.code import code_digest, data_digest
from constraint_geodesics.pipeline.compute import parallel_map
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import machine, run_header
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.studies.arm_parts import (
    SEED,
    Part,
    figures,
    kept,
    measure,
    parts_of,
    table_of,
)
from constraint_geodesics.studies.arms import robots_folder
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.comparison import ARMS, cells_of
from constraint_geodesics.tracking.experiment import Work, tracked_stage

STAGE = "benchmark_arms"
MEASURED_BY = "studies.arm_parts"
"""The module that measures: every row depends on what it imports."""


def main(params: Params, layout: Layout) -> None:
    """Write data/arm_rows/ as the parts finish, then reports/arms.csv and arms.json."""
    robots_folder()  # what is missing is said before anything is measured
    work = Work(STAGE, STAGE, {"seed": SEED}, [layout.planner])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        parts = fingerprinted(params, layout)
        left = [part for part in parts if kept(part) is None]
        parallel_map(measure, left, params.compute, description="arms and goals")
        rows = table_of([row for part in parts for row in kept(part) or ()])
        reports, found = layout.root / "reports", figures(rows)
        about = run_header(layout.root)
        write_table(rows, reports / "arms.csv", about)
        told = found | {"machine": about}
        write_text(reports / "arms.json", json.dumps(told, indent=1) + "\n")
        run.mirror({table: own["all"] for table, own in found.items()}, reports / "arms.json")
        run.cells(cells_of(compared(found), ("table", "arm", "constraint", "planner"), ARMS))


def compared(found: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Iterator[dict[str, Any]]:
    """The rows of figures that say how often the planner succeeds, by what they are of."""
    for table, own in found.items():
        for name, row in own.items():
            arm, _, constraint = name.rpartition(", ")
            if arm and "success" in row:
                about = {"table": table, "arm": arm, "constraint": constraint}
                yield {**about, "planner": "planner", **row}


def fingerprinted(params: Params, layout: Layout) -> list[Part]:
    """All parts, each with a digest of what its rows depend on."""
    queries = {
        name: [q for q in read_queries(layout.benchmark_queries(name)) if q.scene == TABLE]
        for name in params.constraints
    }
    shared = [code_digest(MEASURED_BY), data_digest(layout.planner), machine(), SEED]
    found = []
    for part in parts_of(queries, layout.planner, layout.arm_rows):
        asked = part.queries
        if not isinstance(asked, int):
            ends = [[q.number, *q.start.tolist(), *q.goal.tolist()] for q in asked]
        own = [part.table, part.arm, part.constraint, asked if isinstance(asked, int) else ends]
        found.append(replace(part, fingerprint=fingerprint(*shared, *own)))
    return found


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
