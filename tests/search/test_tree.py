"""Ways of two trees: every corner sound, the same for the same seed, and round what stands in the
way.
"""

from dataclasses import replace

import numpy as np
import pytest
from tests.planner_fixtures import NAMES, manifold_of, packaged_planner, pairs_of

from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.band import project
from constraint_geodesics.search.roadmap import edge_lengths
from constraint_geodesics.search.space import Space, space_of
from constraint_geodesics.search.tree import TreeSettings, tree_way

MARGIN = 0.006


def scene_space(name: str, *more: Sphere) -> Space:
    scene = packaged_planner().scene.now
    model = clearance_model(replace(scene, workcell=(*scene.workcell, *more)))
    return space_of(manifold_of(packaged_planner(), name), model, MARGIN)


@pytest.mark.parametrize("name", NAMES)
def test_a_way_is_made_of_edges_that_hold(name) -> None:
    space, manifold = scene_space(name), manifold_of(packaged_planner(), name)
    found = 0
    for start, goal in pairs_of(name, 4, seed=3):
        corners = tree_way(space, start, goal, 0)
        if corners is None:
            continue
        found += 1
        assert corners[0].tobytes() == start.tobytes()
        assert corners[-1].tobytes() == goal.tobytes()
        assert manifold.violation(corners).max() <= 1e-6
        inner = corners[1:-1].copy()
        assert project(space, inner) <= 1e-6
        np.testing.assert_allclose(inner, corners[1:-1], atol=1e-5)
        lengths = np.empty(len(corners) - 1)
        edge_lengths(
            space,
            corners,
            np.stack([np.arange(len(lengths)), np.arange(1, len(corners))], axis=1),
            lengths,
        )
        assert np.isfinite(lengths).all()
    assert found >= 3


def test_a_seed_decides_the_way() -> None:
    space, bare, different = scene_space("slide"), TreeSettings(shortcuts=0), 0
    for start, goal in pairs_of("slide", 6, seed=4):
        first, again, other = (tree_way(space, start, goal, seed, bare) for seed in (0, 0, 1))
        assert (first is None) == (again is None)
        if first is None or again is None or other is None:
            continue
        assert first.tobytes() == again.tobytes()
        different += (
            first.tobytes() != other.tobytes()
        )  # trees that meet at once have drawn nothing
    assert different >= 2


def test_shortcuts_leave_corners_out_and_make_the_way_shorter() -> None:
    space = scene_space("level_cup")
    shorter = 0
    for start, goal in pairs_of("level_cup", 5, seed=5):
        long, short = (tree_way(space, start, goal, 2, TreeSettings(shortcuts=n)) for n in (0, 60))
        if long is None or short is None:
            continue
        ways = [np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in (long, short)]
        assert len(short) <= len(long)
        assert ways[1] <= ways[0] + 1e-9
        shorter += ways[1] < 0.95 * ways[0] or len(short) < len(long)
    assert shorter >= 3


def test_where_there_is_no_way_there_is_none() -> None:
    start, goal = pairs_of("level_cup", 1, seed=6)[0]
    x, y, z = map(float, packaged_planner().scene.robot.forward(goal)[0])
    space = scene_space("level_cup", Sphere("over the goal", (x, y, z), 0.15))
    assert tree_way(space, start, goal, 0, TreeSettings(iterations=30)) is None


def test_a_sphere_is_gone_round() -> None:
    planner = packaged_planner()
    robot, gone_round = planner.scene.robot, 0
    for start, goal in pairs_of("free", 6, seed=7):
        line = np.linspace(start, goal, 50)
        x, y, z = map(float, robot.forward(line[25])[0])
        ball = Sphere("ball", (x, y, z), 0.08)
        model = clearance_model(Scene(robot, (*planner.scene.workcell, ball)))
        if model.clearance(robot, line[[0, -1]]).min() < 0.02:
            continue
        way = tree_way(scene_space("free", ball), start, goal, 0)
        assert way is not None
        assert model.clearance(robot, way[1:-1]).min() >= MARGIN - 1e-6
        assert len(way) > 2, "the straight line leads through the ball"
        gone_round += 1
    assert gone_round >= 3


def test_settings_bound_the_work() -> None:
    start, goal = pairs_of("tool_down", 1, seed=8)[0]
    settings = TreeSettings()
    assert (
        tree_way(scene_space("tool_down"), start, goal, 0, replace(settings, nodes=2, iterations=1))
        is None
    )
