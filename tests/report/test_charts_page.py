"""The page of charts: cells and sentences from figures that are known."""

import json

import pytest
from tests.report.study_fixtures import ORIGIN, RUN

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.charts_page import METRICS, charts_markdown
from constraint_geodesics.report.results import studies_at_hand
from constraint_geodesics.studies.charts import CHART, HOLE, JOINTS, TASK, WORKCELL
from constraint_geodesics.studies.proposals import DESCENT, POLICY


def same(value: float | None) -> dict:
    return dict.fromkeys(("mean", "least", "largest"), value)


def chart(solved: float, p95: float) -> dict:
    search = {name: same(1.0) for name in ("ratio_median", "ms")}
    search |= {"solved": same(solved), "ratio_p95": same(p95)}
    about = {name: same(2.0) for name in ("learned_s", "trained_s", "reproduction_rad")}
    return {CHART: about, POLICY: search, DESCENT: search}


@pytest.fixture
def layout(tmp_path) -> Layout:
    geodesic = {"collision_free": same(0.25), "length_rad": same(3.0), "pairs": same(30.0)}
    nothing = {"collision_free": same(None), "length_rad": same(None), "pairs": same(0.0)}
    charts = {
        JOINTS: {"6": chart(0.99, 1.01)},
        WORKCELL: {"2": chart(0.4, 1.5), "6": chart(0.98, 1.02)},
        TASK: {"2": chart(0.5, 1.4), "6": chart(1.0, 1.015)},
        HOLE: {"2": dict.fromkeys(METRICS, geodesic), "6": dict.fromkeys(METRICS, nothing)},
    }
    file = tmp_path / "reports" / "compare_charts.json"
    file.parent.mkdir()
    file.write_text(json.dumps({"charts": charts, "queries": 50, "solvable": 49, "machine": RUN}))
    return Layout(tmp_path)


def test_the_page_says_what_the_figures_say(params, layout) -> None:
    text = charts_markdown(params, layout)
    assert ORIGIN in text
    assert "In joint space itself the policy solves 99.0% with a p95 of 1.010" in text
    assert "best learned chart, of 6 dimensions and task data, 100.0% and 1.015" in text
    assert "With fewer dimensions than joints it solves 40.0% to 50.0%." in text
    assert "in 2 dimensions 25.0% (25 to 25) of the geodesics with the variance term" in text
    assert "50 queries, of which 49 are solved in any chart" in text


def test_there_is_a_row_for_each_chart_and_for_each_metric(params, layout) -> None:
    lines = [line for line in charts_markdown(params, layout).splitlines() if line.startswith("|")]
    assert len(lines) == 2 * 2 + 5 + 2 * len(METRICS)
    assert any("nothing: joint space" in line and "–" in line for line in lines)
    assert sum("nan" in line for line in lines) <= len(METRICS)


def test_the_report_writes_it_where_the_study_was_run(params, layout, tmp_path) -> None:
    assert "charts" in studies_at_hand(params, layout)
    assert "charts" not in studies_at_hand(params, Layout(tmp_path / "other"))
