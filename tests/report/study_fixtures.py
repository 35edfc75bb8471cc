"""Reports of the studies' stages, as those stages write them, from a few rows whose figures are
known.
"""

import json

import numpy as np
import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.arms_page import TABLES
from constraint_geodesics.studies.arm_parts import figures, table_of
from constraint_geodesics.studies.execution import PLANNED, STRAIGHT
from constraint_geodesics.studies.proposals import POLICY, RANDOM, STILL, grouped_figures


def policy_rows(params: Params) -> pd.DataFrame:
    """Rows of `run_policies`: the policy solves both queries of each constraint, the same search
    without one and random curves one of them.
    """
    answers = (
        *((POLICY, 0, 2.02), (POLICY, 1, 2.04), (STILL, 0, 2.06), (STILL, 1, np.nan)),
        *((RANDOM, 0, 2.2), (RANDOM, 1, np.nan)),
    )
    return pd.DataFrame(
        [
            {
                "constraint": constraint,
                "scene": scene,
                "query": query,
                "method": method,
                "seed": 0,
                "solved": np.isfinite(length),
                "length_rad": length,
                "best_rad": 2.0,
                "optimum_rad": 2.0
                if (constraint, scene) == (params.studies.constraint, "table")
                else np.nan,
                "refined_rad": length - 0.01,
                "curves": 5,
                "checked": 1,
                "search_ms": 3.0,
                "time_ms": 4.0,
            }
            for constraint in params.all_constraints
            for scene in ("table", "keep_out")
            for method, query, length in answers
        ]
    )


def execution_figures() -> dict:
    """What `execution_figures` returns of two queries."""
    figures = {
        "executed": 2,
        "kept_share_mean": 1.0,
        "kept_share_worst": 1.0,
        "spilled": 0,
        "emptied": 0,
        "collisions": 0,
        "largest_tilt_rad": 0.01,
        "largest_tracking_error_rad": 0.002,
        "duration_mean_s": 1.5,
    }
    spilled = figures | {
        "kept_share_mean": 0.25,
        "kept_share_worst": 0.0,
        "largest_tilt_rad": np.pi / 2,
    }
    return {
        "queries": 2,
        "drawn": 9,
        "smallest_line_tilt_rad": 2.0,
        PLANNED: figures,
        STRAIGHT: spilled,
    }


def arm_rows() -> list[dict]:
    """Two queries of each table of the study of arms; BiRRT is asked a third one, and one of a held
    angle has no path.
    """
    named = {"arm": "UR5", "constraint": "level", "status": "solved", "length_rad": 2.0}
    found = {"time_ms": 3.0, "best_known_rad": 1.6, "birrt_status": "", "given_status": ""}
    rows = [
        named | found | {"table": table, "query": query} for table in TABLES for query in range(3)
    ]
    of = {(own["table"], own["query"]): own for own in rows}
    of["configurations", 2] |= {"birrt_status": "solved", "birrt_time_ms": 80.0}
    nothing = {"length_rad": np.nan, "best_known_rad": np.nan, "time_ms": 900.0}
    of["held_angle", 2] |= {"status": "not_connected"} | nothing
    return rows


RUN = {"commit": "0123456789abcdef", "date": "2026-01-01 00:00 UTC", "processor": "a processor"}
ORIGIN = "Rows of commit 0123456789ab, 2026-01-01 00:00 UTC, one thread of a processor"
"""Where rows are from, as reports have it and as pages say it."""


def write_arm_report(layout: Layout) -> None:
    """reports/arms.json of this layout."""
    file = layout.root / "reports" / "arms.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(figures(table_of(arm_rows())) | {"machine": RUN}))


def write_study_reports(params: Params, layout: Layout) -> None:
    """reports/benchmark_policies and execute_paths of this layout."""
    policies = grouped_figures(policy_rows(params), params) | {"machine": RUN}
    for file, content in (
        (layout.report("benchmark_policies", "policies"), policies),
        (layout.report("execute_paths", params.studies.constraint), execution_figures()),
    ):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(content))
    executed = [
        {
            "query": 0,
            "kind": kind,
            "status": "executed",
            "kept": kept,
            "spheres": 12,
            "recording": f"data/recordings/execute_paths/{params.studies.constraint}/{k}.rrd"
            if k == 0
            else "",
        }
        for k, (kind, kept) in enumerate(((PLANNED, 12), (STRAIGHT, 3)))
    ]
    pd.DataFrame(executed).to_csv(
        layout.report("execute_paths", params.studies.constraint, "csv"), index=False
    )
