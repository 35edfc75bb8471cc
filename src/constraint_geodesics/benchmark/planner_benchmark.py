"""The sampling-based planners on the queries of one constraint, judged and measured like the
learned paths.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import judge_limits, measure_path
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.dataset import Queries
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.lift import as_executed
from constraint_geodesics.params import BenchmarkParams, JudgeParams
from constraint_geodesics.peers.ompl import PlannerName, plan_all
from constraint_geodesics.scene.scene import Scene


@dataclass(frozen=True)
class PlannerTask:
    """One planner and seed on some of the queries; picklable."""

    planner: PlannerName
    seed: int
    scene: Scene
    manifold: ConstraintManifold
    charts: Mapping[str, LearnedManifold]
    queries: Queries
    settings: BenchmarkParams
    judge: JudgeParams


@dataclass(frozen=True)
class PlannerResult:
    """One row and one joint path a query."""

    rows: list[dict[str, Any]]
    paths: list[Float[np.ndarray, "T D"]]


def run_planner(task: PlannerTask) -> PlannerResult:
    """Plan every query and measure what came back; failures keep their row."""
    scene, queries = task.scene, task.queries
    planned = plan_all(
        task.planner,
        task.settings,
        scene.robot,
        task.manifold.constraint,
        scene.workcell,
        queries.starts,
        queries.goals,
        task.seed,
    )
    rows, paths = [], []
    with Certifier(scene, judge_limits(task.judge)) as certifier:
        for query, path in enumerate(planned):
            began = time.perf_counter()
            joints = as_executed(task.manifold, path.joints, task.judge.row_spacing_rad)
            refining_s = time.perf_counter() - began
            paths.append(joints)
            measures = measure_path(
                joints,
                queries.starts[query],
                queries.goals[query],
                task.manifold,
                task.charts,
                certifier,
                task.judge.spacing_rad,
            )
            found = {
                "status": path.status,
                "time_s": path.time_s + refining_s,
                "evaluations": path.iterations,
            }
            rows.append(
                {
                    "planner": task.planner,
                    "query": query,
                    "seed": task.seed,
                    **found,
                    **measures.row(),
                }
            )
    return PlannerResult(rows, paths)


def planner_figures(results: Sequence[PlannerResult]) -> dict[str, dict[str, float]]:
    """Success, length and what was claimed but is not valid, of each planner; times stand in the
    table alone.
    """
    figures: dict[str, dict[str, float]] = {}
    rows = [row for result in results for row in result.rows]
    for planner in dict.fromkeys(row["planner"] for row in rows):
        own = [row for row in rows if row["planner"] == planner]
        lengths = [row["length_rad"] for row in own if row["valid"]]
        figures[planner] = {
            "rows": len(own),
            "success": len(lengths) / len(own),
            "claimed_but_invalid": sum(
                row["status"] == "solved" and not row["valid"] for row in own
            ),
            "length_median_rad": float(np.median(lengths)) if lengths else float("nan"),
        }
    return figures
