"""The proof that a way along a hull's edges ends at the corner that lies furthest out."""

import numpy as np
import pytest
from jaxtyping import Float
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from constraint_geodesics.scene import convex_kernels as kernels

ROUNDING_M = 1e-9


def ball(count: int, seed: int) -> Float[np.ndarray, "n 3"]:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return 0.1 * points / np.linalg.norm(points, axis=1, keepdims=True)


def prism(sides: int, turned: int) -> Float[np.ndarray, "n 3"]:
    """Of which the ends are flat faces of many corners."""
    angles = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = 0.05 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ends = [np.column_stack([ring, np.full(sides, height)]) for height in (0.0, 0.1)]
    return np.concatenate(ends) @ Rotation.random(random_state=turned).as_matrix().T


def is_proven(corners: np.ndarray, faces: np.ndarray) -> bool:
    begins = np.zeros(len(corners) + 1, int)
    begins[1:] = np.cumsum(np.bincount(faces.ravel(), minlength=len(corners)))
    around = np.argsort(faces.ravel(), kind="stable") // 3
    return bool(kernels.leads_furthest(corners, faces, begins, around, ROUNDING_M))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("points", [ball(12, 0), ball(300, 1), prism(16, 2), prism(64, 3)])
def test_the_surface_of_a_hull_is_proven(points: np.ndarray, seed: int) -> None:
    moved = points @ Rotation.random(random_state=seed).as_matrix().T
    assert is_proven(moved, ConvexHull(moved).simplices)


@pytest.mark.parametrize("depth_m", [1e-3, 1e-5, 1e-7])
def test_a_dent_is_seen_and_would_end_the_way_early(depth_m: float) -> None:
    """A corner of a prism's flat end is pushed in: from it no way leads out again."""
    points = np.concatenate([prism(16, 0), prism(16, 0)[:16].mean(axis=0, keepdims=True)])
    out = points[:16].mean(axis=0) - points[16:32].mean(axis=0)
    raised = points.copy()
    raised[-1] += 1e-3 * out / np.linalg.norm(out)  # a low tip, so that it is a corner
    faces = ConvexHull(raised).simplices
    assert is_proven(raised, faces)
    dented = points.copy()
    dented[-1] -= depth_m * out / np.linalg.norm(out)
    assert not is_proven(dented, faces)


def test_a_corner_beside_the_surface_is_seen() -> None:
    points = ball(100, 5)
    faces = ConvexHull(points).simplices
    points[17] *= 0.9
    assert not is_proven(points, faces)
