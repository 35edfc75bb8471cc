"""Ways over a graph against Dijkstra's, what joins a configuration to it, and a graph made from
scratch.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import csgraph

from constraint_geodesics.constraints.constraint import ConstraintManifold, constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geometry.graph import components, nearest_neighbour_edges
from constraint_geodesics.params import Params
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import ClearanceModel, clearance_model
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.search.band import project
from constraint_geodesics.search.roadmap import (
    JOINED,
    NEAREST,
    Joined,
    Roadmap,
    build_roadmap,
    edge_lengths,
    join,
    resample,
    shortest_way,
)
from constraint_geodesics.search.space import Space, space_of

MARGIN = 0.006


@dataclass(frozen=True)
class Query:
    """A drawn graph and two configurations joined to it, every edge at least as long as it is
    straight.
    """

    roadmap: Roadmap
    start: np.ndarray
    goal: np.ndarray
    at_start: Joined
    at_goal: Joined

    def way(self) -> np.ndarray | None:
        return shortest_way(self.roadmap, self.start, self.goal, self.at_start, self.at_goal)

    def adjacency(self) -> sparse.csr_array:
        """Lengths with start and goal as nodes n and n + 1."""
        n = len(self.roadmap.joints)
        first = np.concatenate([self.roadmap.edges[:, 0], self.at_start.nodes, self.at_goal.nodes])
        second = np.concatenate(
            [
                self.roadmap.edges[:, 1],
                np.full(len(self.at_start.nodes), n),
                np.full(len(self.at_goal.nodes), n + 1),
            ]
        )
        lengths = np.concatenate(
            [self.roadmap.lengths, self.at_start.lengths, self.at_goal.lengths]
        )
        matrix = np.zeros((n + 2, n + 2))
        # an end that is a node is joined to it by an edge of no length, which is none in a matrix
        matrix[first, second] = matrix[second, first] = np.maximum(lengths, 1e-12)
        return sparse.csr_array(matrix)


def draw(seed: int, nodes: int, neighbours: int) -> Query:
    rng = np.random.default_rng(seed)
    joints = rng.uniform(-2.0, 2.0, (nodes, 3))
    edges = nearest_neighbour_edges(joints, neighbours)
    edges = edges[rng.uniform(size=len(edges)) < 0.8]

    def long(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.norm(a - b, axis=-1) * (
            1.0 + rng.choice([0.0, 0.5], len(a)) * rng.uniform(size=len(a))
        )

    lengths = long(joints[edges[:, 0]], joints[edges[:, 1]])
    start, goal = rng.uniform(-2.0, 2.0, (2, 3))
    ends = []
    for q in (start, goal):
        own = rng.choice(nodes, rng.integers(1, 5), replace=False)
        ends.append(Joined(own, long(joints[own], np.broadcast_to(q, (len(own), 3)))))
    return Query(Roadmap(joints, edges, lengths, components(nodes, edges)), start, goal, *ends)


def test_a_way_is_as_short_as_dijkstras() -> None:
    found = apart = 0
    for seed in range(120):
        query = draw(seed, 10 + seed, 2 + seed % 3)
        n = len(query.roadmap.joints)
        matrix = query.adjacency()
        exact = float(csgraph.dijkstra(matrix, directed=False, indices=n)[n + 1])
        corners = query.way()
        connected = query.at_start.components(query.roadmap) & query.at_goal.components(
            query.roadmap
        )
        assert (corners is not None) == np.isfinite(exact) == bool(connected)
        if corners is None:
            apart += 1
            continue
        found += 1
        np.testing.assert_array_equal(corners[[0, -1]], [query.start, query.goal])
        index = {joints.tobytes(): i for i, joints in enumerate(query.roadmap.joints)}
        nodes = [n, *(index[corner.tobytes()] for corner in corners[1:-1]), n + 1]
        steps = [matrix[a, b] for a, b in itertools.pairwise(nodes)]
        assert min(steps) > 0.0, "only along edges"
        assert sum(steps) == pytest.approx(exact, rel=1e-12)
    assert found > 60
    assert apart > 10


def test_there_is_no_way_from_what_is_joined_to_nothing() -> None:
    query = draw(0, 30, 3)
    nobody = Joined(np.empty(0, np.int64), np.empty(0))
    assert shortest_way(query.roadmap, query.start, query.goal, nobody, query.at_goal) is None
    assert shortest_way(query.roadmap, query.start, query.goal, query.at_start, nobody) is None
    assert nobody.components(query.roadmap) == set()


def test_both_ends_may_hang_on_one_node() -> None:
    roadmap = Roadmap(
        np.zeros((1, 3)), np.empty((0, 2), np.int64), np.empty(0), np.zeros(1, np.int64)
    )
    joined = Joined(np.array([0]), np.array([1.0]))
    start, goal = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    np.testing.assert_array_equal(
        shortest_way(roadmap, start, goal, joined, joined), [start, np.zeros(3), goal]
    )


def test_neighbours_are_the_edges_of_each_node() -> None:
    roadmap = draw(1, 50, 4).roadmap
    begins, leads, lengths = roadmap.neighbours
    assert len(leads) == 2 * len(roadmap.edges)
    matrix = np.zeros((50, 50))
    for node in range(50):
        own = slice(begins[node], begins[node + 1])
        matrix[node, leads[own]] = lengths[own]
    expected = np.zeros((50, 50))
    expected[roadmap.edges[:, 0], roadmap.edges[:, 1]] = roadmap.lengths
    np.testing.assert_array_equal(matrix, expected + expected.T)


def test_resampled_points_are_spread_evenly_along_the_corners() -> None:
    rng = np.random.default_rng(2)
    corners = rng.normal(size=(6, 4))
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(sides)])
    for count in (2, 3, 17, 200):
        points = resample(corners, count)
        assert points.shape == (count, 4)
        assert points[0].tobytes() == corners[0].tobytes()
        assert points[-1].tobytes() == corners[-1].tobytes()
        for share, point in zip(np.linspace(0.0, along[-1], count), points, strict=True):
            side = min(int(np.searchsorted(along, share, side="right")) - 1, 4)
            expected = corners[side] + (share - along[side]) / sides[side] * (
                corners[side + 1] - corners[side]
            )
            np.testing.assert_allclose(point, expected, atol=1e-12)
    # an end that lies on a node leaves a side of no length
    doubled = resample(np.concatenate([corners[:1], corners]), 9)
    np.testing.assert_allclose(doubled, resample(corners, 9), atol=1e-12)


@dataclass(frozen=True)
class Made:
    """A graph over configurations of one constraint."""

    manifold: ConstraintManifold
    model: ClearanceModel
    space: tuple
    roadmap: Roadmap


@pytest.fixture(scope="module")
def made(scene: Scene, params: Params) -> Made:
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup"])
    robot, model = scene.robot, clearance_model(scene)
    drawn = retract(manifold, robot.sample(1500, np.random.default_rng(3)))
    nodes = drawn.joints[drawn.converged & (robot.limit_distance(drawn.joints) >= 0.0)]
    nodes = nodes[model.clearance(robot, nodes) > MARGIN][:400]
    space = space_of(manifold, model, MARGIN)
    return Made(manifold, model, space, build_roadmap(space, nodes, 10))


def test_most_configurations_of_a_level_cup_are_in_one_component(made) -> None:
    roadmap = made.roadmap
    assert len(roadmap.joints) == 400
    sizes = np.bincount(roadmap.labels)
    assert sizes[0] == sizes.max() > 0.9 * len(roadmap.joints)
    count = csgraph.connected_components(
        sparse.csr_array((np.ones(len(roadmap.edges)), roadmap.edges.T), shape=(400, 400)),
        directed=False,
    )[0]
    assert count == len(sizes)


def test_every_edge_holds(made) -> None:
    """Its points, projected one by one, keep the space, do not jump, and are as far apart as its
    length says.
    """
    roadmap, robot = made.roadmap, made.manifold.robot
    first, second = roadmap.joints[roadmap.edges].transpose(1, 0, 2)
    direct = np.linalg.norm(second - first, axis=1)
    assert (roadmap.lengths >= direct - 1e-9).all()
    assert np.median(roadmap.lengths / direct) < 1.05
    kept = 0
    for k in np.random.default_rng(4).choice(len(roadmap.edges), 60, replace=False):
        share = np.linspace(0.0, 1.0, 12)[:, None]
        points = (1.0 - share) * first[k] + share * second[k]
        left = project(made.space, points)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        # a jump between the points that an edge was checked at is what checking more of them may
        # find
        if steps.max() > 4.0 * direct[k] / 11 + 0.05:
            continue
        kept += 1
        assert left <= 1e-6
        assert made.manifold.violation(points).max() <= 1e-6
        assert robot.limit_distance(points).min() >= -1e-6
        assert made.model.clearance(robot, points).min() >= MARGIN - 1e-6
        assert steps.sum() == pytest.approx(roadmap.lengths[k], rel=0.1)
    assert kept >= 54


def test_an_edge_is_as_long_from_either_side(made) -> None:
    edges = made.roadmap.edges[:200]
    back = np.empty(len(edges))
    edge_lengths(made.space, made.roadmap.joints, np.ascontiguousarray(edges[:, ::-1]), back)
    np.testing.assert_allclose(back, made.roadmap.lengths[:200], rtol=1e-6)


def test_a_configuration_joins_the_component_it_lies_in(made) -> None:
    """Near a node, on the constraint, there is an edge to the node's own component."""
    roadmap, robot = made.roadmap, made.manifold.robot
    rng = np.random.default_rng(5)
    chosen = rng.choice(len(roadmap.joints), 40, replace=False)
    near = retract(
        made.manifold, roadmap.joints[chosen] + rng.uniform(-0.05, 0.05, (40, robot.dof))
    ).joints
    agree = 0
    for node, q in zip(chosen, near, strict=True):
        joined = join(roadmap, made.space, q)
        assert 1 <= len(joined.nodes) <= JOINED
        straight = np.linalg.norm(roadmap.joints[joined.nodes] - q, axis=1)
        assert (joined.lengths >= straight - 1e-9).all()
        assert (np.diff(straight) >= 0.0).all(), "the nearest first"
        assert set(joined.nodes) <= set(
            np.argsort(np.linalg.norm(roadmap.joints - q, axis=1))[:NEAREST]
        )
        agree += roadmap.labels[node] in joined.components(roadmap)
    assert agree >= 38


