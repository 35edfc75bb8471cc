"""The documentation as a person sees it who has no network: from disk, on a desk and on a
telephone, by day and by night.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.browser.chromium import until, visit
from tests.browser.pixels import picture
from tests.browser.test_report import DESK, TELEPHONE
from tests.docs_site import NO_MKDOCS, built

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = NO_MKDOCS
OVERHANGING = """() => {
  const scrolls = element => getComputedStyle(element).overflowX !== 'visible';
  const boxed = element => {
    for (let at = element.parentElement; at && at.tagName !== 'ARTICLE'; at = at.parentElement)
      if (scrolls(at) && at.getBoundingClientRect().right <= innerWidth + 1) return true;
    return false;
  };
  return [...document.querySelectorAll('article *')]
    .filter(element => element.getBoundingClientRect().right > innerWidth + 1 && !boxed(element))
    .map(element => element.outerHTML.slice(0, 120));
}"""
"""What of the text goes beyond the page's edge and lies in no box that scrolls."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("site"))


@pytest.mark.parametrize("by", ["light", "dark"])
@pytest.mark.parametrize("name", ["index", "results", "first_path_notebook", "api_planner"])
def test_a_page_is_whole_from_disk_by_day_and_by_night(
    browser: "Browser", site: Path, name: str, by: str
) -> None:
    with visit(browser, viewport=DESK, color_scheme=by) as (page, traffic):
        page.context.set_offline(True)
        page.goto((site / f"{name}.html").as_uri())
        page.wait_for_load_state("networkidle")
        assert not traffic.outside
        assert not traffic.errors
        images = "[...document.images].map(image => [image.src.slice(0, 80), image.naturalWidth])"
        assert all(width > 0 for _, width in page.evaluate(images))
        ground = picture(page)[-8:, :8].reshape(-1, 3)
        assert (np.median(ground) < 64) == (by == "dark")


def test_the_night_can_be_chosen_and_is_kept(browser: "Browser", site: Path) -> None:
    scheme = "document.body.getAttribute('data-md-color-scheme')"
    with visit(browser, viewport=DESK, color_scheme="light") as (page, _):
        page.goto((site / "index.html").as_uri())
        for name in ("By day", "By night"):
            page.get_by_title(name, exact=True).click()
        assert page.evaluate(scheme) == "slate"
        page.goto((site / "scenes.html").as_uri())
        assert page.evaluate(scheme) == "slate"


@pytest.mark.parametrize(
    ("words", "where"),
    [
        ("plan_batch", "api_planner.html#constraint_geodesics.Planner.plan_batch"),
        ("PointCloud", "api_scene.html#constraint_geodesics.PointCloud"),
        ("braking distance", "scenes.html#obstacles-that-appear"),
    ],
)
def test_the_search_finds_a_word_without_a_server(
    browser: "Browser", site: Path, words: str, where: str
) -> None:
    with visit(browser, viewport=DESK) as (page, traffic):
        page.context.set_offline(True)
        page.goto((site / "index.html").as_uri())
        page.wait_for_load_state("networkidle")
        page.locator("input[name=query]").click()
        page.locator("input[name=query]").press_sequentially(words)  # the theme listens to keys
        file, place = where.split("#")  # the words to be marked stand between them
        link = f'a.md-search-result__link[href*="{file}"][href$="#{place}"]'
        found = page.locator(link)
        until(lambda: found.count() > 0, f"{words} is found in {where}")
        found.first.click()
        page.wait_for_load_state("networkidle")
        assert not traffic.outside
        assert not traffic.errors


def test_nothing_is_wider_than_a_telephone(browser: "Browser", site: Path) -> None:
    wide = {}
    with visit(browser, viewport=TELEPHONE, is_mobile=True, has_touch=True) as (page, _):
        for file in sorted(site.glob("*.html")):
            if file.name == "404.html":  # for servers
                continue
            page.goto(file.as_uri())
            page.wait_for_load_state("networkidle")
            whole = page.evaluate("document.scrollingElement.scrollWidth")
            over = page.evaluate(OVERHANGING)
            if whole > TELEPHONE["width"] or over:
                wide[file.name] = (whole, over[:3])
    assert not wide


def test_a_wide_table_scrolls_in_its_own_box(browser: "Browser", site: Path) -> None:
    with visit(browser, viewport=TELEPHONE, is_mobile=True, has_touch=True) as (page, _):
        page.goto((site / "results.html").as_uri())
        page.wait_for_load_state("networkidle")
        box = "document.querySelector('article table').closest('.md-typeset__scrollwrap')"
        whole, seen = page.evaluate(f"(box => [box.scrollWidth, box.clientWidth])({box})")
        assert whole > seen
        moved = page.evaluate(f"(box => {{ box.scrollLeft = 40; return box.scrollLeft; }})({box})")
        assert moved == 40
