"""Constraints from demonstrations whose formula is hidden: what identification and other methods
make of the same rows, and how well their paths keep to the formula.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from constraint_geodesics.studies.hidden_tasks import HOLE, HOLE_M, ROWS, TASKS, HiddenTask
from constraint_geodesics.studies.local_models import Answer, LocalModels, NearestRows, poses_of

FORMULA, IDENTIFIED, WITHIN = "formula", "identified", "identified, where shown"
ROUNDED, COMPARED = "identified, rounded", "identified, as asked of peers"
AS_NETWORKS = "identified, as asked of networks"
TANGENTS, NEAREST = "local models of poses", "nearest rows"
PEERS = (TANGENTS, NEAREST)
LEVEL_SET, RESIDUAL = "level-set network", "residual network"
DESCENT, FLAT, POLICY = "VAE, geodesic", "VAE, no variance", "VAE, policy"
NETWORK_SEEDS = 3
"""Seeds that networks are trained on: that takes longest."""
LEARNED = (LEVEL_SET, RESIDUAL, DESCENT, FLAT, POLICY)
"""Those that studies/learned_demonstrations.py trains."""
APART_RAD = (0.4, 2.5)
"""How far apart the ends of a query are."""
TRIES, SCATTER_RAD = 400, 0.05
LEAST_MM, LEAST_DEG = 15.0, 2.0
"""How deep into the hole the formula's path goes, of the queries of that task; how far beyond a
tolerance the straight joint line does.
"""
Columns = dict[str, Any]
Query = tuple[np.ndarray, np.ndarray, float]
"""Start, goal, and the length of the path of the formula's planner [rad]."""
Answering = Callable[[np.ndarray, np.ndarray], Answer]


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
    def hidden(self) -> HiddenTask:
        """The task."""
        return TASKS[self.task]

    @property
    def named(self) -> Columns:
        """Columns that say which it is."""
        return {"task": self.task, "case": self.case.name, "seed": self.seed}

    def shown(self, scene: Scene) -> Any:
        """Its demonstrations."""
        return self.case.drawn(self.hidden, scene, 100 * self.seed)


def cells_of(params: Params, layout: Layout) -> list[Cell]:
    """All of them."""
    return [
        Cell(params, layout, task, case, seed)
        for task in params.demonstrations.tasks
        for case in cases_of(task)
        for seed in params.demonstrations.seeds
    ]


def measure(cell: Cell) -> list[Columns]:
    """Rows of one cell, of what has no training."""
    return list(_rows(cell))


def _rows(cell: Cell) -> Iterator[Columns]:
    scene = Scene.from_params(cell.params)
    shown = cell.shown(scene)
    began = time.perf_counter()
    found = identify(shown, scene.robot)
    seconds = time.perf_counter() - began
    about = {
        "codim": found.codim,
        "hidden_codim": cell.hidden.manifold(scene.robot).codim,
        "bounds": found.bounds,
        "hidden_bounds": int(cell.hidden.loosely_rad > 0.0),
        "asked_for_more": "show more" in found.missing or "further off" in found.missing,
        "identify_s": seconds,
        "noise_rad": found.noise_rad,
    }
    with Planner.load(cell.layout.planner) as planner:
        pairs = pairs_of(cell, planner, cell.settings.pairs)
        # the first plan draws the graph of a constraint, which no later one waits for
        for method, answer in _methods(cell, found, shown, planner).items():
            asked = pairs[: cell.settings.peer_pairs] if method in PEERS else pairs
            for row in asked_all(cell, scene.robot, method, answer, asked):
                yield row | about


def asked_all(
    cell: Cell, robot: SerialRobot, method: str, answer: Answering, pairs: Sequence[Query]
) -> Iterator[Columns]:
    """A method's answers to queries, one row each."""
    for number, (start, goal, length) in enumerate(pairs):
        judged = _judged(cell.hidden, robot, answer(start, goal), length)
        yield cell.named | {"method": method, "query": number} | judged


