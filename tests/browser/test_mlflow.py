"""MLflow's dashboard shows the runs that stages made, and compares them, with nothing asked from
elsewhere.
"""

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from constraint_geodesics.tracking.views import COMPARED, VIEWS
from tests.browser.chromium import Traffic, until, visit
from tests.browser.dashboard import (
    FLAT,
    SIDE_PANEL_CLOSED,
    base_of,
    line_colours,
    row,
    runs_address,
    runs_found,
    view_address,
)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

Opened = tuple["Page", Traffic]
SEEDS = ("plane seed 0", "plane seed 1")
OF_THE_PLANE = "tags.stage = 'train_analytic' and tags.item = 'plane'"
ITS_SEEDS = f"{OF_THE_PLANE} and tags.child LIKE 'seed %'"
COLUMNS = ("final/mean_ratio", "return", "seed")


@pytest.fixture
def opened(browser: "Browser") -> Iterator[Opened]:
    with visit(browser, viewport={"width": 1800, "height": 900}) as (page, traffic):
        page.add_init_script(SIDE_PANEL_CLOSED)
        yield page, traffic


def test_the_printed_address_opens_the_comparison_with_its_columns(
    opened: Opened, compared_page: str
) -> None:
    page, traffic = opened
    page.goto(compared_page)
    row(page, "planner-free seed 0").wait_for()
    heads = page.get_by_role("columnheader").evaluate_all(
        "heads => heads.map(head => [head.innerText.trim(), head.getBoundingClientRect().x])"
    )
    wanted = ["Run Name", "Created", "constraint", "planner", "seed", *COMPARED, "Duration"]
    places = dict(heads)
    assert sorted(wanted, key=places.__getitem__) == wanted
    dashboard = base_of(compared_page)
    found = runs_found(dashboard, VIEWS[0].search)
    assert len(found) > 50
    for run in found:
        assert "system/" not in str(run["data"]["metrics"])
    seeds = runs_found(dashboard, "tags.item = 'planner-free' and tags.seed = '0'")
    figures = {entry["key"]: entry["value"] for entry in seeds[0]["data"]["metrics"]}
    for name in COMPARED:
        cell = page.locator(f'[row-id="{seeds[0]["info"]["run_id"]}"] [col-id*="{name}"]').first
        assert float(cell.inner_text()) == pytest.approx(figures[name], rel=0.01)
    assert not traffic.outside


def test_names_fit_their_column(opened: Opened, compared_page: str) -> None:
    page, _ = opened
    page.goto(view_address(base_of(compared_page), VIEWS[1]))
    row(page, "train_geodesics planner-level_cup_relaxed").wait_for()
    links = page.get_by_role("link", name=re.compile("^train_geodesics"))
    assert links.count() == 6
    for link in links.all():
        assert link.evaluate("a => a.scrollWidth <= a.clientWidth")


def test_the_menu_of_views_leads_to_each(opened: Opened, compared_page: str) -> None:
    page, traffic = opened
    page.goto(compared_page)
    row(page, "planner-free seed 0").wait_for()
    menu = page.get_by_test_id("saved-views-trigger")
    assert menu.inner_text().strip() == VIEWS[0].name
    for view in VIEWS[1:3]:
        menu.click()
        listed = page.get_by_role("menuitem").all_inner_texts()
        assert [name for name in map(str.strip, listed) if name in {v.name for v in VIEWS}] == [
            view.name for view in VIEWS
        ]
        page.get_by_role("menuitem").filter(has_text=re.compile(f"^{view.name}$")).click()
        page.get_by_role("columnheader").filter(
            has_text=re.compile(rf"^\s*{re.escape(view.tags[-1])}\s*$")
        ).first.wait_for()
        until(lambda name=view.name: menu.inner_text().strip() == name, "the menu has its name")
    assert not traffic.outside


