"""Rows that keep a tolerance all along the lines between them."""

import numpy as np
from tests.planner_fixtures import manifold_of, packaged_planner

from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.peers.elastic_band import halved
from constraint_geodesics.peers.kept_rows import closer
from constraint_geodesics.problem import SATISFIED


def off(rows: np.ndarray, pieces: int = 33) -> float:
    """The worst violation along the lines between rows."""
    manifold = manifold_of(packaged_planner(), "level_cup_relaxed")
    t = np.linspace(0.0, 1.0, pieces)[:, None]
    lines = rows[:-1, None] + t * np.diff(rows, axis=0)[:, None]
    return float(manifold.violation(lines).max())


def test_a_turn_at_the_edge_of_a_tolerance_is_kept_wherever_it_is() -> None:
    """Lines into the edge and along it: some are worst away from their middles."""
    manifold = manifold_of(packaged_planner(), "level_cup_relaxed")
    rng, before = np.random.default_rng(0), []
    for _ in range(300):
        first, last = manifold.robot.sample(2, rng)
        start = retract(manifold, first, band=np.array(0.5)).joints
        path = retract(manifold, np.linspace(start, 0.7 * start + 0.3 * last, 17)).joints
        jumps = np.abs(np.diff(path, axis=0)).max() > 0.2 or manifold.violation(path).max() > 1e-9
        if jumps or manifold.robot.limit_distance(path).min() < 0.1:
            continue
        rows = halved(manifold, path)
        kept = closer(manifold, rows)
        before.append(off(rows))
        assert off(kept) <= SATISFIED
        np.testing.assert_array_equal(kept[[0, -1]], path[[0, -1]])
    assert max(before) > SATISFIED


def test_rows_that_keep_it_stay_as_they_are() -> None:
    manifold = manifold_of(packaged_planner(), "free")
    rows = np.linspace(np.zeros(6), np.full(6, 0.5), 20)
    np.testing.assert_array_equal(closer(manifold, rows), rows)
