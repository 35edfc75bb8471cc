from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch

from constraint_geodesics.geodesics.policy_search import PolicySolver, save_policy, train_policy
from constraint_geodesics.geodesics.proposals import MeanPolicy
from constraint_geodesics.studies.geodesic_search import (
    AnalyticTask,
    analytic_problem,
    curve_family,
    run_analytic,
)


class Quiet:
    def log(self, step, metrics) -> None:
        assert np.isfinite(list(metrics.values())).all()


@pytest.fixture(scope="module")
def small(params):
    ppo = params.geodesics.ppo.model_copy(update={"batch_size": 80})
    return params.geodesics.model_copy(
        update={
            "steps": 2560,
            "environments": 16,
            "checkpoint_steps": 800,
            "ppo": ppo,
            "rollouts": 8,
        }
    )


def ignore(step, figures) -> None:
    pass


def test_policy_search_straightens_curves_in_the_plane(params, tmp_path: Path) -> None:
    settings = params.geodesics.model_copy(update={"steps": 60000})
    result = run_analytic(
        AnalyticTask(
            "plane", curve_family(2, settings), settings, 0, tmp_path, nullcontext(Quiet())
        )
    )
    figures = result.figures()
    assert (result.ratio >= 1 - 1e-9).all()
    assert figures["first_mean_ratio"] > 1.2
    assert figures["mean_ratio"] < 1.01
    exact = np.linalg.norm(result.learned[-1] - result.learned[0])
    drawn = np.linalg.norm(np.diff(result.learned, axis=0), axis=1).sum()
    assert exact <= drawn < 1.1 * exact


def test_the_same_seed_gives_the_same_policy(small, tmp_path: Path) -> None:
    problem = analytic_problem("plane", curve_family(2, small))
    first, again, other = (
        train_policy(problem, small, seed, tmp_path / folder, ignore).actor.state_dict()
        for seed, folder in ((0, "a"), (0, "b"), (1, "c"))
    )
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


def test_interrupted_training_ends_as_if_it_had_never_stopped(small, tmp_path: Path) -> None:
    problem = analytic_problem("plane", curve_family(2, small))
    whole = train_policy(problem, small, 0, tmp_path / "whole", ignore)

    def interrupt(step, figures) -> None:
        if step > 1800:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_policy(problem, small, 0, tmp_path / "cut", interrupt)
    steps = []
    resumed = train_policy(
        problem, small, 0, tmp_path / "cut", lambda step, figures: steps.append(step)
    )
    assert steps[0] > 800, "it went on from a checkpoint"
    timed = ("seconds", "steps_per_s")
    for own, other in zip(resumed.curve, whole.curve, strict=True):
        assert {k: own[k] for k in own if k not in timed} == {
            k: other[k] for k in other if k not in timed
        }
    for name, value in whole.actor.state_dict().items():
        assert torch.equal(resumed.actor.state_dict()[name], value)


def test_a_checkpoint_of_other_parameters_is_not_used(small, tmp_path: Path) -> None:
    problem = analytic_problem("plane", curve_family(2, small))
    train_policy(problem, small, 0, tmp_path, ignore)
    steps = []
    changed = small.model_copy(update={"episode_steps": 5})
    train_policy(problem, changed, 0, tmp_path, lambda step, figures: steps.append(step))
    assert steps[0] < 800


def test_a_saved_policy_acts_the_same(small, tmp_path: Path) -> None:
    problem = analytic_problem("sphere", curve_family(2, small))
    policy = train_policy(problem, small, 0, tmp_path, ignore)
    save_policy(policy, tmp_path, 0)
    ends = problem.sample_ends(1, np.random.default_rng(0))
    found, again = (
        PolicySolver(mean, small, 3).search(problem, ends, lambda phi: True)
        for mean in (policy.mean, MeanPolicy.load(tmp_path, 0))
    )
    np.testing.assert_array_equal(found.phi, again.phi)
    assert found.found
    assert found.length <= found.straight_length + 1e-12


def test_what_the_exact_check_refuses_is_not_returned(small, tmp_path: Path) -> None:
    problem = analytic_problem("sphere", curve_family(2, small))
    policy = train_policy(problem, small, 0, tmp_path, ignore)
    ends = problem.sample_ends(1, np.random.default_rng(0))
    solver = PolicySolver(policy.mean, small, 3)
    nothing = solver.search(problem, ends, lambda phi: False)
    assert nothing.status == "not_found"
    best = solver.search(problem, ends, lambda phi: True)
    second = solver.search(problem, ends, lambda phi: not np.array_equal(phi, best.phi))
    assert second.length >= best.length
