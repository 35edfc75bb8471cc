"""Figures that runs are compared by, held against ones counted by hand and committed tables."""

import json
import math
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from constraint_geodesics.tracking.comparison import (
    BENCHMARK,
    REPORT,
    Columns,
    cells_of,
    of_seeds,
    of_summary,
    problem_cells,
)

ROOT = Path(__file__).resolve().parents[2]


def row(planner: str, query: int, seed: int, length: float, valid: bool = True) -> dict[str, Any]:
    """One answer, which took as many milliseconds as its length."""
    about = {"planner": planner, "query": query, "seed": seed}
    return {**about, "valid": valid, "length_rad": length, "time_s": length / 1e3}


def test_a_seed_is_held_against_the_shortest_path_of_each_query() -> None:
    rows = [row("ours", 0, 0, 3.0), row("ours", 1, 0, 4.0), row("ours", 2, 0, 9.0, valid=False)]
    rows += [row("ours", 0, 1, 2.0), row("ours", 1, 1, 5.0, valid=False), row("ours", 2, 1, 6.0)]
    rows += [row("other", 1, 0, 2.0), row("other", 2, 0, 1.0, valid=False)]
    first, second = of_seeds(rows, "ours", [0, 1])
    assert first == {"success": 0.666667, "median_ratio": 1.75, "median_ms": 4.0}
    assert second == {"success": 0.666667, "median_ratio": 1.0, "median_ms": 5.0}


def test_a_seed_that_solves_nothing_has_no_ratio() -> None:
    (found,) = of_seeds([row("ours", 0, 0, 3.0, valid=False)], "ours", [0])
    assert found["success"] == 0.0
    assert math.isnan(found["median_ratio"])


def test_committed_rows_give_the_committed_success() -> None:
    folder = ROOT / "reports" / "train_geodesics"
    rows: Any = pd.read_csv(folder / "planner-level_cup.csv").to_dict("records")
    seeds = sorted({own["seed"] for own in rows if own["planner"] == "learned_geodesic"})
    found = of_seeds(rows, "learned_geodesic", seeds)
    told = json.loads((folder / "planner-level_cup.json").read_text())
    mean = sum(own["success"] for own in found) / len(found)
    assert mean == pytest.approx(told["success_mean"], abs=1e-6)
    assert all(own["median_ratio"] >= 1.0 and own["median_ms"] > 0.0 for own in found)


def test_a_summary_s_seconds_become_milliseconds_and_what_it_lacks_stays_out() -> None:
    columns = Columns("share", "ratio", "spent_s", 1e3)
    found = of_summary({"share": 0.5, "ratio": 1.1, "spent_s": 0.002}, columns)
    assert found == {"success": 0.5, "median_ratio": 1.1, "median_ms": 2.0}
    lacking = of_summary({"share": 0.0, "ratio": None}, columns)
    assert lacking == pytest.approx(
        {"success": 0.0, "median_ratio": math.nan, "median_ms": math.nan}, nan_ok=True
    )


def test_rows_of_the_committed_tables_are_cells() -> None:
    for file, told_by, columns in (
        ("table.csv", ("manifold", "constraint", "planner"), REPORT),
        ("benchmark/overview.csv", ("planner", "constraint", "scene"), BENCHMARK),
    ):
        rows: Any = pd.read_csv(ROOT / "reports" / file).to_dict("records")
        cells = cells_of(rows, told_by, columns)
        assert len(cells) == len(rows), "each has a name of its own"
        about, figures = cells[", ".join(rows[0][name] for name in told_by)]
        assert about == {name: rows[0][name] for name in told_by}
        assert figures["success"] == pytest.approx(rows[0][columns.success], rel=1e-5)
        assert figures["median_ms"] == pytest.approx(1e3 * rows[0][columns.time], rel=1e-5)


def test_problems_are_a_cell_for_each_constraint_and_planner() -> None:
    found = json.loads((ROOT / "reports" / "problems.json").read_text())["figures"]
    cells = problem_cells(found)
    assert len(cells) == sum(len(scenes["all"]) for scenes in found.values())
    about, figures = cells["free, planner"]
    assert about == {"constraint": "free", "planner": "planner"}
    told = found["free"]["all"]["planner"]
    assert figures["success"] == pytest.approx(told["share"], rel=1e-5)
    assert figures["median_ms"] == pytest.approx(told["time_ms_median"], rel=1e-5)
