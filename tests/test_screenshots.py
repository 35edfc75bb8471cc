"""The documentation's pictures: each marker has one, each picture a marker, and none is large; and
README's moving one.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from constraint_geodesics.palette import SKY
from constraint_geodesics.recording.recording import read_recording
from tests.browser import hero, screenshots
from tests.browser.pixels import having
from tests.browser.screenshots import DOCS, IMAGES, LARGEST_BYTES, MARKER, SHOTS, WIDTH

PAGES = {page.name: page.read_text() for page in sorted(DOCS.glob("*.md"))}
MARKED = [(page, name) for page, text in PAGES.items() for name in MARKER.findall(text)]
PICTURES = sorted(IMAGES.glob("*.png"))


def test_each_marker_is_one_picture_that_can_be_made() -> None:
    names = [name for _, name in MARKED]
    assert sorted(names) == sorted(SHOTS)


@pytest.mark.parametrize(("page", "name"), MARKED)
def test_a_marker_has_its_picture_below_it(page: str, name: str) -> None:
    below = rf"<!-- screenshot: {name} -->\n\n!\[[^]]{{20,}}\]\(images/{name}\.png\)\n"
    assert re.search(below, PAGES[page]), "run `make screenshots`"
    assert (IMAGES / f"{name}.png").is_file()


@pytest.mark.parametrize("picture", PICTURES, ids=lambda picture: picture.stem)
def test_a_picture_is_small_and_stands_on_a_page(picture: Path) -> None:
    assert picture.stat().st_size <= LARGEST_BYTES
    with Image.open(picture) as image:
        assert image.width <= WIDTH
        assert image.mode == "P"
    assert any(f"](images/{picture.name})" in text for text in PAGES.values())


def test_writing_the_pictures_of_a_page_again_changes_nothing() -> None:
    page = "before\n\n<!-- screenshot: one -->\n\nbetween\n\n<!-- screenshot: other -->\n"
    once = screenshots.with_pictures(page, {"one": "what it shows"})
    shown = "<!-- screenshot: one -->\n\n![what it shows](images/one.png)\n\nbetween"
    assert shown in once
    assert once.endswith("<!-- screenshot: other -->\n")
    assert screenshots.with_pictures(once, {"one": "what it shows"}) == once
    assert "![new](images/one.png)\n\nbetween" in screenshots.with_pictures(once, {"one": "new"})


def test_readme_s_picture_moves_and_is_small() -> None:
    assert "](docs/images/hero.webp)" in (DOCS.parent / "README.md").read_text()
    assert hero.PICTURE.stat().st_size <= hero.LARGEST_BYTES
    with Image.open(hero.PICTURE) as image:
        assert image.size == hero.SIZE
        assert image.n_frames >= 30


def test_readme_s_picture_is_of_a_certified_path_past_the_pillar(tmp_path: Path) -> None:
    cup = hero.carried_cup()
    past, through = hero.planned(cup)
    assert past.certificate is not None
    assert past.certificate.violation is None
    assert [held.shape for held in past.scene.attached] == [cup]
    assert hero.PILLAR in past.scene.workcell
    assert hero.PILLAR not in through.scene.workcell
    past.record(tmp_path / "path.rrd", frames=3)
    shown = read_recording(tmp_path / "path.rrd")
    poses = hero.cup_poses(past.scene.robot, cup, shown.joints)
    np.testing.assert_allclose(poses[:, :3, 2], np.tile([0, 0, 1], (3, 1)), atol=1e-3)
    first, _, last = hero.pictures(past.scene.robot, cup, shown, through)
    places = [np.argwhere(having(np.asarray(one), SKY)).mean(axis=0) for one in (first, last)]
    assert np.linalg.norm(places[1] - places[0]) > 100, "the cup is carried across the picture"