def flat_rows(shown: Any) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n, D) of demonstrations, and the demonstration (n,) of each; independent rows are one
    each.
    """
    if not isinstance(shown, list):
        return shown, np.arange(len(shown))
    return np.concatenate(shown), np.repeat(np.arange(len(shown)), [len(own) for own in shown])


def pairs_of(cell: Cell, planner: Planner, count: int) -> list[Query]:
    """The first queries that the formula's planner solves within the region that is shown, or
    through the hole.
    """
    task, rng = cell.hidden, np.random.default_rng(9000 + cell.seed)
    ends = task.draw(planner.scene.now, 1500, 9000 + cell.seed)
    own, found = task.manifold(planner.robot).constraint, []
    for _ in range(TRIES * count):
        start = ends[rng.integers(len(ends))]
        away = np.linalg.norm(ends - start, axis=1)
        near = np.flatnonzero((away > APART_RAD[0]) & (away < APART_RAD[1]))
        if not len(near):
            continue
        goal = ends[near[rng.integers(len(near))]]
        if not _asks(cell, planner.robot, start, goal):
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
        if len(found) == count:
            break
    return found


def _asks(cell: Cell, robot: SerialRobot, start: np.ndarray, goal: np.ndarray) -> bool:
    """Whether a query tells a planner that knows of a hole, or of a tolerance, from one that does
    not.
    """
    if cell.task == "hole":
        return _across(robot, start, goal)
    if not cell.hidden.loosely_rad:
        return True
    t = np.linspace(0.0, 1.0, 50)[:, None]
    return bool(cell.hidden.missed(robot, start + t * (goal - start))[0].max() > LEAST_DEG)


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


def _methods(
    cell: Cell, found: Identified, shown: Any, planner: Planner
) -> Mapping[str, Answering]:
    """Everything that is held against each other."""
    hidden = cell.hidden.manifold(planner.robot)
    methods: dict[str, Answering] = {FORMULA: _planned(planner, hidden.constraint)}
    methods[IDENTIFIED] = _nothing
    if found.constraint is not None:
        methods[IDENTIFIED] = _planned(planner, found.constraint)
        if found.rounded is not None:
            methods[ROUNDED] = _planned(planner, found.rounded.constraint)
        if cell.task == "hole" and found.supported is not None:
            methods[WITHIN] = _planned(planner, found.supported)
    rows, of = flat_rows(shown)
    methods[TANGENTS] = LocalModels(poses_of(planner.robot), rows, of, hidden.codim).answer
    methods[NEAREST] = NearestRows(rows, of).answer
    return methods


def _nothing(start: np.ndarray, goal: np.ndarray) -> Answer:  # noqa: ARG001
    """Where nothing was identified."""
    return "not_identified", None, 0.0


def _planned(planner: Planner, constraint: Any) -> Answering:
    """By the planner; the ends are moved onto the constraint first, as its users do."""

    def answer(start: np.ndarray, goal: np.ndarray) -> Answer:
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


def _judged(task: HiddenTask, robot: SerialRobot, own: Answer, length: float) -> Columns:
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
                found = identify(own, robot)
                held = {"codim": found.codim, "bounds": found.bounds}
                rows.append({"robot": robot.name, "seed": seed, "shown": how} | held)
    return rows


def _swept(first: np.ndarray, last: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A motion between two configurations with smooth detours."""
    t = np.linspace(0.0, 1.0, 60)[:, None]
    waves = np.sin(np.pi * t * np.arange(1, 4)) @ rng.normal(size=(3, len(first)))
    found: np.ndarray = first + t * (last - first) + SCATTER_RAD * waves
    return found


def summary(table: pd.DataFrame, peer_pairs: int) -> dict[str, Any]:
    """Figures by task, case and method; medians and 95th percentiles over all paths of all seeds,
    and the largest over seeds of the seeds' medians.

    COMPARED: what is identified, on the queries that peers are asked; AS_NETWORKS: of the draws
    that networks are trained on.
    """
    figures: dict[str, Any] = {}
    asked = table[(table["method"] == IDENTIFIED) & (table["query"] < peer_pairs)]
    first = asked["seed"].unique()[:NETWORK_SEEDS]  # in the order of params.yaml
    few = asked[asked["seed"].isin(first)].assign(method=AS_NETWORKS)
    table = pd.concat([table, asked.assign(method=COMPARED), few])
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
        if "trained_s" in own:
            cell["trained_s"] = float(own["trained_s"].median())
        figures.setdefault(task, {}).setdefault(case, {})[method] = cell
    return figures


def by_cell(cells: Mapping[str, Any]) -> dict[str, tuple[Columns, Columns]]:
    """Figures of each task and case, with what tells them apart."""
    return {
        f"{task}, {case.name}": (
            {
                "task": task,
                "demonstrations": case.motions,
                "rows": case.rows or case.motions * ROWS,
                "noise_deg": case.noise_deg,
            },
            cells[task][case.name],
        )
        for task in cells
        for case in cases_of(task)
    }


def ranks(table: pd.DataFrame) -> dict[str, Any]:
    """How often the rank is right, or less was said with a word on what is missing."""
    each = table.groupby(["task", "case", "seed"]).first().reset_index()
    made = each["task"].map(lambda name: TASKS[name].made_for)
    less = (each["codim"] < each["hidden_codim"]) | (each["bounds"] < each["hidden_bounds"])
    more = (each["codim"] > each["hidden_codim"]) | (each["bounds"] > each["hidden_bounds"])
    right, refused = ~(less | more), less & ~more & each["asked_for_more"]
    wrong = each[~(right | refused)]
    return {
        "cells": len(each),
        "right": float(right.mean()),
        "right_or_refused": float((right | refused).mean()),
        "right_where_made_for": float(right[made].mean()),
        "too_many": int(more.sum()),
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
    name, case, scene = "wavy surface", OF_SURFACES[-1], Scene.from_params(params)
    cell = Cell(params, layout, name, case, params.demonstrations.seeds[0])
    task, shown = cell.hidden, cell.shown(scene)
    found = identify(shown, scene.robot)
    constraint = found.constraint
    if not isinstance(constraint, SplineConstraint):
        raise ValueError(f"{name}, {case.name}: no surface was identified: {found.explanation}")
    with Planner.load(layout.planner) as planner:
        ask, paths = _planned(planner, constraint), []
        for start, goal, _ in pairs_of(cell, planner, cell.settings.pairs):
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
