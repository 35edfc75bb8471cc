"""Reports of the planner's stages, as those stages write them, from a few rows whose figures are
known.
"""

import json

import numpy as np
import pandas as pd

from constraint_geodesics.benchmark.plan_benchmark import BAND_AFTER, figures_of, plan_table
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.studies.execution import PLANNED, STRAIGHT
from constraint_geodesics.studies.proposals import policy_figures, policy_table

LENGTHS = {"planner": (2.0, 4.0, 3.0), BAND_AFTER: (2.2, 4.0, np.nan), "BiRRT": (3.0, 8.0, np.nan)}
"""Joint lengths of three queries; nan without a path."""


def plan_rows(constraint: str) -> pd.DataFrame:
    """Rows of `plan_rows`: BiRRT claims a path for the last query that is not valid."""
    rows = []
    for planner, lengths in LENGTHS.items():
        for query, length in enumerate(lengths):
            found = np.isfinite(length)
            rows.append(
                {
                    "planner": planner,
                    "constraint": constraint,
                    "query": query,
                    "seed": 0,
                    "source": "straight" if planner == "planner" else "",
                    "status": "solved" if found or planner == "BiRRT" else "not_found",
                    "time_s": 0.005,
                    "check_time_s": 0.001 if planner == "planner" else np.nan,
                    "valid": found,
                    "reason": "",
                    "length_rad": length,
                    "max_violation": 1e-5,
                    "violation_bound": 8e-5,
                    "best_known_rad": LENGTHS["planner"][query],
                }
            )
    return pd.DataFrame(rows)


def policy_rows() -> pd.DataFrame:
    """Rows of `policy_rows`: the policy solves both queries, the straight line one of them."""
    return pd.DataFrame(
        [
            {
                "method": method,
                "query": query,
                "seed": 0,
                "feasible": feasible,
                "length_rad": length,
                "optimum_rad": 2.0,
                "curves": 5,
                "time_ms": 4.0,
            }
            for method, query, feasible, length in (
                ("policy", 0, True, 2.02),
                ("policy", 1, True, 2.04),
                ("straight line", 0, True, 2.2),
                ("straight line", 1, False, np.nan),
            )
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


def write_plan_reports(params: Params, layout: Layout) -> None:
    """reports/benchmark_plans, benchmark_policies and execute_paths of this layout."""
    names = [params.plans.constraint, *params.plans.unseen]
    plans = {
        "machine": {"processor": "a processor"},
        "plans": figures_of(pd.concat([plan_table(plan_rows(name)) for name in names])),
        "batch": {
            name: {"size": 4, "per_second": 400.0, "checked_per_second": 300.0} for name in names
        },
    }
    policies = policy_figures(
        policy_table(policy_rows()).assign(constraint=params.plans.constraint)
    )
    for file, content in (
        (layout.report("benchmark_plans", "plans"), plans),
        (layout.report("benchmark_policies", params.geodesics.searched[0]), policies),
        (layout.report("execute_paths", params.plans.constraint), execution_figures()),
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
            "recording": f"data/recordings/execute_paths/{params.plans.constraint}/{k}.rrd"
            if k == 0
            else "",
        }
        for k, (kind, kept) in enumerate(((PLANNED, 12), (STRAIGHT, 3)))
    ]
    pd.DataFrame(executed).to_csv(
        layout.report("execute_paths", params.plans.constraint, "csv"), index=False
    )
