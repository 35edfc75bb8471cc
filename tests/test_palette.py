"""One colour a planner: that of palette.py, in every figure and table, and far enough from the
other families'.
"""

import itertools
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from constraint_geodesics.palette import (
    FAMILIES,
    GREY,
    NIGHT,
    by_night,
    planner_colour,
    planner_family,
)
from constraint_geodesics.params import load_params
from constraint_geodesics.peers.registry import all_settings, colours
from constraint_geodesics.report.benchmark_figures import DASHES, styles_of
from constraint_geodesics.report.figures import PLANNERS
from constraint_geodesics.report.study_report import METHODS

PARAMS = load_params(Path(__file__).parents[1] / "params.yaml")
COLOURS = colours(all_settings(PARAMS))
SHOWN = {
    *PARAMS.benchmark.planners,
    *METHODS,
    *PLANNERS,
    *(style.label for style in PLANNERS.values()),
}
"""Every planner that a table, a figure or a recording names."""


def seen(colour, without):
    """A colour as who has no cones of one kind sees it: Viénot, Brettel and Mollon, Color Res.
    Appl., 1999.
    """
    linear = np.array(
        [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(colour)]
    )
    cones = np.array(
        [[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]]
    )
    reduced = {
        "protan": np.array([[0, 2.02344, -2.52581], [0, 1, 0], [0, 0, 1]]),
        "deutan": np.array([[1, 0, 0], [0.494207, 0, 1.24827], [0, 0, 1]]),
        "none": np.eye(3),
    }[without]
    rgb = np.linalg.inv(cones) @ reduced @ cones @ linear
    return np.clip(rgb, 0, 1) ** (1 / 2.2)


@pytest.mark.parametrize("planner", sorted(SHOWN))
def test_every_planner_is_in_a_family(planner):
    family = planner_family(planner)
    assert family is not None
    assert planner_colour(planner) == FAMILIES[family].colour


def test_figures_take_their_colours_from_the_palette():
    for name, style in PLANNERS.items():
        assert style.colour == planner_colour(name) == planner_colour(style.label)
    for name, colour in COLOURS.items():
        assert colour == planner_colour(name), "as its recordings have it"


def test_drawn_planners_of_one_family_differ_in_dashes():
    styles = styles_of(PARAMS.benchmark.drawn, COLOURS)
    for one, two in itertools.combinations(styles.values(), 2):
        assert one["color"] != two["color"] or one["linestyle"] != two["linestyle"]
    assert len({str(dash) for dash in DASHES}) == len(DASHES)


def test_a_name_of_no_family_is_grey():
    assert planner_family("something else") is None
    assert planner_colour("something else") == GREY


@pytest.mark.parametrize("without", ["none", "protan", "deutan"])
def test_families_are_told_apart_without_red_or_green_cones(without):
    colours = [family.colour for family in FAMILIES.values()]
    assert len(set(colours)) == len(colours)
    for one, two in itertools.combinations(colours, 2):
        assert np.abs(seen(one, without) - seen(two, without)).max() > 0.09, (one, two)


def test_families_are_told_apart_and_seen_at_night():
    colours = [by_night(family.colour) for family in FAMILIES.values()]
    turned = [
        name for name, own in FAMILIES.items() if by_night(own.colour).lower() != own.colour.lower()
    ]
    assert turned == ["optimisation", "other"], "the greys"
    for one, two in itertools.combinations(colours, 2):
        assert np.abs(seen(one, "none") - seen(two, "none")).max() > 0.09, (one, two)
    for colour in colours:
        assert np.abs(np.array(to_rgb(colour)) - to_rgb(NIGHT.page)).max() > 0.3, colour


def test_black_and_white_change_places_at_night():
    assert by_night("#000000").lower() == NIGHT.ink
    assert by_night("#ffffff").lower() == NIGHT.page
