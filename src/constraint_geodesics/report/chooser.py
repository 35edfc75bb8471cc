"""The chart of the benchmark's page that its reader chooses planners, constraints and scenes for:
the rows as the page reads them, and what is chosen at first.
"""

import base64
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, UInt16

from constraint_geodesics.benchmark.statistics import CASE
from constraint_geodesics.palette import planner_family
from constraint_geodesics.report.page import family_colour
from constraint_geodesics.report.standing import CHOICE, WHERE, shown_at_first

TIME_S, EXCESS = (1e-5, 1e3), (1e-6, 1e2)
"""Between what a number of 16 bits stands for times, and for excesses over the best known length;
what lies beyond is put at the end.
"""
NONE = 2**16 - 1
"""Stands for no valid path."""


class Chooser(NamedTuple):
    """What may be chosen, and what the chart draws.

    families: the planners of each family.  shown: those of the chart at first; told: why these.
    content: what the page's script reads, as `packed` gives it.
    """

    families: Mapping[str, Sequence[str]]
    shown: Sequence[str]
    told: str
    constraints: Sequence[str]
    scenes: Mapping[str, str]
    content: Mapping[str, Any]


def chooser(rows: pd.DataFrame, overview: pd.DataFrame, planners: Sequence[str]) -> Chooser:
    """The chart of these rows.

    rows: of the benchmark's table.  overview: its summary with all constraints together.
    planners: in the order in which they are to be offered; those without rows are left out.
    """
    there = set(rows["planner"])
    names = [name for name in planners if name in there]
    families: dict[str, list[str]] = {}
    for name in names:
        families.setdefault(planner_family(name) or "other", []).append(name)
    shown = [name for name in shown_at_first(overview) if name in there]
    scenes = set(rows["scene"])
    return Chooser(
        families,
        shown,
        f"At first the planner and {len(shown) - 1} others: {CHOICE[0].lower()}{CHOICE[1:]}",
        list(dict.fromkeys(map(str, rows["constraint"]))),
        {scene: where for scene, where in WHERE.items() if scene in scenes},
        packed(rows, names),
    )


def packed(rows: pd.DataFrame, planners: Sequence[str]) -> dict[str, Any]:
    """The rows of solvable queries for a page: small, and exact to a part in a thousand.

    cases: constraint, scene and number of queries; queries are counted through all cases.
    planners: name, colour and, as base64 of its variant for addresses, three numbers of 16 bits a
    row, the lower byte first: query, time and excess over the best known length.  time, excess: the
    ends of what these stand for, evenly in the logarithm.  none: the excess where there is no
    valid path.
    """
    solvable = rows[rows["best_known_rad"].notna() & (rows["status"] != "not_applicable")]
    asked = solvable[[*CASE, "query"]].drop_duplicates().sort_values([*CASE, "query"])
    assert len(asked) < NONE
    number = pd.MultiIndex.from_frame(asked).get_indexer(
        pd.MultiIndex.from_frame(solvable[[*CASE, "query"]])
    )
    excess = solvable["length_rad"].where(solvable["valid"]) / solvable["best_known_rad"] - 1.0
    columns = (number, coded(solvable["time_s"], TIME_S), coded(excess, EXCESS))
    content = np.stack(columns, axis=1).astype("<u2")
    return {
        "time": TIME_S,
        "excess": EXCESS,
        "none": NONE,
        "cases": [
            {"constraint": constraint, "scene": scene, "queries": len(own)}
            for (constraint, scene), own in asked.groupby(CASE)
        ],
        "planners": [
            {
                "name": name,
                "colour": family_colour(name) or "var(--ink)",
                "rows": _base64(content[(solvable["planner"] == name).to_numpy()]),
            }
            for name in planners
        ],
    }


def coded(values: "pd.Series[float]", ends: tuple[float, float]) -> UInt16[np.ndarray, "n"]:
    """Values as numbers of 16 bits, evenly in the logarithm between the ends; NONE for nan."""
    low, high = np.log(ends)
    kept: Float[np.ndarray, "n"] = values.clip(*ends).fillna(ends[1]).to_numpy(float)
    place = np.round((NONE - 1) * (np.log(kept) - low) / (high - low))
    return np.where(values.isna(), NONE, place).astype(np.uint16)


def _base64(content: UInt16[np.ndarray, "n 3"]) -> str:
    return base64.urlsafe_b64encode(content.tobytes()).decode()
