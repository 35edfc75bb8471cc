"""The policies' benchmark of one constraint as a task that runs in parallel with the others."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.geodesics.episodes import episode_settings
from constraint_geodesics.geodesics.problem import LearnedProblem
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.dataset import (
    ShardTask,
    draw_queries,
    draw_shard,
    free_rows,
    joints_of,
)
from constraint_geodesics.learning.joint_chart import JointChart
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import GeodesicParams
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.policy_benchmark import charts_together, policy_rows

PAST_ROWS = 1000
"""Configurations of the constraint that random curves are bent past."""
LEARNED, JOINTS = "learned manifold", "joint space"


@dataclass(frozen=True)
class PolicyTask:
    """One constraint; picklable.  policies: folder of those for all constraints; separate: of its
    own, or None.
    """

    name: str
    scene: Scene
    manifold: ConstraintManifold
    chart: LearnedManifold
    settings: GeodesicParams
    policies: Path
    separate: Path | None
    queries: int
    seed: int


def run_policies(task: PolicyTask) -> pd.DataFrame:
    """Rows of all methods in the learned chart, and of those that need no policy in joint space."""
    queries = draw_queries(task.scene, task.manifold, task.name, task.queries, task.seed)
    drawn = draw_shard(
        ShardTask(
            task.scene, task.manifold, PAST_ROWS, (task.seed, zlib.crc32(task.name.encode()), 2)
        )
    )
    past = joints_of(drawn.frame)[free_rows(drawn.frame)]
    shared = [MeanPolicy.load(task.policies, seed) for seed in task.settings.seeds]
    separate = None
    if task.separate is not None:
        separate = [MeanPolicy.load(task.separate, seed) for seed in task.settings.seeds]
    joint_space = JointChart.of(task.scene.robot.sample(PAST_ROWS, np.random.default_rng(0)))
    tables = {}
    for name, chart in ((LEARNED, task.chart), (JOINTS, joint_space)):
        curve = PinnedPolynomial(chart.dim, task.settings.degree)
        problem = LearnedProblem(
            chart, task.manifold, curve, past, task.settings.length_degree, True, 0.0
        )
        policies = (shared, separate) if chart is task.chart else ([], None)
        ends, settings = (
            problem.ends(queries.starts, queries.goals),
            episode_settings(task.settings),
        )
        drawn_curves = len(shared) * settings.steps + 1
        tables[name] = policy_rows(problem, *policies, settings, ends, task.seed, drawn_curves)
    return charts_together(tables)


def policy_figures(table: pd.DataFrame) -> dict[str, Any]:
    """Constraint → method → figures."""
    figures: dict[str, Any] = {}
    for row in table.to_dict("records"):
        about: Mapping[str, Any] = {
            str(k): v for k, v in row.items() if k not in ("constraint", "method")
        }
        finite = {
            k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in about.items()
        }
        figures.setdefault(str(row["constraint"]), {})[str(row["method"])] = finite
    return figures
