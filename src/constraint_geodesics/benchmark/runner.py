"""Every planner on the same queries: one row a planner, query and seed, judged by the certifier and
kept as it comes.

Rows are appended to one file for each block of queries, and each carries a fingerprint of all it
depends on: a benchmark that was killed goes on where it stopped, and after a change only the rows
it touches are run again. All planners answer a query one after another, in one process on one
thread, so that a slow spell of the machine hits them alike.
"""

import ctypes
import hashlib
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import PathMeasures, judge_limits, measure_path
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.params import JudgeParams
from constraint_geodesics.problem import PathPlanner, PlanningProblem, Solution
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere

COLUMNS = (
    "planner",
    "constraint",
    "scene",
    "query",
    "seed",
    "status",
    "valid",
    "time_s",
    "length_rad",
    "best_known_rad",
    "latent_length",
    "tool_length_m",
    "max_violation_rad",
    "energy_j_or_blank",
    "peak_memory_mb",
    "recording",
    "scene_s",
)
KEY = ("planner", "constraint", "scene", "query", "seed")
_WARM: set[tuple[str, str]] = set()  # planners and scenes that this process has asked before
TABLE, KEEP_OUT = "table", "keep_out"
"""Scenes: the workcell of params.yaml, and the same with a sphere on the way."""


@dataclass(frozen=True)
class Case:
    """One query: its ends [rad] and the scene it is asked in, with the sphere to keep out of, if
    there is one.
    """

    constraint: str
    scene: str
    query: int
    start: Float[np.ndarray, "D"]
    goal: Float[np.ndarray, "D"]
    obstacle: Sphere | None = None

    def in_scene(self, scene: Scene) -> Scene:
        """The workcell with this query's obstacle."""
        return (
            scene
            if self.obstacle is None
            else replace(scene, workcell=(*scene.workcell, self.obstacle))
        )


@dataclass(frozen=True)
class Entry:
    """A planner of the benchmark: its name, its seeds, and a fingerprint of its settings.

    queries: how many of a block's it answers, the first ones; by default all.  after: name of the
    planner whose remembered path it shortens, if so: the memory is that of both.  uses_clearance:
    whether it needs the model of distances, whose making then counts as its preparation for the
    scene.
    """

    name: str
    seeds: tuple[int, ...]
    fingerprint: str
    queries: int | None = None
    after: str = ""
    uses_clearance: bool = True


class Builder(Protocol):
    """Makes planners by name for one scene and constraint; picklable."""

    def __call__(
        self, names: Sequence[str], scene: Scene, constraint: str, manifold: ConstraintManifold
    ) -> AbstractContextManager[tuple[Mapping[str, PathPlanner], Mapping[str, float]]]:
        """The planners of these names, closed again when the context ends, and the seconds that
        making them took.
        """
        ...


class Recorder(Protocol):
    """Records some of the paths; picklable."""

    def __call__(
        self,
        case: "Case",
        planner: str,
        seed: int,
        joints: Float[np.ndarray, "T D"],
        measures: PathMeasures,
        scene: Scene,
        manifold: ConstraintManifold,
    ) -> str:
        """The recording's file, or "" where this path is not one to record."""
        ...


@dataclass(frozen=True)
class Block:
    """Some queries of one constraint and scene, with the planners that answer them; picklable.

    file: where the rows are kept, one JSON record a line.  record: called with every path that
    there is.
    """

    scene: Scene
    manifold: ConstraintManifold
    charts: Mapping[str, LearnedManifold]
    cases: tuple[Case, ...]
    entries: tuple[Entry, ...]
    build: Builder
    judge: JudgeParams
    file: Path
    record: Recorder | None = None


def run_block(block: Block) -> int:
    """Answer what of the block is not answered yet; returns the number of rows that it added."""
    open_jobs, added = _open_jobs(block), 0
    block.file.parent.mkdir(parents=True, exist_ok=True)
    if block.file.is_file() and not block.file.read_bytes().endswith(
        b"\n"
    ):  # killed while a line was written
        with block.file.open("a") as lines:
            lines.write("\n")
    for case, jobs in open_jobs:
        for row in _answered(block, case, jobs):
            with block.file.open("a") as lines:
                lines.write(json.dumps(row, allow_nan=False) + "\n")
            added += 1
    return added


def rows_to_do(block: Block) -> int:
    """How many rows `run_block` would add."""
    return sum(len(jobs) for _, jobs in _open_jobs(block))


def fingerprints(entries: Iterable[Entry]) -> dict[str, str]:
    """Each planner's fingerprint."""
    return {entry.name: entry.fingerprint for entry in entries}


