"""The benchmark's figures from tables whose figures are known."""

import sqlite3
from contextlib import closing

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from constraint_geodesics.benchmark.planner_arena import export_arena
from constraint_geodesics.benchmark.row import COLUMNS, LATENT, read_table, table_of, write_table
from constraint_geodesics.benchmark.statistics import (
    all_constraints,
    benchmark_summary,
    break_even_table,
    interquartile_mean,
    ours_against_baselines,
    over_budget,
    quantile_with_failures,
    repeated,
)


def row(planner, query, seed, length, time, *, status="solved", valid=None):
    return {
        "planner": planner,
        "constraint": "level",
        "scene": "table",
        "query": query,
        "seed": seed,
        "status": status,
        "valid": bool(np.isfinite(length)) if valid is None else valid,
        "time_s": time,
        "length_rad": length,
        f"{LATENT}planner": length,
        "tool_length_m": 0.1 * length,
        "max_violation_rad": 1e-9,
        "peak_memory_mb": 1.0,
        "recording": "",
    }


@pytest.fixture(scope="module")
def table():
    rows = [row("ours", q, 0, length, 0.01) for q, length in enumerate((1.0, 2.0, 3.0, 4.0))]
    for seed in (0, 1):
        rows += [
            row("peer", 0, seed, 1.5, 0.1),
            row("peer", 1, seed, 2.0, 0.2),
            row("peer", 2, seed, np.nan, 1.0, status="not_found"),
            row("peer", 3, seed, 2.0, 1.0, valid=False),
        ]
    rows += [row("short", 0, 0, 1.0, 0.5), row("short", 4, 0, np.nan, 0.5, status="not_applicable")]
    return table_of(rows)


def test_best_known_is_the_shortest_valid_path_of_all(table) -> None:
    best = table.groupby("query")["best_known_rad"].first()
    np.testing.assert_array_equal(best, [1.0, 2.0, 3.0, 4.0, np.nan])
    assert list(table.columns) == [*COLUMNS, f"{LATENT}planner"]


def test_every_row_counts_and_claims_are_told(table) -> None:
    peer = benchmark_summary(table, "ours").set_index("planner").loc["peer"]
    assert (peer["rows"], peer["queries"], peer["seeds"], peer["solvable"]) == (8, 4, 2, 4)
    assert peer["success"] == 0.5
    assert peer["claimed_but_invalid"] == 2
    assert peer["ratio_median"] == 1.25
    assert peer["ratio_p95_all"] == np.inf
    assert peer["time_median_s"] == 0.6
    # of query 0 the peer is longer, of query 1 as long, of 2 and 3 it has nothing
    assert peer["beaten"] == (1.0 + 0.5 + 1.0 + 1.0) / 4
    assert (peer["within_1_s"], peer["within_10_s"]) == (np.inf, np.inf)


def test_what_is_not_applicable_or_unsolved_by_all_is_told(table) -> None:
    short = benchmark_summary(table, "ours").set_index("planner").loc["short"]
    assert short["not_applicable"] == 1
    assert (short["success"], short["success_of_solvable"]) == (0.5, 1.0)
    assert short["within_1_s"] == 0.5
    assert short["beaten"] == 0.5


def test_interquartile_mean_is_that_of_the_middle_half_and_lies_in_its_interval() -> None:
    values = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 700.0])
    low, middle, high = interquartile_mean(values)
    assert middle == 3.5
    assert low < middle < high
    assert interquartile_mean(np.array([2.0])) == (2.0, 2.0, 2.0)
    assert np.isnan(interquartile_mean(np.array([]))).all()


def test_intervals_cover_the_mean_that_is_known() -> None:
    rng, covered = np.random.default_rng(0), 0
    for _ in range(100):
        low, _, high = interquartile_mean(rng.normal(1.0, 0.2, size=60))
        covered += low <= 1.0 <= high
    assert 85 <= covered <= 100


@pytest.mark.parametrize(
    ("share", "expected"), [(0.25, 1.0), (0.5, 2.0), (0.75, 3.0), (0.76, np.inf)]
)
def test_failures_are_infinite_in_a_quantile(share, expected) -> None:
    assert quantile_with_failures(np.array([3.0, np.nan, 1.0, 2.0]), share) == expected


