"""Restarts keep the shortest, end in time, and ask no more where no seed changes the answer; a
path that is not sound is no answer.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from tests.planner_fixtures import manifold_of, packaged_planner, pairs_of

from constraint_geodesics.peers.wrappers import Remembered, Restarted, UntilSound
from constraint_geodesics.problem import PlanningProblem, Solution


@dataclass
class Listed:
    """Answers with paths of the given lengths, one after another; nan for none."""

    lengths: tuple[float, ...]
    status: str = "solved"
    seeds: list[int] = field(default_factory=list)
    name: str = "listed"
    each_s: float = 0.0

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        length = self.lengths[len(self.seeds) % len(self.lengths)]
        self.seeds.append(seed)
        if np.isnan(length):
            return Solution("not_found", np.empty((0, 6)), self.each_s, 1)
        joints = np.array([[0.0] * 6, [length] + [0.0] * 5])
        return Solution(self.status, joints, self.each_s, 1)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def problem() -> PlanningProblem:
    start, goal = pairs_of("free", 1, seed=1)[0]
    return PlanningProblem(start, goal, manifold_of(packaged_planner(), "free"), lambda q: True)


def test_the_shortest_of_all_attempts_is_the_answer(problem) -> None:
    inner = Listed((np.nan, 3.0, 1.0, 2.0))
    found = Restarted(inner, 0.05).plan(problem, 2)
    assert found.status == "solved"
    assert found.joints[1, 0] == 1.0
    assert found.iterations == len(inner.seeds) > 4
    assert inner.seeds == list(range(200_000, 200_000 + len(inner.seeds)))
    assert found.time_s > 0.0


def test_without_a_path_there_is_an_answer_all_the_same(problem) -> None:
    found = Restarted(Listed((np.nan,)), 0.01).plan(problem, 0)
    assert (found.status, found.joints.shape) == ("not_found", (0, 6))


@pytest.mark.parametrize("status", ["not_applicable", "start_violates"])
def test_what_no_seed_changes_is_asked_once(problem, status) -> None:
    inner = Listed((1.0,), status)
    assert Restarted(inner, 5.0).plan(problem, 0).status == status
    assert len(inner.seeds) == 1


def test_one_attempt_is_made_however_short_the_time(problem) -> None:
    inner = Listed((2.0,))
    assert Restarted(inner, 1e-9).plan(problem, 0).joints[1, 0] == 2.0
    assert len(inner.seeds) == 1


def test_an_attempt_that_is_remembered_counts_with_the_time_it_took(problem) -> None:
    inner = Listed((3.0, 1.0), each_s=0.6)
    found = Restarted(inner, 1.0).plan(problem, 0)
    assert (len(inner.seeds), found.joints[1, 0]) == (1, 3.0)
    assert 0.6 <= found.time_s < 1.2, "once, not twice"


@dataclass
class Timed:
    """Attempts of these lengths, nan for none, that take these times [s]."""

    attempts: tuple[tuple[float, float], ...]
    asked: int = 0
    name: str = "timed"

    def plan(self, problem: PlanningProblem, seed: int) -> Solution:
        length, spent_s = self.attempts[self.asked % len(self.attempts)]
        self.asked += 1
        return replace(Listed((length,)).plan(problem, seed), time_s=spent_s)


def test_what_is_found_too_late_takes_nothing_from_what_was_there(problem) -> None:
    inner = Timed(((3.0, 0.1), (1.0, 5.0)))
    found = Restarted(inner, 1.0).plan(problem, 0)
    assert (found.joints[1, 0], found.time_s, inner.asked) == (3.0, 1.0, 2)


def test_the_first_path_may_take_longer_than_the_restarts(problem) -> None:
    inner = Timed(((np.nan, 0.7), (np.nan, 0.7), (2.0, 0.7), (1.0, 0.7)))
    found = Restarted(inner, 1.0, limit_s=10.0).plan(problem, 0)
    assert (found.joints[1, 0], inner.asked) == (2.0, 3)
    assert 2.1 <= found.time_s < 2.5
    assert Restarted(Timed(inner.attempts), 1.0).plan(problem, 0).status == "not_found"


def shorter_than(length: float, problem: PlanningProblem) -> PlanningProblem:
    """The problem with such paths as its sound ones."""
    return replace(problem, is_sound=lambda joints: bool(joints[-1, 0] < length))


def test_a_path_that_is_not_sound_is_no_shortest_one(problem) -> None:
    inner = Listed((1.0, 3.0, 2.0, 4.0))
    longer = replace(problem, is_sound=lambda joints: bool(joints[-1, 0] > 1.5))
    assert Restarted(inner, 0.05).plan(longer, 0).joints[-1, 0] == 2.0
    claimed = Restarted(Listed((1.0,)), 0.01).plan(longer, 0)
    assert (claimed.status, claimed.joints[-1, 0]) == ("solved", 1.0)


def test_restarts_after_a_path_that_is_not_sound_take_shorter_steps(problem) -> None:
    inner, halved = Listed((1.0,)), Listed((3.0, 2.0))
    longer = replace(problem, is_sound=lambda joints: bool(joints[-1, 0] > 1.5))
    assert Restarted(inner, 0.05, halved).plan(longer, 0).joints[-1, 0] == 2.0
    assert (len(inner.seeds), halved.seeds[:2]) == (1, [1, 2])


def test_where_nobody_can_tell_the_first_path_is_the_answer(problem) -> None:
    inner = Listed((5.0, 1.0))
    assert UntilSound(inner, 10.0).plan(problem, 0).joints[-1, 0] == 5.0
    assert len(inner.seeds) == 1


def test_the_first_sound_path_is_the_answer_with_the_time_of_all_attempts(problem) -> None:
    inner = Listed((5.0, 3.0, 1.0, 0.5), each_s=0.25)
    found = UntilSound(inner, 10.0).plan(shorter_than(2.0, problem), 2)
    assert (found.status, found.joints[-1, 0]) == ("solved", 1.0)
    assert inner.seeds == [200_000, 200_001, 200_002]
    assert found.iterations == 3
    assert 0.75 <= found.time_s < 1.0


def test_after_a_path_that_is_not_sound_shorter_steps_are_asked_for(problem) -> None:
    inner, halved = Listed((5.0, 1.0)), Listed((4.0, 3.0, 1.0))
    found = UntilSound(inner, 10.0, halved).plan(shorter_than(2.0, problem), 0)
    assert (found.joints[-1, 0], inner.seeds, halved.seeds) == (1.0, [0], [1, 2, 3])


def test_an_attempt_that_finds_nothing_after_one_that_was_not_sound_ends_nothing(problem) -> None:
    inner = Listed((5.0, np.nan, 1.0), each_s=0.1)
    found = UntilSound(inner, 10.0).plan(shorter_than(2.0, problem), 0)
    assert (found.joints[-1, 0], len(inner.seeds)) == (1.0, 3)


def test_every_answer_to_the_last_problem_is_remembered(problem) -> None:
    inner = Listed((1.0,))
    kept = Remembered(inner)
    for seed in [*range(1000), *range(1000)]:
        kept.plan(problem, seed)
    assert inner.seeds == list(range(1000))
    kept.plan(replace(problem), 0)
    assert inner.seeds[-1] == 0
    assert len(inner.seeds) == 1001


def test_once_the_time_for_sound_paths_is_over_the_last_one_is_what_is_claimed(problem) -> None:
    inner = Listed((5.0, 4.0, 3.0), each_s=0.25)
    found = UntilSound(inner, 0.6).plan(shorter_than(2.0, problem), 0)
    assert (found.status, found.joints[-1, 0], len(inner.seeds)) == ("solved", 3.0, 3)
    assert found.time_s >= 0.75


def test_who_takes_all_the_time_for_one_path_has_a_second_try(problem) -> None:
    inner = Listed((5.0, 1.0), each_s=0.7)
    found = UntilSound(inner, 0.6).plan(shorter_than(2.0, problem), 0)
    assert (found.joints[-1, 0], len(inner.seeds)) == (1.0, 2)
    assert found.time_s >= 1.4


@pytest.mark.parametrize("status", ["not_found", "in_collision"])
def test_what_is_no_path_is_not_asked_again(problem, status) -> None:
    inner = Listed((np.nan,)) if status == "not_found" else Listed((1.0,), status)
    assert UntilSound(inner, 5.0).plan(shorter_than(0.5, problem), 0).status == status
    assert len(inner.seeds) == 1
