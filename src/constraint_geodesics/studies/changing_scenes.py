"""What a change of the scene costs, and what the planner answers to it: a sphere on the way, a cup
that is carried, a sphere that comes up while the arm moves.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from itertools import count as counted
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.constraints.constraint import ConstraintManifold, Pose
from constraint_geodesics.learning.dataset import draw_queries
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.studies.cup import carried_cup
from constraint_geodesics.studies.episodes import stop_on
from constraint_geodesics.studies.problem_runs import DENSE_RAD, quantiles
from constraint_geodesics.trajectory import Trajectory

RADII_M, MIDDLE = (0.05, 0.08), (0.3, 0.7)
"""Of a sphere, and the share of the path without it at which the arm meets it."""
OFF_M = 0.03
"""Standard deviation by which it is beside the tool."""
SHORTEST_RAD = 1.0
"""Of the paths that a sphere is put on."""
BUDGETS_S = (None, 0.03, 0.1, 0.5)
"""None: the first answer; the last is the reference for lengths."""
SUDDEN = 0.25
"""Share of the motion at which a sphere comes up."""
TRIES = 20
DRAWN = 100
"""Pairs of ends at a time."""

Rows = Iterator[dict[str, Any]]


def pairs(planner: Planner, name: str, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Free ends drawn like the data, none of which is of the planner's roadmap, without end."""
    scene = planner.scene.now
    manifold = ConstraintManifold(scene.robot, planner.constraints[name])
    for attempt in counted():
        ends = draw_queries(scene, manifold, name, DRAWN, seed + 1000 * attempt)
        yield from zip(ends.starts, ends.goals, strict=True)


def _long_paths(planner: Planner, name: str, seed: int) -> Iterator[Trajectory]:
    """Those between such ends that something can be put on."""
    for start, goal in pairs(planner, name, seed):
        path = planner.plan(start, goal, name)
        if path.status == "solved" and path.length_rad >= SHORTEST_RAD:
            yield path


def touches(path: Trajectory) -> bool:
    """Whether PyBullet, in a world of its own, finds anything in touch on a path, asked every
    DENSE_RAD.
    """
    if path.status != "solved":
        return False
    with path.scene.world() as world:
        return world.first_collision(densify(path.joints, DENSE_RAD)) is not None


def _row(path: Trajectory, **about: Any) -> dict[str, Any]:
    solved = path.status == "solved"
    return about | {
        "status": path.status,
        "source": path.source,
        "ms": 1e3 * path.planning_time_s,
        "length_rad": path.length_rad if solved else np.nan,
        "touches": touches(path),
    }


def beside_a_sphere(planner: Planner, name: str, count: int, seed: int) -> Rows:
    """Queries whose path without it runs into a sphere, ends clear of it, with each budget."""
    rng, number = np.random.default_rng(seed + 1), 0
    for path in _long_paths(planner, name, seed):
        if number == count:
            return
        start, goal = path.joints[[0, -1]]
        tool, _ = planner.robot.forward(path.at(rng.uniform(*MIDDLE)))
        place = tuple((tool + OFF_M * rng.normal(size=3)).tolist())
        ball = Sphere("ball", place, rng.uniform(*RADII_M))
        if not _meets(ball, path, np.stack([start, goal])):
            continue
        for budget in BUDGETS_S:
            found = planner.plan(start, goal, name, scene=[ball], budget_s=budget)
            about = {"constraint": name, "query": number, "budget_ms": 1e3 * (budget or 0.0)}
            yield _row(found, **about)
        number += 1


def _meets(ball: Sphere, path: Trajectory, free: np.ndarray) -> bool:
    """Whether a path runs into a ball that certain configurations are free of, by PyBullet."""
    around = path.scene.adding(ball)
    with around.world() as world:
        touched = world.first_collision(densify(path.joints, DENSE_RAD)) is not None
        return bool(world.free(free).all()) and touched


def loaded(planner: Planner, scene: Scene, name: str, count: int, seed: int) -> Rows:
    """Queries in a scene in which the arm carries something, between ends that are free with it."""
    before, manifold = planner.scene.now, ConstraintManifold(scene.robot, planner.constraints[name])
    ends = draw_queries(scene, manifold, name, count, seed)
    planner.scene.become(scene)
    try:
        for number, pair in enumerate(zip(ends.starts, ends.goals, strict=True)):
            yield _row(planner.plan(*pair, name), constraint=name, query=number)
    finally:
        planner.scene.become(before)