def test_within_a_budget_only_what_is_there_in_time_counts(table) -> None:
    budgets = over_budget(table, [0.05, 0.15, 0.5]).set_index(["planner", "budget_s"])
    assert budgets.loc[("ours", 0.05), "success"] == 1.0
    assert budgets.loc[("ours", 0.05), "ratio_p95"] == 1.0
    assert [budgets.loc[("peer", b), "success"] for b in (0.05, 0.15, 0.5)] == [0.0, 0.25, 0.5]
    assert budgets.loc[("peer", 0.5), "ratio_p95"] == np.inf


def test_the_file_keeps_every_bit_that_matters_and_says_where_it_is_from(table, tmp_path) -> None:
    write_table(table, tmp_path / "benchmark.csv", {"commit": "abc", "processor": "a: b"})
    again, about = read_table(tmp_path / "benchmark.csv")
    assert about == {"commit": "abc", "processor": "a: b"}
    assert list(again.columns) == list(table.columns)
    np.testing.assert_allclose(again["length_rad"], table["length_rad"], rtol=1e-11)
    pd.testing.assert_series_equal(again["valid"], table["valid"])


def test_planner_arena_finds_its_tables_and_every_run(table, tmp_path) -> None:
    export_arena(table, tmp_path / "arena.db", {"commit": "abc"}, {"ours": "segments: 16"})
    with closing(sqlite3.connect(tmp_path / "arena.db")) as database:
        runs = pd.read_sql_query(
            "SELECT plannerConfigs.name AS planner, runs.* FROM plannerConfigs "
            "INNER JOIN runs ON plannerConfigs.id = runs.plannerid",
            database,
        )
        names = {
            name
            for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        }
        assert {"experiments", "plannerConfigs", "enums", "runs", "progress"} <= names
        assert database.execute("SELECT name, runcount FROM experiments").fetchall() == [
            ("level, table", len(table))
        ]
        described = dict(
            database.execute(
                "SELECT value, description FROM enums WHERE name = 'status'"
            ).fetchall()
        )
    assert len(runs) == len(table)
    assert runs[runs["planner"] == "peer"]["correct_solution"].sum() == 4
    assert sorted(runs["status"].map(described)) == sorted(table["status"])
    assert runs["solution_length"].isna().sum() == table["length_rad"].isna().sum()


def test_intervals_of_success_hold_it(table) -> None:
    for _, figures in benchmark_summary(table, "ours").iterrows():
        assert (
            0.0
            <= figures["success_low"]
            <= figures["success_of_solvable"]
            <= figures["success_high"]
            <= 1.0
        )


def test_the_planner_is_told_on_the_queries_that_the_other_solved(table) -> None:
    summary = benchmark_summary(table, "ours").set_index("planner")
    assert summary.loc["peer", "reference_iqm"] == 1.0
    assert summary.loc["ours", "reference_iqm"] == summary.loc["ours", "ratio_iqm"] == 1.0


def test_who_is_ahead_within_a_budget() -> None:
    rows = [row("ours", q, 0, 1.1 if q == 0 else 1.0, 0.01) for q in range(4)]
    rows += [row("ours 1 s", q, 0, 1.0, 1.1) for q in range(4)]
    rows += [row("slow", q, 0, 1.0, 0.5) for q in range(4)]
    rows += [row("half", q, 0, 1.0 if q % 2 else np.nan, 0.005) for q in range(4)]
    table = ours_against_baselines(
        table_of(rows), {"ours": 0.0, "ours 1 s": 1.0}, [0.001, 0.006, 0.02, 0.6, 2.0]
    )
    verdicts = {(r["budget_s"], r["baseline"]): r["verdict"] for r in table.to_dict("records")}
    assert {peer for _, peer in verdicts} == {"slow", "half"}
    assert verdicts[0.001, "half"] == "neither"
    assert verdicts[0.006, "half"] == "ahead", "some success against none"
    assert verdicts[0.02, "half"] == "behind"
    assert verdicts[0.02, "slow"] == "behind"
    assert verdicts[0.6, "slow"] == "ahead"
    assert verdicts[2.0, "slow"] == "tied"
    assert set(table[table["budget_s"] == 2.0]["asked"]) == {"ours 1 s"}


