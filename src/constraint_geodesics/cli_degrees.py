"""Degrees where rad are asked for: recognised by what no arm reaches, refused, and said in rad."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from constraint_geodesics.robot.kinematics import SerialRobot

FAR_RAD = 2.0 * math.pi
"""Beyond a joint's limits: nearer is a whole turn too much, or another mistake."""
ROOM_RAD = 1e-3
"""By which a rounded number of degrees may lie beyond a limit."""
MOST_DEGREES = 720.0


def refuse_degrees(given: Mapping[str, Any], robot: "SerialRobot") -> None:
    """Raises PlannerError, with the values in rad, where a configuration among these looks like
    degrees.

    given: by the names of their options; what is no list of a number a joint is left alone.
    """
    from constraint_geodesics.planner import PlannerError

    ends = {n: q for n, q in given.items() if isinstance(q, list) and len(q) == robot.dof}
    for name, q in ends.items():
        if said := _said(q, robot):
            mended = {
                n: _in_rad(end, robot) if _beyond(end, robot).any() else end
                for n, end in ends.items()
            }
            own = [f'{n} "{_words(end)}"' for n, end in mended.items()]
            raise PlannerError(f"{name} looks like degrees: {said}; in rad: {' '.join(own)}")


def refuse_degrees_of_table(
    file: Path, rows: "Float[np.ndarray, 'T D']", robot: "SerialRobot"
) -> None:
    """Raises PlannerError where a file's rows look like degrees."""
    from constraint_geodesics.planner import PlannerError

    if said := _said(rows, robot):
        first = ",".join(f"{x:.6f}" for x in _in_rad(rows, robot)[0])
        raise PlannerError(f"{file} looks like degrees: {said}; in rad its first row is {first}")


def refuse_degrees_of_pose(values: Sequence[float], option: str) -> None:
    """Raises PlannerError, with the values in rad, where the angles of a pose, its last three
    numbers, look like degrees.
    """
    from constraint_geodesics.planner import PlannerError
    from constraint_geodesics.values import MOST_ANGLE

    angles = values[3:]
    if MOST_ANGLE < max(map(abs, angles)) <= MOST_DEGREES:
        shown = " ".join(f"{x:g}" for x in angles)
        mended = _words([*values[:3], *map(math.radians, angles)])
        line = f'{option}: roll pitch yaw = {shown} look like degrees; in rad: {option} "{mended}"'
        raise PlannerError(line)


def _said(q: Any, robot: "SerialRobot") -> str:
    """Which value can't be meant in rad, where all are possible in degrees; else blank."""
    import numpy as np

    rows, beyond = np.atleast_2d(np.asarray(q, float)), np.atleast_2d(_beyond(q, robot))
    mended = _in_rad(rows, robot)
    inside = (mended >= robot.lower - ROOM_RAD) & (mended <= robot.upper + ROOM_RAD)
    if not (inside.all() and beyond.max() > FAR_RAD):
        return ""
    row, joint = np.unravel_index(int(beyond.argmax()), beyond.shape)
    limits = f"{robot.lower[joint]:.4g} to {robot.upper[joint]:.4g} rad"
    return f"{robot.joint_names[joint]} = {rows[row, joint]:g} is far beyond its limits, {limits}"


def _beyond(q: Any, robot: "SerialRobot") -> "Float[np.ndarray, '*batch D']":
    """By how much joints lie beyond their limits [rad], where degrees would."""
    import numpy as np

    endless = np.isin(robot.joint_names, list(robot.continuous))  # whole turns are its controller's
    counted, q = ~(robot.chain.prismatic | endless), np.asarray(q, float)
    return np.where(counted, np.maximum(robot.lower - q, q - robot.upper), 0.0).clip(0.0)


def _in_rad(q: Any, robot: "SerialRobot") -> "Float[np.ndarray, '*batch D']":
    """Degrees in rad; what a prismatic joint has stays [m]."""
    import numpy as np

    return np.where(robot.chain.prismatic, q, np.radians(q))


def _words(values: Any) -> str:
    return " ".join(f"{x:.6f}" for x in values)
