"""The report's page as a person sees it who has no network: on a desk, on a telephone, by day and
by night.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from constraint_geodesics.benchmark.row import read_table
from constraint_geodesics.benchmark.statistics import quantile_with_failures, ratio_of
from constraint_geodesics.palette import FAMILIES
from tests.browser.chromium import ROOT, Traffic, until, visit
from tests.browser.pixels import having, picture

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

Opened = tuple["Page", Traffic]
PAGES = INDEX, BENCHMARK = [ROOT / "reports" / name for name in ("index.html", "benchmark.html")]
COLOURED = {"index": "comparison_planner", "benchmark": "break_even"}
"""A figure of each page that has the planners' colours."""
TIMES_S = (0.01, 0.1, 1.0, 10.0)
"""Columns of the table below the benchmark's chart."""
DESK, TELEPHONE = {"width": 1280, "height": 900}, {"width": 360, "height": 740}
READABLE = 4.5
"""The contrast that WCAG's level AA asks of text."""
TEXTS = """() => {
  const lit = element => {
    for (let at = element; at; at = at.parentElement) {
      const colour = getComputedStyle(at).backgroundColor;
      if (!/^rgba\\(.*, 0\\)$/.test(colour) && colour !== 'transparent') return colour;
    }
    return 'rgb(255, 255, 255)';
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const found = [];
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    const words = walker.currentNode.data.trim();
    if (!words || element.closest('svg, script, style') || !element.checkVisibility()) continue;
    const style = getComputedStyle(element);
    found.push([words.slice(0, 40), style.color, lit(element)]);
  }
  return found;
}"""
"""Words of the page with their colour and that of the ground below them."""