def sudden(planner: Planner, name: str, count: int, seed: int) -> Rows:
    """Motions in whose way a sphere comes up, beyond where the arm could stop; one that can't be
    stopped at all is a row of its own, beside the `count`.
    """
    rng, number = np.random.default_rng(seed + 1), 0
    for path in _long_paths(planner, name, seed):
        if number == count:
            return
        at_s = SUDDEN * float(path.times[-1])
        stop = stop_on(path, at_s)
        if stop is None:
            yield {"constraint": name, "status": "no stop on the path", "touches": False}
            continue
        ball = _in_the_way(planner, path, stop, rng)
        if ball is None:
            continue
        planner.scene.add(ball)
        began = time.perf_counter()
        answer = planner.replan(path, at_s)
        spent = 1e3 * (time.perf_counter() - began)
        valid = answer.certificate is not None and answer.certificate.valid
        row = _row(answer, constraint=name, query=number, certified=valid)
        planner.scene.remove("sudden")
        yield row | {"ms": spent}
        number += 1


def _in_the_way(
    planner: Planner, path: Trajectory, stop: Trajectory, rng: np.random.Generator
) -> Sphere | None:
    """A sphere on a link's end that the rest of a path runs into, clear of stop and goal."""
    earliest = SUDDEN * float(path.times[-1]) + 1.05 * float(stop.times[-1])
    for _ in range(TRIES if earliest < path.times[-1] else 0):
        place = path.state(rng.uniform(earliest, float(path.times[-1]))).configuration
        ends = planner.robot.skeleton(place)[3:]
        middle = tuple(ends[rng.integers(len(ends))].tolist())
        ball = Sphere("sudden", middle, rng.uniform(*RADII_M))
        if _meets(ball, path, np.vstack([stop.joints, path.joints[-1:]])):
            return ball
    return None


def changes(planner: Planner, others: int, count: int, seed: int) -> Rows:
    """Milliseconds of each kind of change among other shapes."""
    rng = np.random.default_rng(seed)
    for k in range(others):
        place = tuple((rng.uniform((0.4, -0.9, 0.1), (0.9, 0.9, 1.0))).tolist())
        planner.scene.add(Box(f"other {k}", place, (0.02, 0.02, 0.02)))
    try:
        for number in range(count):
            for kind, spent in _changed(planner, rng):
                yield {"change": kind, "among": others, "query": number, "ms": spent}
    finally:
        planner.scene.remove(*(f"other {k}" for k in range(others)))


def _changed(planner: Planner, rng: np.random.Generator) -> Iterator[tuple[str, float]]:
    scene, link = planner.scene, planner.robot.tool_link
    crate = Box("crate", (0.6, 0.4, 0.2), (0.1, 0.1, 0.1))
    elsewhere = Pose(rng.uniform((0.4, -0.9, 0.1), (0.9, 0.9, 1.0)), np.eye(3))
    cup = carried_cup(np.array([0.0, 1.0, 0.0]))
    steps: Sequence[tuple[str, Callable[[], object]]] = (
        ("add", lambda: scene.add(crate)),
        ("move", lambda: scene.move("crate", elsewhere)),
        ("remove", lambda: scene.remove("crate")),
        ("attach", lambda: scene.attach(cup, link=link)),
        ("detach", lambda: scene.detach("cup")),
    )
    for kind, change in steps:
        began = time.perf_counter()
        change()
        yield kind, 1e3 * (time.perf_counter() - began)


def sphere_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """By constraint and together: what is solved of what any budget solves, times, and lengths over
    the shortest of all budgets.
    """
    best = rows.groupby(["constraint", "query"]).length_rad.transform("min")
    never = rows[best.isna()].drop_duplicates(["constraint", "query"])
    rows = rows.assign(ratio=rows.length_rad / best)[best.notna()]
    groups = [("all", rows), *rows.groupby("constraint", sort=False)]
    found = {str(name): _by_budget(own) for name, own in groups}
    return found | {"solved with no budget": len(never)}


def _by_budget(rows: pd.DataFrame) -> dict[str, Any]:
    found = {}
    for budget, own in rows.groupby("budget_ms"):
        solved = own[own.status == "solved"]
        found["first answer" if budget == 0.0 else f"{budget:.0f} ms"] = {
            "queries": len(own),
            "solved": len(solved),
            "touching": int(own.touches.sum()),
            **quantiles("ms", solved.ms),
            **quantiles("ratio", solved.ratio),
        }
    return found


def answer_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """How many of each status, times of all, and how many touch something."""
    return {
        "queries": len(rows),
        "statuses": {str(k): int(n) for k, n in rows.status.value_counts().items()},
        "touching": int(rows.touches.sum()),
        **quantiles("ms", rows.ms),
    }


def change_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """Medians [ms] by how many other shapes there are, and the kind of change."""
    medians = rows.groupby(["among", "change"]).ms.median().unstack()
    return {str(among): row.to_dict() for among, row in medians.iterrows()}
