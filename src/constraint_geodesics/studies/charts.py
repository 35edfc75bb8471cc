"""What a learned manifold adds to the search for a curve: one constraint's policy in charts of
N = 2 to 8 dimensions, learned from the workcell's data or from the task's own, and in joint space;
and what the variance term of eq. 5 does where the data has a hole.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import judge_limits
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.policy_search import train_policy
from constraint_geodesics.learning.dataset import draw_queries, read_joints
from constraint_geodesics.learning.learned_manifold import LearnedManifold, joint_space
from constraint_geodesics.learning.training import TrainingRun, train_manifold
from constraint_geodesics.params import CompareChartsParams, ManifoldParams, Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.ablation import LearnedAblation
from constraint_geodesics.studies.geodesic_search import policy_problem
from constraint_geodesics.studies.proposals import (
    DESCENT,
    POLICY,
    Asked,
    answered,
    by_descent,
    by_policy,
)

WORKCELL, TASK, JOINTS = "workcell", "task", "joint space"
"""What a chart is learned from: all free configurations, those that keep the constraint, nothing.
"""
HOLE = "workcell with a hole"
CHART = "chart"
"""In place of a method: figures of the chart itself."""


@dataclass(frozen=True)
class ChartTask:
    """One chart with one seed; picklable.  data: WORKCELL, TASK, JOINTS or HOLE."""

    params: Params
    layout: Layout
    data: str
    dim: int
    seed: int

    @property
    def settings(self) -> CompareChartsParams:
        """Of the study."""
        return self.params.compare_charts

    @property
    def vae(self) -> ManifoldParams:
        """How its VAE is trained."""
        own = {"latent_dim": self.dim, "seed": self.seed, "epochs": self.settings.epochs}
        return self.params.manifolds[self.settings.vae].model_copy(update=own)

    @property
    def scratch(self) -> Path:
        """Of its checkpoints."""
        name = f"{self.data}-{self.dim}-{self.seed}".replace(" ", "-")
        return self.layout.scratch("compare_charts", name)


def tasks_of(params: Params, layout: Layout) -> list[ChartTask]:
    """Every chart with every seed, the slow ones first."""
    own, dof = params.compare_charts, Scene.from_params(params).robot.dof
    cases = [(HOLE, dim) for dim in own.hole.dims]
    cases += [(data, dim) for data in (WORKCELL, TASK) for dim in own.dims] + [(JOINTS, dof)]
    return [ChartTask(params, layout, *case, seed) for case in cases for seed in own.seeds]


def measure(task: ChartTask) -> list[dict[str, Any]]:
    """Rows of one chart: data, dim, seed, method, query (−1: of all), figure, value."""
    found = _hole_rows(task) if task.data == HOLE else _search_rows(task)
    named = {"data": task.data, "dim": task.dim, "seed": task.seed}
    return [named | row for row in found]


def _search_rows(task: ChartTask) -> list[dict[str, Any]]:
    """A policy trained in the chart, and a descent that is given the same time, on the queries."""
    params, own = task.params, task.settings
    scene = Scene.from_params(params, own.constraint)
    manifold = constraint_manifold(scene.robot, params.constraints[own.constraint])
    joints = read_joints(task.layout.joints(own.constraint)).free_joints
    began = time.process_time()
    chart, held_out = _chart(task, scene, joints)
    learned_s, began = time.process_time() - began, time.process_time()
    problem = policy_problem(params, chart, scene, manifold, joints)
    settings = params.policy_settings().model_copy(update={"steps": own.steps})
    policy = train_policy(problem, settings, task.seed, task.scratch, _quiet).mean
    trained_s = time.process_time() - began
    about = {"learned_s": learned_s, "trained_s": trained_s, **held_out}
    rows = [_row(CHART, -1, name, value) for name, value in about.items()]
    queries = draw_queries(scene, manifold, own.constraint, own.queries, own.query_seed)
    ends = problem.ends(queries.starts, queries.goals)
    methods = {POLICY: by_policy(policy, settings, task.seed), DESCENT: by_descent(task.seed)}
    with Certifier(scene, judge_limits(params.judge)) as certifier:
        for query in range(len(ends)):
            asked, spent = Asked(problem, ends[np.array([query])], query, certifier), 0.0
            if not query:
                answered(asked, methods[POLICY](asked, spent))  # what is loaded late is no query's
            for name, method in methods.items():
                answer = answered(asked, method(asked, spent))
                spent = spent or answer.search_s + answer.check_s
                rows.append(_row(name, query, "length_rad", answer.length))
                rows.append(_row(name, query, "ms", 1e3 * (answer.search_s + answer.check_s)))
    return rows


def _chart(
    task: ChartTask, scene: Scene, joints: Float[np.ndarray, "n D"]
) -> tuple[LearnedManifold, Mapping[str, float]]:
    """The chart, and how well it reproduces configurations of the task that it was not told of."""
    if task.data == JOINTS:
        return joint_space(scene.robot), {"reproduction_rad": 0.0}
    rows = np.random.default_rng(task.seed).permutation(joints)
    kept, held_out = np.split(rows, [int((1.0 - task.vae.held_out) * len(rows))])
    if task.data == WORKCELL:
        kept = read_joints(task.layout.joints("free")).free_joints
    chart = _trained(task, scene, kept)
    error = np.abs(chart.decode(chart.encode(held_out)) - held_out)
    return chart, {"reproduction_rad": float(error.mean())}


def _trained(task: ChartTask, scene: Scene, rows: Float[np.ndarray, "n D"]) -> LearnedManifold:
    run = TrainingRun(task.scratch, _quiet)
    return train_manifold(rows, scene.robot, task.vae, run).manifold


def _hole_rows(task: ChartTask) -> list[dict[str, Any]]:
    """Latent geodesics with and without the variance term, on a chart whose data kept away from
    shapes that nothing else tells of.
    """
    params, hole = task.params, task.settings.hole
    workcell = Scene.from_params(params)
    scene = replace(workcell, workcell=(*workcell.workcell, *hole.around.shapes.values()))
    joints = read_joints(task.layout.joints("free")).free_joints
    with scene.world() as world:
        rows = joints[world.free(joints)]
        chart = _trained(task, scene, rows)
        ablation = LearnedAblation(chart, rows, params.geodesics, hole.pairs, world.free)
        figures = ablation.variance()
    share = len(rows) / len(joints)
    return [_row(CHART, -1, "data_kept", share)] + [
        _row(metric, -1, name, value)
        for metric, own in figures.items()
        for name, value in own.items()
    ]


def _row(method: str, query: int, figure: str, value: float) -> dict[str, Any]:
    return {"method": method, "query": query, "figure": figure, "value": float(value)}


def _quiet(*_: Any) -> None:
    """Nothing is logged of single trainings."""


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """All rows, charts by data and dimension."""
    table = pd.DataFrame(rows)
    order = {data: k for k, data in enumerate((JOINTS, WORKCELL, TASK, HOLE))}
    table = table.assign(order=table["data"].map(order))
    keys = ["order", "dim", "seed", "method", "query", "figure"]
    return table.sort_values(keys, kind="stable", ignore_index=True).drop(columns="order")


def summary(table: pd.DataFrame) -> dict[str, Any]:
    """By data, dimension and method: each figure's mean, least and largest over the seeds that have
    it, None where none has.

    Of the searches: solved (share of the queries that any chart's answer solves), ratio_median and
    ratio_p95 (length over the shortest answer of all), ms (median).
    """
    holed = table["data"] == HOLE
    asked = table[~holed & (table["query"] >= 0)]
    lengths = asked[asked["figure"] == "length_rad"]
    best = lengths.groupby("query")["value"].min()
    solvable = best[best.notna()].index
    rows: list[Any] = table[table["query"] < 0].to_dict("records")
    keys = ["data", "dim", "seed", "method"]
    for key, own in asked[asked["query"].isin(solvable)].groupby(keys, sort=False):
        length = own[own["figure"] == "length_rad"].set_index("query")["value"]
        ratio = (length / best[length.index]).dropna()
        figures = {
            "solved": float(length.notna().mean()),
            "ratio_median": float(ratio.median()),
            "ratio_p95": float(ratio.quantile(0.95)),
            "ms": float(own[own["figure"] == "ms"]["value"].median()),
        }
        named = dict(zip(keys, key, strict=True))
        rows += [named | {"figure": name, "value": value} for name, value in figures.items()]
    found: dict[str, Any] = {}
    for (data, dim, method, figure), part in pd.DataFrame(rows).groupby(
        ["data", "dim", "method", "figure"], sort=False
    ):
        values = part["value"].dropna()
        spread = {"mean": values.mean(), "least": values.min(), "largest": values.max()}
        place = found.setdefault(str(data), {}).setdefault(str(dim), {}).setdefault(str(method), {})
        place[str(figure)] = {k: None if np.isnan(v) else float(v) for k, v in spread.items()}
    return {"charts": found, "solvable": len(solvable), "queries": int(asked["query"].nunique())}