def test_a_node_joins_itself(made) -> None:
    joined = join(made.roadmap, made.space, made.roadmap.joints[7])
    assert joined.nodes[0] == 7
    assert joined.lengths[0] == 0.0


def test_graphs_of_few_nodes_have_few_edges(made) -> None:
    nodes = made.roadmap.joints
    alone = build_roadmap(made.space, nodes[:1], 10)
    assert alone.edges.shape == (0, 2)
    np.testing.assert_array_equal(alone.labels, [0])
    assert len(join(alone, made.space, nodes[0]).nodes) == 1
    few = build_roadmap(made.space, nodes[:4], 10)
    assert len(few.edges) <= 6


def that_hold(query: Query, space: Space) -> Query:
    """The same with the edges alone that hold when each is measured again in a space."""
    roadmap = query.roadmap
    holds = np.isfinite(measured(space, roadmap.joints, roadmap.edges))
    kept = replace(roadmap, edges=roadmap.edges[holds], lengths=roadmap.lengths[holds])
    ends = []
    for q, joined in ((query.start, query.at_start), (query.goal, query.at_goal)):
        from_end = np.stack([np.full(len(joined.nodes), len(roadmap.joints)), joined.nodes], axis=1)
        holds = np.isfinite(measured(space, np.vstack([roadmap.joints, q]), from_end))
        ends.append(Joined(joined.nodes[holds], joined.lengths[holds]))
    return Query(kept, query.start, query.goal, *ends)