def fingerprint(*parts: Any) -> str:
    """A short hash of what a row depends on: anything that JSON takes, and bytes."""
    text = json.dumps(
        parts, sort_keys=True, default=lambda value: hashlib.sha256(bytes(value)).hexdigest()
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def block_rows(block: Block) -> list[dict[str, Any]]:
    """The block's rows that are there: of its own queries, planners and seeds, one each."""
    asked = {
        (entry.name, case.constraint, case.scene, case.query, seed)
        for k, case in enumerate(block.cases)
        for entry in block.entries
        if _asks(entry, k)
        for seed in entry.seeds
    }
    return [row for row in read_rows(block.file, fingerprints(block.entries)) if _key(row) in asked]


def read_rows(file: Path, wanted: Mapping[str, str]) -> list[dict[str, Any]]:
    """Rows of a block's file whose planner has the wanted fingerprint, the last of each key; no
    torn lines.
    """
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for line in file.read_text().splitlines() if file.is_file() else ():
        try:
            row = json.loads(line)
        except json.JSONDecodeError:  # killed while it was written
            continue
        if "started" not in row and wanted.get(row["planner"]) == row["fingerprint"]:
            found[_key(row)] = row
    return list(found.values())


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """All rows with best_known_rad, the shortest valid path that any planner and seed found for the
    query.
    """
    table = pd.DataFrame(rows).assign(
        **({} if rows and "scene_s" in rows[0] else {"scene_s": np.nan})
    )
    assert not table.duplicated(list(KEY)).any()
    numbers = [
        "time_s",
        "length_rad",
        "latent_length",
        "tool_length_m",
        "max_violation_rad",
        "peak_memory_mb",
        "scene_s",
    ]
    table = table.astype(dict.fromkeys(numbers, float))
    best = (
        table["length_rad"]
        .where(table["valid"])
        .groupby([table[k] for k in ("constraint", "scene", "query")])
    )
    table["best_known_rad"] = best.transform("min")
    return table[list(COLUMNS)].sort_values(list(KEY), kind="stable", ignore_index=True)


def write_table(table: pd.DataFrame, file: Path, about: Mapping[str, str]) -> None:
    """Write the rows as CSV, with a comment line for each entry of `about` (commit, lock file,
    processor) before.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w") as lines:
        lines.writelines(f"# {name}: {' '.join(value.split())}\n" for name, value in about.items())
        table.to_csv(lines, index=False, float_format="%.12g")


def read_table(file: Path) -> tuple[pd.DataFrame, dict[str, str]]:
    """The rows of `write_table`, and what its comment lines say."""
    head = [
        line[2:].split(": ", 1) for line in file.read_text().splitlines() if line.startswith("# ")
    ]
    table = pd.read_csv(
        file, comment="#", float_precision="round_trip", dtype={"recording": str, "status": str}
    )
    return table.assign(recording=table["recording"].fillna("")), {
        name: value.strip() for name, value in head
    }


def write_cases(cases: Sequence[Case], file: Path) -> None:
    """One row a query: scene, the ends [rad], and centre and radius of the sphere [m], blank where
    there is none.
    """
    rows = []
    for case in cases:
        ball = case.obstacle
        place = ("", "", "", "") if ball is None else (*ball.centre_m, ball.radius_m)
        rows.append(
            {
                "constraint": case.constraint,
                "scene": case.scene,
                "query": case.query,
                **{f"start_{k + 1}": value for k, value in enumerate(case.start)},
                **{f"goal_{k + 1}": value for k, value in enumerate(case.goal)},
                **dict(
                    zip(("sphere_x", "sphere_y", "sphere_z", "sphere_radius"), place, strict=True)
                ),
            }
        )
    file.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(file, index=False)


def read_cases(file: Path) -> list[Case]:
    """Read what `write_cases` wrote."""
    frame = pd.read_csv(file, float_precision="round_trip")
    starts, goals = (frame.filter(regex=f"^{end}_").to_numpy() for end in ("start", "goal"))
    spheres = frame.filter(regex="^sphere_").to_numpy()
    return [
        Case(
            str(row["constraint"]), str(row["scene"]), int(row["query"]), start, goal, _ball(sphere)
        )
        for row, start, goal, sphere in zip(
            frame.to_dict("records"), starts, goals, spheres, strict=True
        )
    ]


def _ball(sphere: Float[np.ndarray, "4"]) -> Sphere | None:
    x, y, z, radius = map(float, sphere)
    return None if np.isnan(radius) else Sphere("keep_out", (x, y, z), radius)


def _open_jobs(block: Block) -> list[tuple[Case, list[tuple[Entry, int]]]]:
    """The queries that still lack rows, with the planners and seeds that they lack."""
    done = {_key(row) for row in read_rows(block.file, fingerprints(block.entries))}
    wanted = [
        (
            case,
            [(entry, seed) for entry in block.entries if _asks(entry, k) for seed in entry.seeds],
        )
        for k, case in enumerate(block.cases)
    ]
    left = [
        (
            case,
            [
                (e, s)
                for e, s in jobs
                if (e.name, case.constraint, case.scene, case.query, s) not in done
            ],
        )
        for case, jobs in wanted
    ]
    return [(case, jobs) for case, jobs in left if jobs]


def _asks(entry: Entry, position: int) -> bool:
    return entry.queries is None or position < entry.queries


def _key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in KEY)


def _answered(
    block: Block, case: Case, jobs: Sequence[tuple[Entry, int]]
) -> Iterator[dict[str, Any]]:
    """Rows of one query.  A planner new to this process answers once before it is timed: that loads
    its code.
    """
    scene, manifold = case.in_scene(block.scene), block.manifold
    names = list(dict.fromkeys(entry.name for entry, _ in jobs))
    with (
        Certifier(scene, judge_limits(block.judge)) as certifier,
        scene.world() as world,
        block.build(names, scene, case.constraint, manifold) as (planners, made_s),
    ):
        began = time.perf_counter()
        grown_by: dict[tuple[str, int], float] = {}
        clearance = clearance_model(scene.robot, scene.workcell)
        assert clearance.arrays  # they are made when first asked for
        clearance_s = time.perf_counter() - began
        problem = PlanningProblem(case.start, case.goal, manifold, world.is_free, clearance)
        for entry, seed in jobs:
            planner = planners[entry.name]
            if (entry.name, case.scene) not in _WARM:
                _planned(
                    planner, replace(problem), seed
                )  # not the same object: its answer is not to be remembered
                _WARM.add((entry.name, case.scene))
            if _started(block, case, entry, seed) > 1:
                found, grown = _crashed(case), float("nan")
            else:
                found, grown = _measured_memory(lambda p=planner, s=seed: _planned(p, problem, s))  # type: ignore[misc]
            grown = grown_by[entry.name, seed] = max(grown, grown_by.get((entry.after, seed), 0.0))
            measures = measure_path(
                found.joints,
                case.start,
                case.goal,
                manifold,
                block.charts,
                certifier,
                block.judge.spacing_rad,
            )
            recording = ""
            if block.record is not None and len(found.joints) > 1:
                recording = block.record(
                    case, entry.name, seed, found.joints, measures, scene, manifold
                )
            row = _row(case, entry, seed, found, measures, grown)
            scene_s = made_s.get(entry.name, 0.0) + (clearance_s if entry.uses_clearance else 0.0)
            yield row | {"recording": recording, "scene_s": scene_s}


def _started(block: Block, case: Case, entry: Entry, seed: int) -> int:
    """Note that a row is begun; how often it was before without an end: once a kill, twice a crash
    of its own.
    """
    key = {
        **dict(zip(KEY, (entry.name, case.constraint, case.scene, case.query, seed), strict=True))
    }
    mark = json.dumps({"started": key, "fingerprint": entry.fingerprint})
    before = block.file.read_text().splitlines().count(mark) if block.file.is_file() else 0
    with block.file.open("a") as lines:
        lines.write(mark + "\n")
    return before


def _crashed(case: Case) -> Solution:
    return Solution(
        "not_found", np.empty((0, len(case.start))), 0.0, 0, "the process died in it twice"
    )


def _planned(planner: PathPlanner, problem: PlanningProblem, seed: int) -> Solution:
    """The planner's answer; one that raises has failed on this query, which is a row as well."""
    began = time.perf_counter()
    try:
        return planner.plan(problem, seed)
    except Exception as error:  # a peer's library may raise anything
        nothing = np.empty((0, problem.manifold.robot.dof))
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Solution("not_found", nothing, time.perf_counter() - began, 0, text)


def _row(
    case: Case, entry: Entry, seed: int, found: Solution, measures: PathMeasures, grown: float
) -> dict[str, Any]:
    latent = list(measures.latent_length.values())
    row = {
        "planner": entry.name,
        "constraint": case.constraint,
        "scene": case.scene,
        "query": case.query,
        "seed": seed,
        "status": found.status,
        "valid": measures.valid,
        "time_s": found.time_s,
        "length_rad": measures.length_rad,
        "latent_length": latent[0] if latent else float("nan"),
        "tool_length_m": measures.tool_length_m,
        "max_violation_rad": measures.max_violation_rad,
        "energy_j_or_blank": None,
        "peak_memory_mb": grown,
        "recording": "",
        "reason": found.explanation or measures.reason,
        "fingerprint": entry.fingerprint,
    }
    return {
        name: None if isinstance(value, float) and np.isnan(value) else value
        for name, value in row.items()
    }


def _measured_memory(work: Callable[[], Solution]) -> tuple[Solution, float]:
    """What the work returns, and by how much the process's memory grew at its peak [MB]; nan but on
    Linux.

    What earlier work has freed is given back to the system before, so that taking it again counts.
    """
    reset, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    try:
        ctypes.CDLL(None).malloc_trim(0)
        reset.write_text("5")  # resets the peak
        before = _kilobytes(status, "VmRSS")
    except (OSError, AttributeError):
        return work(), float("nan")
    found = work()
    return found, max(_kilobytes(status, "VmHWM") - before, 0.0) / 1024.0


def _kilobytes(status: Path, name: str) -> float:
    line = next(line for line in status.read_text().splitlines() if line.startswith(f"{name}:"))
    return float(line.split()[1])
