"""Tables of the planner that users call: exact figures from rows that are known."""

from pathlib import Path

import pytest
from tests.benchmark.plan_fixtures import write_plan_reports

from constraint_geodesics.params import load_params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.plan_report import (
    execution_block,
    plan_blocks,
    plans_markdown,
    policies_markdown,
    policy_blocks,
)


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    params, layout = (
        load_params(Path(__file__).parents[2] / "params.yaml"),
        Layout(tmp_path_factory.mktemp("run")),
    )
    write_plan_reports(params, layout)
    return params, layout


def test_every_planner_has_its_row_and_failures_count(reported):
    whole, unseen = plan_blocks(*reported)
    rows = {row[0]: row[1:] for row in whole.rows}
    assert rows["planner"] == ["100.0%", "0", "1.0000", "1.0000", "1.0000", "4", "4", "5", "5"]
    # of lengths 1.1 and 1.0 times the best, and 1.5 and 2; one of three queries is missed
    assert rows["BiRRT + band"][:5] == ["66.7%", "0", "1.0500", "1.0950", "–"]
    assert rows["BiRRT"][:4] == ["66.7%", "1", "1.7500", "1.9750"]
    assert "3 queries, 3 of which" in whole.note
    assert "300 queries a second, 400 without" in whole.note
    assert "the straight start (100%), the graph (0%), the policies (0%)" in whole.note
    assert [row[0] for row in whole.rows] == ["planner", "BiRRT + band", "BiRRT"]
    assert len(unseen.rows) == 3 * len(reported[0].plans.unseen)


def test_policies_are_compared_where_every_method_answers(reported):
    (block,) = policy_blocks(*reported)
    rows = {row[0]: row[1:] for row in block.rows}
    assert rows["policy"] == ["100.0%", "1.0100", "1.0100", "1.0100", "5", "4"]
    assert rows["straight line"][:2] == ["50.0%", "1.1000"]
    assert "ratios over the 1 that every method solves" in block.note


def test_the_cup_on_both_paths(reported):
    block = execution_block(*reported)
    assert block.rows[0] == ["planned path", "2", "100%", "100%", "0.6", "0", "0.002", "1.50"]
    assert block.rows[1][2:5] == ["25%", "0%", "90.0"]
    assert "tilts the cup by 115° or more" in block.note
    planned, straight = block.links
    (recorded,) = planned.recordings
    assert recorded.command == "geodesics replay data/recordings/execute_paths/level_cup/0.rrd"
    assert recorded.text == "query 0: executed, 12 of 12 spheres kept"
    assert not straight.recordings


def test_markdown_holds_every_row(reported):
    text = plans_markdown(*reported)
    assert text.count("BiRRT + band") == 1 + len(reported[0].plans.unseen)
    assert "| planned path" in text
    assert "| straight line" in policies_markdown(*reported)
