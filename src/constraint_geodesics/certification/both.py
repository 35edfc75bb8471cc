"""Two constraints at once: each is certified by itself."""

from constraint_geodesics.certification.certificate import Violation
from constraint_geodesics.certification.kept import Asked, Kept, how_kept


def kept(asked: Asked) -> Kept:
    """The larger excesses, and what breaks first."""
    one, other = (
        how_kept(asked._replace(constraint=own))
        for own in (asked.constraint.first, asked.constraint.second)
    )
    return Kept(
        {unit: max(value, other.attained[unit]) for unit, value in one.attained.items()},
        {unit: max(value, other.bound[unit]) for unit, value in one.bound.items()},
        _first(one.at_rows, other.at_rows),
        _first(one.between_rows, other.between_rows),
    )


def _first(one: Violation | None, other: Violation | None) -> Violation | None:
    found = [own for own in (one, other) if own is not None]
    return min(found, key=lambda own: own.row or 0, default=None)
