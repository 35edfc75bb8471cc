"""Two constraints at once: relations of two kinds that demonstrations keep to, or where a goal's
region and the path's constraint meet.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from numba import carray, int64

from constraint_geodesics.constraints.constraint import (
    Constraint,
    Pose,
    Series,
    constraint_from_json,
)
from constraint_geodesics.constraints.kernels import (
    LINEARISE_WORDS,
    ConstraintArrays,
    Rows,
    c_function,
    call,
    floats,
)
from constraint_geodesics.robot.kernels import LANES
from constraint_geodesics.robot.kinematics import SerialRobot

_HEAD = 6
"""Numbers before the data of the two: addresses, rows, how long the first's data and room are."""


def both(first: Constraint, second: Constraint) -> Constraint:
    """What holds both; one of them where the other holds nothing.

    What one holds exactly is left out of the other, where a kind can tell: it would be the same
    rows again, or rows that nothing keeps.
    """
    if not (first.is_free or second.is_free):
        first, second = first.apart_from(second)
    if first.is_free or second.is_free:
        return second if first.is_free else first
    return Both(first, second)


@dataclass(frozen=True)
class Both(Constraint):
    """The rows of two constraints, one after the other.

    Rows of the second that are bounded together, as those of the first are, become bounds of each:
    the box within the ball.
    """

    kind: ClassVar[str] = "both"
    first: Constraint
    second: Constraint

    @property
    def rows(self) -> Rows:
        """Those of both."""
        one, other = self.first.rows, self.second.rows
        loose = other.together & (other.tolerance > 0.0)
        tolerance, together = other.tolerance, other.together
        if loose.any() and (one.together & (one.tolerance > 0.0)).any():
            tolerance = np.where(loose, tolerance / np.sqrt(loose.sum()), tolerance)
            together = np.zeros_like(together)
        elif loose.any():
            one = one._replace(together=np.zeros_like(one.together))
        else:
            together = np.zeros_like(together)
        return Rows(
            np.concatenate([one.held, other.held]),
            np.concatenate([one.tolerance, tolerance]),
            np.concatenate([one.together, together]),
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Those of both."""
        return self.first.units + self.second.units

    def arrays(self, robot: SerialRobot) -> ConstraintArrays:
        """For the kernels."""
        one, other = self.first.arrays(robot), self.second.arrays(robot)
        counts = [len(own.rows.held) for own in (one, other)]
        head = [one.linearise, other.linearise, *counts, len(one.data), max(one.room, other.room)]
        own = max(counts) * LANES * (1 + robot.dof)
        data = np.concatenate([head, one.data, other.data])
        return ConstraintArrays(self.rows, data, _compiled().address, 0, int(head[5]) + own)

    @property
    def is_placed(self) -> bool:
        """Whether both are."""
        return self.first.is_placed and self.second.is_placed

    def relative_to(self, pose: Pose) -> Constraint:
        """With what has no reference yet held at `pose`."""
        parts = (
            part if part.is_placed else part.relative_to(pose) for part in (self.first, self.second)
        )
        return Both(*parts)

    def compile(self) -> None:
        """What both need."""
        self.first.compile()
        self.second.compile()

    def loosened(self, least: Mapping[str, float]) -> "Both":
        """Both, each by itself."""
        return Both(self.first.loosened(least), self.second.loosened(least))

    @property
    def label(self) -> str:
        """Those of both."""
        return f"{self.first.label} and {self.second.label}"

    @property
    def caveat(self) -> str:
        """Those of both."""
        return " and ".join(filter(None, (self.first.caveat, self.second.caveat)))

    @property
    def key(self) -> tuple:
        """Those of both."""
        return (self.kind, self.first.key, self.second.key)

    def series(self, residual: Float[np.ndarray, "n m"]) -> list[Series]:
        """Those of both."""
        count = len(self.first.rows.held)
        return self.first.series(residual[:, :count]) + self.second.series(residual[:, count:])

    def to_json(self) -> dict[str, Any]:
        """Both, each by itself."""
        parts = {"first": self.first.to_json(), "second": self.second.to_json()}
        return {"kind": self.kind, **parts}

    @classmethod
    def from_json(cls, about: Mapping[str, Any], robot: SerialRobot | None) -> "Both":
        """What `to_json` wrote."""
        return cls(*(constraint_from_json(about[part], robot) for part in ("first", "second")))


KIND = Both


def _write(
    origins, axes, prismatic, base, tool, data, q, room, residuals, jacobians, dof, rows, count
):
    head, at = carray(floats(data), (_HEAD,)), 0
    values, slopes = room + 8 * int64(head[5]), 0
    own = data + 8 * _HEAD
    for part in range(2):
        held = int64(head[2 + part])
        if jacobians != 0:
            slopes = values + 8 * LANES * held
            carray(floats(slopes), (count * held * dof,))[:] = 0.0
        carray(floats(values), (count * held,))[:] = 0.0
        words = (
            origins,
            axes,
            prismatic,
            base,
            tool,
            own,
            q,
            room,
            values,
            slopes,
            dof,
            held,
            count,
        )
        call(int64(head[part]), words)
        out, written = (
            carray(floats(residuals), (count, rows)),
            carray(floats(values), (count, held)),
        )
        for n in range(count):
            for i in range(held):
                out[n, at + i] = written[n, i]
        if jacobians != 0:
            all_slopes = carray(floats(jacobians), (count, rows, dof))
            own_slopes = carray(floats(slopes), (count, held, dof))
            for n in range(count):
                for i in range(held):
                    for d in range(dof):
                        all_slopes[n, at + i, d] = own_slopes[n, i, d]
        at += held
        own += 8 * int64(head[4])
    return 0


@cache
def _compiled() -> Any:
    return c_function(_write, LINEARISE_WORDS)
