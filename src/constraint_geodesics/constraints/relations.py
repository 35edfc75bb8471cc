"""Constraints that are a list of relations, all of which hold: what the polynomial ones and those
with splines share.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintError,
    Series,
    each_drawn,
    each_held,
    left_out_words,
)
from constraint_geodesics.constraints.kernels import Rows


@dataclass(frozen=True, eq=False)
class RelationsConstraint(Constraint):
    """relations: each with a name, unit and tolerance (`Bounded`).  left_out: what each is off by
    on demonstrations that it was not found on, in its unit; () where it was not found but given.

    Raises ConstraintError without relations, or where left_out has another number of entries.
    """

    relations: tuple[Any, ...]
    left_out: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.relations:
            raise ConstraintError("relations = (): one is needed at least")
        if self.left_out and len(self.left_out) != len(self.relations):
            raise ConstraintError(
                f"left_out has {len(self.left_out)} entries, there are {len(self.relations)} "
                f"relations"
            )

    @property
    def rows(self) -> Rows:
        """Every row is held, each by itself."""
        return each_held(self.relations)

    @property
    def units(self) -> tuple[str, ...]:
        """Those of the relations."""
        return tuple(own.unit for own in self.relations)

    def loosened(self, least: Mapping[str, float]) -> Self:
        """The same with every tolerance at least that of its row's unit."""
        wider = (
            replace(own, tolerance=max(own.tolerance, least[own.unit])) for own in self.relations
        )
        return replace(self, relations=tuple(wider))

    def widened(self, times: float) -> Self:
        """The same with each relation looser by so many times what it is missed by on left-out
        demonstrations.
        """
        pairs = zip(self.relations, self.left_out, strict=True)
        wider = (replace(own, tolerance=own.tolerance + times * off) for own, off in pairs)
        return replace(self, relations=tuple(wider))

    @property
    def whose(self) -> str:
        """What the relations are of, in words."""
        return "the tool's pose"

    @property
    def label(self) -> str:
        """Its relations, those of one name once."""
        names = "; ".join(dict.fromkeys(own.name for own in self.relations))
        return f"the constraint on {self.whose} ({names})"

    @property
    def caveat(self) -> str:
        """By what is identified."""
        return left_out_words(self.units, self.left_out)

    def series(self, residual: Float[np.ndarray, "n m"]) -> list[Series]:
        """Each row by itself, in mm or degrees."""
        return each_drawn(self.relations, residual)