def measured(space: Space, nodes: np.ndarray, edges: np.ndarray) -> np.ndarray:
    lengths = np.empty(len(edges))
    edge_lengths(space, nodes, np.ascontiguousarray(edges, np.int64), lengths)
    return lengths


@pytest.mark.parametrize("shape", ["ball", "thin plate"])
def test_edges_that_something_new_stands_on_are_left_out(made, shape: str) -> None:
    """The shortest way over a graph of another workcell is that over the edges which hold in this
    one: Dijkstra's, of all edges measured again in it.  Few nodes touch the plate.
    """
    roadmap, robot = made.roadmap, made.manifold.robot
    rng, changed, found = np.random.default_rng(9), 0, 0
    for _ in range(12):
        start, goal = roadmap.joints[
            rng.choice(np.flatnonzero(roadmap.labels == 0), 2, replace=False)
        ]
        at_start, at_goal = join(roadmap, made.space, start), join(roadmap, made.space, goal)
        before = shortest_way(roadmap, start, goal, at_start, at_goal, made.space)
        assert before is not None
        np.testing.assert_array_equal(before, shortest_way(roadmap, start, goal, at_start, at_goal))
        half = len(before) // 2
        # on a node, and between two
        on = before[half] if shape == "ball" else 0.5 * (before[half - 1] + before[half])
        place = tuple(map(float, robot.forward(on)[0]))
        plate = Box("plate", place, (0.004, 0.3, 0.3))
        new = Sphere("ball", place, 0.1) if shape == "ball" else plate
        model = clearance_model(Scene(robot, (new,)))
        if model.clearance(robot, np.stack([start, goal])).min() < 0.01:
            continue
        space = space_of(made.manifold, model, MARGIN)
        after = shortest_way(roadmap, start, goal, at_start, at_goal, space)
        query = that_hold(Query(roadmap, start, goal, at_start, at_goal), space)
        again = query.adjacency()
        n = len(roadmap.joints)
        shortest = float(csgraph.dijkstra(again, directed=False, indices=n)[n + 1])
        assert (after is not None) == np.isfinite(shortest)
        changed += 1
        if after is None:
            continue
        found += 1
        assert after.tobytes() != before.tobytes()
        numbers = {joints.tobytes(): i for i, joints in enumerate(roadmap.joints)}
        nodes = [n, *(numbers[corner.tobytes()] for corner in after[1:-1]), n + 1]
        steps = [again[a, b] for a, b in itertools.pairwise(nodes)]
        assert min(steps) > 0.0, "only along edges that hold"
        assert sum(steps) == pytest.approx(shortest, rel=1e-9)
    assert changed >= 8
    assert found >= 6
