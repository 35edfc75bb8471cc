"""A table small enough to work out by hand, and what must not change when rows are added or
failures appear.
"""

import numpy as np
import pandas as pd
import pytest

from constraint_geodesics.benchmark.statistics import common_queries, summarise

NAN = float("nan")


def row(
    planner,
    query,
    seed,
    length=NAN,
    *,
    valid=None,
    status="solved",
    time=NAN,
    violation=NAN,
    latent=None,
):
    return {
        "planner": planner,
        "query": query,
        "seed": seed,
        "status": status,
        "valid": np.isfinite(length) if valid is None else valid,
        "length_rad": length,
        "latent_length_toy": 10 * length if latent is None else latent,
        "max_violation_rad": violation,
        "max_violation_m": violation / 100,
        "time_s": time,
    }


TABLE = pd.DataFrame(
    [
        # a solves both queries: query 0 with 2 and 4, query 1 with 3 and 3
        row("a", 0, 0, 2.0, time=1.0, violation=0.0),
        row("a", 0, 1, 4.0, time=2.0, violation=0.1),
        row("a", 1, 0, 3.0, time=3.0, violation=0.2),
        row("a", 1, 1, 3.0, time=6.0, violation=0.3),
        # b solves query 0 once, returns a path that the judge refuses, and fails twice
        row("b", 0, 0, 1.0, time=1.0),
        row("b", 0, 1, 9.0, valid=False, time=1.0),
        row("b", 1, 0, status="not_found", time=5.0),
        row("b", 1, 1, status="not_connected", time=1.0),
    ]
)


def summary(paths, **options):
    return summarise(paths, "toy", **options).set_index("planner")


def test_every_row_counts_for_success_and_time():
    found = summary(TABLE)
    assert found.loc["a", ["rows", "queries", "success", "found", "refused"]].tolist() == [
        4,
        2,
        1.0,
        1.0,
        0.0,
    ]
    assert found.loc["b", ["rows", "success", "found", "refused", "not_connected"]].tolist() == [
        4,
        0.25,
        0.5,
        0.25,
        0.25,
    ]
    assert found.loc["a", "time_mean_s"] == 3.0
    assert found.loc["a", "time_std_s"] == pytest.approx(np.sqrt(14 / 3))
    assert found.loc["b", "time_mean_s"] == 2.0


def test_lengths_are_over_the_queries_that_every_planner_solved():
    found = summary(TABLE)
    assert found["compared"].tolist() == [1, 1]
    assert found.loc["a", ["latent_shortest", "latent_mean", "length_mean_rad"]].tolist() == [
        20.0,
        30.0,
        3.0,
    ]
    assert found.loc["a", "latent_std"] == pytest.approx(np.sqrt(200.0))  # of 20 and 40
    assert found.loc["b", ["latent_shortest", "latent_mean"]].tolist() == [10.0, 10.0]
    assert np.isnan(found.loc["b", "latent_std"])  # one path has no spread


def test_mean_and_spread_are_taken_a_query_first():
    found = summary(TABLE[TABLE["planner"] == "a"])
    assert found.loc["a", "latent_shortest"] == 25.0  # of 20 and 30
    assert found.loc["a", "latent_mean"] == 30.0
    assert found.loc["a", "latent_std"] == pytest.approx(np.sqrt((200.0 + 0.0) / 2))


def test_length_over_best_uses_the_shortest_counted_path_of_the_query():
    found = summary(TABLE)
    # a: 2 and 4 over b's 1, then 3 and 3 over 3
    assert found.loc["a", "over_best_median"] == pytest.approx(np.median([2.0, 4.0, 1.0, 1.0]))
    assert found.loc["a", "over_best_p95"] == pytest.approx(np.quantile([2.0, 4.0, 1.0, 1.0], 0.95))
    assert found.loc["b", "over_best_median"] == 1.0


def test_found_paths_count_where_asked_even_if_the_judge_refused_them():
    found = summary(TABLE, counted="found")
    assert found.loc["b", "latent_mean"] == 50.0  # of 10 and 90
    assert found.loc["b", "success"] == 0.25


def test_violation_is_over_all_returned_paths_in_degrees_and_millimetres():
    found = summary(TABLE)
    assert found.loc["a", "violation_median_deg"] == pytest.approx(np.degrees(0.15))
    assert found.loc["a", "violation_max_deg"] == pytest.approx(np.degrees(0.3))
    assert found.loc["a", "violation_max_mm"] == pytest.approx(3.0)
    assert np.isnan(found.loc["b", "violation_max_deg"])


def test_a_planner_without_any_path_keeps_its_row_and_hides_no_other():
    failed = pd.DataFrame(
        [row("c", q, s, status="not_found", time=7.0) for q in (0, 1) for s in (0, 1)]
    )
    found = summary(pd.concat([TABLE, failed], ignore_index=True))
    assert found.loc["c", ["rows", "success", "compared", "time_mean_s"]].tolist() == [
        4,
        0.0,
        0,
        7.0,
    ]
    assert found.loc["c", ["latent_mean", "over_best_median", "violation_max_deg"]].isna().all()
    pd.testing.assert_frame_equal(found.loc[["a", "b"]], summary(TABLE))


def test_the_straight_line_does_not_choose_the_queries():
    a = TABLE[TABLE["planner"] == "a"]
    straight = pd.DataFrame(
        [row("straight_latent_line", 0, 0, 2.5), row("straight_latent_line", 1, 0, valid=False)]
    )
    found = summary(pd.concat([a, straight], ignore_index=True))
    assert found["compared"].tolist() == [2, 1]
    assert found.loc["a", "latent_mean"] == 30.0
    assert found.loc["straight_latent_line", "latent_mean"] == 25.0
    assert np.isnan(found.loc["straight_latent_line", "time_mean_s"])


def test_result_depends_neither_on_the_order_of_rows_nor_on_their_index():
    shuffled = TABLE.sample(frac=1.0, random_state=3)
    pd.testing.assert_frame_equal(summary(shuffled).sort_index(), summary(TABLE))


def test_common_queries():
    assert common_queries(TABLE) == {0, 1}
    assert common_queries(TABLE[TABLE["valid"]]) == {0}
    assert common_queries(TABLE[:0]) == set()
