"""Demonstrations as they come: arrays or files of joint configurations, checked."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.robot.kinematics import SerialRobot

FEWEST_ROWS = 12
"""Rows of all demonstrations together."""
SPREAD_RAD = 1e-3
"""Rows that differ by less in every joint are one."""
OUTSIDE = 0.02
"""Rows beyond the joint limits by more are of another robot, or in degrees [rad or m]."""
TURNS = 4.0 * np.pi
"""Larger numbers than two turns look like degrees [rad]."""
STATE, EPISODE = "observation.state", "episode_index"
"""Columns of a LeRobot data set."""
Demonstrations = Sequence[Float[np.ndarray, "T D"]]


class DemonstrationError(ValueError):
    """Demonstrations that nothing can be learned from; the message says which, and what to do."""


def demonstrations_from(
    given: Any, robot: SerialRobot
) -> tuple[list[Float[np.ndarray, "T D"]], bool]:
    """Demonstrations (T, D) [rad], and whether they are motions: an array (n, D) is a set of
    independent rows.

    given: an array (n, D) or (demonstrations, T, D), a list of arrays (T, D), or a file: CSV, or
    parquet as LeRobot writes it.  Raises DemonstrationError, one line.
    """
    if isinstance(given, (str, Path)):
        given = _read(Path(given), robot.dof)
    if isinstance(given, np.ndarray) and given.ndim == 2:
        found, apart = [given], False
    else:
        found, apart = list(given), True
    shown = [_checked(np.asarray(rows, float), k, robot, apart) for k, rows in enumerate(found)]
    rows = sum(len(own) for own in shown)
    if rows < FEWEST_ROWS:
        raise DemonstrationError(
            f"{rows} rows in all: at least {FEWEST_ROWS} are needed; show more of the motion"
        )
    every = np.concatenate(shown)
    if (np.ptp(every, axis=0) < SPREAD_RAD).all():
        raise DemonstrationError("all rows are the same configuration: show the arm moving")
    return shown, apart


def _checked(
    rows: Float[np.ndarray, "T D"], number: int, robot: SerialRobot, apart: bool
) -> Float[np.ndarray, "T D"]:
    where = f"demonstration {number}" if apart else "the rows"
    if rows.ndim != 2 or rows.shape[1] != robot.dof:
        raise DemonstrationError(
            f"{where}: shape {rows.shape}, must be (T, {robot.dof}): one joint a column, "
            f"{', '.join(robot.joint_names)}"
        )
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise DemonstrationError(
            f"{where}, row {bad[0]}: not a finite number; leave such rows out ({len(bad)} of them)"
        )
    outside = float(np.maximum(-robot.limit_distance(rows), 0.0).mean())
    if outside > OUTSIDE:
        why = "are they another robot's?"
        if robot.limit_distance(np.radians(rows)).min() >= -OUTSIDE and np.abs(rows).max() > TURNS:
            why = "they look like degrees: give radians"
        raise DemonstrationError(
            f"{where}: outside the joint limits by {outside:.3g} rad in the mean; {why}"
        )
    return rows


def _read(file: Path, dof: int) -> Any:
    if not file.is_file():
        raise DemonstrationError(f"{file}: there is no such file")
    if file.suffix == ".parquet":
        return _read_lerobot(file)
    try:
        with file.open(encoding="utf-8") as lines:
            first = next(lines, "").strip().split(",")
            named = not _is_number(first[0])
        table = np.loadtxt(file, delimiter=",", skiprows=int(named), ndmin=2)
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise DemonstrationError(f"{file}: not a table of numbers: {error}") from None
    if table.shape[1] == dof + 1:  # a demonstration's number, then the joints
        order = table[:, 0]
        return [table[order == k, 1:] for k in dict.fromkeys(order.tolist())]
    return table


def _read_lerobot(file: Path) -> Any:
    try:
        import pandas as pd
    except ImportError:
        raise DemonstrationError(
            f"{file}: reading parquet needs pandas: pip install 'constraint_geodesics[pipeline]'"
        ) from None
    try:
        table = pd.read_parquet(file)
    except (OSError, ValueError) as error:
        raise DemonstrationError(f"{file}: not a parquet file: {error}") from None
    if STATE not in table:
        raise DemonstrationError(f"{file}: there is no column {STATE!r}, as LeRobot writes it")
    groups = table.groupby(EPISODE) if EPISODE in table else [(0, table)]
    return [np.array(own[STATE].tolist(), float) for _, own in groups]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
