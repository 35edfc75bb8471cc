"""The study of arms and goals in parts that are kept as they finish, so that a run that was
interrupted goes on; and the figures of its rows.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from constraint_geodesics.benchmark.queries import Query
from constraint_geodesics.planner import Planner
from constraint_geodesics.studies.arm_queries import (
    Row,
    between_configurations,
    to_free_yaw,
    to_poses,
    to_redundant_poses,
)
from constraint_geodesics.studies.arms import ARMS, REDUNDANT, first_paths
from constraint_geodesics.text_files import kept_json, write_text

Table = Literal["first_path", "configurations", "pose", "free_yaw", "redundant_pose", "held_angle"]
PIPELINE_ARM = "xArm 6 on its table"
"""The robot and workcell of params.yaml."""
ON_ARMS, REDUNDANT_POSES, HELD = 50, 25, 100
"""Queries of each arm and constraint, poses of each arm with seven joints or more, queries of each
held angle.
"""
POSES, FREE_YAWS = 100, 50
"""Of the benchmark's queries of each constraint."""
YAW_UNDER = ("level_cup", "free")
SEED = 97
"""Of all random queries; not that of those that settings were chosen on."""
COLUMNS = ("table", "arm", "constraint", *(field.name for field in fields(Row)))
NAMES = COLUMNS[:3]


@dataclass(frozen=True)
class Part:
    """Queries of one arm and constraint for one table.  queries: the benchmark's, or how many are
    drawn.  planner: the pipeline's folder, where the part is of its planner.  file: where the rows
    are kept, with the fingerprint of what they depend on.
    """

    table: Table
    arm: str
    constraint: str
    queries: int | tuple[Query, ...]
    planner: Path
    file: Path
    fingerprint: str = ""


def parts_of(
    queries: Mapping[str, Sequence[Query]], planner: Path, folder: Path, share: float = 1.0
) -> list[Part]:
    """All parts, those that take longest first.  queries: the benchmark's without an obstacle, by
    their constraints.  folder: of the kept rows.  share: of the number of queries of every part, at
    least one.
    """

    def some(count: int) -> int:
        return max(1, round(share * count))

    own = PIPELINE_ARM
    found: list[tuple[Table, str, str, int | tuple[Query, ...]]] = [
        *(("held_angle", own, axis, some(HELD)) for axis in ("roll", "pitch", "yaw")),
        *(("configurations", arm, "level", some(ON_ARMS)) for arm in ARMS),
        *(("configurations", arm, "free", some(ON_ARMS)) for arm in ARMS),
        *(("redundant_pose", arm, "free", some(REDUNDANT_POSES)) for arm in REDUNDANT),
        *(("free_yaw", own, name, tuple(queries[name][: some(FREE_YAWS)])) for name in YAW_UNDER),
        *(("pose", own, name, tuple(asked[: some(POSES)])) for name, asked in queries.items()),
        *(("first_path", arm, "free", 2) for arm in ARMS),
    ]
    return [
        Part(table, arm, name, asked, planner, folder / f"{table}-{arm}-{name}.json")
        for table, arm, name, asked in found
    ]


def measure(part: Part) -> None:
    """Ask the part's queries and keep their rows."""
    rows = [asdict(row) for row in _rows(part)]
    write_text(part.file, json.dumps({"fingerprint": part.fingerprint, "rows": rows}) + "\n")


def kept(part: Part) -> list[dict[str, Any]] | None:
    """The rows of a part that was measured on the same code and data; None if there are none."""
    content = kept_json(part.file)
    if content is None or content["fingerprint"] != part.fingerprint:
        return None
    about = {"table": part.table, "arm": part.arm, "constraint": part.constraint}
    return [about | row for row in content["rows"]]


def _rows(part: Part) -> list[Row]:
    if part.table == "first_path":
        assert isinstance(part.queries, int)
        paths = first_paths(part.arm, SEED, part.queries)
        return [
            Row(k, path.status, path.length_rad, 1e3 * (path.made_s + path.planned_s))
            for k, path in enumerate(paths)
        ]
    with (
        Planner.load(part.planner)
        if part.arm == PIPELINE_ARM
        else ARMS[part.arm].planner() as planner
    ):
        if isinstance(part.queries, tuple):
            ask = to_poses if part.table == "pose" else to_free_yaw
            return ask(planner, part.queries)
        if part.table == "redundant_pose":
            return to_redundant_poses(planner, part.queries, SEED)
        everywhere = part.table == "configurations"
        return between_configurations(
            planner, part.constraint, part.queries, SEED, ask_all=everywhere
        )


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """All rows, with the columns in their order."""
    return pd.DataFrame(rows, columns=list(COLUMNS))


def figures(rows: pd.DataFrame) -> dict[str, dict[str, dict[str, Any]]]:
    """The figures of each table: by arm and constraint, and of all its rows (`all`)."""
    found: dict[str, dict[str, dict[str, Any]]] = {}
    for table, own in rows.groupby("table", sort=False):
        groups = own.groupby(["arm", "constraint"], sort=False)
        of = first_path_figures if table == "first_path" else figures_of
        named = {f"{arm}, {name}": of(group) for (arm, name), group in groups}
        found[str(table)] = {**named, "all": of(own)}
    return found


def first_path_figures(rows: pd.DataFrame) -> dict[str, Any]:
    """Of first paths: the longest that one took with an empty cache of arms, and afterwards [s]."""
    taken = rows["time_ms"].where(rows["status"] == "solved", np.inf) / 1e3
    first = rows["query"] == 0
    return {"first_s": _number(taken[first].max()), "again_s": _number(taken[~first].max())}


def figures_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Of some rows.  success: share solved of those that anything solves.  ratio: of the first
    path's length to the best known, where there is one; time: of the queries that are solved,
    time_all of all.  Figures of nothing are left out.
    """
    solved, known = rows["status"] == "solved", rows["best_known_rad"].notna()
    theirs = rows["birrt_status"] == "solved"
    ratio = (rows["length_rad"] / rows["best_known_rad"])[solved & known]
    given = (rows["given_length_rad"] / rows["best_known_rad"]).dropna()
    found = {
        "queries": len(rows),
        "solved": int(solved.sum()),
        "straight": _share(rows["source"] == "straight", solved),
        "not_connected": int((rows["status"] == "not_connected").sum()),
        "solvable": int(known.sum()),
        "success": _share(solved & known, known),
        "birrt_asked": int((rows["birrt_status"] != "").sum()),
        "birrt_solved": int(theirs.sum()),
        "success_of_birrt": _share(solved & theirs, theirs),
        "given_solved": int((rows["given_status"] == "solved").sum()),
        **_quantiles("ratio", ratio),
        **_quantiles("given_ratio", given),
        **_quantiles("time_ms", rows["time_ms"][solved]),
        **_quantiles("time_all_ms", rows["time_ms"]),
        **_quantiles("birrt_time_ms", rows["birrt_time_ms"][theirs]),
        "prepared_s": _number(rows["prepared_s"].max()),
    }
    return {name: value for name, value in found.items() if value is not None}


def _share(of: pd.Series, all_of: pd.Series) -> float | None:
    return _number(of.sum() / all_of.sum()) if all_of.any() else None


def _quantiles(name: str, values: pd.Series) -> dict[str, float | None]:
    found = {"median": values.median(), "p95": values.quantile(0.95), "max": values.max()}
    return {f"{name}_{which}": _number(value) for which, value in found.items()}


def _number(value: Any) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None
