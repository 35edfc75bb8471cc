"""Constraints from demonstrations whose formula is hidden: what identification and other methods
make of the same rows, and how well their paths keep to the formula.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.identification import Identified, identify
from constraint_geodesics.params import DemonstrationsParams, Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.planner import Planner, PlannerError
from constraint_geodesics.robot.kinematics import SerialRobot, load_robot
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.arms import ARMS
from constraint_geodesics.studies.hidden_tasks import HOLE, HOLE_M, TASKS, HiddenTask
from constraint_geodesics.studies.local_models import NearestRows, PoseTangents

FORMULA, IDENTIFIED, WITHIN = "formula", "identified", "identified, where shown"
TANGENTS, NEAREST = "local PCA on poses", "nearest rows"
PEERS = (TANGENTS, NEAREST)
APART_RAD = (0.4, 2.5)
"""How far apart the ends of a query are."""
LEAST_MM = 15.0
"""How deep into the hole the formula's path goes, of the queries of that task."""
Columns = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """How demonstrations are given: so many motions with a person's error, or independent rows
    with noise of each joint.
    """

    name: str
    motions: int
    rows: int
    noise_deg: float

    def drawn(self, task: HiddenTask, scene: Scene, seed: int) -> Any:
        """Demonstrations of a task."""
        if self.motions:
            return task.demonstrate(scene, self.motions, self.noise_deg, seed)
        q = task.draw(scene, self.rows, seed)
        noise = np.random.default_rng(seed + 7).normal(size=q.shape)
        return q + np.radians(self.noise_deg) * noise


CLEAN = Case("10 demonstrations, clean", 10, 0, 0.0)
HUMAN = Case("20 demonstrations, 0.3°", 20, 0, 0.3)
NOISY = Case("2,000 rows, 0.5°", 0, 2000, 0.5)
CASES = (CLEAN, HUMAN, NOISY)
OF_SURFACES = (
    Case("2,000 rows, clean", 0, 2000, 0.0),
    Case("10,000 rows, 0.5°", 0, 10_000, 0.5),
    Case("40 demonstrations, 0.3°", 40, 0, 0.3),
)
OF_HOLES = (Case("10,000 rows, clean", 0, 10_000, 0.0),)


def cases_of(task: str) -> tuple[Case, ...]:
    """Surfaces without a formula need more rows, and holes those beside them."""
    return {"wavy surface": OF_SURFACES, "torus": OF_SURFACES, "hole": OF_HOLES}.get(task, CASES)


@dataclass(frozen=True)
class Cell:
    """One task, shown in one way, with one seed; picklable."""

    params: Params
    layout: Layout
    task: str
    case: Case
    seed: int

    @property
    def settings(self) -> DemonstrationsParams:
        """Of the study."""
        return self.params.demonstrations

    @property
    def kept(self) -> Path:
        """Where its rows are until all cells are measured."""
        name = f"{self.task}-{self.case.name}-{self.seed}".replace(" ", "-").replace(",", "")
        return self.layout.scratch("benchmark_demonstrations", name) / "rows.json"


def cells_of(params: Params, layout: Layout) -> list[Cell]:
    """All of them."""
    return [
        Cell(params, layout, task, case, seed)
        for task in TASKS
        for case in cases_of(task)
        for seed in params.demonstrations.seeds
    ]


def measure(cell: Cell) -> list[Columns]:
    """Rows of one cell; those of an earlier run that was interrupted are taken as they are."""
    if cell.kept.is_file():
        found: list[Columns] = json.loads(cell.kept.read_text())
        return found
    rows = list(_rows(cell))
    cell.kept.parent.mkdir(parents=True, exist_ok=True)
    cell.kept.write_text(json.dumps(rows))
    return rows


def _rows(cell: Cell) -> Iterator[Columns]:
    task, scene = TASKS[cell.task], Scene.from_params(cell.params)
    named = {"task": cell.task, "case": cell.case.name, "seed": cell.seed}
    shown = cell.case.drawn(task, scene, 100 * cell.seed)
    began = time.perf_counter()
    found = identify(shown, scene.robot)
    seconds = time.perf_counter() - began
    about = {
        "codim": found.codim,
        "hidden_codim": task.manifold(scene.robot).codim,
        "missing": bool(found.missing),
        "identify_s": seconds,
        "noise_rad": found.noise_rad,
    }
    with Planner.load(cell.layout.planner) as planner:
        pairs = _pairs(cell, task, planner)
        # the first plan draws the graph of a constraint, which no later one waits for
        for method, answer in _methods(cell, found, shown, planner).items():
            peers = method in PEERS
            asked = pairs[: cell.settings.peer_pairs] if peers else pairs
            for number, (start, goal, length) in enumerate(asked):
                own = answer(start, goal)
                yield (
                    named
                    | about
                    | {"method": method, "query": number}
                    | _judged(task, scene.robot, own, length)
                )


