"""Ways among thin plates and rods."""

import numpy as np
from tests.planner_fixtures import packaged_bundle

from constraint_geodesics.studies.thin_shapes import (
    PLATE_M,
    ROD_M,
    SHAPES,
    Thicket,
    plates_and_rods,
    try_thicket,
)


def test_half_of_the_shapes_are_plates_and_half_rods() -> None:
    sizes = np.array([box.size_m for box in plates_and_rods(np.random.default_rng(0)).values()])
    assert ((sizes == PLATE_M).sum(axis=1) == 1).sum() == SHAPES / 2
    assert ((sizes == ROD_M).sum(axis=1) == 2).sum() == SHAPES / 2


def test_the_planner_finds_what_trees_find() -> None:
    own = packaged_bundle()
    found = try_thicket(Thicket(own, ("level_cup",), 4, seed=0))
    assert found.asked == 4
    assert 2 <= found.sampled == found.both <= found.planned
    assert found == try_thicket(Thicket(own, ("level_cup",), 4, seed=0))
