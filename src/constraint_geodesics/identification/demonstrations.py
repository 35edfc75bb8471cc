"""Demonstrations as they come: arrays or files of joint configurations, checked."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics import values
from constraint_geodesics.formats import NUMBER, TABLE, FormatError
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.text_files import is_number, read_text, reason_of

FEWEST_ROWS = 12
"""Rows of all demonstrations together."""
SPREAD_RAD = 1e-3
"""Rows that differ by less in every joint are one."""
OUTSIDE = 0.02
"""Rows beyond the joint limits by more are of another robot, or in degrees [rad or m]."""
IN_A_ROW = 0.3
"""Rows whose steps are shorter than this share of their distances are a motion, not draws."""
STATE, EPISODE = "observation.state", "episode_index"
"""Columns of a LeRobot data set."""
NUMBERS = ("demonstration", "demo", "episode", EPISODE)
"""Names of a column that tells demonstrations apart."""
TIMES = frozenset({"time", "time_s", "t", "timestamp"})
"""Names of a column that is no joint's."""
Demonstrations = Sequence[Float[np.ndarray, "T D"]]


class DemonstrationError(ValueError):
    """Demonstrations that nothing can be learned from; the message says which, and what to do."""


def demonstrations_from(
    given: Any, robot: SerialRobot
) -> tuple[list[Float[np.ndarray, "T D"]], bool]:
    """Demonstrations (T, D) [rad], and whether they are motions: an array (n, D) is a set of
    independent rows, unless its rows follow each other.

    given: an array (n, D) or (demonstrations, T, D), a list of arrays (T, D), or a file: CSV, or
    parquet as LeRobot writes it.  Raises DemonstrationError, one line.
    """
    if not isinstance(robot, SerialRobot):
        raise DemonstrationError(
            f"robot = {values.shown(robot)}: must be a SerialRobot, as planner.robot"
        )
    if isinstance(given, (str, Path)):
        given = _read(Path(given), robot)
    if hasattr(given, "to_numpy") and hasattr(given, "columns"):  # a table of pandas
        names = [str(name) for name in given.columns]
        given = _told_apart("the table", names, given.to_numpy(), robot)
    shown, motions = _arrays(given)
    found = [_checked(rows, k, robot, motions) for k, rows in enumerate(shown)]
    if motions and 2 * sum(len(own) == 1 for own in found) > len(found):
        found, motions = [np.concatenate(found)], False  # the numbers tell rows apart
    _require_rows(sum(map(len, found)))
    every = np.concatenate(found)
    if (np.ptp(every, axis=0) < SPREAD_RAD).all():
        raise DemonstrationError("all rows are the same configuration: show the arm moving")
    found = _different(found, motions)
    every = np.concatenate(found)
    _require_rows(len(every))
    others = len(every) - max(map(len, found))
    if motions and 0 < others < FEWEST_ROWS // 2:
        raise DemonstrationError(
            f"all but {others} of {len(every)} rows are of one demonstration: show more of the "
            f"others"
        )
    return found, motions or _is_a_motion(every)


def _require_rows(count: int) -> None:
    if count < FEWEST_ROWS:
        raise DemonstrationError(
            f"{count} rows in all: at least {FEWEST_ROWS} are needed; show more of the motion"
        )


def nearest_turns(q: Float[np.ndarray, "n D"], robot: SerialRobot) -> Float[np.ndarray, "n D"]:
    """The same configurations with the values of revolute joints within half a turn of their mean
    direction.
    """
    middle = np.angle(np.exp(1j * q).mean(axis=0))
    turned = middle + (q - middle + np.pi) % (2.0 * np.pi) - np.pi
    found: Float[np.ndarray, "n D"] = np.where(robot.chain.prismatic, q, turned)
    return found


def _different(shown: list[np.ndarray], motions: bool) -> list[np.ndarray]:
    """Without repeated motions, or repeated rows: of each other they show nothing."""
    if motions:
        return list({own.tobytes(): own for own in shown}.values())
    return [own[np.sort(np.unique(own, axis=0, return_index=True)[1])] for own in shown]


def _arrays(given: Any) -> tuple[list[np.ndarray], bool]:
    if hasattr(given, "to_numpy"):  # a table of pandas
        given = given.to_numpy()
    whole = isinstance(given, np.ndarray) and given.ndim == 2
    own = [given] if whole else given
    found = (
        [values.numbers(rows) for rows in own] if isinstance(own, np.ndarray | Sequence) else [None]
    )
    arrays = [rows for rows in found if rows is not None]
    if len(arrays) < len(found):
        raise DemonstrationError(
            f"demonstrations must be rows (n, D), (demonstrations, T, D), a list of (T, D) or a "
            f"file, of numbers: {values.shown(given)}"
        )
    return arrays, not whole