def test_planners_that_were_asked_less_are_compared_on_what_they_were_asked() -> None:
    rows = [row("ours", q, 0, 1.0 if q < 2 else np.nan, 0.01) for q in range(20)]
    rows += [row("peer", q, s, 1.5, 0.01) for q in range(2) for s in range(3)] + [
        row("all", 19, 0, 1.0, 1.0)
    ]
    table = ours_against_baselines(table_of(rows), {"ours": 0.0}, [0.1]).set_index("baseline")
    assert (table.loc["peer", "queries"], table.loc["peer", "verdict"]) == (2, "behind")


def test_who_is_given_a_budget_may_end_shortly_after_it() -> None:
    rows = [row("ours", 0, 0, 1.1, 0.01), row("peer", 0, 0, 1.0, 1.03)]
    table = ours_against_baselines(table_of(rows), {"ours": 0.0}, [0.97, 1.0])
    assert table["verdict"].tolist() == ["behind", "ahead"]


def test_a_budget_that_no_solvable_query_was_asked_with_counts_as_the_one_before() -> None:
    rows = [row("ours", q, 0, 1.0 if q else np.nan, 0.01) for q in range(3)]
    rows += [row("ours 1 s", 0, 0, np.nan, 1.1), row("peer", 1, 0, 1.5, 0.01)]
    budgets = {"ours": 0.0, "ours 1 s": 1.0}
    (line,) = ours_against_baselines(table_of(rows), budgets, [2.0]).to_dict("records")
    assert (line["asked"], line["verdict"]) == ("ours", "behind")


def test_training_pays_from_as_many_queries_as_what_is_saved_needs() -> None:
    rows = [row("ours", q, 0, 1.0, 0.01) for q in range(3)]
    rows += [row("slow", q, s, 1.0, 0.11) for q in range(2) for s in range(2)] + [
        row("fast", 0, 0, 1.0, 0.001)
    ]
    costs = break_even_table(table_of(rows), {"ours": 100.0, "slow": 20.0}, "ours").set_index(
        "planner"
    )
    assert costs.loc["slow", "break_even"] == pytest.approx(800.0)
    assert costs.loc["fast", "break_even"] == np.inf
    assert costs.index[0] == "ours"


def test_a_second_run_is_compared_row_by_row() -> None:
    first = table_of(
        [row("same", q, 0, 1.0 + q, 0.1) for q in range(5)] + [row("other", 0, 0, 1.0, 0.1)]
    )
    again = first.assign(
        length_rad=first["length_rad"].where(first["planner"] == "same", 1.5),
        time_s=first["time_s"].where(first["planner"] == "same", 7.0),
    )
    told = repeated(first, again).set_index("planner")
    figures = ["rows", "same_validity", "length_difference", "ratio", "ratio_low", "ratio_high"]
    assert told.loc["same", figures].tolist() == [5, True, 0.0, 1.0, 1.0, 1.0]
    assert told.loc["other", "length_difference"] == pytest.approx(0.5)
    assert told.loc["other", "ratio"] == pytest.approx(70.0)
    paired = table_of([row("same", q, 0, 1.0, t) for q, t in enumerate((1.0, 10.0, 100.0))])
    slower = repeated(paired, paired.assign(time_s=[5.0, 20.0, 1.0])).iloc[0]
    assert slower["ratio"] == 2.0  # that of the medians is 0.5
    slower = repeated(paired.assign(time_s=[0.0, 10.0, 100.0]), paired.assign(time_s=20.0)).iloc[0]
    assert slower["ratio"] == pytest.approx(1.1)
    refused = repeated(first, again.assign(valid=False)).set_index("planner")
    assert not refused["same_validity"].any()


def test_rows_that_do_not_apply_are_not_failures_of_all_constraints(table) -> None:
    pooled = benchmark_summary(all_constraints(table), "ours").set_index("planner")
    assert pooled.loc["short", ["queries", "success"]].tolist() == [1, 1.0]


def test_a_share_of_few_queries_is_never_sure() -> None:
    for solved in (0, 3, 9):
        known = [row("ours", q, 0, 1.0 if q < solved else np.nan, 0.1) for q in range(9)]
        others = [row("peer", q, 0, 1.0, 0.1) for q in range(9)]
        told = benchmark_summary(table_of(known + others), "ours").set_index("planner").loc["ours"]
        exact = stats.binomtest(solved, 9).proportion_ci(0.95, "exact")
        assert told["success_low"] == pytest.approx(exact.low)
        assert told["success_high"] == pytest.approx(exact.high)
        assert told["success_low"] < told["success_high"]