@pytest.fixture(params=["light", "dark"])
def by(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(params=PAGES, ids=lambda page: page.stem)
def report(request: pytest.FixtureRequest) -> Path:
    return Path(request.param)


@pytest.fixture
def opened(browser: "Browser", by: str, report: Path) -> Iterator[Opened]:
    with visit(browser, viewport=DESK, color_scheme=by) as (page, traffic):
        page.context.set_offline(True)
        page.goto(report.as_uri())
        page.wait_for_load_state("networkidle")
        yield page, traffic


def test_the_page_is_whole_without_a_network(opened: Opened, report: Path) -> None:
    page, traffic = opened
    assert not traffic.outside
    assert all(url.startswith(("file:", "data:")) for url in traffic.local)
    assert {url for url in traffic.local if url.startswith("file:")} == {report.as_uri()}, (
        "it is one file"
    )
    assert not traffic.errors
    page.evaluate("document.querySelectorAll('details').forEach(part => { part.open = true; })")
    page.evaluate(
        "Promise.all([...document.images].map(image => "
        "{ image.loading = 'eager'; return image.decode(); }))"
    )
    widths = page.evaluate("[...document.images].map(image => [image.alt, image.naturalWidth])")
    assert widths
    assert all(width > 0 for _, width in widths), widths


def test_nothing_has_to_be_pushed_aside_on_a_telephone(
    browser: "Browser", by: str, report: Path
) -> None:
    with visit(browser, viewport=TELEPHONE, color_scheme=by, is_mobile=True, has_touch=True) as (
        page,
        _,
    ):
        page.goto(report.as_uri())
        page.evaluate("document.querySelectorAll('details').forEach(part => { part.open = true; })")
        whole, seen = page.evaluate(
            "[document.scrollingElement.scrollWidth, document.scrollingElement.clientWidth]"
        )
        assert whole <= seen == TELEPHONE["width"]


def test_words_can_be_read_and_the_night_is_dark(opened: Opened, by: str) -> None:
    page, _ = opened
    edge = picture(page)[:, :8].reshape(-1, 3)
    assert (np.median(edge) < 64) == (by == "dark")
    texts = page.evaluate(TEXTS)
    assert texts
    faint = [(words, *colours) for words, *colours in texts if contrast(*colours) < READABLE]
    assert not faint, faint[:10]


def test_figures_follow_the_theme_and_keep_the_planners_colours(
    opened: Opened, by: str, report: Path
) -> None:
    page, _ = opened
    figure = page.locator(f"#figure-{COLOURED[report.stem]} img")
    drawn = picture(figure)
    for family in ("planner", "birrt"):
        assert having(drawn, FAMILIES[family].colour).any(), family
    ground = np.median(drawn.reshape(-1, 3), axis=0)
    assert (ground < 64).all() if by == "dark" else (ground > 192).all()


@pytest.fixture
def chart(browser: "Browser", by: str) -> "Iterator[Page]":
    with visit(browser, viewport=DESK, color_scheme=by) as (page, traffic):
        page.context.set_offline(True)
        page.goto(BENCHMARK.as_uri())
        page.evaluate("document.getElementById('planners').open = true")
        yield page
        assert not traffic.outside
        assert not traffic.errors
        assert {url for url in traffic.local if url.startswith("file:")} == {BENCHMARK.as_uri()}


def curves(page: "Page") -> list[str]:
    """The planners whose curves are drawn: those with a path."""
    found: list[str] = page.evaluate(
        "[...document.querySelectorAll('#plot path')].filter(line => line.getAttribute('d'))"
        ".map(line => line.dataset.planner)"
    )
    return found


def shown(page: "Page") -> dict[str, list[str]]:
    """The table below the chart: cells by planner."""
    rows: list[list[str]] = page.evaluate(
        "[...document.querySelectorAll('#values tbody tr')]"
        ".map(row => [...row.cells].map(cell => cell.textContent))"
    )
    return {row[0]: row[1:] for row in rows}


def box(page: "Page", kind: str, value: str) -> "Locator":
    return page.locator(f'#chooser input[name="{kind}"][value="{value}"]')


def test_the_reader_chooses_planners(chart: "Page") -> None:
    first = curves(chart)
    assert len(first) == 5
    assert first[0] == "planner"
    box(chart, "planner", "RRT* 10 s").check()
    assert set(curves(chart)) == {*first, "RRT* 10 s"} == set(shown(chart))
    assert len({cells[0] for cells in shown(chart).values()}) == 1, "over the same queries"
    box(chart, "planner", "planner").uncheck()
    assert "planner" not in curves(chart)
    chart.get_by_role("button", name="as at first").click()
    until(lambda: curves(chart) == first, "the chart is as it was at first")


def test_the_chart_says_what_the_rows_say_of_the_chosen_constraints_and_scenes(
    chart: "Page",
) -> None:
    rows, _ = read_table(BENCHMARK.with_suffix(".csv"))
    chart.locator("#same").uncheck()
    for name in sorted(set(rows["constraint"]) - {"level_cup", "slide"}):
        box(chart, "constraint", name).uncheck()
    box(chart, "scene", "table").uncheck()
    own = rows[rows["constraint"].isin(["level_cup", "slide"]) & rows["best_known_rad"].notna()]
    own = own[(own["scene"] == "keep_out") & (own["planner"] == "planner")]
    queries, count, *values = shown(chart)["planner"]
    assert (int(queries), int(count)) == (
        own["query"].groupby(own["constraint"]).nunique().sum(),
        len(own),
    )
    wanted = [100 * (own["valid"] & (own["time_s"] <= time)).mean() for time in TIMES_S]
    told = [float(value.removesuffix(" %")) for value in values]
    assert told == pytest.approx(wanted, abs=0.05 + 150 / len(own))
    chart.locator("#measure").select_option("length")
    ratio = quantile_with_failures(ratio_of(own).to_numpy(), 0.95)
    assert float(shown(chart)["planner"][-1]) == pytest.approx(ratio, abs=2e-3)
    chart.locator("#measure").select_option("spread")
    within = 100 * (ratio_of(own) <= 1.01).mean()
    assert float(shown(chart)["planner"][4].removesuffix(" %")) == pytest.approx(within, abs=1.5)


def test_nothing_chosen_is_said_and_draws_nothing(chart: "Page") -> None:
    for scene in ("table", "keep_out"):
        box(chart, "scene", scene).uncheck()
    assert curves(chart) == []
    assert "No planner" in chart.locator("#counted").inner_text()


def contrast(ink: str, ground: str) -> float:
    """Of two colours as the browser computes them, by WCAG's formula."""
    dark, light = sorted((luminance(ink), luminance(ground)))
    return (light + 0.05) / (dark + 0.05)


def luminance(colour: str) -> float:
    channels = (
        np.array([float(part) for part in colour.split("(")[1].rstrip(")").split(",")[:3]]) / 255.0
    )
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
