"""Tables of the study of arms and goals: cells and targets from figures that are known."""

import pytest
from tests.report.study_fixtures import ORIGIN, write_arm_report

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.arms_page import TABLES, arm_tables, arms_markdown


@pytest.fixture(scope="module")
def layout(tmp_path_factory) -> Layout:
    layout = Layout(tmp_path_factory.mktemp("run"))
    write_arm_report(layout)
    return layout


def test_every_measurement_is_a_table_that_ends_with_its_targets(layout) -> None:
    tables = arm_tables(layout)
    assert [own.title for own in tables] == [own.title for own in TABLES.values()]
    for own in tables:
        assert [row[0] for row in own.rows] == ["UR5, level", "all", "target"]
        assert {len(row) for row in own.rows} == {len(own.header)}
        assert any(own.rows[-1][1:]), "something is aimed at"


def test_the_cells_are_the_figures(layout) -> None:
    first, between, *_, held = arm_tables(layout)
    assert first.rows[0] == ["UR5, level", "0.00", "0.00"]
    cells = dict(zip(between.header, between.rows[1], strict=True))
    assert cells["of these the planner"] == "100.0%"
    assert cells["length / best known, median"] == "1.2500"
    assert (cells["queries"], cells["BiRRT solves"], cells["BiRRT [ms], median"]) == (
        "3",
        "1",
        "80",
    )
    cells = dict(zip(held.header, held.rows[0], strict=True))
    assert (cells["queries"], cells["solved"], cells["not connected"]) == ("3", "2", "1")
    assert cells["of what either solves"] == "100.0%"


def test_markdown_names_every_table_and_target(layout) -> None:
    text = arms_markdown(layout)
    assert f"{ORIGIN}, next to another process." in text
    for own in TABLES.values():
        assert f"## {own.title}\n" in text
        assert all(column.target in text for column in own.columns)