def _is_a_motion(rows: Float[np.ndarray, "n D"]) -> bool:
    """Whether rows follow each other: then they are one demonstration."""
    steps = np.median(np.linalg.norm(np.diff(rows, axis=0), axis=1))
    mixed = np.random.default_rng(0).permutation(rows)
    return bool(steps < IN_A_ROW * np.median(np.linalg.norm(np.diff(mixed, axis=0), axis=1)))


def _checked(
    rows: Float[np.ndarray, "T D"], number: int, robot: SerialRobot, motions: bool
) -> Float[np.ndarray, "T D"]:
    where = f"demonstration {number}" if motions else "the rows"
    if rows.ndim != 2 or rows.shape[1] != robot.dof or not len(rows):
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
        if (
            robot.limit_distance(np.radians(rows)).min() >= -OUTSIDE
            and np.abs(rows).max() > values.MOST_ANGLE
        ):
            why = "they look like degrees: give radians"
        raise DemonstrationError(
            f"{where}: outside the joint limits by {outside:.3g} rad in the mean; {why}"
        )
    return rows


def _read(file: Path, robot: SerialRobot) -> Any:
    if not file.is_file():
        raise DemonstrationError(f"{file}: there is no such file")
    if file.suffix == ".parquet":
        return _read_lerobot(file)
    try:
        stream = read_text(file, "utf-8-sig").splitlines()
        lines = [line for line in csv.reader(stream) if any(line) and line[0][:1] != "#"]
        names: list[str] = []
        try:
            table = np.array(lines, float)
        except ValueError:  # a line of names stands above
            names = lines.pop(0)
            odd = next((name for name in names if not is_number(name)), None)
            if odd is None:
                raise
            if 2 * sum(map(is_number, names)) > len(names):
                line = f"{file}: its first row has {values.shown(odd)} among numbers"
                raise DemonstrationError(f"{line}: must be numbers alone, or names") from None
            table = np.array(lines, float)
    except DemonstrationError:
        raise
    except (OSError, ValueError, csv.Error) as error:
        why = reason_of(error)
        raise DemonstrationError(f"{file}: not a table of numbers: {why}") from None
    _require_format(file, [line for line in stream if line.startswith("#")])
    if table.ndim != 2 or not table.size:
        raise DemonstrationError(f"{file}: no rows of numbers")
    return _told_apart(file, [name.strip() for name in names], table, robot)


def _require_format(file: Path, comments: Sequence[str]) -> None:
    """Of a line as a trajectory has it, where there is one."""
    for line in comments:
        name, _, text = line.removeprefix("#").partition(":")
        try:
            if name.strip() == NUMBER:
                TABLE.require_line(text)
        except FormatError as error:
            raise DemonstrationError(f"{file}: {error}") from None


def _told_apart(file: Path | str, names: list[str], table: np.ndarray, robot: SerialRobot) -> Any:
    """Rows, or demonstrations where a column tells them apart: one of NUMBERS, or without names
    the first of one more than there are joints, if its numbers are whole.
    """
    if set(robot.joint_names) <= set(names):
        joints = table[:, [names.index(name) for name in robot.joint_names]]
        column = next((names.index(name) for name in NUMBERS if name in names), None)
        numbers = None if column is None else table[:, column]
    elif table.shape[1] == robot.dof + 1 and not names:
        joints, numbers = table[:, 1:], table[:, 0]
        if not (np.isfinite(numbers).all() and (numbers == np.round(numbers)).all()):
            raise DemonstrationError(
                f"{file}: the first of {table.shape[1]} columns must be the demonstration's "
                f"number, or name the columns: time_s, {', '.join(robot.joint_names)}"
            )
    elif unlike := TIMES.intersection(names) | set(NUMBERS).intersection(names):
        raise DemonstrationError(
            f"{file}: beside {', '.join(sorted(unlike))} its columns are named otherwise than the "
            f"joints: {', '.join(robot.joint_names)}"
        )
    elif some := set(robot.joint_names).intersection(names):
        missing = ", ".join(name for name in robot.joint_names if name not in some)
        raise DemonstrationError(f"{file}: among its columns {', '.join(names)} is no {missing}")
    else:
        return table
    if numbers is None:
        return joints
    return [joints[numbers == k] for k in dict.fromkeys(numbers.tolist())]


def _read_lerobot(file: Path) -> Any:
    try:
        from constraint_geodesics.parquet_files import read_parquet
    except ImportError:
        raise DemonstrationError(
            f"{file}: reading parquet needs pandas and pyarrow: pip install "
            "'constraint_geodesics[pipeline]'"
        ) from None
    try:
        table = read_parquet(file, (STATE, EPISODE))
        if STATE not in table:
            raise DemonstrationError(f"{file}: there is no column {STATE!r}, as LeRobot writes it")
        groups = table.groupby(EPISODE) if EPISODE in table else [(0, table)]
        return [np.array(own[STATE].tolist(), float) for _, own in groups]
    except DemonstrationError:
        raise
    except (OSError, TypeError, ValueError) as error:
        raise DemonstrationError(f"{file}: {reason_of(error)}") from None
