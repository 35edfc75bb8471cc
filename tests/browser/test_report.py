"""The report's page as a person sees it who has no network: on a desk, on a telephone, by day and
by night.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.browser.chromium import ROOT, Traffic, visit
from tests.browser.pixels import picture

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

Opened = tuple["Page", Traffic]
PAGES = [ROOT / "reports" / name for name in ("index.html", "benchmark.html")]
DESK, TELEPHONE = {"width": 1280, "height": 900}, {"width": 390, "height": 844}
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
