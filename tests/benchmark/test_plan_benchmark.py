"""The planner's benchmark on two queries, with the planner that comes with the package."""

from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import packaged_planner, pairs_of

from constraint_geodesics.benchmark.plan_benchmark import (
    BAND_AFTER,
    MULTI_START,
    TANGENT,
    batch_rate,
    plan_rows,
    plan_table,
)
from constraint_geodesics.learning.dataset import Queries
from constraint_geodesics.params import load_params
from constraint_geodesics.search.band import BandSettings


@pytest.fixture(scope="module")
def asked():
    params = load_params(Path(__file__).parents[2] / "params.yaml")
    settings = params.plans.model_copy(
        update={"parts": ("planner", "straight"), "peers": ("birrt",), "seeds": (0, 1), "starts": 4}
    )
    pairs = pairs_of("level_cup", 2, seed=1)
    return params, settings, Queries(*(np.array(ends) for ends in zip(*pairs, strict=True)))


@pytest.fixture(scope="module")
def answered(asked):
    params, settings, queries = asked
    planner = packaged_planner()
    constraint = planner.constraints["level_cup"]
    # fewer segments than the planner's: nothing may count on their number
    return plan_rows(
        planner,
        planner.scene,
        "level_cup",
        constraint,
        queries,
        settings,
        BandSettings(segments=8),
        params.benchmark,
        params.judge,
    )


def test_every_planner_query_and_seed_has_its_row(answered) -> None:
    rows, paths = answered
    counts = rows.groupby("planner").size().to_dict()
    assert counts == {
        "planner": 2,
        "straight": 2,
        MULTI_START: 2,
        "BiRRT": 4,
        BAND_AFTER: 4,
        TANGENT: 4,
    }
    assert set(paths) == {
        (r["planner"], r["query"], r["seed"]) for r in rows.to_dict("records") if r["valid"]
    }
    own = rows[rows["planner"] == "planner"]
    assert own["valid"].all()
    assert own["source"].isin(["straight", "graph", "policy"]).all()


def test_best_known_is_the_shortest_valid_path(answered) -> None:
    rows, _ = answered
    for _, group in rows.groupby("query"):
        np.testing.assert_array_equal(
            group["best_known_rad"], group.loc[group["valid"], "length_rad"].min()
        )
    assert (
        rows.loc[rows["valid"], "length_rad"] >= rows.loc[rows["valid"], "best_known_rad"]
    ).all()


def test_the_final_check_is_told_apart_wherever_there_is_one(answered) -> None:
    rows, _ = answered
    for name in ("planner", MULTI_START, BAND_AFTER):
        own = rows[(rows["planner"] == name) & rows["valid"]]
        assert (own["check_time_s"] > 0.0).any(), name
        assert not (own["check_time_s"] >= own["time_s"]).any(), name
    assert rows.loc[rows["planner"] == "BiRRT", "check_time_s"].isna().all()


def test_the_table_counts_every_row(answered) -> None:
    rows, _ = answered
    table = plan_table(rows).set_index("planner")
    assert (table["queries"] == 2).all()
    assert table.loc["planner", "success"] == 1.0
    assert table.loc["planner", "from_straight"] + table.loc["planner", "from_graph"] == 1.0
    assert (table["ratio_median"].dropna() >= 1.0).all()


def test_a_batch_answers_every_query(asked) -> None:
    _, _, queries = asked
    planner = packaged_planner()
    rate = batch_rate(planner, planner.constraints["level_cup"], queries, 5)
    assert rate["size"] == 5
    assert 0.0 < rate["checked_per_second"] < rate["per_second"]
