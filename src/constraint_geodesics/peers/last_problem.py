"""What was worked out for the last problem, for all who ask for it."""

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

from constraint_geodesics.problem import PlanningProblem

Kept = TypeVar("Kept")


class LastProblem(Generic[Kept]):
    """What several ask of one problem, and is found once: who takes a path as it is, and who
    shortens it.  It holds the time that it took, whoever asks for it again.
    """

    def __init__(self) -> None:
        self._problem: PlanningProblem | None = None
        self._found: dict[Hashable, Kept] = {}

    def found(self, problem: PlanningProblem, asked: Hashable, find: Callable[[], Kept]) -> Kept:
        """What is asked; for the same problem, as an object, it is not looked for again."""
        if self._problem is not problem:
            self._problem = problem
            self._found.clear()
        if asked not in self._found:
            self._found[asked] = find()
        return self._found[asked]
