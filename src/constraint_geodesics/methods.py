"""How a planner looks for curves.  `plugs.METHODS` has the methods by their names.

A further method is one file with a class that implements `Method`, and one line there.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Protocol, Self

import numpy as np
from jaxtyping import Float

from constraint_geodesics.bundle import Bundle
from constraint_geodesics.plugs import METHODS, plug
from constraint_geodesics.problem import PlannerError
from constraint_geodesics.search.candidates import (
    Answer,
    Candidate,
    Parts,
    Task,
    candidates,
    further,
    improvements,
)
from constraint_geodesics.search.preparation import Draw
from constraint_geodesics.search.roadmap import Roadmap


class Method(Protocol):
    """Proposes curves for a query; the planner has them certified.

    name: users choose it by this.  roadmaps: by constraint, instead of the planner's; None for
    those.  draw: of the configurations that further roadmaps are made of; None for uniform ones.
    """

    name: str
    roadmaps: Mapping[str, Roadmap] | None
    draw: Draw | None

    @classmethod
    def open(cls, source: str | Path | None, bundle: Bundle) -> Self:
        """For a planner's files.  Raises BundleError if files of its own are missing or altered."""
        ...

    def candidates(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | Answer | None]:
        """Sound curves, the most promising first; None where those begin that take longer, an
        Answer at the end.
        """
        ...

    def improvements(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | None]:
        """Further curves, for as long as there is time; None for one that is not sound."""
        ...

    def further(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Iterator[Candidate]]:
        """Where no candidate came to a path, for as long as there is time: each try's curves."""
        ...


class SearchMethod:
    """The planner's own: straight line, roadmap and trees, each refined by an elastic band."""

    name = "planner"
    roadmaps: Mapping[str, Roadmap] | None = None
    draw: Draw | None = None

    @classmethod
    def open(cls, source: str | Path | None, bundle: Bundle) -> Self:
        """It has no files of its own."""
        return cls()

    def candidates(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | Answer | None]:
        """From the cheapest proposals to the most expensive."""
        return candidates(task, start, goal, parts)

    def improvements(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Candidate | None]:
        """Bent lines and new trees."""
        return improvements(task, start, goal, parts)

    def further(
        self, task: Task, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], parts: Parts
    ) -> Iterator[Iterator[Candidate]]:
        """New trees."""
        return further(task, start, goal, parts)


def open_method(name: str, source: str | Path | None, bundle: Bundle) -> Method:
    """A method by its name.  Raises PlannerError if there is none of that name."""
    if name not in METHODS:
        raise PlannerError(f"there is no method {name!r}: must be one of {', '.join(METHODS)}")
    method: Method = plug(METHODS[name]).open(source, bundle)
    return method
