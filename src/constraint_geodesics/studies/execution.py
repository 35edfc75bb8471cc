"""What a planned path is worth to a robot that carries an open cup, executed in simulation.

Each query is executed along the planner's path and along the straight joint line, both near
time-optimal within the same limits.  Only queries are taken whose line tips the cup.  Tilt is not
all: a fast swing can hold the spheres upside down, or throw one out of a level cup.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from constraint_geodesics.array_files import read_npz
from constraint_geodesics.benchmark.judge import polyline_length
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.geometry.braking import Pace
from constraint_geodesics.learning.dataset import Queries, draw_queries
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.params import ExecutionParams
from constraint_geodesics.progress import progress
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings, Execution, execute
from constraint_geodesics.text_files import reading, written
from constraint_geodesics.trajectory import Trajectory

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


OF_EXECUTION = {"kept": "Int64", "spheres": "Int64"} | dict.fromkeys(
    ("kept_share", "largest_tilt_rad", "largest_tracking_error_rad", "duration_s"), "float64"
)
COLUMNS = {
    "query": "int64",
    "kind": "str",
    "status": "str",
    **OF_EXECUTION,
    "length_rad": "float64",
    "collision": "boolean",
}
"""Of the table, with the type of each; empty where there was no path."""


class ExecutionCheckError(ValueError):
    """An experiment without meaning; names the entry, its value and what is allowed."""


Plan = Callable[[Float[np.ndarray, "D"], Float[np.ndarray, "D"]], Trajectory]
"""Plans from a start to a goal [rad] under the constraint that is looked at."""


@dataclass(frozen=True)
class Carrying:
    """A robot that carries an open cup under a constraint.

    acceleration_rad_s2: limit of every joint on straight lines; velocity limits are the robot's.
    """

    name: str
    scene: Scene
    manifold: ConstraintManifold
    acceleration_rad_s2: float
    cup: CupSettings


@dataclass(frozen=True)
class TippingQueries:
    """Queries whose straight joint line tips the cup, their largest tilts, and pairs drawn."""

    queries: Queries
    tilt_rad: Float[np.ndarray, "n"]
    drawn: int
    """Pairs looked at until the last of the queries was found."""


@dataclass(frozen=True)
class Executed:
    """One query executed along one kind of path; without a path, `status` says why."""

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
        if self.execution is None:
            return about
        found = {name: getattr(self.execution, name) for name in OF_EXECUTION}
        return about | found | {"length_rad": self.length_rad, "collision": self.collision}


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
    """Largest tilt [rad] of the cup's axis on the straight joint line of each query."""
    t = np.linspace(0.0, 1.0, LINE_POINTS)[:, None]
    lines = (1.0 - t) * queries.starts[:, None] + t * queries.goals[:, None]
    vertical = manifold.robot.forward(lines)[1][..., 2, :] @ cup_axis(manifold)
    return np.asarray(np.arccos(np.clip(vertical.min(axis=1), -1.0, 1.0)))


def tipping_queries(
    scene: Scene, manifold: ConstraintManifold, name: str, settings: ExecutionParams
) -> TippingQueries:
    """The first pairs of `draw_queries` whose straight joint line tilts the cup far enough.

    Raises ExecutionCheckError if least_tilt_rad is not in (0, π), or too few of the pairs drawn
    tilt the cup so far.
    """
    count, least_tilt_rad = settings.queries, settings.least_tilt_rad
    if not 0.0 < least_tilt_rad < np.pi:
        raise ExecutionCheckError(f"least_tilt_rad = {least_tilt_rad}: must lie between 0 and π")
    drawn = DRAWN_FIRST * count
    while drawn <= DRAWN_MOST * count:
        pairs = draw_queries(scene, manifold, name, drawn, settings.seed)
        tilts = line_tilts(manifold, pairs)
        kept = np.flatnonzero(tilts >= least_tilt_rad)[:count]
        if len(kept) == count:
            queries = Queries(pairs.starts[kept], pairs.goals[kept])
            return TippingQueries(queries, tilts[kept], int(kept[-1]) + 1)
        drawn *= 2
    raise ExecutionCheckError(
        f"least_tilt_rad = {least_tilt_rad}: {len(kept)} of {len(pairs)} straight lines under "
        f"{name!r} tilt the cup so far, {count} are needed"
    )


def execute_queries(
    plan: Plan, carrying: Carrying, queries: Queries
) -> tuple[pd.DataFrame, list[Executed]]:
    """Execute every query along its planned path and along its straight joint line.

    Returns one row a query and kind with `COLUMNS`, and the executions in the same order.
    Raises ExecutionCheckError if the constraint does not hold roll and pitch.
    """
    scene, axis = carrying.scene, cup_axis(carrying.manifold)
    pace = Pace(scene.robot.velocity, np.full(scene.robot.dof, carrying.acceleration_rad_s2))
    label, executed = f"executions {carrying.name}", list[Executed]()
    with scene.world() as world, progress(label, 2 * len(queries)) as advance:
        for query, ends in enumerate(zip(queries.starts, queries.goals, strict=True)):
            for kind, status, joints, times in _paths(plan, *ends, pace):
                if len(joints) < 2:
                    executed.append(Executed(query, kind, status))
                else:
                    cup = carrying.cup
                    found = execute(scene, joints, times, axis, cup)
                    hit = world.first_collision(joints) is not None
                    length = polyline_length(joints)
                    executed.append(Executed(query, kind, EXECUTED, length, hit, found))
                advance()
    table = pd.DataFrame([one.row() for one in executed], columns=list(COLUMNS)).astype(COLUMNS)
    return table, executed


def _paths(
    plan: Plan, start: Float[np.ndarray, "D"], goal: Float[np.ndarray, "D"], pace: Pace
) -> Iterator[tuple[str, str, Float[np.ndarray, "T D"], Float[np.ndarray, "T"]]]:
    """Kind, status, rows and times of both paths of a query."""
    planned = plan(start, goal)
    yield PLANNED, planned.status, planned.joints, planned.times
    line = densify(np.stack([start, goal]), ROW_SPACING_RAD)
    yield STRAIGHT, EXECUTED, line, pace.times(line, None)


def execution_figures(table: pd.DataFrame, found: TippingQueries) -> dict[str, Any]:
    """Queries and pairs drawn for them, and how much stayed in the cup on each kind of path."""
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


def save_execution(file: Path, execution: Execution) -> None:
    """What became of a path, for `load_execution`."""
    with written(file) as part:
        np.savez_compressed(part, **asdict(execution))


def load_execution(file: Path) -> Execution:
    """An execution that was kept in a file."""
    with reading(file):
        kept: Any = read_npz(file)
        return Execution(**{n: v if v.ndim else v.item() for n, v in kept.items()})
