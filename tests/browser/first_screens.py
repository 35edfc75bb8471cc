"""The first screens that people see, as pictures to be looked at: `make first-screens`.

    python -m tests.browser.first_screens [FOLDER]

README as a web page, both pages of the report and the documentation's first page, each on a
desktop, at night and on a phone; the page that `geodesics ui` opens, and two seeds compared there;
three recordings in Rerun's viewer.
What this checkout has not made is named, with the command that makes it.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markdown_it import MarkdownIt

from constraint_geodesics.palette import BLUE, planner_colour
from tests.browser.chromium import ROOT, chromium, visit
from tests.browser.dashboard import SIDE_PANEL_CLOSED, base_of
from tests.browser.screenshots import MissingRunError, copied_dashboard, rerun, settled, two_seeds

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SIZES: dict[str, dict[str, Any]] = {
    "desktop": {"viewport": {"width": 1280, "height": 800}},
    "night": {"viewport": {"width": 1280, "height": 800}, "color_scheme": "dark"},
    "phone": {
        "viewport": {"width": 390, "height": 844},
        "device_scale_factor": 2,
        "is_mobile": True,
        "has_touch": True,
    },
}
STYLE = """
:root { color-scheme: light dark }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 56rem; margin: 2rem auto; padding: 0 1rem;
  overflow-wrap: anywhere }
img { max-width: 100% } table { border-collapse: collapse; display: block; overflow-x: auto }
td, th { border: 1px solid #8888; padding: .3rem .8rem }
pre, code { background: #8882; border-radius: 6px } pre { padding: 1rem; overflow: auto }
"""
"""About as a forge shows a README."""
PAGES = {
    "readme": (ROOT / "README.md", ""),
    "report": (ROOT / "reports/index.html", "make repro"),
    "benchmark": (ROOT / "reports/benchmark.html", "make bench"),
    "docs": (ROOT / ".geodesics/site/index.html", "make docs"),
}
"""Files, and the commands that make them."""
OWN = ROOT / "data/recordings"
PLANNED = planner_colour("planner")
RECORDINGS = {
    "planned": (ROOT / "first_path/path.rrd", "make plan", PLANNED),
    "executed": (OWN / "execute_paths/level_cup/query0-planned-path.rrd", "make repro", PLANNED),
    "episode": (OWN / "study_episodes/level_cup/episode0-replan.rrd", "make bench", BLUE),
}
"""Files, the commands that make them, and a colour that each draws from its first second on: of the
planner's path, or of the path that an episode follows.
"""


@contextlib.contextmanager
def readme_page() -> Iterator[Path]:
    """README as a page beside it, so that its pictures are found."""
    text = (
        MarkdownIt("commonmark", {"html": True})
        .enable("table")
        .render((ROOT / "README.md").read_text())
    )
    page = ROOT / ".readme.html"
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    page.write_text(f"<!doctype html>{head}<style>{STYLE}</style>{text}")
    try:
        yield page
    finally:
        page.unlink()


def page_shot(browser: "Browser", address: str, size: str) -> bytes:
    """The first screen of a page; says where it is wider than that."""
    with visit(browser, **SIZES[size]) as (page, traffic):
        page.goto(address)
        page.wait_for_load_state("networkidle")
        wide = page.evaluate("document.documentElement.scrollWidth")
        room = SIZES[size]["viewport"]["width"]  # a phone's own width grows with what it shows
        if wide > room:
            print(f"{address} on a {size}: {wide} pixels wide, {room} are there", file=sys.stderr)
        if traffic.outside:
            print(f"{address} asks for {traffic.outside[:3]}", file=sys.stderr)
        return page.screenshot()


def ui_shot(browser: "Browser") -> bytes:
    """What `geodesics ui` opens."""
    with copied_dashboard() as address, visit(browser, **SIZES["desktop"]) as (page, _):
        page.add_init_script(SIDE_PANEL_CLOSED)
        page.goto(address)
        page.wait_for_load_state("networkidle")
        return settled(page)


def comparison_shot(browser: "Browser") -> bytes:
    """Two seeds of one stage, their curves in one chart."""
    with copied_dashboard() as address:
        return two_seeds(browser, base_of(address))


def shots(browser: "Browser", readme: Path) -> Iterator[tuple[str, Callable[[], bytes]]]:
    """Every picture's name, and how it is taken."""
    for name, (file, made_by) in PAGES.items():
        page = readme if name == "readme" else file
        for size in SIZES:
            shot = partial(page_shot, browser, page.as_uri(), size)
            yield f"{name}-{size}", partial(_of_file, file, made_by, shot)
    yield "dashboard", partial(ui_shot, browser)
    yield "comparison", partial(comparison_shot, browser)
    for name, (file, made_by, colour) in RECORDINGS.items():
        shot = partial(rerun([file], [colour]), browser, "")
        yield f"recording-{name}", partial(_of_file, file, made_by, shot)


def _of_file(file: Path, made_by: str, shot: Callable[[], bytes]) -> bytes:
    if not file.is_file():
        raise MissingRunError(f"there is no {file.relative_to(ROOT)}: {made_by}")
    return shot()


def main(folder: Path) -> int:
    """Take all pictures.  Exit code 1 if one can't be taken."""
    folder.mkdir(parents=True, exist_ok=True)
    code = 0
    with chromium() as browser, readme_page() as readme:
        for name, shot in shots(browser, readme):
            try:
                (folder / f"{name}.png").write_bytes(shot())
                print(folder / f"{name}.png", flush=True)
            except (MissingRunError, AssertionError) as error:
                print(f"{name}: {error}", file=sys.stderr)
                code = 1
    return code


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1] if sys.argv[1:] else ROOT / ".geodesics/screens")))
