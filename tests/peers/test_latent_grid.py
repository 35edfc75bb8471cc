from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.planner_fixtures import (
    assert_sound,
    length,
    manifold_of,
    nodes_of,
    packaged_planner,
    problem,
)

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.geometry.curves import Curves, PinnedPolynomial
from constraint_geodesics.geometry.errors import GeometryError
from constraint_geodesics.geometry.length import estimate_length
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.submanifold import (
    GraphSubmanifold,
    GridSubmanifold,
    Surface,
    on_graph,
    on_grid,
)
from constraint_geodesics.learning.training import TrainingRun, train_manifold
from constraint_geodesics.params import Params
from constraint_geodesics.peers.latent_geodesic import same_constraint, straight_lengths
from constraint_geodesics.peers.latent_graph import LatentGraphSearch, LatentGraphSettings
from constraint_geodesics.peers.latent_grid import (
    GridSearch,
    LatentGridSettings,
    neighbours_on_grid,
)
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.world import World

FEW, DECODED = LatentGridSettings(rounds=4), LatentGridSettings(retracted=False)


@pytest.fixture(scope="module")
def plane(
    scene: Scene, params: Params, tmp_path_factory: pytest.TempPathFactory
) -> LearnedManifold:
    small = params.manifolds["paper"].model_copy(
        update={"epochs": 4, "variance_epochs": 2, "variance_centres": 64}
    )
    joints = nodes_of("free")[0]
    folder = tmp_path_factory.mktemp("plane")
    return train_manifold(
        joints, scene.robot, small, TrainingRun(folder, lambda *_: None, False)
    ).manifold


def graph_of(chart: LearnedManifold, name: str, world: World, params: Params) -> GraphSubmanifold:
    manifold, joints = manifold_of(packaged_planner(), name), nodes_of(name)[0]
    return on_graph(Surface(chart, manifold, world.free), joints, params.submanifold)


def grid_of(plane: LearnedManifold, name: str, params: Params, cells: int = 60) -> GridSubmanifold:
    manifold = manifold_of(packaged_planner(), name)
    settings = params.submanifold.model_copy(update={"grid": cells})
    return on_grid(plane, manifold, plane.encode(nodes_of("free")[0]), settings)


@pytest.mark.parametrize("name", ["free", "level_cup", "slide"])
def test_graph_paths_keep_the_constraint_and_shortcuts_shorten_them(
    name: str, world: World, chart: LearnedManifold, params: Params, certifier: Certifier
) -> None:
    constraint = packaged_planner().constraints[name]
    search = LatentGraphSearch(chart, constraint, graph_of(chart, name, world, params))
    solved = 0
    for seed in range(3):
        asked = problem(world, name, seed)
        short, plain = (
            search.plan(asked, 0),
            replace(search, settings=LatentGraphSettings(shortcuts=0)).plan(asked, 0),
        )
        assert short.status == plain.status
        if short.status == "solved":
            solved += 1
            for path in (short, plain):
                assert_sound(path, asked, certifier)
            assert length(short.joints) <= length(plain.joints) + 1e-3
            np.testing.assert_array_equal(search.plan(asked, 0).joints, short.joints)
    assert solved


def test_graph_goes_round_what_its_edges_do_not_know_of(
    world: World, chart: LearnedManifold, params: Params
) -> None:
    search = LatentGraphSearch(
        chart, packaged_planner().constraints["free"], graph_of(chart, "free", world, params)
    )
    asked = problem(world, "free", 0)
    middle = 0.5 * (asked.start + asked.goal)

    def outside_a_ball(q: np.ndarray) -> bool:
        return bool(np.linalg.norm(q - middle) > 0.7) and world.is_free(q)

    path = search.plan(replace(asked, is_free=outside_a_ball), 0)
    assert path.status == "solved"
    assert path.iterations > 1
    assert np.linalg.norm(path.joints - middle, axis=1).min() > 0.65
    walled = replace(
        asked, is_free=lambda q: any(np.array_equal(q, end) for end in (asked.start, asked.goal))
    )
    assert search.plan(walled, 0).status == "not_found"


