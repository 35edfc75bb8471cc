"""The shortest certified path from one configuration to any of several.

The goals are looked at nearest first, kind of proposal by kind of proposal: the straight lines to
all, the ways over the graph, the trees.  Of the curves that are found the shortest is certified
first, and a goal whose straight distance is no less than the length of the path so far is left
alone: no path to it is shorter.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.progress import saying_late
from constraint_geodesics.search.candidates import ALMOST, Answer, Candidate, Task, refined
from constraint_geodesics.search.nearest import nearest_on

Certified = TypeVar("Certified")

_WORTHWHILE = 1e-4
"""Share by which another path must be shorter to be looked for."""
_CHEAP_ROUNDS, _PATIENTLY = 3, 4
"""After so many rounds trees are grown, towards so many of the goals, the nearest."""
_SLIDES = 6
_MOVED_RAD = 1e-3
"""An end that would move by less stays."""
_ON = 1e-8
"""Violation of an end that has moved, at most [rad or m]."""


@dataclass(eq=False)
class Pursued:
    """A configuration that a path may end at, while paths to it are looked for.

    distance: from the start, straight.  curves: those that are still to come.  region: what the end
    must keep, where it is more than the configuration; room: the set that it may move in.  answer:
    what the curves ended with.  failed: why the last curve is no path.
    """

    goal: Float[np.ndarray, "D"]
    distance: float
    curves: Iterator[Candidate | Answer | None] = field(repr=False)
    region: Constraint | None = None
    room: ConstraintManifold | None = None
    answer: Answer | None = None
    failed: str = ""
    is_over: bool = False


def shortest(
    pursued: Sequence[Pursued],
    task: Task,
    certify: Callable[[Pursued, Candidate], tuple[Certified, float] | str],
    more: Callable[[], Sequence[Pursued]],
    is_connected: Callable[[Pursued], bool],
) -> tuple[Certified, Pursued] | None:
    """The shortest path that is certified, and whose it is; None where there is none.

    pursued: the nearest first.  certify: gives the path and its length, or why it is none.  more:
    further ones, the nearest first, where the path is not almost as short as can be.  is_connected:
    whether the graph does not keep one apart from the start.
    """
    pursuit = _Pursuit(task, certify)
    left = pursuit.go_on(pursued, _CHEAP_ROUNDS)
    if pursuit.least > ALMOST * pursued[0].distance:
        left += pursuit.go_on(more(), _CHEAP_ROUNDS)
    left = sorted(left, key=lambda one: one.distance)[:_PATIENTLY]
    if pursuit.best is not None:
        # the graph hardly ever errs: no trees are grown to where it says that there is no way
        left = [one for one in left if is_connected(one)]
    if left:
        with saying_late("looking further for a path"):
            pursuit.go_on(left)
    return pursuit.best


class _Pursuit(Generic[Certified]):
    """The best path so far, and its length."""

    def __init__(
        self, task: Task, certify: Callable[[Pursued, Candidate], tuple[Certified, float] | str]
    ) -> None:
        self.task, self.certify = task, certify
        self.best: tuple[Certified, Pursued] | None = None
        self.least = np.inf

    @property
    def worth(self) -> float:
        """A path must be shorter."""
        return (1.0 - _WORTHWHILE) * self.least

    def go_on(self, pursued: Sequence[Pursued], rounds: int | None = None) -> list[Pursued]:
        """Ask for so many curves to each, or for all there are; returns those that may have more
        that are worth it.
        """
        waiting, done = [one for one in pursued if one.distance < self.worth], 0
        while waiting and done != rounds:
            for length, one, candidate in sorted(self._found(waiting), key=lambda own: own[0]):
                if length >= self.worth:
                    one.is_over = True
                    continue
                result = self.certify(one, candidate)
                if isinstance(result, str):
                    one.failed = f"; the {candidate.source} curve fails: {result}"
                else:
                    self.best, self.least, one.is_over = (result[0], one), result[1], True
            waiting = [one for one in waiting if not one.is_over and one.distance < self.worth]
            done += 1
        return waiting

    def _found(self, waiting: Sequence[Pursued]) -> Iterator[tuple[float, Pursued, Candidate]]:
        """The next curve to each that is near enough."""
        nearest = self.least
        for one in waiting:
            if one.distance >= (1.0 - _WORTHWHILE) * nearest:
                break
            item = next(one.curves, Answer("not_found"))
            if isinstance(item, Answer):
                one.answer, one.is_over = item, True
            elif item is not None:
                if one.room is not None:
                    item = slid(self.task, item, one.room)
                nearest = min(nearest, item.length)
                yield item.length, one, item


def slid(task: Task, candidate: Candidate, room: ConstraintManifold) -> Candidate:
    """The candidate with its end moved to where in its room the curve is shortest.

    The end goes to the configuration of the room that is nearest to where the curve would begin
    were it straight, going by its last direction, and the curve is relaxed anew.
    """
    share, tried = np.linspace(0.0, 1.0, len(candidate.nodes))[:, None], 1.0
    for _ in range(_SLIDES):
        end, before = candidate.points[-1], candidate.points[-2]
        along = (end - before) / max(float(np.linalg.norm(end - before)), 1e-12)
        found = nearest_on(room, end - tried * candidate.length * along, end[None])
        if not len(found) or np.abs(found[0] - end).max() < _MOVED_RAD:
            break
        better = None
        if task.manifold.violation(found) <= _ON:
            nodes = candidate.nodes + share * (found[0] - end)
            nodes[-1] = found[0]
            better = refined(task, candidate.source, nodes, clear=candidate.pushed)
        if better is not None and better.length < (1.0 - _WORTHWHILE) * candidate.length:
            candidate = better
            share = np.linspace(0.0, 1.0, len(candidate.nodes))[:, None]
        else:
            tried *= 0.5
    return candidate
