"""The benchmark's page, from the committed tables: it says what they say, and asks nothing of the
network.
"""

import html
import shutil
from pathlib import Path

import pandas as pd
import pytest
from tests.report.pages import check_page

from constraint_geodesics.benchmark.row import read_table
from constraint_geodesics.palette import planner_colour
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.benchmark_page import write_benchmark_page
from constraint_geodesics.report.benchmark_tables import ahead_markdown, verdict_cells
from constraint_geodesics.report.results import ReportError
from constraint_geodesics.report.standing import (
    CHOICE,
    SHOWN,
    best_of_families,
    equal_time,
    losses,
    planner_result,
    winner,
)

ROOT = Path(__file__).parents[2]
SOURCES = ("benchmark", "benchmark_repeat", "growth")


@pytest.fixture(scope="module")
def layout(tmp_path_factory):
    root = tmp_path_factory.mktemp("checkout")
    for name in SOURCES:
        shutil.copytree(ROOT / "reports" / name, root / "reports" / name)
    shutil.copy(ROOT / "reports" / "benchmark.csv", root / "reports")
    return Layout(root)


@pytest.fixture(scope="module")
def page(layout, params):
    write_benchmark_page(params, layout)
    reports = layout.root / "reports"
    return check_page((reports / "benchmark.html").read_text(), reports, ("index.html",))


def table_of(layout, name):
    return pd.read_csv(layout.root / "reports" / "benchmark" / f"{name}.csv")


def text_of(layout):
    return html.unescape((layout.root / "reports" / "benchmark.html").read_text())


def test_every_figure_of_the_benchmark_is_on_the_page(page):
    assert len(page.sources) == 2
    assert {"growth/growth.png", "benchmark/break_even.png"} <= set(page.links)


def test_the_page_opens_with_who_is_ahead_and_where_the_planner_loses(layout, page):
    text, budgets = text_of(layout), table_of(layout, "budgets")
    overview = table_of(layout, "overview")
    first = text.index(f"<strong>Ahead at equal time: {winner(budgets)}.</strong>")
    assert first < text.index(equal_time(budgets))
    assert first < text.index(planner_result(overview))
    for loss in losses(overview, budgets):
        place = text.index(f"<strong>{loss.title}</strong>: {loss.sentence}")
        assert first < text.index('id="chooser"') < place, "narrow screens show the chart before"
        for detail in loss.details:
            assert place < text.index(f"<li>{detail}</li>") < text.index('id="overview"')


def test_other_verdicts_give_the_page_another_winner(layout, page, params):
    file = layout.root / "reports" / "benchmark" / "budgets.csv"
    kept, turned = file.read_text(), table_of(layout, "budgets")
    turned["verdict"] = turned["verdict"].replace({"ahead": "behind", "behind": "ahead"})
    assert winner(table_of(layout, "budgets")) != winner(turned)
    try:
        turned.to_csv(file, index=False)
        write_benchmark_page(params, layout)
        assert f"Ahead at equal time: {winner(turned)}.</strong> It is ahead" in text_of(layout)
    finally:
        file.write_text(kept)
        write_benchmark_page(params, layout)
    kept_first = winner(table_of(layout, "budgets"))
    assert f"Ahead at equal time: {kept_first}.</strong> Within" in text_of(layout)


def test_five_curves_are_chosen_at_first_and_all_constraints_and_scenes(layout, page):
    rows, _ = read_table(layout.benchmark_table)
    best = best_of_families(table_of(layout, "overview"))[:SHOWN]
    chosen = [value for kind, value in page.checked if kind == "planner"]
    assert sorted(chosen) == sorted(["planner", *best])
    assert len(chosen) == 5
    for column in ("constraint", "scene"):
        assert {value for kind, value in page.checked if kind == column} == set(rows[column])
    assert CHOICE[1:] in text_of(layout)


def test_the_overview_says_what_its_csv_says(layout, page, params):
    overview = table_of(layout, "overview")
    for row in overview.to_dict("records"):
        shown = page.rows(f"Scene {row['scene']}, all planners")
        cells = shown.get(row["planner"]) or shown[f"{row['planner']} †"]
        assert cells[0] == f"{row['queries']} × {row['seeds']}"
        assert cells[1].startswith(f"{row['success_of_solvable']:.0%} [")
        assert cells[2] == str(row["claimed_but_invalid"])
        header = page.tables[f"Scene {row['scene']}, all planners"][0]
        median = cells[header.index("time [ms]: median") - 1]
        assert float(median.replace(",", "")) == pytest.approx(1e3 * row["time_median_s"], rel=6e-3)
        assert cells[-1] == ("–" if pd.isna(row["beaten"]) else f"{row['beaten']:.0%}")
    drawn = page.rows("Scene table, planners that are drawn")
    assert {name.removesuffix(" †") for name in drawn} - {"planner"} <= set(params.benchmark.drawn)
    parts = page.rows("Scene table, the planner and its parts")
    assert {"without graph", "without trees"} <= set(parts)
    assert "BiRRT" not in parts


