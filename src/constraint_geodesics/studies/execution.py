"""What a planned path is worth to a robot that carries an open cup: executed in simulation, beside
a straight line.

Each query is executed twice: along the planner's path, and along the straight joint line between
the same ends, both near time-optimal within the same limits.  Only queries are taken whose line
tips the cup.  Tilt is not all: a fast swing can hold the spheres in a cup that hangs upside down,
and throw one over the rim of a cup that stays level.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.benchmark.judge import polyline_length
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.geometry.timing import time_parametrisation
from constraint_geodesics.learning.dataset import Queries, draw_queries
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.pipeline.progress import progress
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings, Execution, execute

PLANNED, STRAIGHT = "planned path", "straight joint line"
EXECUTED = "executed"
ROW_SPACING_RAD = 0.02
"""Distance of a straight line's rows."""
LINE_POINTS = 201
"""Configurations of a straight line at which its tilt is looked at."""
DRAWN_FIRST, DRAWN_MOST = 8, 256
"""Pairs drawn for each query that is wanted, doubled from the first number to the last while too
few tip the cup.
"""


class ExecutionCheckError(ValueError):
    """An experiment that can't be meant; the message names the entry, its value and what is
    allowed.
    """


class Solution(Protocol):
    """What is asked of a planner's answer."""

    @property
    def status(self) -> str:
        """Either solved, or why not."""
        ...

    @property
    def joints(self) -> Float[np.ndarray, "T D"]:
        """Rows [rad]."""
        ...

    @property
    def times(self) -> Float[np.ndarray, "T"]:
        """Of the rows [s]."""
        ...


Plan = Callable[[Float[np.ndarray, "D"], Float[np.ndarray, "D"]], Solution]
"""Plans from a start to a goal [rad] under the constraint that is looked at."""


@dataclass(frozen=True)
class TippingQueries:
    """Queries whose straight joint line tips the cup, the largest tilt of each, and how many pairs
    were drawn.
    """

    queries: Queries
    tilt_rad: Float[np.ndarray, "n"]
    drawn: int
    """Pairs looked at until the last of the queries was found."""


@dataclass(frozen=True)
class Executed:
    """One query executed along one kind of path; without an execution, `status` says why there was
    no path.
    """

    query: int
    kind: str
    status: str
    length_rad: float = float("nan")
    collision: bool = False
    """Whether the arm, as PyBullet judges its rows, touches itself or the workcell on the path."""
    execution: Execution | None = None

    def row(self) -> dict[str, Any]:
        """As columns of a table."""
        about = {"query": self.query, "kind": self.kind, "status": self.status}
        found = self.execution
        if found is None:
            return about
        return about | {
            "kept": found.kept,
            "spheres": found.spheres,
            "kept_share": found.kept_share,
            "largest_tilt_rad": found.largest_tilt_rad,
            "largest_tracking_error_rad": found.largest_tracking_error_rad,
            "duration_s": found.duration_s,
            "length_rad": self.length_rad,
            "collision": self.collision,
        }


COLUMNS = {
    "query": "int64",
    "kind": "str",
    "status": "str",
    "kept": "Int64",
    "spheres": "Int64",
    "kept_share": "float64",
    "largest_tilt_rad": "float64",
    "largest_tracking_error_rad": "float64",
    "duration_s": "float64",
    "length_rad": "float64",
    "collision": "boolean",
}
"""Of the table, with the type of each; empty where there was no path."""


def cup_axis(manifold: ConstraintManifold) -> Float[np.ndarray, "3"]:
    """Direction in the tool frame that points up at the constraint's reference: where the cup
    opens.

    Raises ExecutionCheckError if the constraint does not hold roll and pitch.
    """
    axis = manifold.constraint.level_axis
    if axis is None:
        raise ExecutionCheckError(
            f"{manifold.constraint.label}: must hold roll and pitch, or a cup need not stay upright"
        )
    return axis


def line_tilts(manifold: ConstraintManifold, queries: Queries) -> Float[np.ndarray, "n"]:
    """Largest tilt [rad] of the cup's axis to the vertical on the straight joint line of each
    query.
    """
    t = np.linspace(0.0, 1.0, LINE_POINTS)[:, None]
    lines = (1.0 - t) * queries.starts[:, None] + t * queries.goals[:, None]
    vertical = manifold.robot.forward(lines)[1][..., 2, :] @ cup_axis(manifold)
    return np.asarray(np.arccos(np.clip(vertical.min(axis=1), -1.0, 1.0)))


