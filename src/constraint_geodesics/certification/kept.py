"""How well a constraint is kept along a path: what each kind's twin here is asked and answers.

The twin of a kind is the file of its name with a function `kept(asked)`.
"""

from collections.abc import Sequence
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.certificate import CertificationError, Limits, Violation
from constraint_geodesics.certification.chain import Chain
from constraint_geodesics.constraints.constraint import Constraint


class Asked(NamedTuple):
    """A path's rows (T, D) and its constraint; first (D,): the configuration whose tool pose is the
    reference of a constraint without one.
    """

    chain: Chain
    rows: Float[np.ndarray, "T D"]
    constraint: Any
    first: Float[np.ndarray, "D"]
    limits: Limits


class Broken(NamedTuple):
    """The row or segment where something first passes its tolerance by too much, its name, unit and
    tolerance, and by how much.
    """

    row: int
    excess: float
    name: str
    unit: str
    tolerance: float


class Kept(NamedTuple):
    """Excesses over the tolerance by unit, "rad" and "m": attained, and proven for the whole path;
    and what is too much.
    """

    attained: dict[str, float]
    bound: dict[str, float]
    at_rows: Violation | None = None
    between_rows: Violation | None = None


def how_kept(asked: Asked) -> Kept:
    """What the twin of the constraint's kind finds."""
    if asked.constraint.is_free:
        return Kept(*nothing_exceeds())
    constraint: Constraint = asked.constraint
    try:
        twin = import_module(f"{__package__}.{constraint.kind}")
    except ModuleNotFoundError:
        raise CertificationError(
            f"constraints of kind {constraint.kind!r} can't be certified"
        ) from None
    found: Kept = twin.kept(asked)
    return found


def nothing_exceeds() -> tuple[dict[str, float], dict[str, float]]:
    """Attained and bound, to be raised."""
    return {"rad": 0.0, "m": 0.0}, {"rad": 0.0, "m": 0.0}


def summed_up(
    attained: dict[str, float],
    bound: dict[str, float],
    at_rows: Sequence[Broken],
    between: Sequence[Broken],
    limits: Limits,
) -> Kept:
    """With the first row where the constraint is left, and the first segment on which it is not
    proven that it is kept.
    """
    row = _first("constraint", "in row", "", at_rows, limits)
    where = "on the line from row"
    segment = _first("constraint_between_rows", where, "up to ", between, limits)
    return Kept(attained, bound, row, segment)


def _first(
    kind: str, where: str, at_most: str, broken: Sequence[Broken], limits: Limits
) -> Violation | None:
    if not broken:
        return None
    first, allowed = min(broken, key=lambda each: each.row), limits.violation_tolerance
    text = (
        f"{where} {first.row} {first.name} is beyond its tolerance of {first.tolerance:.3g} "
        f"{first.unit} by {at_most}{first.excess:.3g} {first.unit}, {allowed:.3g} is allowed"
    )
    return Violation(kind, first.row, first.excess, allowed, text)
