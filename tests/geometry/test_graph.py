import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from constraint_geodesics.geometry.analytic import Sphere, Torus
from constraint_geodesics.geometry.graph import (
    OUTSIDE,
    GraphError,
    components,
    components_on_grid,
    nearest_neighbour_edges,
    shortest_path,
)
from constraint_geodesics.geometry.manifold import NonFiniteError

repeatable = settings(max_examples=60)
NO_EDGES = np.empty((0, 2), dtype=np.int64)


# Neighbours


def test_neighbours_on_a_line():
    edges = nearest_neighbour_edges(np.array([[0.0], [1.0], [2.1], [10.0]]), 1)
    assert edges.tolist() == [[0, 1], [1, 2], [2, 3]]
    assert edges.dtype == np.int64


@repeatable
@given(
    arrays(
        np.float64, st.tuples(st.integers(0, 12), st.integers(1, 3)), elements=st.integers(0, 4)
    ),
    st.integers(1, 5),
)
def test_every_point_is_joined_to_its_nearest(points, neighbours):
    edges = nearest_neighbour_edges(points, neighbours)
    assert (edges[:, 0] < edges[:, 1]).all()
    assert np.array_equal(edges, np.unique(edges, axis=0))
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    for i in range(len(points)):
        joined = np.concatenate([edges[edges[:, 0] == i, 1], edges[edges[:, 1] == i, 0]])
        wanted = min(neighbours, len(points) - 1)
        assert len(joined) >= wanted
        nearest = np.sort(np.delete(distances[i], i))[:wanted]
        assert np.allclose(np.sort(distances[i, joined])[:wanted], nearest)


def test_bad_points_are_refused():
    with pytest.raises(NonFiniteError, match=r"points\[1, 0\] = nan"):
        nearest_neighbour_edges(np.array([[0.0, 1.0], [np.nan, 0.0]]), 1)
    with pytest.raises(GraphError, match="neighbours = 0"):
        nearest_neighbour_edges(np.zeros((3, 2)), 0)


# Components and paths


def test_components_are_numbered_by_size_and_then_by_place():
    edges = np.array([[1, 2], [3, 4], [4, 5], [6, 7]])
    assert components(9, edges).tolist() == [3, 1, 1, 0, 0, 0, 2, 2, 4]


def test_components_without_edges_or_nodes():
    assert components(3, NO_EDGES).tolist() == [0, 1, 2]
    assert components(0, NO_EDGES).tolist() == []


def test_shortest_path_takes_the_shorter_way_round():
    edges = np.array([[0, 1], [1, 2], [2, 3], [0, 3], [4, 5]])
    path = shortest_path(6, edges, np.array([1.0, 1.0, 1.0, 3.5, 1.0]), 3, 0)
    assert path.nodes.tolist() == [3, 2, 1, 0]
    assert path.length == 3.0


def test_shortest_path_may_use_edges_of_no_length():
    nodes, length = shortest_path(
        3, np.array([[0, 1], [1, 2], [0, 2]]), np.array([0.0, 1.0, 2.0]), 0, 2
    )
    assert nodes.tolist() == [0, 1, 2]
    assert length == 1.0


def test_a_path_to_itself_is_one_node_and_no_length():
    nodes, length = shortest_path(2, np.array([[0, 1]]), np.array([1.0]), 1, 1)
    assert (nodes.tolist(), length) == ([1], 0.0)


@pytest.mark.parametrize("edges", [np.array([[0, 1], [2, 3]]), NO_EDGES])
def test_no_path_is_an_answer(edges):
    nodes, length = shortest_path(4, edges, np.ones(len(edges)), 0, 3)
    assert nodes.shape == (0,)
    assert length == np.inf


@repeatable
@given(st.integers(2, 9), st.integers(0, 2**32 - 1))
def test_shortest_paths_agree_with_all_pairs_relaxation(n, seed):
    rng = np.random.default_rng(seed)
    pairs = np.stack(np.triu_indices(n, 1), axis=-1)
    edges = pairs[rng.random(len(pairs)) < 0.35]
    weights = rng.random(len(edges))
    best = np.where(np.eye(n, dtype=bool), 0.0, np.inf)
    best[edges[:, 0], edges[:, 1]] = best[edges[:, 1], edges[:, 0]] = weights
    weight_of = best.copy()
    for k in range(n):
        best = np.minimum(best, best[:, k, None] + best[None, k])
    labels = components(n, edges)
    for source in range(n):
        for target in range(n):
            nodes, length = shortest_path(n, edges, weights, source, target)
            assert length == pytest.approx(best[source, target])
            assert (len(nodes) > 0) == (labels[source] == labels[target])
            if len(nodes):
                assert (nodes[0], nodes[-1]) == (source, target)
                assert weight_of[nodes[:-1], nodes[1:]].sum() == pytest.approx(length)


