"""Tables of the planner that users call: exact figures from rows that are known."""

import pytest
from tests.report.study_fixtures import ORIGIN, write_study_reports

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.study_report import (
    execution_block,
    execution_markdown,
    policies_markdown,
    policy_blocks,
    what_learning_adds,
)


@pytest.fixture(scope="module")
def reported(params, tmp_path_factory):
    layout = Layout(tmp_path_factory.mktemp("run"))
    write_study_reports(params, layout)
    return params, layout


def test_policies_are_compared_over_what_anything_solves(reported):
    params, _ = reported
    blocks = policy_blocks(*reported)
    first = blocks[0]
    rows = {row[0]: row[1:] for row in first.rows}
    cells = ["2 × 1", "100.0%", "", "1.0150", "1.0195", "1.0200", "5", "4", "", ""]
    cells += ["100.0%", "1.0145"]
    assert rows["policy"] == cells
    cells = ["2 × 1", "50.0%", "", "1.1000", "1.1000", "∞", "5", "4", "100%", "100%"]
    cells += ["50.0%", "1.0950"]
    assert rows["random curves, same time"] == cells
    assert "2 queries, 2 of which anything solves" in first.note
    assert "the family's shortest curve" in first.note
    others = {block.title: block.note for block in blocks[1:]}
    assert len(others) == 1 + len(params.unseen) + 3
    assert all("the shortest certified path known" in note for note in others.values())
    assert any("one sphere on the way" in title for title in others)


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
    text = execution_markdown(*reported)
    assert "| straight joint line" in text
    assert "| planned path" in text
    text = policies_markdown(*reported)
    assert "| random curves, same time" in text
    assert ORIGIN in text


def test_what_learning_adds_is_said_of_every_footing(reported):
    params, _ = reported
    said = what_learning_adds(*reported)
    footings = ["One curve", "Constraints never trained on", "A sphere on the way"]
    assert list(said) == [*footings, "Refined paths"]
    assert (
        "policy 100.0% and 1.0150; the same search, no policy 50.0% and 1.0250; random curves, "
        "same time 50.0%" in said["Refined paths"]
    )
    assert said["One curve"].startswith(
        f"{params.studies.constraint}: solved, and 95th percentile of the length over the family's "
        "shortest curve, policy 100.0% and 1.020; the same search, no policy 50.0% and 1.030; "
        "random curves, same time 50.0% and 1.100."
    )
    for name in params.unseen:
        assert f"{name} 100%" in said["Constraints never trained on"]
