"""What policies are compared with: every answer is certified, controls have the policy's time, and
figures are those of the rows.
"""

import time

import numpy as np
import pandas as pd
import pytest

from constraint_geodesics.benchmark.judge import judge_limits
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.geodesics.episodes import observation_size
from constraint_geodesics.geodesics.proposals import MeanPolicy, rounds
from constraint_geodesics.learning.dataset import ShardTask, draw_free, draw_queries
from constraint_geodesics.learning.learned_manifold import joint_space
from constraint_geodesics.studies import proposals as bench
from constraint_geodesics.studies.geodesic_search import policy_problem

QUERIES = 6


@pytest.fixture(scope="module")
def asked(scene, params):
    """Queries of level_cup, in the workcell."""
    manifold = constraint_manifold(scene.robot, params.constraints["level_cup"])
    past = draw_free(ShardTask(scene, manifold, 300, (3,)))
    problem = policy_problem(params, joint_space(scene.robot), scene, manifold, past)
    drawn = draw_queries(scene, manifold, "level_cup", QUERIES, 77)
    with Certifier(scene, judge_limits(params.judge)) as certifier:
        ends = problem.ends(drawn.starts, drawn.goals)
        yield [bench.Asked(problem, ends[np.array([k])], k, certifier) for k in range(QUERIES)]


@pytest.fixture(scope="module")
def compared(asked, params):
    """Two policies that know nothing."""
    settings = params.policy_settings()
    rng, problem = np.random.default_rng(0), asked[0].problem
    seen, size = observation_size(problem, settings), problem.curve.coefficients
    policies = {
        seed: MeanPolicy(((rng.normal(scale=0.05, size=(size, seen)), np.zeros(size)),))
        for seed in (0, 1)
    }
    return bench.Compared(policies, settings)


@pytest.fixture(scope="module")
def answers(asked, compared):
    return [bench.query_answers(own, compared) for own in asked]


def test_every_answer_is_a_certified_curve_of_the_family(asked, answers) -> None:
    for own, found in zip(asked, answers, strict=True):
        for name, _, answer in found:
            if not answer.solved:
                assert np.isnan(answer.length), name
                continue
            assert own.certified_length(answer.phi) == pytest.approx(answer.length, rel=1e-9)
            direct = np.linalg.norm(own.ends.q_goal - own.ends.q_start)
            assert answer.length >= direct * (1 - 1e-9)
    assert sum(a.solved for found in answers for n, _, a in found if n == bench.POLICY) > QUERIES


def test_all_methods_answer_and_the_straight_line_is_among_them(answers, compared) -> None:
    names = [(name, seed) for name, seed, _ in answers[0]]
    assert names[0] == (bench.POLICY, 0)
    assert len(names) == 5 * len(compared.policies) + 1, "as many controls as policies"
    for found in answers:
        straight = next(a for name, _, a in found if name == bench.STRAIGHT)
        if straight.solved:
            for name, _, answer in found:
                if name in (bench.POLICY, bench.DESCENT, bench.RANDOM):
                    assert answer.solved, name


def test_controls_search_for_the_time_they_are_given(asked) -> None:
    for method in (bench.at_random(0), bench.by_descent(0)):
        next(method(asked[0], 0.0))
        few, many = (next(method(asked[0], seconds)).curves for seconds in (0.0, 0.2))
        assert many > few
        began = time.perf_counter()
        next(method(asked[0], 0.2))
        assert time.perf_counter() - began >= 0.2


def test_the_search_without_a_policy_looks_at_the_straight_line_once(asked, compared) -> None:
    own, policy = asked[0], compared.policies[0]
    assert compared.settings.heads > 1
    still = bench.without_actions(policy, compared.settings.heads)
    alone = compared.settings.model_copy(update={"heads": 1})
    first = next(rounds(own.problem, still, alone, own.ends, np.random.default_rng(0)))
    looked = first.phi[: alone.rollouts]
    assert (~looked.any(axis=1)).sum() == 1


def test_its_own_branches_alone_draw_no_random_curve(compared) -> None:
    own = bench.own_branches(compared.settings)
    assert own.rollouts == own.heads == own.kept == compared.settings.heads
    assert own.rounds == 1


def rows(*answers: tuple[str, int, int, float]) -> pd.DataFrame:
    columns = ["method", "seed", "query", "length_rad"]
    table = pd.DataFrame(answers, columns=columns).assign(constraint="cup", scene="table")
    table["solved"] = table["length_rad"].notna()
    table["best_rad"] = table["query"].map({0: 1.0, 1: 2.0, 2: np.nan})
    table["optimum_rad"] = table["query"].map({0: 1.1, 1: 2.0, 2: np.nan})
    table["refined_rad"] = table["length_rad"] - 0.01
    return table.assign(curves=5, checked=1, search_ms=2.0, time_ms=3.0)


def test_figures_are_of_what_anything_solves_and_of_the_seeds() -> None:
    table = rows(
        (bench.POLICY, 0, 0, 1.1),
        (bench.POLICY, 0, 1, 2.2),
        (bench.POLICY, 0, 2, np.nan),
        (bench.POLICY, 1, 0, 1.3),
        (bench.POLICY, 1, 1, np.nan),
        (bench.POLICY, 1, 2, np.nan),
        (bench.RANDOM, 0, 0, 1.5),
        (bench.RANDOM, 0, 1, np.nan),
        (bench.RANDOM, 0, 2, np.nan),
    )
    found = bench.policy_figures(table)
    mine, theirs = found[bench.POLICY], found[bench.RANDOM]
    assert (mine["queries"], mine["solvable"], mine["seeds"]) == (3, 2, 2)
    assert mine["solved_mean"] == mine["solved_iqm"] == pytest.approx(0.75)
    interval = mine["solved_low"], mine["solved_high"]
    assert interval == pytest.approx((0.51875, 0.98125)), "of 0.5, 0.75, 0.75 and 1"
    assert mine["ratio_median_mean"] == pytest.approx((1.1 + 1.3) / 2)
    assert mine["optimum_median_mean"] == pytest.approx(((1.0 + 1.1) / 2 + 1.3 / 1.1) / 2)
    assert theirs["beaten_in_solved"] == pytest.approx(0.75), "one seed solves more, one as many"
    assert theirs["beaten_in_ratio_p95"] == pytest.approx(0.75), "a failure is as long as another"
    assert mine["refined_mean"] == pytest.approx(0.75)
    assert mine["ratio_p95_all_mean"] is None, "one seed of two has a failure, which is infinite"
    assert theirs["solved_low"] is None, "one run has no interval"
    nothing = bench.policy_figures(rows((bench.POLICY, 0, 0, np.nan)))[bench.POLICY]
    assert nothing["solved_mean"] == 0.0
    assert nothing["ratio_median_mean"] is None


def test_groups_put_constraints_together(params) -> None:
    every = pd.concat(
        [rows((bench.POLICY, 0, 0, 1.1)).assign(constraint=name) for name in params.all_constraints]
    )
    found = bench.grouped_figures(every, params)
    together = found["trained on"]["table"][bench.POLICY]
    assert together["queries"] == len(params.constraints)
    assert found["never seen"]["table"][bench.POLICY]["queries"] == len(params.unseen)
    assert set(params.all_constraints) < set(found)
