"""MLflow's dashboard shows the runs that stages made, and compares them, with nothing asked from
elsewhere.
"""

import re
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.browser.chromium import Traffic, until, visit
from tests.browser.dashboard import (
    FLAT,
    SIDE_PANEL_CLOSED,
    line_colours,
    row,
    runs_address,
    runs_found,
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
    search = (
        "tags.stage = 'train_geodesics' and tags.item = 'planner-level_cup' and tags.child "
        "LIKE 'seed %'"
    )
    seeds = ("planner-level_cup seed 0", "planner-level_cup seed 1")
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
