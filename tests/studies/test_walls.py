"""The study of solvers among walls compares with what it says."""

import math

import numpy as np
import pytest
import torch

from constraint_geodesics.geodesics.graph_search import CombinedSolver, GraphSolver
from constraint_geodesics.geodesics.problem import ChartBox, ChartProblem, Geodesic
from constraint_geodesics.geodesics.solver import geodesics_between
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.graph import components_on_grid
from constraint_geodesics.geometry.grid import GridManifold
from constraint_geodesics.studies.walls import METRICS, SEEDS, WalledGrid, judged

CUBIC = PinnedPolynomial(2, 3)


def block(gap: bool) -> GridManifold:
    blocked = torch.zeros(12, 12, dtype=torch.bool)
    blocked[5:7, 2 if gap else 0 :] = True
    return GridManifold(torch.full((12, 12), 4.0).double(), (0.0, 0.0), (11.0, 11.0), blocked)


@pytest.mark.parametrize("name", METRICS)
def test_every_free_node_can_be_reached(name) -> None:
    free = WalledGrid(METRICS[name](SEEDS[name])).free.reshape(150, 150)
    labels = components_on_grid(free, (False, False))
    assert labels.max() == 0
    assert 0.75 < free.mean() < 0.97


def test_dijkstra_measures_axes_and_diagonals_round_the_walls() -> None:
    lengths = WalledGrid(block(gap=True)).dijkstra(11).reshape(12, 12)  # from (0, 11); √g = 2
    assert lengths[3, 11] == pytest.approx(6.0)
    assert lengths[4, 7] == pytest.approx(2 * 4 * math.sqrt(2))
    # to (4, 2) and then past the corner to (5, 1), two rows on and back again
    there = 2 * (4 * math.sqrt(2) + 5 + math.sqrt(2))
    assert lengths[5, 1] == pytest.approx(there)
    assert np.isinf(lengths[5:7, 2:]).all()
    assert np.isinf(WalledGrid(block(gap=False)).dijkstra(0).reshape(12, 12)[7:]).all()


def test_queries_are_free_and_joined() -> None:
    grid = WalledGrid(block(gap=False))
    start, goal, lengths = grid.queries(20, np.random.default_rng(0))
    assert grid.free[start].all()
    assert grid.free[goal].all()
    assert ((start < 60) == (goal < 60)).all(), "on one side of the wall"
    assert (lengths > 0).all()


def test_curves_are_judged_by_what_they_are() -> None:
    manifold = block(gap=True)
    case = ChartProblem(manifold, CUBIC, ChartBox((0.0, 0.0), (11.0, 11.0)))
    start, goal = np.array([[2.0, 6.0]]), np.array([[9.0, 6.0]])
    graph = GraphSolver.over_grid(manifold, (0.0, 0.0), (11.0, 11.0), (12, 12))
    (tight,) = geodesics_between(CombinedSolver(graph), case, start, goal)
    through = Geodesic("converged", CUBIC, np.zeros(4), start[0], goal[0], 28.0)
    nothing = Geodesic.nothing("not_found", CUBIC, start[0], goal[0])
    lengths = np.array([tight.length, 14.0, 1.0])
    found = judged(manifold, [tight, through, nothing], lengths, 2 * lengths)
    assert found["found"] == pytest.approx(2 / 3)
    assert found["inside"] == 0.5, "one of the two leads through the wall"
    assert found["over_dijkstra"] == pytest.approx({"mean": 1.5, "p95": 1.95, "max": 2.0})
    assert found["over_reference"]["max"] == pytest.approx(1.0)
    alone = judged(manifold, [tight], lengths, lengths)
    assert (alone["found"], alone["inside"], alone["queries"]) == (1.0, 1.0, 1)
    assert alone["largest_error_of_length"] < 1e-4
    assert judged(manifold, [nothing], lengths, lengths)["over_dijkstra"]["mean"] is None