def test_a_view_has_its_charts(opened: Opened, compared_page: str) -> None:
    page, traffic = opened
    view = VIEWS[1]
    page.goto(view_address(base_of(compared_page), view, "CHART"))
    for _, metric in view.charts:
        page.get_by_text(metric, exact=True).first.wait_for()
    assert not traffic.outside


def test_the_description_says_where_to_click(opened: Opened, compared_page: str) -> None:
    page, _ = opened
    page.goto(compared_page)
    row(page, "planner-free seed 0").wait_for()
    page.get_by_text(re.compile(r"Click\s+Views\s+at the top right")).first.wait_for()


def test_the_table_has_the_runs_by_name_their_seeds_below_them_and_the_columns_asked_for(
    opened: Opened, small_dashboard: str
) -> None:
    page, traffic = opened
    page.goto(runs_address(small_dashboard, ""))
    row(page, "train_analytic plane").wait_for()
    page.get_by_test_id("search-box").fill(OF_THE_PLANE)
    page.keyboard.press("Enter")
    row(page, "train_analytic plane").locator(
        "button"
    ).first.click()  # what MLflow hides below the parent
    for name in SEEDS:
        row(page, name).wait_for()
    for column in COLUMNS:
        choose_column(page, column)
    found = runs_found(small_dashboard, ITS_SEEDS)
    assert len(found) == len(SEEDS)
    for run in found:
        ratio = next(
            entry["value"] for entry in run["data"]["metrics"] if entry["key"] == "final/mean_ratio"
        )
        cell = page.locator(
            f'[row-id="{run["info"]["run_id"]}"] [col-id*="final/mean_ratio"]'
        ).first
        assert float(cell.inner_text()) == pytest.approx(ratio, rel=0.01)
    assert not traffic.outside


def choose_column(page: "Page", name: str) -> None:
    page.get_by_role("button", name="Columns").click()
    page.get_by_placeholder("Search columns").fill(name)
    page.get_by_role("dialog").locator("[class*=tree-title]").filter(
        has_text=re.compile(f"^{name}$")
    ).first.click()
    page.keyboard.press("Escape")
    page.get_by_role("columnheader").filter(
        has_text=re.compile(rf"^\s*{name}\s*$")
    ).first.wait_for()


def test_two_seeds_are_compared_down_to_their_learning_curves(
    opened: Opened, small_dashboard: str
) -> None:
    page, traffic = opened
    compare(page, runs_address(small_dashboard, ITS_SEEDS, **FLAT), SEEDS, "return")
    assert not traffic.outside


def test_two_seeds_of_this_checkout_are_compared_as_well(
    opened: Opened, own_dashboard: str
) -> None:
    page, traffic = opened
    search = "tags.stage = 'train_policies' and tags.child LIKE 'seed %'"
    seeds = ("joint_space seed 0", "joint_space seed 1")
    compare(page, runs_address(own_dashboard, search, **FLAT), seeds, "saving")
    assert not traffic.outside


def compare(page: "Page", runs: str, names: tuple[str, str], curve: str) -> None:
    """From the table to the page that compares two runs, and on to a chart of one of their
    figures.
    """
    page.goto(runs)
    for name in names:
        row(page, name).locator("input[type=checkbox]").first.click()
    page.get_by_test_id("runs-compare-button").click()
    for name in names:
        page.get_by_role("cell", name=re.compile(f"^{name}")).first.wait_for()
    page.get_by_role("link", name=curve, exact=True).first.click()
    until(lambda: len(line_colours(page)) == 2, "a line for each seed")
    for name in names:
        page.get_by_text(re.compile(rf"^{name}.*\({curve}\)$")).first.wait_for()


def test_the_charts_lay_the_learning_curves_of_all_seeds_over_each_other(
    opened: Opened, small_dashboard: str
) -> None:
    page, traffic = opened
    page.goto(runs_address(small_dashboard, ITS_SEEDS, compareRunsMode="CHART", **FLAT))
    page.get_by_placeholder("Search metric charts").fill("^return$")
    until(lambda: len(line_colours(page)) == len(SEEDS), "one chart with a line for each seed")
    assert not traffic.outside
