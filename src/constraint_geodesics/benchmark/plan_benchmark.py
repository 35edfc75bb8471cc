"""The planner that users call, its parts one by one, and its peers, on queries that no training
saw.

Every path goes to the same certifier, whoever planned it, and every planner runs in one process on
one thread, after one query that is not counted.  Best known is the shortest certified path of all
planners of the table.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any, Protocol, get_args

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import judge_limits
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.learning.dataset import Queries
from constraint_geodesics.learning.lift import as_executed
from constraint_geodesics.params import BenchmarkParams, JudgeParams, PlanBenchmarkParams
from constraint_geodesics.peers.ompl import PlannerName, plan_all
from constraint_geodesics.pipeline.progress import progress
from constraint_geodesics.report.figures import PLANNERS
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World
from constraint_geodesics.search.band import BandSettings
from constraint_geodesics.search.candidates import Parts, Source, Task, refined, rows_of
from constraint_geodesics.search.roadmap import resample

PARTS = {
    "planner": Parts(),
    "without policy": Parts(policy=False),
    "straight": Parts(policy=False, graph=False, refinement=False, tree=False),
    "straight + band": Parts(policy=False, graph=False, tree=False),
    "policy": Parts(straight=False, graph=False, refinement=False, tree=False),
    "policy + band": Parts(straight=False, graph=False, tree=False),
    "graph": Parts(straight=False, policy=False, refinement=False, tree=False),
    "graph + band": Parts(straight=False, policy=False, tree=False),
    "trees + band": Parts(straight=False, policy=False, graph=False),
}
"""The planner whole and in parts, by the names the table shows."""
MULTI_START, BAND_AFTER, TANGENT = "band from many starts", "BiRRT + band", "BiRRT, tangent bundle"
SOURCES = get_args(Source)


class Solution(Protocol):
    """What is asked of a planner's answer."""

    @property
    def status(self) -> str:
        """Either solved, or why not."""
        ...

    @property
    def joints(self) -> Float[np.ndarray, "T D"]:
        """Rows [rad]."""
        ...

    @property
    def planning_time_s(self) -> float:
        """Everything."""
        ...

    @property
    def collision_time_s(self) -> float:
        """What PyBullet's check of the path took of it."""
        ...

    @property
    def source(self) -> str:
        """The proposal it came from."""
        ...


class Planner(Protocol):
    """What is asked of the planner that users call."""

    def plan(
        self,
        start: Float[np.ndarray, "D"],
        goal: Float[np.ndarray, "D"],
        constraint: Constraint,
        *,
        parts: Parts,
    ) -> Solution:
        """One query, with some of its parts."""
        ...

    def plan_batch(
        self,
        starts: Float[np.ndarray, "B D"],
        goals: Float[np.ndarray, "B D"],
        constraint: Constraint,
    ) -> Sequence[Solution]:
        """Many of them."""
        ...

    def nodes(self, constraint: Constraint) -> Float[np.ndarray, "n D"]:
        """Configurations of the constraint's graph."""
        ...


@dataclass(frozen=True)
class Found:
    """One planner's answer to one query: status, path (T, D) [rad] or (0, D), seconds, of which in
    PyBullet's check of the final path (nan where the check is part of the search), and the proposal
    it came from, where there are several.
    """

    status: str
    joints: Float[np.ndarray, "T D"]
    time_s: float
    check_time_s: float = float("nan")
    source: str = ""


Plan = Callable[[int], Found]
"""Answers the query of that index."""


