"""What a change of the scene costs, and what the planner answers to it: a sphere on the way, a cup
that is carried, a sphere that comes up while the arm moves.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count as counted
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import ConvexHull

from constraint_geodesics.benchmark.dense_check import DENSE_RAD
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.dataset import draw_queries
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.planner import Planner, limits_of
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.studies.clutter import MAKERS, write_bracket
from constraint_geodesics.studies.episodes import stop_on
from constraint_geodesics.studies.problem_runs import quantiles
from constraint_geodesics.text_files import write_text
from constraint_geodesics.trajectory import Trajectory

RADII_M, MIDDLE = (0.05, 0.08), (0.3, 0.7)
"""Of a sphere, and the share of the path without it at which the arm meets it."""
OFF_M = 0.03
"""Standard deviation by which it is beside the tool."""
SHORTEST_RAD = 1.0
"""Of the paths that a sphere is put on."""
BUDGETS_S = (None, 0.03, 0.1, 0.5)
"""None: the first answer; the last is the reference for lengths."""
LONGEST_S = 10.0
"""Where none of these solves."""
SUDDEN = 0.25
"""Share of the motion at which a sphere comes up."""
TRIES = 20
TRIANGLES = 5000
"""Of a large mesh."""
ON_THE_WAY = (0.02, 0.98)
"""Shares of a motion at which it is to stop."""
HALF_M = 0.05
"""About half as large are the shapes that change."""
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


def touches(path: Trajectory, scene: Scene) -> bool:
    """Whether PyBullet, in a world of its own, finds anything in touch on a path, a stop's too,
    asked every DENSE_RAD.  scene: what stands there, whatever the path says.
    """
    if len(path.joints) < 2:
        return False
    with scene.world() as world:
        return world.first_collision(densify(path.joints, DENSE_RAD)) is not None


def _row(path: Trajectory, scene: Scene, **about: Any) -> dict[str, Any]:
    solved = path.status == "solved"
    return about | {
        "status": path.status,
        "source": path.source,
        "ms": 1e3 * path.planning_time_s,
        "length_rad": path.length_rad if solved else np.nan,
        "touches": touches(path, scene),
    }


def beside_a_sphere(planner: Planner, name: str, count: int, seed: int) -> Rows:
    """Queries whose path without it runs into a sphere, ends clear of it, with each budget; with
    LONGEST_S where none of them solves.
    """
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
        around, solved = path.scene.adding(ball), False
        for budget in (*BUDGETS_S, LONGEST_S):
            if solved and budget == LONGEST_S:
                break
            found = planner.plan(start, goal, name, scene=[ball], budget_s=budget)
            solved |= found.status == "solved"
            about = {"constraint": name, "query": number, "budget_ms": 1e3 * (budget or 0.0)}
            yield _row(found, around, **about)
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
            yield _row(planner.plan(*pair, name), scene, constraint=name, query=number)
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
        began = time.perf_counter()
        planner.scene.add(ball)
        answer = planner.replan(path, at_s)
        spent = 1e3 * (time.perf_counter() - began)
        valid = answer.certificate is not None and answer.certificate.valid
        row = _row(answer, planner.scene.now, constraint=name, query=number, certified=valid)
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
    """Milliseconds of each change of a shape of each kind, among other shapes."""
    rng = np.random.default_rng(seed)
    for k in range(others):
        planner.scene.add(Box(f"other {k}", _somewhere(rng).position_m, (0.02, 0.02, 0.02)))
    try:
        with TemporaryDirectory() as folder:
            bracket = write_bracket(Path(folder))
            for number, (kind, make) in product(range(count), MAKERS.items()):
                # new ones, but for the parts of the mesh
                halves = HALF_M * rng.uniform(0.9, 1.1, size=2)
                crate, load = (
                    make(name, _somewhere(rng), half, rng, bracket)
                    for name, half in zip(("crate", "load"), halves.tolist(), strict=True)
                )
                about = {"shape": kind, "among": others, "query": number}
                for change, spent in _changed(planner, crate, load, _somewhere(rng)):
                    yield about | {"change": change, "ms": spent}
    finally:
        planner.scene.remove(*(f"other {k}" for k in range(others)))


def _somewhere(rng: np.random.Generator) -> Placement:
    return Placement(tuple(rng.uniform((0.4, -0.9, 0.1), (0.9, 0.9, 1.0)).tolist()))


def _changed(
    planner: Planner, shape: Shape, load: Shape, elsewhere: Placement
) -> Iterator[tuple[str, float]]:
    """load: which the scene has not had before, but for a mesh, whose parts are kept."""
    scene, link = planner.scene, planner.robot.tool_link
    held = load.placed(Placement((0.0, 0.0, 0.1)))
    steps: Sequence[tuple[str, Callable[[], object]]] = (
        ("add", lambda: scene.add(shape)),
        ("move", lambda: scene.move(shape.name, elsewhere)),
        ("remove", lambda: scene.remove(shape.name)),
        ("attach", lambda: scene.attach(held, link=link)),
        ("detach", lambda: scene.detach(held.name)),
    )
    for kind, change in steps:
        yield kind, _spent_ms(change)


def _spent_ms(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - began)


def large_meshes(planner: Planner, count: int, seed: int) -> Rows:
    """Milliseconds of adding meshes of TRIANGLES that no process has seen before: a ball, and a
    ring, which is divided into convex parts.
    """
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        for number, (name, make) in product(range(count), (("ball", _ball), ("ring", _ring))):
            corners, faces = make()
            corners = corners * rng.uniform(0.9, 1.1)  # another file to every memory
            lines = [f"v {x} {y} {z}" for x, y, z in corners]
            lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
            file = Path(folder) / f"{name}{number}.obj"
            write_text(file, "\n".join(lines) + "\n")
            shape = Mesh("mesh", file, Placement((0.7, 0.5, 0.3)))
            spent = _spent_ms(partial(planner.scene.add, shape))
            planner.scene.remove("mesh")
            yield {"mesh": name, "triangles": len(faces), "query": number, "ms": spent}


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """Corners [m] and triangles, the corners of each anticlockwise from outside."""
    height = np.linspace(-1.0, 1.0, TRIANGLES // 2 + 2)
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(len(height))
    away = np.sqrt(1.0 - height**2)
    corners = 0.1 * np.stack([away * np.cos(turn), away * np.sin(turn), height], axis=1)
    faces = ConvexHull(corners).simplices
    a, b, c = np.moveaxis(corners[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return corners, faces


def _ring() -> tuple[np.ndarray, np.ndarray]:
    side = round(np.sqrt(TRIANGLES / 2))
    k, m = np.divmod(np.arange(side**2), side)
    round_it, across = 2.0 * np.pi * k / side, 2.0 * np.pi * m / side
    away = 0.1 + 0.03 * np.cos(across)
    corners = [away * np.cos(round_it), away * np.sin(round_it), 0.03 * np.sin(across)]
    next_k, next_m = (k + 1) % side, (m + 1) % side
    first, on, up = k * side + m, next_k * side + m, k * side + next_m
    both = next_k * side + next_m
    faces = np.concatenate([np.stack([first, on, both], 1), np.stack([first, both, up], 1)])
    return np.stack(corners, axis=1), faces


def after_a_first_shape(planner: Planner, names: Sequence[str]) -> Rows:
    """Milliseconds in which the roadmap of each constraint is made anew, once a shape is gone that
    the planner was loaded with; the planner's scene is another one afterwards.
    """
    planner.scene.remove(planner.scene.workcell[-1].name)
    for name in names:
        yield {"constraint": name, "ms": _spent_ms(partial(planner.nodes, name))}


def stops(planner: Planner, name: str, count: int, seed: int) -> Rows:
    """Whether there is a stop at random moments of motions, on the path's own lines or drawn anew,
    and whether it is certified when it is looked at in the scene.
    """
    rng, bundle = np.random.default_rng(seed + 1), planner.bundle
    limits = limits_of(bundle.planner, bundle.judge, planner.robot)
    with Certifier(planner.scene.now, limits) as certifier:
        for number, path in zip(range(count), _long_paths(planner, name, seed), strict=False):
            stop = stop_on(path, rng.uniform(*ON_THE_WAY) * float(path.times[-1]))
            about = {"constraint": name, "query": number}
            if stop is None:
                yield about | {"status": "none", "touches": False}
            else:
                hit = touches(stop, planner.scene.now)
                yield about | {"status": _looked_at(stop, certifier), "touches": hit}


def _looked_at(stop: Trajectory, certifier: Certifier) -> str:
    found = "drawn anew" if stop.certificate is None else "on the path's lines"
    looked = certifier.certify(
        stop.joints, stop.constraint, times=stop.times, start_velocity=stop.start_velocity
    )
    return found if looked.valid else f"{found}, not certified"


def sphere_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """By constraint and together: what is solved of what any budget solves, times of all answers,
    and lengths over the shortest of all budgets.
    """
    best = rows.groupby(["constraint", "query"]).length_rad.transform("min")
    never = rows[best.isna()].drop_duplicates(["constraint", "query"])
    rows = rows.assign(ratio=rows.length_rad / best)[best.notna()]
    rows = rows[rows.budget_ms < 1e3 * LONGEST_S]
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
            **quantiles("ms", own.ms),
            **quantiles("ratio", solved.ratio),
        }
    return found


def answer_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """How many of each status, times of all, and how many touch something; of the certified, where
    a row says whether it is.
    """
    found = {
        "queries": len(rows),
        "statuses": {str(k): int(n) for k, n in rows.status.value_counts().items()},
        "touching": int(rows.touches.sum()),
    }
    if "ms" in rows:
        found |= quantiles("ms", rows.ms)
    if "certified" in rows:
        found["certified"] = int(rows.certified.fillna(False).sum())
    return found


def by_constraint(rows: pd.DataFrame) -> dict[str, Any]:
    """As `answer_figures`, of all rows and of each constraint's."""
    groups = [("all", rows), *rows.groupby("constraint", sort=False)]
    return {str(name): answer_figures(own) for name, own in groups}


def change_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """Medians [ms] by how many other shapes there are and the kind of change, over all kinds of
    shapes; the 95th percentiles; and the medians of each kind of shape.
    """
    found: dict[str, Any] = {}
    for among, own in rows.groupby("among"):
        by_change = own.groupby("change").ms
        by_shape = own.groupby(["shape", "change"]).ms.median().unstack()
        found[str(among)] = {
            **by_change.median().to_dict(),
            **by_change.quantile(0.95).add_suffix("_p95").to_dict(),
            "by_shape": by_shape.to_dict(orient="index"),
        }
    return found


def mesh_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """Triangles, and how long adding one took, of a ball and of a ring."""
    return {
        str(name): {"triangles": int(own.triangles.iloc[0]), **quantiles("ms", own.ms)}
        for name, own in rows.groupby("mesh", sort=False)
    }