def test_bad_graphs_are_refused_by_name():
    edges, weights = np.array([[0, 1], [1, 2]]), np.array([1.0, 1.0])
    with pytest.raises(GraphError, match=r"edges\[1\] = \[1, 2\]: the nodes are 0 to 1"):
        components(2, edges)
    with pytest.raises(GraphError, match=r"edges\[0\] = \[-1, 0\]"):
        components(2, np.array([[-1, 0]]))
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(GraphError, match=rf"weights\[1\] = {bad}"):
            shortest_path(3, edges, np.array([1.0, bad]), 0, 1)
    with pytest.raises(GraphError, match="source = 3"):
        shortest_path(3, edges, weights, 3, 0)
    with pytest.raises(GraphError, match="target = -1"):
        shortest_path(3, edges, weights, 0, -1)
    with pytest.raises(GraphError, match="edges name 1 pairs twice"):
        shortest_path(3, np.array([[0, 1], [0, 1]]), weights, 0, 1)


# Components on a grid


def test_cells_that_meet_at_a_corner_are_apart():
    assert components_on_grid(np.eye(2, dtype=bool), (False, False)).tolist() == [
        [0, OUTSIDE],
        [OUTSIDE, 1],
    ]


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [
        ((False, False), [[1, -1, 0], [-1, -1, 0], [2, -1, 0]]),
        ((True, False), [[1, -1, 0], [-1, -1, 0], [1, -1, 0]]),
        ((False, True), [[0, -1, 0], [-1, -1, 0], [0, -1, 0]]),
        ((True, True), [[0, -1, 0], [-1, -1, 0], [0, -1, 0]]),
    ],
)
def test_wrapped_axes_join_what_meets_across_the_seam(wrap, expected):
    inside = np.array([[1, 0, 1], [0, 0, 1], [1, 0, 1]], dtype=bool)
    assert components_on_grid(inside, wrap).tolist() == expected


def test_a_grid_without_cells_inside_has_no_component():
    assert (components_on_grid(np.zeros((3, 4), dtype=bool), (True, True)) == OUTSIDE).all()


@repeatable
@given(
    arrays(np.bool_, st.tuples(st.integers(1, 6), st.integers(1, 6))),
    st.tuples(st.booleans(), st.booleans()),
)
def test_grid_components_are_those_of_the_graph_of_its_cells(inside, wrap):
    cells = np.arange(inside.size).reshape(inside.shape)
    pairs = []
    for axis in (0, 1):
        following = np.roll(cells, -1, axis)
        last = [slice(None), slice(None)]
        last[axis] = slice(None) if wrap[axis] else slice(0, -1)
        pairs.append(np.stack([cells[tuple(last)], following[tuple(last)]], axis=-1).reshape(-1, 2))
    edges = np.concatenate(pairs)
    edges = edges[inside.reshape(-1)[edges].all(axis=1)]
    of_cells = components(inside.size, edges).reshape(inside.shape)
    labels = components_on_grid(inside, wrap)
    assert np.array_equal(labels == OUTSIDE, ~inside)
    matched = set(zip(labels[inside].tolist(), of_cells[inside].tolist(), strict=True))
    assert len(matched) == len(set(labels[inside].tolist())) == len(set(of_cells[inside].tolist()))
    sizes = np.bincount(labels[inside])
    assert (np.diff(sizes) <= 0).all()


def chart(rows: np.ndarray, columns: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1))


def test_one_elevation_of_the_sphere_is_one_circle():
    sphere = Sphere()
    z = chart(
        np.linspace(-np.pi / 2, np.pi / 2, 91), np.linspace(-np.pi, np.pi, 120, endpoint=False)
    )
    inside = ((sphere.elevation(z) - 0.6).abs() < 0.05).numpy()
    assert components_on_grid(inside, (False, True)).max() == 0
    # Cut opposite the seam of the chart: one arc, which only wrapping keeps in one piece.
    arc = inside & (np.arange(120) != 60)
    assert components_on_grid(arc, (False, True)).max() == 0
    assert components_on_grid(arc, (False, False)).max() == 1


def test_angles_around_the_tube_are_a_set_of_circles():
    torus = Torus()
    angles = np.linspace(-np.pi, np.pi, 120, endpoint=False)
    tube = torus.tube_angle(chart(angles, angles)).numpy()
    inside = (np.abs(np.abs(tube) - 1.0) < 0.1) | (np.abs(tube) > np.pi - 0.1)
    # ±1 and the inner equator, which the seam of the chart cuts in two.
    assert components_on_grid(inside, (True, True)).max() + 1 == 3
    assert components_on_grid(inside, (True, False)).max() + 1 == 4