def plan_rows(
    planner: Planner,
    scene: Scene,
    name: str,
    constraint: Constraint,
    queries: Queries,
    settings: PlanBenchmarkParams,
    band: BandSettings,
    benchmark: BenchmarkParams,
    judge: JudgeParams,
) -> tuple[pd.DataFrame, dict[tuple[str, int, int], Float[np.ndarray, "T D"]]]:
    """One row a planner, query and seed, certified, with best_known_rad; and the paths by (planner,
    query, seed).
    """
    manifold = ConstraintManifold(scene.robot, constraint)
    task = _task(scene, manifold, band)
    jobs: list[tuple[str, int, Plan]] = [
        (part, 0, _own(planner, queries, constraint, PARTS[part])) for part in settings.parts
    ]
    rows, paths = [], {}
    with Certifier(scene, judge_limits(judge)) as certifier, scene.world() as world:
        jobs.append((MULTI_START, 0, _multi_start(planner, task, queries, settings, world)))

        def keep(shown: str, seed: int, query: int, found: Found) -> None:
            row, valid = _judged(certifier, constraint, queries, query, found)
            rows.append({"planner": shown, "constraint": name, "query": query, "seed": seed, **row})
            if valid:
                paths[shown, query, seed] = found.joints

        peers = list(_peers(settings.peers, benchmark.space, manifold))
        with progress(f"plans {name}", len(jobs) + len(peers) * len(settings.seeds)) as advance:
            for shown, seed, plan in jobs:
                plan(0)
                for query in range(len(queries)):
                    keep(shown, seed, query, plan(query))
                advance()
            for shown, peer, space in peers:
                for seed in settings.seeds:
                    planned = plan_all(
                        peer,
                        benchmark.model_copy(update={"space": space}),
                        scene.robot,
                        constraint,
                        scene.workcell,
                        queries.starts,
                        queries.goals,
                        seed,
                    )
                    for query, path in enumerate(planned):
                        began = time.perf_counter()
                        joints = as_executed(manifold, path.joints, judge.row_spacing_rad)
                        found = Found(
                            path.status, joints, path.time_s + time.perf_counter() - began
                        )
                        keep(shown, seed, query, found)
                        if shown == PLANNERS["birrt"].label:
                            after = _after(
                                task, world, path.joints, path.status, judge.row_spacing_rad
                            )
                            keep(
                                BAND_AFTER,
                                seed,
                                query,
                                replace(after, time_s=after.time_s + path.time_s),
                            )
                    advance()
    table = pd.DataFrame(rows)
    best = table["length_rad"].where(table["valid"]).groupby(table["query"]).min()
    return table.assign(best_known_rad=table["query"].map(best)), paths


def plan_table(rows: pd.DataFrame) -> pd.DataFrame:
    """One row a constraint and planner: success over all queries and over those that any planner
    solved, paths called solved but not valid, length over best known, time with and without
    PyBullet's check of the final path.

    ratio_*: of the planner's own valid paths; ratio_p95_all: the 95th percentile over all queries
    that any planner solved, failures counted as infinitely long, so that leaving out what is hard
    is no merit.  Times are of all rows, failures too.  from_*: share of the valid paths from each
    proposal.
    """
    table = []
    for (constraint, planner), group in rows.groupby(["constraint", "planner"], sort=False):
        valid, solvable = group[group["valid"]], group[group["best_known_rad"].notna()]
        ratio = valid["length_rad"] / valid["best_known_rad"]
        bare = group["time_s"] - group["check_time_s"].fillna(0.0)
        table.append(
            {
                "constraint": constraint,
                "planner": planner,
                "queries": group["query"].nunique(),
                "solvable": solvable["query"].nunique(),
                "success": float(group["valid"].mean()),
                "success_of_solvable": float(solvable["valid"].mean()) if len(solvable) else np.nan,
                "claimed_but_invalid": int(((group["status"] == "solved") & ~group["valid"]).sum()),
                "ratio_median": _quantile(ratio, 0.5),
                "ratio_p95": _quantile(ratio, 0.95),
                "ratio_p95_all": _p95_with_failures(solvable),
                "time_median_ms": 1e3 * _quantile(bare, 0.5),
                "time_p95_ms": 1e3 * _quantile(bare, 0.95),
                "checked_median_ms": 1e3 * _quantile(group["time_s"], 0.5),
                "checked_p95_ms": 1e3 * _quantile(group["time_s"], 0.95),
                "violation_bound_max": float(valid["violation_bound"].max())
                if len(valid)
                else np.nan,
                **{
                    f"from_{source}": float((valid["source"] == source).mean())
                    for source in SOURCES
                },
            }
        )
    return pd.DataFrame(table)


def _p95_with_failures(solvable: pd.DataFrame) -> float:
    """The smallest ratio that 95 % of the rows do not pass; nan if fewer are valid."""
    ratio = (
        (solvable["length_rad"] / solvable["best_known_rad"])
        .where(solvable["valid"], np.inf)
        .sort_values()
    )
    worst = ratio.iloc[int(np.ceil(0.95 * len(ratio))) - 1] if len(ratio) else np.inf
    return float(worst) if np.isfinite(worst) else float("nan")


def batch_rate(
    planner: Planner, constraint: Constraint, queries: Queries, size: int
) -> dict[str, float]:
    """Queries answered a second in one batch of `size`, with PyBullet's check of the paths and
    without its time.
    """
    rows = np.arange(size) % len(queries)
    began = time.perf_counter()
    paths = planner.plan_batch(queries.starts[rows], queries.goals[rows], constraint)
    seconds = time.perf_counter() - began
    checking = float(np.nansum([path.collision_time_s for path in paths]))
    return {
        "size": size,
        "per_second": size / (seconds - checking),
        "checked_per_second": size / seconds,
    }


def _peers(
    names: Sequence[PlannerName], space: str, manifold: ConstraintManifold
) -> Iterator[tuple[str, PlannerName, str]]:
    """Label, planner and state space: BiRRT in the tangent bundle as well, which a tolerance does
    not have.
    """
    for name in names:
        yield PLANNERS[name].label, name, space
        if (
            name == "birrt"
            and not manifold.constraint.is_free
            and not manifold.rows.tolerance.any()
        ):
            yield TANGENT, name, "tangent_bundle"


