"""The geometry benchmark measures what it says, on a small learned manifold."""

import json

import numpy as np
import pytest
import torch

from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.gradient import GradientSolver
from constraint_geodesics.geodesics.graph_search import GraphSolver
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.problem import ChartBox, ChartProblem, Samples
from constraint_geodesics.geometry.analytic import Sphere
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.geometry.length import curve_length
from constraint_geodesics.learning.dataset import ShardTask, draw_free
from constraint_geodesics.pipeline.machine import machine
from constraint_geodesics.studies.geometry import (
    GeometryBenchmark,
    alternately,
    naive_length,
    naive_retracted_length,
    one_thread,
    random_curves,
    reference_length,
    solver_figures,
)


@pytest.fixture(scope="module")
def benchmark(scene, params, trained):
    level = constraint_manifold(scene.robot, params.constraints["level_cup"])
    joints = draw_free(ShardTask(scene, level, 1000, (1,)))
    curve = PinnedPolynomial(6, 3)
    plain = ChartProblem(trained.manifold, curve, Samples(trained.manifold.encode(trained.joints)))
    retracted = LearnedProblem(trained.manifold, level, curve, joints, 16, True, 1.0)
    ppo = params.geodesics.ppo.model_copy(update={"batch_size": 40, "epochs": 1})
    geodesics = params.geodesics.model_copy(update={"environments": 8, "ppo": ppo})
    small = params.geometry.model_copy(
        update={"rounds": 1, "batch": 128, "checked": 24, "graph_points": 100, "pairs": 3}
    )
    return GeometryBenchmark(plain, retracted, geodesics, small)


def test_all_sides_measure_the_same_lengths(benchmark) -> None:
    curves, _ = random_curves(benchmark.plain, 20)
    with torch.no_grad():
        ours, naive = (
            measure(benchmark.manifold, curves) for measure in (curve_length, naive_length)
        )
    reference = reference_length(benchmark.manifold, curves)
    torch.testing.assert_close(ours, reference, rtol=1e-3, atol=0)
    torch.testing.assert_close(naive, reference, rtol=5e-3, atol=0)


def test_all_sides_measure_the_same_retracted_lengths(benchmark) -> None:
    curves, ends = random_curves(benchmark.retracted, 60)
    costs = benchmark.retracted.evaluate(curves.phi.numpy(), ends)
    naive = naive_retracted_length(benchmark.retracted, curves, ends)
    smooth = costs.feasible & (costs.cost - costs.length < 1e-3 * costs.length)
    assert smooth.sum() > 5
    np.testing.assert_allclose(costs.length[smooth], naive[smooth], rtol=5e-3)


def test_the_same_curves_are_drawn_every_time(benchmark) -> None:
    first, again = (random_curves(benchmark.plain, 5)[0] for _ in range(2))
    assert torch.equal(first.phi, again.phi)
    assert torch.equal(first.goal, again.goal)


def test_rates_and_their_ratios_belong_together(benchmark) -> None:
    for found in (benchmark.curve_length(), benchmark.curve_length_retracted()):
        assert found["batch"] == 128
        assert found["per_second"] == found["per_second_by_batch"]["128"]
        assert found["ratio_to_naive"] == pytest.approx(
            found["per_second"] / found["naive_per_second"]
        )
    environment = benchmark.environment(benchmark.plain)
    expected = environment["steps_per_second"] / environment["dummy_vec_env_steps_per_second"]
    assert environment["ratio_to_dummy_vec_env"] == pytest.approx(expected)
    assert json.dumps(environment)


def test_errors_are_those_of_the_reference(benchmark) -> None:
    error = benchmark.length_errors()
    assert 0 < error["median"] <= error["p95"] <= error["max"] < 1e-3
    assert error["share_above_estimate"] <= 0.1
    assert (error["curves"], error["reference_points"]) == (24, 2000)


def test_finer_rules_err_less(benchmark) -> None:
    rows = benchmark.quadrature_rows()
    for rule in ("chords", "gauss_legendre", "collocation"):
        mine = [row for row in rows if row["rule"] == rule]
        assert mine[-1]["error_p95"] < 0.05 * mine[0]["error_p95"]
        assert [row["points"] for row in mine] == sorted(row["points"] for row in mine)
        assert all(row["microseconds"] > 0 for row in mine)


def test_solvers_are_compared_with_the_exact_distance_or_with_the_best() -> None:
    problem = ChartProblem(Sphere(), PinnedPolynomial(2, 3), ChartBox((-0.6, -0.6), (0.6, 0.6)))
    ends = problem.sample_ends(5, np.random.default_rng(0))
    graph = GraphSolver.over_points(Sphere(), problem.domain.sample(100, np.random.default_rng(1)))
    solvers = {"gradient": GradientSolver(), "graph": graph}
    exact = Sphere().distance(torch.from_numpy(ends.z_start), torch.from_numpy(ends.z_goal)).numpy()
    known = solver_figures(problem, ends, exact, solvers)
    assert known["gradient"]["max_ratio"] < 1 + 1e-3 < known["graph"]["max_ratio"]
    assert known["gradient"]["found"] == known["graph"]["found"] == 1.0
    best = solver_figures(problem, ends, None, solvers)
    assert best["gradient"]["mean_ratio"] == 1.0
    assert best["graph"]["mean_ratio"] == pytest.approx(known["graph"]["mean_ratio"], rel=1e-3)


def test_what_is_compared_runs_in_turn() -> None:
    order = []
    seconds = alternately(
        {"a": lambda: order.append("a"), "b": lambda: order.append("b")}, rounds=2
    )
    assert order == ["a", "b"] * 3, "one round to warm up, two that count"
    assert set(seconds) == {"a", "b"}


def test_one_thread_is_one_and_is_given_back() -> None:
    before = torch.get_num_threads()
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == before
    assert machine()["processor"]