def _pairs(
    cell: Cell, task: HiddenTask, planner: Planner
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Queries that the formula's planner solves, and the lengths of its paths [rad]."""
    rng = np.random.default_rng(9000 + cell.seed)
    ends = task.draw(planner.scene, 400, 9000 + cell.seed)
    own, found = task.manifold(planner.robot).constraint, []
    for _ in range(40 * cell.settings.pairs):
        start = ends[rng.integers(len(ends))]
        away = np.linalg.norm(ends - start, axis=1)
        near = np.flatnonzero((away > APART_RAD[0]) & (away < APART_RAD[1]))
        if not len(near):
            continue
        goal = ends[near[rng.integers(len(near))]]
        path = planner.plan(start, goal, own)
        if path.status != "solved":
            continue
        if cell.task != "hole" or _depth_mm(planner.robot, path.joints) > LEAST_MM:
            found.append((start, goal, _length(path.joints)))
        if len(found) == cell.settings.pairs:
            break
    return found


def _depth_mm(robot: SerialRobot, path: np.ndarray) -> float:
    """How far the tip enters the hole."""
    away = np.linalg.norm(robot.forward(path)[0] - HOLE, axis=1)
    return float(1e3 * (HOLE_M - away).max())


Answer = Callable[[np.ndarray, np.ndarray], tuple[str, np.ndarray | None, float]]
"""Status, path (T, D) and milliseconds of a query."""


def _methods(cell: Cell, found: Identified, shown: Any, planner: Planner) -> Mapping[str, Answer]:
    """Everything that is held against each other."""
    methods: dict[str, Answer] = {
        FORMULA: _planned(planner, TASKS[cell.task].manifold(planner.robot).constraint)
    }
    if found.constraint is not None:
        methods[IDENTIFIED] = _planned(planner, found.constraint)
        if cell.task == "hole" and found.supported is not None:
            methods[WITHIN] = _planned(planner, found.supported)
    rows = np.concatenate(shown) if isinstance(shown, list) else shown
    codim = TASKS[cell.task].manifold(planner.robot).codim
    methods[TANGENTS] = PoseTangents(planner.robot, rows, codim).answer
    methods[NEAREST] = NearestRows(rows).answer
    return methods


def _planned(planner: Planner, constraint: Any) -> Answer:
    """By the planner; the ends are moved onto the constraint first, as its users do."""

    def answer(start: np.ndarray, goal: np.ndarray) -> tuple[str, np.ndarray | None, float]:
        began = time.perf_counter()
        try:
            first, last = (planner.project(q, constraint).configuration for q in (start, goal))
        except PlannerError:
            return "not_projected", None, 1e3 * (time.perf_counter() - began)
        path = planner.plan(first, last, constraint)
        ms = 1e3 * (time.perf_counter() - began)
        return path.status, path.joints if path.status == "solved" else None, ms

    planner.prepare(constraint)
    return answer


def _judged(
    task: HiddenTask, robot: SerialRobot, own: tuple[str, np.ndarray | None, float], length: float
) -> Columns:
    """What the hidden formula says of a path: the worst violation, in degrees and mm."""
    status, path, ms = own
    row: Columns = {"status": status, "ms": ms, "deg": None, "mm": None, "ratio": None}
    if path is None:
        return row
    degrees, mm = task.missed(robot, path)
    row["deg"], row["mm"] = float(degrees.max()), float(mm.max())
    row["ratio"] = _length(path) / length
    if task.name == "hole":
        row["depth_mm"] = _depth_mm(robot, path)
    return row


def _length(path: Float[np.ndarray, "T D"]) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def free_arms() -> list[SerialRobot]:
    """Those of PyBullet's data."""
    return [load_robot(arm.path, arm.tool_link) for arm in ARMS.values() if not arm.in_robot_data]


def free_motion(robots: Sequence[SerialRobot], seeds: Sequence[int]) -> list[Columns]:
    """What is identified in motion that keeps to nothing."""
    rows = []
    for robot in robots:
        for seed in seeds:
            found = identify(robot.sample(2000, np.random.default_rng(seed)), robot)
            rows.append({"robot": robot.name, "seed": seed, "codim": found.codim})
    return rows


def summary(table: pd.DataFrame) -> dict[str, Any]:
    """Figures by task, case and method; medians and 95th percentiles over all paths of all seeds,
    and the largest over seeds of the seeds' medians.
    """
    figures: dict[str, Any] = {}
    for named, own in table.groupby(["task", "case", "method"], sort=False):
        task, case, method = map(str, named)
        solved = own[own["status"] == "solved"]
        by_seed = solved.groupby("seed")
        cell: dict[str, Any] = {
            "queries": len(own),
            "solved": len(solved) / len(own),
            "ratio_median": _quantile(solved["ratio"], 0.5),
            "ms_median": _quantile(solved["ms"], 0.5),
            "ms_p95": _quantile(solved["ms"], 0.95),
        }
        for name in ("deg", "mm", "depth_mm"):
            if name in solved and solved[name].notna().any():
                cell[name] = _quantile(solved[name], 0.5)
                cell[f"{name}_p95"] = _quantile(solved[name], 0.95)
                cell[f"{name}_worst_seed"] = float(by_seed[name].median().max())
        if method == IDENTIFIED:
            each = own.groupby("seed").first()
            cell["identify_s"] = float(each["identify_s"].median())
        figures.setdefault(task, {}).setdefault(case, {})[method] = cell
    return figures


def ranks(table: pd.DataFrame) -> dict[str, Any]:
    """How often the rank is right, or less was said with a word on what is missing."""
    each = table.groupby(["task", "case", "seed"]).first().reset_index()
    made = each["task"].map(lambda name: TASKS[name].made_for)
    right = each["codim"] == each["hidden_codim"]
    refused = (each["codim"] < each["hidden_codim"]) & each["missing"]
    wrong = each[~(right | refused)]
    return {
        "cells": len(each),
        "right": float(right.mean()),
        "right_or_refused": float((right | refused).mean()),
        "right_where_made_for": float(right[made].mean()),
        "too_many": int((each["codim"] > each["hidden_codim"]).sum()),
        "wrong": [f"{r.task}, {r.case}, seed {r.seed}: {r.codim}" for r in wrong.itertuples()],
    }


def _quantile(values: pd.Series, share: float) -> float | None:
    own = values.dropna()
    return float(own.quantile(share)) if len(own) else None
