"""How a planner looks for curves: the methods by their names, in this one place.

A further method is one file with a class that implements `Method`, and one line here.  A method of
the lab is named by its module, and imported when it is asked for.
"""

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
from jaxtyping import Float

from constraint_geodesics.search.candidates import (
    Answer,
    Candidate,
    Parts,
    Proposals,
    Task,
    candidates,
    improvements,
)

DEFAULT = "planner"


class Method(Protocol):
    """Proposes curves for a query; the planner has them certified."""

    @property
    def name(self) -> str:
        """The name that users choose it by."""
        ...

    def candidates(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | Answer]:
        """Sound curves, the most promising first; an Answer ends them."""
        ...

    def improvements(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | None]:
        """Further curves, for as long as there is time; None for one that is not sound."""
        ...


class SearchMethod:
    """The planner's own: straight line, roadmap and trees, each refined by an elastic band.

    proposals: a plug for learned curves, asked for when a query needs them.
    """

    name = DEFAULT

    def __init__(self, proposals: Callable[[], Proposals | None] = lambda: None) -> None:
        self.proposals = proposals

    def candidates(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | Answer]:
        """From the cheapest proposals to the most expensive."""
        return candidates(task, start, goal, self.proposals, parts)

    def improvements(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | None]:
        """Bent lines and new trees."""
        return improvements(task, start, goal, parts)