def test_grid_paths_keep_the_constraint_only_where_they_are_retracted(
    world: World, plane: LearnedManifold, params: Params, certifier: Certifier
) -> None:
    constraint = packaged_planner().constraints["level_cup"]
    search = GridSearch(plane, constraint, grid_of(plane, "level_cup", params), FEW)
    plain = replace(search, settings=LatentGridSettings(rounds=4, retracted=False))
    statuses = []
    for seed in range(8):
        asked = problem(world, "level_cup", seed)
        path, decoded = search.plan(asked, 0), plain.plan(asked, 0)
        statuses.append(path.status)
        if path.status == "solved":
            assert_sound(path, asked, certifier)
            np.testing.assert_array_equal(search.plan(asked, 1).joints, path.joints)
        else:
            assert path.explanation
        assert decoded.status == "not_found"
        assert "leaves the constraint" in decoded.explanation
    assert "solved" in statuses


def test_grid_without_a_constraint_needs_no_retraction(
    world: World, plane: LearnedManifold, params: Params, certifier: Certifier
) -> None:
    constraint = packaged_planner().constraints["free"]
    search = GridSearch(plane, constraint, grid_of(plane, "free", params), DECODED)
    paths = [
        (search.plan(asked, 0), asked)
        for asked in (problem(world, "free", seed) for seed in range(4))
    ]
    assert any(path.status == "solved" for path, _ in paths)
    for path, asked in paths:
        if path.status == "solved":
            assert_sound(path, asked, certifier)


def test_an_infinite_weight_keeps_the_way_inside_the_submanifold(
    world: World, plane: LearnedManifold, params: Params
) -> None:
    constraint = packaged_planner().constraints["level_cup"]
    grid = grid_of(plane, "level_cup", params)
    nowhere = replace(grid, labels=np.full_like(grid.labels, -1))
    path = GridSearch(plane, constraint, nowhere, LatentGridSettings(inclusion_weight=np.inf)).plan(
        problem(world, "level_cup", 0), 0
    )
    assert (path.status, path.explanation) == ("not_found", "the grid does not join the ends")


def test_ends_and_constraints_that_do_not_fit_are_answers(
    world: World, chart: LearnedManifold, plane: LearnedManifold, params: Params
) -> None:
    constraints = packaged_planner().constraints
    grid = GridSearch(plane, constraints["slide"], grid_of(plane, "slide", params))
    graph = LatentGraphSearch(chart, constraints["slide"], graph_of(chart, "slide", world, params))
    asked = problem(world, "level_cup", 0)
    tilted = replace(asked, start=asked.start + np.array([0, 0, 0, 0, 0.3, 0]))
    for search in (grid, graph):
        path = search.plan(asked, 0)
        assert (path.status, path.joints.shape) == ("not_applicable", (0, 6))
        assert "another constraint" in path.explanation
        assert search.plan(tilted, 0).status == "start_violates"


def test_constraints_are_told_apart_by_what_they_hold(scene: Scene) -> None:
    constraints = packaged_planner().constraints
    names = list(constraints)
    for first in names:
        for second in names:
            assert same_constraint(constraints[first], constraints[second]) == (first == second)
    unplaced = Constraint((0, 0, 0, 1, 1, 0))
    assert not same_constraint(unplaced, unplaced)
    assert ConstraintManifold(scene.robot, constraints["slide"]).codim == 3


def test_a_grid_is_for_two_dimensions(
    chart: LearnedManifold, plane: LearnedManifold, params: Params
) -> None:
    constraint = packaged_planner().constraints["free"]
    with pytest.raises(GeometryError, match="dim = 6"):
        GridSearch(chart, constraint, grid_of(plane, "free", params, 10))


def test_grid_nodes_have_sixteen_neighbours() -> None:
    edges = neighbours_on_grid((7, 7))
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert (edges[:, 0] < edges[:, 1]).all()
    assert np.bincount(edges.ravel())[3 * 7 + 3] == 16


def test_chords_measure_what_the_metric_does(chart: LearnedManifold) -> None:
    first, last = (
        chart.encode(nodes_of("level_cup")[0][rows]) for rows in (slice(0, 20), slice(20, 40))
    )
    last = first + 0.2 * (last - first)
    line, none = PinnedPolynomial(chart.dim, 1), torch.zeros(20, 0, dtype=torch.float64)
    expected = estimate_length(
        chart, Curves(line, none, torch.from_numpy(first), torch.from_numpy(last))
    ).length
    np.testing.assert_allclose(straight_lengths(chart, first, last), expected.numpy(), rtol=5e-3)
