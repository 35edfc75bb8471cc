"""The first page opens with the figures of its reports: other figures, other words."""

import json

import numpy as np
import pandas as pd
import pytest
from tests.report.test_standing import summary

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.front import (
    NOT_RUN,
    SAME,
    SAME_NOTE,
    learning,
    opening,
    planner_row,
)
from constraint_geodesics.report.standing import ASKED
from constraint_geodesics.studies.proposals import PLANNER, POLICY, STILL

ABOUT = {"commit": "0123456789abcdef", "date": "2026-01-01", "processor": "a processor"}


def figures(solved, length, refined, spread=0.001):
    """A method's figures with intervals of this half width."""
    row = {"solvable": 10, "seeds": 5, "time_ms_iqm": 4.0}
    for column, value in (("solved", solved), ("ratio_p95", length), ("refined", refined)):
        row |= {f"{column}_iqm": value}
        row |= {f"{column}_{end}": value + by for end, by in (("low", -spread), ("high", spread))}
    return row


@pytest.fixture
def layout(tmp_path):
    return Layout(tmp_path)


def write_overview(layout, *rows):
    folder = layout.root / "reports" / "benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).assign(seeds=1).to_csv(folder / "overview.csv", index=False)
    (folder / "about.json").write_text(json.dumps(ABOUT))


def write_policies(layout, **groups):
    file = layout.report("benchmark_policies", "policies")
    file.parent.mkdir(parents=True, exist_ok=True)
    named = {name.replace("_", " "): {"table": rows} for name, rows in groups.items()}
    file.write_text(json.dumps(named))


def test_three_sentences_with_the_planners_own_figures(layout):
    write_overview(layout, *summary("planner", (1.0, 0.9), (1.0, 1.5)))
    sentences = opening(layout, measured=True)
    assert len(sentences) == 3
    asked = f"the {ASKED - 1} of {ASKED} queries that any planner solved"
    assert f"solves 90.0% of {asked}" in sentences[1]
    assert opening(layout, measured=False)[1] == NOT_RUN


def test_the_row_stands_beside_the_best_of_the_rest_with_its_commit(layout):
    own = summary("planner", (1.0, 0.9), (1.001, 1.5))
    prm, birrt = (summary(name, (0.8, 0.8), (np.inf, 2.0)) for name in ("PRM", "BiRRT"))
    better = summary("BiRRT", (0.9, 0.85), (1.2, 2.0))
    write_overview(layout, *own, *prm, *better)
    row = planner_row(layout)
    assert [cells[0] for cells in row.rows] == ["planner", "BiRRT", "PRM"]
    assert row.rows[0][1:5] == ["30 × 1", "100.0%", "1.001", "2"]
    assert row.rows[1][6:] == ["85.0%", "2.000", "2"]
    assert [span for _, span in row.groups] == [4, 4]
    assert "commit 0123456789ab, 2026-01-01" in row.note
    write_overview(layout, *own, *summary("PRM", (0.95, 0.9), (1.2, 2.0)), *birrt)
    assert [cells[0] for cells in planner_row(layout).rows] == ["planner", "PRM", "BiRRT"]


def test_the_planner_is_also_shown_on_the_queries_of_the_best_of_the_rest(layout):
    fewer = summary("PRM", (0.95, 0.9), (1.2, 2.0), queries=ASKED)
    many = summary("planner", (1.0, 0.9), (1.001, 1.5), queries=2 * ASKED)
    same = {"reference_queries": ASKED, "reference_seeds": 1}
    same |= {"reference_success_of_solvable": 1.0}
    same |= {"reference_ratio_p95_all": 1.1, "reference_time_median_s": 0.004}
    write_overview(layout, *[row | same for row in (*many, *fewer)])
    row = planner_row(layout)
    assert row.rows[-1] == [SAME.format("PRM"), *["30 × 1", "100.0%", "1.100", "4"] * 2]
    assert row.planners == ["planner", "PRM", "planner"]
    assert SAME_NOTE in row.note


def test_what_learning_adds_is_what_its_intervals_show(layout, params):
    policy, still = figures(0.99, 1.04, 0.98), figures(0.98, 1.04, 0.99)
    write_policies(layout, trained_on={POLICY: policy, STILL: still})
    found = learning(params, layout)
    on = "constraints it was trained on, in the workcell"
    assert found.adds == [f"Solved with one curve: better on {on} (99.0% against 98.0%)."]
    assert found.lacks == [
        f"Length of that curve, p95: no difference that the intervals show on {on} (1.040 against "
        "1.040).",
        f"Solved once the planner's band has refined it: worse on {on} (98.0% against 99.0%).",
    ]
    assert found.table.rows[0][:4] == [f"{on}: {POLICY}", "10", "5", "99.0% [98.9%, 99.1%]"]


def test_a_policy_that_is_as_good_as_none_adds_nothing(layout, params):
    same = figures(0.9, 1.1, 0.9)
    write_policies(
        layout,
        trained_on={POLICY: same, STILL: same, PLANNER: figures(1.0, 1.0, 1.0)},
        never_seen={POLICY: same, STILL: figures(0.8, 1.1, 0.9)},
    )
    found = learning(params, layout)
    assert [text.split(" on ")[1] for text in found.adds] == [
        "constraints never seen, in the workcell (90.0% against 80.0%)."
    ]
    assert found.lacks[-1].startswith("The planner, in which nothing is learned, solves 100.0% on")
    write_policies(layout, trained_on={POLICY: same, STILL: same})
    assert learning(params, layout).adds == ["Nothing that the intervals over the seeds show."]
    unknown = {**same, "solved_low": None, "solved_high": None}
    write_policies(layout, trained_on={POLICY: figures(1.0, 1.1, 0.9), STILL: unknown})
    assert learning(params, layout).adds == ["Nothing that the intervals over the seeds show."]
    write_policies(layout, trained_on={POLICY: same})
    assert learning(params, layout) is None