def tipping_queries(
    scene: Scene,
    manifold: ConstraintManifold,
    name: str,
    count: int,
    least_tilt_rad: float,
    seed: int,
) -> TippingQueries:
    """The first `count` pairs of `draw_queries` whose straight joint line tilts the cup by
    `least_tilt_rad` or more.

    Raises ExecutionCheckError if least_tilt_rad is not in (0, π), or too few of the pairs drawn
    tilt the cup so far.
    """
    if not 0.0 < least_tilt_rad < np.pi:
        raise ExecutionCheckError(f"least_tilt_rad = {least_tilt_rad}: must lie between 0 and π")
    drawn = DRAWN_FIRST * count
    while drawn <= DRAWN_MOST * count:
        pairs = draw_queries(scene, manifold, name, drawn, seed)
        tilts = line_tilts(manifold, pairs)
        kept = np.flatnonzero(tilts >= least_tilt_rad)[:count]
        if len(kept) == count:
            return TippingQueries(
                Queries(pairs.starts[kept], pairs.goals[kept]), tilts[kept], int(kept[-1]) + 1
            )
        drawn *= 2
    raise ExecutionCheckError(
        f"least_tilt_rad = {least_tilt_rad}: {len(kept)} of {len(pairs)} straight lines under "
        f"{name!r} tilt the cup "
        f"so far, {count} are needed"
    )


def execute_queries(
    plan: Plan,
    scene: Scene,
    manifold: ConstraintManifold,
    name: str,
    queries: Queries,
    acceleration_rad_s2: float,
    cup: CupSettings,
) -> tuple[pd.DataFrame, list[Executed]]:
    """Execute every query along its planned path and along its straight joint line.

    acceleration_rad_s2: limit of every joint on the straight lines; velocity limits are the
    robot's.  The planned path comes with times of its own.
    Returns one row a query and kind with `COLUMNS`, and the executions in the same order.
    Raises ExecutionCheckError if the constraint does not hold roll and pitch.
    """
    axis = cup_axis(manifold)
    limits = (scene.robot.velocity, np.full(scene.robot.dof, acceleration_rad_s2))
    executed: list[Executed] = []
    with scene.world() as world, progress(f"executions {name}", 2 * len(queries)) as advance:
        for query in range(len(queries)):
            for kind, status, joints, times in _paths(
                plan, queries.starts[query], queries.goals[query], limits
            ):
                if len(joints) < 2:
                    executed.append(Executed(query, kind, status))
                else:
                    found = execute(scene.robot, scene.workcell, joints, times, axis, cup)
                    hit = world.first_collision(joints) is not None
                    executed.append(
                        Executed(query, kind, EXECUTED, polyline_length(joints), hit, found)
                    )
                advance()
    table = pd.DataFrame([one.row() for one in executed], columns=list(COLUMNS)).astype(COLUMNS)
    return table, executed


def _paths(
    plan: Plan,
    start: Float[np.ndarray, "D"],
    goal: Float[np.ndarray, "D"],
    limits: tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D"]],
) -> Iterator[tuple[str, str, Float[np.ndarray, "T D"], Float[np.ndarray, "T"]]]:
    """Kind, status, rows and times of both paths of a query."""
    planned = plan(start, goal)
    yield PLANNED, planned.status, planned.joints, planned.times
    line = densify(np.stack([start, goal]), ROW_SPACING_RAD)
    yield STRAIGHT, EXECUTED, line, time_parametrisation(line, *limits)


def execution_figures(table: pd.DataFrame, found: TippingQueries) -> dict[str, Any]:
    """Number of queries and of pairs drawn for them, and of each kind how much of the cup's content
    stayed in it.
    """
    figures: dict[str, Any] = {
        "queries": len(found.queries),
        "drawn": found.drawn,
        "smallest_line_tilt_rad": float(found.tilt_rad.min()),
    }
    for kind, group in table.groupby("kind", sort=False):
        done = group[group["status"] == EXECUTED]
        figures[str(kind)] = {
            "executed": len(done),
            "kept_share_mean": float(done["kept_share"].mean()),
            "kept_share_worst": float(done["kept_share"].min()),
            "spilled": int((done["kept"] < done["spheres"]).sum()),
            "emptied": int((done["kept"] == 0).sum()),
            "collisions": int(done["collision"].sum()),
            "largest_tilt_rad": float(done["largest_tilt_rad"].max()),
            "largest_tracking_error_rad": float(done["largest_tracking_error_rad"].max()),
            "duration_mean_s": float(done["duration_s"].mean()),
        }
    return figures
