"""What the chart of the benchmark's page reads is what the rows say."""

import base64

import numpy as np
import pandas as pd
import pytest
from tests.readme import ROOT

from constraint_geodesics.benchmark.row import read_table
from constraint_geodesics.benchmark.statistics import all_constraints, over_budget, ratio_of
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.chooser import EXCESS, NONE, TIME_S, coded, packed


def decoded(codes, ends):
    low, high = ends
    return np.where(codes == NONE, np.inf, low * (high / low) ** (codes / (NONE - 1)))


@pytest.fixture(scope="module")
def rows():
    return read_table(Layout(ROOT).benchmark_table)[0]


@pytest.fixture(scope="module")
def content(rows):
    return packed(rows, list(dict.fromkeys(rows["planner"])))


def numbers(content, planner):
    """Query, time and length over the best known of a planner's rows, as a page reads them."""
    (text,) = (own["rows"] for own in content["planners"] if own["name"] == planner)
    query, time, excess = np.frombuffer(base64.urlsafe_b64decode(text), "<u2").reshape(-1, 3).T
    return query, decoded(time, content["time"]), 1.0 + decoded(excess, content["excess"])


@pytest.mark.parametrize("planner", ["planner", "straight + band", "BiRRT", "RRT* 10 s"])
def test_shares_within_a_time_are_those_of_the_rows(rows, content, planner):
    query, time, ratio = numbers(content, planner)
    scene = np.repeat(
        *zip(*((own["scene"], own["queries"]) for own in content["cases"]), strict=True)
    )
    wanted = over_budget(
        all_constraints(rows[rows["planner"] == planner]), budgets := [0.01, 0.1, 1.0, 15.0]
    )
    for name, own in wanted.groupby("scene"):
        here = scene[query] == name
        found = [((time <= budget) & np.isfinite(ratio))[here].mean() for budget in budgets]
        assert found == pytest.approx(own["success"].tolist(), abs=1.5 / here.sum())


def test_lengths_are_those_of_the_rows(rows, content):
    _, _, found = numbers(content, "planner")
    own = rows[(rows["planner"] == "planner") & rows["best_known_rad"].notna()]
    wanted = ratio_of(own).to_numpy()
    assert np.isfinite(found).sum() == np.isfinite(wanted).sum()
    np.testing.assert_allclose(
        np.sort(found[np.isfinite(found)]), np.sort(wanted[np.isfinite(wanted)]), atol=2e-3
    )


def test_queries_are_counted_through_all_cases(rows, content):
    asked = rows[rows["best_known_rad"].notna()].groupby(["constraint", "scene"])["query"].nunique()
    found = {(own["constraint"], own["scene"]): own["queries"] for own in content["cases"]}
    assert found == asked.to_dict()
    assert numbers(content, "planner")[0].max() < sum(found.values())


def test_codes_reach_from_end_to_end_and_tell_nothing_apart():
    values = pd.Series([TIME_S[0] / 2, TIME_S[0], TIME_S[1], 2 * TIME_S[1], np.nan])
    assert coded(values, TIME_S).tolist() == [0, 0, NONE - 1, NONE - 1, NONE]
    near = decoded(coded(pd.Series([0.0123]), EXCESS), EXCESS)
    assert near == pytest.approx(0.0123, rel=1e-3)