def _own(planner: Planner, queries: Queries, constraint: Constraint, parts: Parts) -> Plan:
    def plan(query: int) -> Found:
        path = planner.plan(queries.starts[query], queries.goals[query], constraint, parts=parts)
        return Found(
            path.status, path.joints, path.planning_time_s, path.collision_time_s, path.source
        )

    return plan


def _multi_start(
    planner: Planner, task: Task, queries: Queries, settings: PlanBenchmarkParams, world: World
) -> Plan:
    """The shortest of many relaxed bands, each from a parabola bent past a configuration of the
    constraint.
    """
    past = planner.nodes(task.manifold.constraint)

    def plan(query: int) -> Found:
        rng = np.random.default_rng((settings.seed, query))
        start, goal = queries.starts[query], queries.goals[query]
        t = np.linspace(0.0, 1.0, task.settings.segments + 1)[:, None]
        line = (1.0 - t) * start + t * goal
        began = time.perf_counter()
        bends = rng.uniform(size=(settings.starts, 1)) * (
            past[rng.integers(len(past), size=settings.starts)] - line[len(line) // 2]
        )
        bends[0] = 0.0
        found = [refined(task, "straight", line + 4.0 * t * (1.0 - t) * bend) for bend in bends]
        sound = sorted((c for c in found if c is not None), key=lambda c: c.length)
        for candidate in sound:
            rows = rows_of(task, candidate, 1e-4)[1]
            asked = time.perf_counter()
            if world.first_collision(rows) is None:
                return Found(
                    "solved", rows, time.perf_counter() - began, time.perf_counter() - asked
                )
        return Found("not_found", np.empty((0, len(start))), time.perf_counter() - began)

    return plan


def _after(
    task: Task, world: World, joints: Float[np.ndarray, "T D"], status: str, spacing: float
) -> Found:
    """The elastic band after another planner's path, on the same kernels as the planner's own; the
    path itself, as it is executed, where the band jumps or touches something.
    """
    if status != "solved" or len(joints) < 2:
        return Found(status, joints, 0.0)
    began = time.perf_counter()
    for segments in (task.settings.segments, 4 * task.settings.segments):
        candidate = refined(task, "graph", resample(joints, segments + 1))
        if candidate is None:
            continue
        rows = rows_of(task, candidate, 1e-4)[1]
        asked = time.perf_counter()
        if world.first_collision(rows) is None:
            return Found(status, rows, time.perf_counter() - began, time.perf_counter() - asked)
    return Found(status, as_executed(task.manifold, joints, spacing), time.perf_counter() - began)


def _task(scene: Scene, manifold: ConstraintManifold, band: BandSettings) -> Task:
    return Task(manifold, clearance_model(scene.robot, scene.workcell), lambda: None, True, band)


def _judged(
    certifier: Certifier, constraint: Constraint, queries: Queries, query: int, found: Found
) -> tuple[dict[str, Any], bool]:
    about = {
        "status": found.status,
        "source": found.source,
        "time_s": found.time_s,
        "check_time_s": found.check_time_s,
    }
    if len(found.joints) < 2:
        nan = float("nan")
        empty = {
            "valid": False,
            "reason": "no path",
            "length_rad": nan,
            "max_violation": nan,
            "violation_bound": nan,
        }
        return about | empty, False
    certificate = certifier.certify(
        found.joints, constraint, queries.starts[query], queries.goals[query]
    )
    broken = certificate.violation
    measures = {
        "valid": certificate.valid,
        "reason": "" if broken is None else broken.kind,
        "length_rad": certificate.length_rad,
        "max_violation": certificate.max_violation,
        "violation_bound": certificate.violation_bound,
    }
    return about | measures, certificate.valid


def _quantile(values: "pd.Series[float]", share: float) -> float:
    known = values.dropna()
    return float(known.quantile(share)) if len(known) else float("nan")


def save_arrays(
    file: FilePath, paths: Mapping[tuple[str, int, int], Float[np.ndarray, "T D"]]
) -> None:
    """All valid paths [rad] of a constraint in one npz, named planner-query-seed."""
    named = {"-".join(map(str, key)): joints for key, joints in paths.items()}
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, **named)  # type: ignore[arg-type]


def figures_of(table: pd.DataFrame) -> dict[str, Any]:
    """The table as a nested record: constraint → planner → figures."""
    figures: dict[str, Any] = {}
    for row in table.to_dict("records"):
        about: Mapping[str, Any] = {
            str(k): v for k, v in row.items() if k not in ("constraint", "planner")
        }
        figures.setdefault(row["constraint"], {})[row["planner"]] = about
    return figures
