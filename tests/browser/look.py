"""Pictures of pages as they open from disk, on a desk by day and by night and on a telephone, to be
looked at: `python -m tests.browser.look FOLDER PAGE.html …`.

By default the pages are the report's two and the documentation's first, if `make docs` made them.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.browser.chromium import ROOT, chromium, visit

if TYPE_CHECKING:
    from playwright.sync_api import Browser

PAGES = ("reports/index.html", "reports/benchmark.html", ".geodesics/site/index.html")
TELEPHONE = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True}
WAYS: dict[str, dict[str, Any]] = {
    "desk": {"viewport": {"width": 1280, "height": 900}},
    "night": {"viewport": {"width": 1280, "height": 900}, "color_scheme": "dark"},
    "telephone": TELEPHONE,
}


def first_screen(browser: "Browser", page_file: Path, way: str) -> bytes:
    """What is seen of a page before anybody scrolls, as PNG."""
    with visit(browser, **WAYS[way]) as (page, _):
        page.context.set_offline(True)
        page.goto(page_file.as_uri())
        page.wait_for_load_state("networkidle")
        return page.screenshot()


def main(folder: str, *pages: str) -> None:
    """Write a picture for each page and way, and say where."""
    chosen: Sequence[str] = pages or PAGES
    Path(folder).mkdir(parents=True, exist_ok=True)
    with chromium() as browser:
        for name in chosen:
            file = (ROOT / name).resolve()
            if not file.is_file():
                print(f"{name}: there is none", file=sys.stderr)
                continue
            for way in WAYS:
                picture = Path(folder) / f"{file.parent.name}-{file.stem}-{way}.png"
                picture.write_bytes(first_screen(browser, file, way))
                print(picture)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("usage: python -m tests.browser.look FOLDER [PAGE.html …]")
    main(*sys.argv[1:])
