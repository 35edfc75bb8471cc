"""Rows of curves that no band has drawn tight.

Such a curve may meet the edge of a tolerance anywhere and turn there: a line between two rows then
leaves the constraint most at a place that is not its middle, where `halved` looks.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.peers.elastic_band import ROW_SAFETY, halved
from constraint_geodesics.problem import SATISFIED, PlanningProblem
from constraint_geodesics.search.band import project
from constraint_geodesics.search.candidates import Candidate, rows_of
from constraint_geodesics.search.curve_kernels import HALVINGS
from constraint_geodesics.search.space import space_of

LOOKED_AT = np.arange(1, 8) / 8.0
"""Shares of a line between two rows at which its violation is measured."""


def first_kept(
    problem: PlanningProblem, curves: Iterable[Candidate]
) -> Float[np.ndarray, "T D"] | None:
    """Rows of the first curve that touches nothing, so close that the lines between them keep the
    constraint; None if there is no such curve.
    """
    for curve in curves:
        rows = closer(problem.manifold, halved(problem.manifold, rows_of(curve, SATISFIED)))
        if problem.keeps_clear(rows):
            return rows
    return None


def closer(
    manifold: ConstraintManifold, rows: Float[np.ndarray, "T D"]
) -> Float[np.ndarray, "n D"]:
    """The rows, with one more in the middle of every line that leaves the constraint somewhere."""
    for _ in range(HALVINGS):
        between = rows[:-1, None] + LOOKED_AT[:, None] * np.diff(rows, axis=0)[:, None]
        worst = manifold.violation(between).max(axis=1)
        off = np.flatnonzero(worst > ROW_SAFETY * SATISFIED)
        if not len(off):
            break
        middle = np.ascontiguousarray(0.5 * (rows[off] + rows[off + 1]))
        project(space_of(manifold), middle)
        rows = np.insert(rows, off + 1, middle, axis=0)
    return rows