def test_every_case_has_a_row_for_every_planner_in_its_colour(layout, page):
    summary = table_of(layout, "summary")
    for (constraint, scene), case in summary.groupby(["constraint", "scene"]):
        title = f"{constraint}, scene {scene}"
        header, *rows = page.tables[title]
        assert [row[0] for row in rows] == case["planner"].tolist()
        place = header.index("claimed, not valid")
        wanted = [
            "–" if row["not_applicable"] == row["rows"] else str(row["claimed_but_invalid"])
            for row in case.to_dict("records")
        ]
        assert [row[place] for row in rows] == wanted
        colours = [page.colours[title][k + 1] for k in range(len(rows))]
        assert colours == [planner_colour(row[0]) for row in rows]


def test_verdicts_are_counted_from_the_budgets(layout, page):
    budgets = table_of(layout, "budgets")
    _, *rows = page.tables["Cases by budget"]
    by_case = budgets.groupby(["scene", "budget_s"])
    assert len(rows) == by_case.ngroups
    for scene, budget, *counts, of in rows:
        case = by_case.get_group((scene, float(budget))).groupby("constraint")["verdict"]
        assert int(counts[2]) == int(case.agg(lambda v: "ahead" in set(v)).sum())
        alone = case.agg(lambda v: "behind" in set(v) <= {"behind", "neither"})
        assert int(counts[0]) == int(alone.sum())
        assert sum(map(int, counts)) == int(of) == case.ngroups
    assert len(page.tables["Baselines and parts that are ahead"]) == 1 + int(
        (budgets["verdict"] == "ahead").sum()
    )


def test_a_planner_that_no_baseline_is_ahead_of_has_no_table_of_baselines():
    case = {"constraint": "free", "scene": "table", "baseline": "a baseline", "queries": 2}
    table = pd.DataFrame(
        [
            case | {"budget_s": 0.1, "verdict": "behind"},
            case | {"budget_s": 0.01, "verdict": "neither"},
            case | {"budget_s": 1.0, "verdict": "behind"},
            case | {"budget_s": 1.0, "verdict": "tied", "baseline": "another"},
        ]
    )
    text = ahead_markdown(table)
    assert "a baseline" not in text.replace("is ahead of every baseline", "")
    assert "in 1 of 3 cases of constraint, scene and budget, and tied" in text
    assert verdict_cells(table)[1:] == [
        ("table", "0.01", "0", "0", "0", "1", "1"),
        ("table", "0.1", "1", "0", "0", "0", "1"),
        ("table", "1", "0", "1", "0", "0", "1"),
    ]


def test_costs_growth_and_the_second_run_are_those_of_their_tables(layout, page):
    for row in table_of(layout, "break_even").to_dict("records"):
        assert (
            page.rows("From how many queries on")[row["planner"]][0] == f"{row['training_s']:.0f}"
        )
    slopes = pd.read_csv(layout.root / "reports" / "growth" / "slopes.csv", comment="#")
    assert (slopes["points"] == 2).any()
    for row in slopes[slopes["points"] > 2].to_dict("records"):
        assert page.rows("Exponents")[f"{row['what']}: {row['axis']}"][0] == f"{row['slope']:.2f}"
    again = pd.read_csv(layout.root / "reports" / "benchmark_repeat" / "repeat.csv")
    assert {name: row[0] for name, row in page.rows("Two runs").items() if name != "planner"} == {
        row["planner"]: str(row["rows"])
        for row in again.to_dict("records")
        if row["planner"] != "planner"
    }


def test_every_recorded_row_has_its_command(layout, page):
    rows, _ = read_table(layout.benchmark_table)
    recorded = rows.loc[rows["recording"] != "", "recording"]
    assert len(recorded) > 0
    for file in recorded:
        assert f"geodesics replay {file[file.index('data/recordings/') :]}" in page.commands


@pytest.mark.parametrize(
    "name", ["benchmark.csv", "benchmark/overview.csv", "growth/slopes.csv", "growth/growth.png"]
)
def test_a_missing_file_is_one_line_that_says_what_makes_it(layout, params, page, name):
    file = layout.root / "reports" / name
    aside = file.with_suffix(".aside")
    file.rename(aside)
    try:
        with pytest.raises(ReportError, match="make bench") as error:
            write_benchmark_page(params, layout)
    finally:
        aside.rename(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)
