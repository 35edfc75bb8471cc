"""Recordings as the web viewer shows them: the arm, its tool's way in its planner's colour, and
both moving.
"""

import sys
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.palette import GOAL as GOAL_COLOUR
from constraint_geodesics.palette import START as START_COLOUR
from constraint_geodesics.palette import planner_colour
from constraint_geodesics.params import Params
from constraint_geodesics.recording.recording import PathRecord, record_path
from constraint_geodesics.scene.scene import Scene
from tests.browser.chromium import ROOT, served, until, visit
from tests.browser.pixels import Picture, having, picture, scene_of
from tests.end_to_end import smoke

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

START, GOAL = [0.3, -0.5, -1.0, 0.4, 0.5, 0.2], [1.5, -0.2, -1.4, 0.8, 0.7, 0.6]
VIEWER_S = 300
"""The viewer compiles its shaders without a graphics card."""
CURVE, ROBOT = 100, 1000
"""So many pixels a curve and an arm have at least."""
ASKED_IN_VAIN = {"fonts.googleapis.com", "api.github.com", "app.rerun.io", "tel.rerun.io"}
"""Whom Rerun's page asks for a font, newer versions, examples, and tells of its use; it does
without their answers.
"""


@pytest.fixture(scope="module")
def recordings(
    scene: Scene, params: Params, tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    """The straight joint line, and a way that bends away from it, in free space."""
    folder, t = tmp_path_factory.mktemp("recordings"), np.linspace(0.0, 1.0, 40)[:, None]
    straight = np.array(START) + t * (np.array(GOAL) - np.array(START))
    bent = straight + np.sin(np.pi * t) * np.array([0.0, 0.5, -0.7, 0.0, 0.0, 0.0])
    files = []
    for planner, joints in (("learned_geodesic", straight), ("birrt", bent)):
        path = PathRecord(planner, "free", 0, 0, joints, f"**{planner}**", meshes=False)
        files.append(folder / f"{planner}.rrd")
        constrained = constraint_manifold(scene.robot, params.constraints["free"])
        record_path(files[-1], path, constrained, scene.workcell, frames=60)  # as the stages do
    return files


def replayed(*files: Path) -> list[str]:
    return [sys.executable, "-m", "constraint_geodesics.cli", "replay", "--web", *map(str, files)]


def scene_shown(page: "Page", address: str, colours: list[str]) -> Picture:
    """The 3D view, once all the colours are in it."""
    page.goto(f"{address}&renderer=webgl")
    until(
        lambda: all(curve(scene_of(picture(page)), colour) for colour in colours),
        f"curves in {colours}",
    )
    return scene_of(picture(page))


def curve(scene: Picture, colour: str) -> bool:
    return int(having(scene, colour).sum()) >= CURVE


@pytest.mark.timeout(VIEWER_S)
def test_a_recording_shows_the_arm_and_its_tools_way_and_plays(
    browser: "Browser", recordings: list[Path]
) -> None:
    with (
        served(replayed(recordings[0]), ROOT, smoke.environment(ROOT)) as address,
        visit(browser, viewport={"width": 1000, "height": 640}) as (page, traffic),
    ):
        shown = scene_shown(page, address, [planner_colour("learned_geodesic")])
        assert arm(shown) >= ROBOT, "its links are in bright colours; table and ground are not"
        until(
            lambda: moved(shown, scene_of(picture(page))) >= ROBOT,
            "the arm is seen in another place",
        )
        assert {urlsplit(address).hostname for address in traffic.outside} <= ASKED_IN_VAIN


def arm(scene: Picture) -> int:
    """Pixels in a bright colour that is not of the tool's way or its ends."""
    bright = np.ptp(scene.astype(int), axis=-1) > 60
    drawn = [
        having(scene, colour)
        for colour in (planner_colour("learned_geodesic"), START_COLOUR, GOAL_COLOUR)
    ]
    return int((bright & ~np.any(drawn, axis=0)).sum())


def moved(before: Picture, after: Picture) -> int:
    """Pixels that differ."""
    return int((abs(before.astype(int) - after) > 40).any(axis=-1).sum())


@pytest.mark.timeout(VIEWER_S)
def test_two_recordings_are_laid_over_each_other_in_their_planners_colours(
    browser: "Browser", recordings: list[Path]
) -> None:
    colours = [planner_colour(name) for name in ("learned_geodesic", "birrt")]
    with (
        served(replayed(*recordings), ROOT, smoke.environment(ROOT)) as address,
        visit(browser, viewport={"width": 1000, "height": 640}) as (page, _),
    ):
        shown = scene_shown(page, address, colours)
        assert not curve(shown, planner_colour("prm")), "a planner that is in neither recording"
