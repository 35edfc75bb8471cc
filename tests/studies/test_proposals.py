"""The policy benchmark measures what it says, on a small learned manifold and with policies that
know nothing.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize

from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_manifold,
)
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geodesics.episodes import observation_size
from constraint_geodesics.geodesics.learned_problem import LearnedProblem
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.geometry.curves import PinnedPolynomial
from constraint_geodesics.learning.learned_manifold import JointManifold
from constraint_geodesics.params import GeodesicParams
from constraint_geodesics.studies import proposals as bench

QUERIES, STEPS = 10, 3
SMALL = bench.OptimumSettings(
    random_starts=4, drawn=16, descent_steps=6, polished=2, polish_steps=8
)


def constrained(chart, manifold, trained) -> LearnedProblem:
    """Data by retraction alone: no constraint needs a training set."""
    found = retract(manifold, trained.joints[:600])
    inside = found.converged & (manifold.robot.limit_distance(found.joints) > 0)
    return LearnedProblem(
        chart, manifold, PinnedPolynomial(6, 3), found.joints[inside], 16, True, 1.0
    )


@pytest.fixture(scope="module")
def level(scene, params, trained) -> LearnedProblem:
    return constrained(
        trained.manifold, constraint_manifold(scene.robot, params.constraints["level_cup"]), trained
    )


@pytest.fixture(scope="module")
def problems(scene, level, trained) -> dict[str, LearnedProblem]:
    shelf = Constraint(
        (0, 0, 1, 0, 0, 1), (0, 0, 0.05, 0, 0, 0), Pose.from_rpy((0.4, 0.0, 0.35), (0.0, 0.5, 0.3))
    )
    return {
        "trained": level,
        "unseen": constrained(trained.manifold, ConstraintManifold(scene.robot, shelf), trained),
        "joints": replace(level, chart=JointManifold.of(trained.joints)),
    }


@pytest.fixture(scope="module")
def settings(params) -> GeodesicParams:
    ppo = params.geodesics.ppo.model_copy(update={"action_scale": 0.25})
    return params.geodesics.model_copy(update={"episode_steps": STEPS, "ppo": ppo})


def untrained(problem, seed: int) -> MeanPolicy:
    rng, seen = np.random.default_rng(seed), observation_size(problem)
    wide = (rng.normal(scale=0.1, size=(8, seen)), np.zeros(8))
    return MeanPolicy(
        (
            wide,
            (
                rng.normal(size=(problem.curve.coefficients, 8)),
                np.zeros(problem.curve.coefficients),
            ),
        )
    )


@pytest.fixture(scope="module")
def measured_rows(problems, settings) -> dict[str, pd.DataFrame]:
    rows = {}
    for name, problem in problems.items():
        ends = problem.sample_ends(QUERIES, np.random.default_rng(0))
        policies = [untrained(problem, seed) for seed in range(3)]
        rows[name] = bench.policy_rows(
            problem, ends, bench.Compared(policies[:2], policies[2:], settings), SMALL
        )
    return rows


@pytest.mark.parametrize("name", ["trained", "unseen", "joints"])
def test_no_answer_is_shorter_than_the_optimum(measured_rows, name) -> None:
    rows = measured_rows[name]
    curves = {"straight latent line": 1, "policy, one seed": STEPS + 1, "policies": 2 * STEPS + 1}
    curves |= {"separate policies": STEPS + 1, "descent": STEPS + 1, "random curves": 2 * STEPS + 1}
    assert rows.groupby("method", sort=False)["curves"].max().to_dict() == curves
    assert len(rows) == QUERIES * (len(curves) + 1)
    assert (
        rows[rows["method"] == "policy, one seed"]
        .groupby("query")["seed"]
        .apply(set)
        .map({0, 1}.__eq__)
        .all()
    )
    assert (rows["length_rad"].notna() == rows["feasible"]).all()
    assert rows["feasible"].any()
    assert (rows["optimum_rad"] <= rows["length_rad"])[rows["feasible"]].all()
    assert (rows.groupby("query")["optimum_rad"].nunique(dropna=False) == 1).all()
    assert (rows["time_ms"] > 0).all()
    straight = rows[rows["method"] == bench.STRAIGHT].set_index("query")["feasible"]
    for method in ("policies", "descent", "random curves"):
        answered = rows[rows["method"] == method].set_index("query")["feasible"]
        assert answered[straight].mean() > 0.7, (
            "the straight line is among the curves that every method meets"
        )


def test_the_same_seed_gives_the_same_rows(problems, measured_rows, settings) -> None:
    problem = problems["trained"]
    ends = problem.sample_ends(QUERIES, np.random.default_rng(0))
    policies = [untrained(problem, seed) for seed in range(3)]
    compared = bench.Compared(policies[:2], policies[2:], settings)
    again = bench.policy_rows(problem, ends, compared, SMALL)
    pd.testing.assert_frame_equal(
        again.drop(columns="time_ms"), measured_rows["trained"].drop(columns="time_ms")
    )


def test_without_policies_their_methods_are_left_out(problems, settings) -> None:
    problem = problems["joints"]
    ends = problem.sample_ends(2, np.random.default_rng(1))
    compared = bench.Compared([], None, settings, random_curves=5)
    rows = bench.policy_rows(problem, ends, compared, SMALL)
    curves = rows.groupby("method", sort=False)["curves"].max().to_dict()
    assert curves == {"straight latent line": 1, "descent": STEPS + 1, "random curves": 5}


def test_the_optimum_without_constraint_is_the_straight_joint_line(scene, params, trained) -> None:
    chart = JointManifold.of(trained.joints)
    free = constraint_manifold(scene.robot, params.constraints["free"])
    problem = LearnedProblem(chart, free, PinnedPolynomial(6, 3), trained.joints, 16, True, 1.0)
    rng = np.random.default_rng(2)
    ends = problem.sample_ends(12, rng)
    bent = 0.2 * rng.normal(size=(12, 2, problem.curve.coefficients))
    exact = np.linalg.norm(ends.q_goal - ends.q_start, axis=1)
    for changed in (
        {"polish_steps": 0, "descent_steps": 12},
        {"polish_steps": 30, "descent_steps": 0},
    ):
        found = bench.family_optimum(problem, ends, bent, replace(SMALL, **changed))
        assert found.feasible.all()
        assert (found.length >= exact * (1 - 1e-6)).all()
        np.testing.assert_allclose(found.length, exact, rtol=1e-4)


def test_the_optimum_is_sound_and_no_longer_than_any_start(level) -> None:
    rng = np.random.default_rng(7)
    ends = level.sample_ends(12, rng)
    each = np.repeat(np.arange(12), 4)
    starts = level.sample_curves(ends[each], rng)
    costs = bench.measured(level, starts, ends[each])
    length = np.where(costs.feasible, costs.length, np.inf).reshape(12, 4).min(axis=1)
    found = bench.family_optimum(level, ends, starts.reshape(12, 4, -1), SMALL)
    started = np.isfinite(length)
    assert started.sum() > 3
    assert found.feasible[started].all()
    assert (found.length <= length * (1 + 1e-4))[started].all()
    assert (found.length < 0.99 * length)[started].any()
    again = bench.measured(level, found.phi, ends)
    np.testing.assert_array_equal(again.feasible, found.feasible)
    np.testing.assert_allclose(
        again.length[found.feasible], found.length[found.feasible], rtol=1e-4
    )
    assert np.isnan(found.length[~found.feasible]).all()


def test_the_optimum_is_no_longer_than_another_optimiser_finds(level) -> None:
    ends = level.sample_ends(40, np.random.default_rng(3))
    zero = np.zeros((40, level.curve.coefficients))
    ends = ends[np.flatnonzero(bench.measured(level, zero, ends).feasible)[:3]]
    found = bench.family_optimum(
        level, ends, zero[: len(ends), None], replace(SMALL, polish_steps=30)
    )
    finer, shorter = replace(level, degree=bench.POLISH_DEGREE, retraction=bench.EXACT), 0
    for row in range(len(ends)):
        one = ends[np.array([row])]
        theirs = minimize(
            lambda phi, one=one: float(finer.evaluate(phi[None], one).cost[0]),
            zero[0],
            method="BFGS",
            options={"eps": 1e-3, "maxiter": 20},
        )
        costs = bench.measured(level, theirs.x[None], one)
        assert costs.feasible[0]
        assert found.length[row] <= costs.length[0] * (1 + 1e-4)
        shorter += int(costs.length[0] < 0.999 * bench.measured(level, zero[:1], one).length[0])
    assert len(ends) == 3
    assert shorter > 0


def test_polishing_makes_no_curve_worse(level) -> None:
    rng = np.random.default_rng(4)
    ends = level.sample_ends(30, rng)
    phi = level.sample_curves(ends, rng)
    before = level.evaluate(phi, ends)
    after = level.evaluate(bench.polished(level, phi, ends, 15), ends)
    assert 5 < before.feasible.sum() < 30
    assert after.feasible[before.feasible].all()
    # batches of another size round differently in single precision
    assert (after.cost <= before.cost * (1 + 1e-3)).all()
    gain = (1 - after.cost / before.cost)[before.feasible]
    assert np.median(gain) > 0.01


def test_a_jump_between_the_points_of_a_length_does_not_go_unseen(level) -> None:
    ends = level.sample_ends(60, np.random.default_rng(5))
    phi = np.zeros((60, level.curve.coefficients))
    coarse, fine = replace(level, degree=4).evaluate(phi, ends), bench.measured(level, phi, ends)
    assert (coarse.feasible & ~fine.feasible).sum() > 5
    each = [ends[np.array([row])] for row in range(60)]
    paths = [level.path(phi[0], one, 0.02) for one in each]
    steps = np.array([np.linalg.norm(np.diff(path, axis=0), axis=1).max() for path in paths])
    assert (steps[fine.feasible] <= 0.1).all()
    sound = np.array([bench.is_sound(level, phi[0], one) for one in each])
    np.testing.assert_array_equal(sound & (steps > 0.1), False)
    assert (coarse.feasible & ~sound).sum() > 5


def test_the_table_compares_over_the_queries_that_all_methods_solve() -> None:
    columns = ["method", "seed", "query", "feasible", "length_rad", "curves", "time_ms"]
    rows = pd.DataFrame(
        [
            ("a", 0, 0, True, 1.2, 1, 1.0),
            ("a", 0, 1, True, 3.0, 1, 3.0),
            ("a", 0, 2, False, np.nan, 1, 5.0),
            ("b", 0, 0, True, 1.0, 9, 2.0),
            ("b", 0, 1, False, np.nan, 9, 2.0),
            ("b", 0, 2, False, np.nan, 9, 2.0),
            ("b", 1, 0, True, 1.1, 9, 2.0),
            ("b", 1, 1, True, 2.2, 9, 4.0),
            ("b", 1, 2, False, np.nan, 9, 4.0),
        ],
        columns=columns,
    )
    rows["optimum_rad"] = rows["query"].map({0: 1.0, 1: 2.0})
    table = bench.policy_table(rows).set_index("method")
    assert (table["queries"] == 3).all()
    assert (table["solvable"] == 2).all()
    assert (table["shared"] == 1).all()
    assert table["feasible"].to_dict() == pytest.approx({"a": 2 / 3, "b": 0.5})
    assert table["ratio_mean"].to_dict() == pytest.approx({"a": 1.35, "b": 3.2 / 3})
    assert table["ratio_median"].to_dict() == pytest.approx({"a": 1.35, "b": 1.1})
    assert table["ratio_p95"]["a"] == pytest.approx(1.2 + 0.95 * 0.3)
    assert table["shared_ratio_mean"].to_dict() == pytest.approx({"a": 1.2, "b": 1.05})
    assert table["time_median_ms"].to_dict() == {"a": 3.0, "b": 2.0}
    assert table["curves"].to_dict() == {"a": 1, "b": 9}


def test_charts_side_by_side_have_one_optimum(measured_rows) -> None:
    both = bench.spaces_together(
        {"latent": measured_rows["trained"], "joints": measured_rows["joints"]}
    )
    assert len(both) == 2 * len(measured_rows["joints"])
    assert {"descent, latent", "descent, joints"} <= set(both["method"])
    assert (both.groupby("query")["optimum_rad"].nunique(dropna=False) == 1).all()
    assert (both["optimum_rad"] <= both["length_rad"])[both["feasible"]].all()
