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

from constraint_geodesics.constraints.spline import Spline, SplineConstraint
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
TANGENTS, NEAREST = "local models of poses", "nearest rows"
PEERS = (TANGENTS, NEAREST)
APART_RAD = (0.4, 2.5)
"""How far apart the ends of a query are."""
TRIES, SCATTER_RAD = 400, 0.05
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
        "asked_for_more": "show more" in found.missing or "further off" in found.missing,
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
    """Queries that the formula's planner solves within the region that is shown, or through the
    hole, and the lengths of its paths [rad].
    """
    rng = np.random.default_rng(9000 + cell.seed)
    ends = task.draw(planner.scene, 1500, 9000 + cell.seed)
    own, found = task.manifold(planner.robot).constraint, []
    for _ in range(TRIES * cell.settings.pairs):
        start = ends[rng.integers(len(ends))]
        away = np.linalg.norm(ends - start, axis=1)
        near = np.flatnonzero((away > APART_RAD[0]) & (away < APART_RAD[1]))
        if not len(near):
            continue
        goal = ends[near[rng.integers(len(near))]]
        if cell.task == "hole" and not _across(planner.robot, start, goal):
            continue
        path = planner.plan(start, goal, own)
        if path.status != "solved":
            continue
        if cell.task == "hole":
            good = _depth_mm(planner.robot, path.joints) > LEAST_MM
        else:  # demonstrations say nothing of where there were none
            good = bool(task.shown(*planner.robot.forward(path.joints)).all())
        if good:
            found.append((start, goal, _length(path.joints)))
        if len(found) == cell.settings.pairs:
            break
    return found


def _across(robot: SerialRobot, start: np.ndarray, goal: np.ndarray) -> bool:
    """Whether the hole lies between two places of the tip."""
    first, last = robot.forward(np.stack([start, goal]))[0]
    t = np.linspace(0.0, 1.0, 50)[:, None]
    away = np.linalg.norm(first + t * (last - first) - HOLE, axis=1)
    return bool(away.min() < HOLE_M - LEAST_MM / 1e3)


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
    methods[IDENTIFIED] = _nothing
    if found.constraint is not None:
        methods[IDENTIFIED] = _planned(planner, found.constraint)
        if cell.task == "hole" and found.supported is not None:
            methods[WITHIN] = _planned(planner, found.supported)
    rows = np.concatenate(shown) if isinstance(shown, list) else shown
    codim = TASKS[cell.task].manifold(planner.robot).codim
    lengths = [len(own) for own in shown] if isinstance(shown, list) else []
    of = np.repeat(np.arange(len(lengths)), lengths) if lengths else np.arange(len(rows))
    methods[TANGENTS] = PoseTangents(planner.robot, rows, of, codim).answer
    methods[NEAREST] = NearestRows(rows, of).answer
    return methods


def _nothing(start: np.ndarray, goal: np.ndarray) -> tuple[str, np.ndarray | None, float]:  # noqa: ARG001
    """Where nothing was identified."""
    return "not_identified", None, 0.0


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
    """What is identified in motion that keeps to nothing: in independent rows, in motions between
    any ends, and in motions that are repeated with some scatter.
    """
    rows = []
    for robot in robots:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            ends = 0.5 * robot.sample(20, rng).reshape(10, 2, robot.dof)
            again = ends[:1] + SCATTER_RAD * rng.normal(size=ends.shape)
            shown = {
                "rows": robot.sample(2000, rng),
                "motions": [_swept(own[0], own[1], rng) for own in ends],
                "repeated": [_swept(own[0], own[1], rng) for own in again],
            }
            for how, own in shown.items():
                codim = identify(own, robot).codim
                rows.append({"robot": robot.name, "seed": seed, "shown": how, "codim": codim})
    return rows


def _swept(first: np.ndarray, last: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A motion between two configurations with smooth detours."""
    t = np.linspace(0.0, 1.0, 60)[:, None]
    waves = np.sin(np.pi * t * np.arange(1, 4)) @ rng.normal(size=(3, len(first)))
    found: np.ndarray = first + t * (last - first) + SCATTER_RAD * waves
    return found


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
    refused = (each["codim"] < each["hidden_codim"]) & each["asked_for_more"]
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


@dataclass(frozen=True)
class Example:
    """One draw of a surface to be looked at: demonstrated places [m], the identified surface, and a
    path's places (T, 3) [m], tool axes (T, 3), and how far it is off the hidden formula.
    """

    title: str
    shown: list[np.ndarray]
    surface: Spline
    path: Float[np.ndarray, "T 3"]
    axes: Float[np.ndarray, "T 3"]
    off_deg: Float[np.ndarray, "T"]
    off_mm: Float[np.ndarray, "T"]


def example(params: Params, layout: Layout) -> Example:
    """The longest of some paths on the surface that forty demonstrations with a person's error keep
    to.
    """
    name, case = "wavy surface", OF_SURFACES[-1]
    task, scene = TASKS[name], Scene.from_params(params)
    cell = Cell(params, layout, name, case, params.demonstrations.seeds[0])
    shown = case.drawn(task, scene, 100 * cell.seed)
    found = identify(shown, scene.robot)
    constraint = found.constraint
    if not isinstance(constraint, SplineConstraint):
        raise ValueError(f"{name}, {case.name}: no surface was identified: {found.explanation}")
    with Planner.load(layout.planner) as planner:
        ask, paths = _planned(planner, constraint), []
        for start, goal, _ in _pairs(cell, task, planner):
            _, path, _ = ask(start, goal)
            if path is not None and task.shown(*scene.robot.forward(path)).all():
                paths.append(path)
    path = max(paths, key=_length)
    position, rotation = scene.robot.forward(path)
    degrees, mm = task.missed(scene.robot, path)
    title = (
        f"{case.motions} demonstrations with an error of {case.noise_deg}° (grey), a planned path"
    )
    tips = [scene.robot.forward(rows)[0] for rows in shown]
    return Example(title, tips, constraint.splines[0], position, rotation[:, :, 2], degrees, mm)
