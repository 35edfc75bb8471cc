from dataclasses import dataclass

import numpy as np
import pytest

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.learning.dataset import ShardTask, draw_free
from constraint_geodesics.learning.submanifold import (
    GraphSubmanifold,
    GridSubmanifold,
    Surface,
    components_of,
    extract,
    load_submanifold,
    save_submanifold,
    submanifold_figures,
)


@dataclass(frozen=True)
class JointChart:
    """Joint space as its own latent space: the chart whose answers are known."""

    dim: int

    def encode(self, q):
        return np.asarray(q, float)

    def decode(self, z):
        return np.asarray(z, float)


@dataclass(frozen=True)
class PlaneChart:
    """Two joints as a latent plane, the others held."""

    held: np.ndarray
    dim: int = 2

    def encode(self, q):
        return np.asarray(q)[..., [0, 4]]

    def decode(self, z):
        q = np.broadcast_to(self.held, (*z.shape[:-1], len(self.held))).copy()
        q[..., [0, 4]] = z
        return q


def everywhere(q):
    return np.ones(len(q), bool)


def configurations(scene, manifold, count):
    return draw_free(ShardTask(scene, manifold, count, (3,)))


def test_graph_edges_hold_and_components_are_answers(scene, params, tmp_path) -> None:
    manifold = constraint_manifold(scene.robot, params.constraints["tool_down"])
    small = params.submanifold.model_copy(update={"nodes": 500})
    joints = configurations(scene, manifold, 1000)
    with scene.world() as world:
        surface = Surface(JointChart(6), manifold, world.free)
        found = extract(surface, joints, joints, small)
        assert isinstance(found, GraphSubmanifold)
        sizes = np.bincount(found.labels)
        assert len(sizes) >= 2, "tool down falls into several sheets"
        assert (np.diff(sizes) <= 0).all()
        node = int(np.flatnonzero(found.labels == 1)[0])
        assert components_of(found, surface, found.joints[node], small) == {1}
        assert components_of(found, surface, np.full(6, 50.0), small) == set()
    direct = np.linalg.norm(
        found.joints[found.edges[:, 0]] - found.joints[found.edges[:, 1]], axis=1
    )
    assert (found.lengths >= direct - 1e-9).all()
    save_submanifold(found, tmp_path)
    again = load_submanifold(tmp_path)
    np.testing.assert_array_equal(again.labels, found.labels)
    figures = submanifold_figures(found, surface, joints, joints, small)
    assert figures["components"] == len(sizes)
    assert figures["decoded_violation_p95"] < 1e-8
    assert figures["share_inside"] == 1.0


def test_a_plane_is_drawn_on_a_grid(scene, params) -> None:
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup_relaxed"])
    joints = configurations(scene, manifold, 200)
    chart = PlaneChart(joints[0])
    small = params.submanifold.model_copy(update={"grid": 60})
    found = extract(Surface(chart, manifold, everywhere), joints, joints, small)
    assert isinstance(found, GridSubmanifold)
    assert found.inclusion.shape == (60, 60)
    assert (found.labels >= 0).any()
    tolerance = max(params.submanifold.resolution_rad, np.radians(10.0))
    extra = tolerance - np.radians(10.0)
    np.testing.assert_array_equal(found.labels >= 0, found.inclusion <= extra + 1e-12)


def test_no_constraint_keeps_everything(scene, params) -> None:
    manifold = constraint_manifold(scene.robot, params.constraints["free"])
    joints = scene.robot.sample(50, np.random.default_rng(0))
    surface = Surface(PlaneChart(joints[0]), manifold, everywhere)
    found = extract(surface, joints, joints, params.submanifold)
    assert (found.labels == 0).all()
    assert found.inclusion.max() == pytest.approx(0.0)
