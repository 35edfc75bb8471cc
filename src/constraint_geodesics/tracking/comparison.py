"""Figures by which runs of different stages are compared, from the rows of their tables."""

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, median
from typing import Any

from constraint_geodesics.tracking.views import COMPARED


def of_seeds(
    rows: Sequence[Mapping[str, Any]], planner: str, seeds: Sequence[int]
) -> list[dict[str, float]]:
    """COMPARED of each seed of a planner; nan where it has no valid path.

    rows: of all planners on the same queries, with planner, query, seed, valid, length_rad and
    time_s.  The lengths are held against the shortest valid path of the query among all rows; the
    times are of all answers.
    """
    best: dict[Any, float] = {}
    for row in rows:
        if row["valid"]:
            best[row["query"]] = min(row["length_rad"], best.get(row["query"], math.inf))
    found = []
    for seed in seeds:
        own = [row for row in rows if row["planner"] == planner and row["seed"] == seed]
        ratios = [row["length_rad"] / best[row["query"]] for row in own if row["valid"]]
        figures = (
            fmean(bool(row["valid"]) for row in own),
            median(ratios) if ratios else math.nan,
            1e3 * median(row["time_s"] for row in own),
        )
        found.append(dict(zip(COMPARED, figures, strict=True)))
    return found


def of_summary(
    row: Mapping[str, Any], success: str, ratio: str, time: str, per_ms: float = 1.0
) -> dict[str, Any]:
    """The same from a row of figures, under their names there.

    per_ms: milliseconds of one unit of its time, 1000 for seconds.
    """
    spent = row.get(time)
    figures = row.get(success), row.get(ratio), None if spent is None else per_ms * float(spent)
    return dict(zip(COMPARED, figures, strict=True))


def of_problems(
    found: Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]],
) -> dict[str, tuple[dict[str, str], dict[str, Any]]]:
    """Cells of a run: of each constraint and planner, what tells them apart and COMPARED of all
    scenes together.

    found: by constraint, scene or "all", and planner.
    """
    return {
        f"{constraint}, {planner}": (
            {"constraint": constraint, "planner": planner},
            of_summary(row, "share", "ratio_median", "time_ms_median"),
        )
        for constraint, scenes in found.items()
        for planner, row in scenes["all"].items()
    }
