"""Identified constraints as files: YAML that `geodesics plan --constraint FILE` takes."""

from pathlib import Path
from typing import Any

import numpy as np

from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintError,
    constraint_from_json,
)
from constraint_geodesics.formats import CONSTRAINT, FormatError
from constraint_geodesics.identification.identify import Identified
from constraint_geodesics.params import ParamsError, read_yaml
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.text_files import written
from constraint_geodesics.values import checked_path

SUFFIXES = (".yaml", ".yml")
SAME_TOOL = 1e-6
"""By which entries of a tool's pose may differ."""


def save_constraint(identified: Identified, file: str | Path, where_shown: bool = False) -> None:
    """Write what was identified, with what it stands on.  where_shown: with the region where
    demonstrations were, which a path then may not leave.

    Raises ConstraintError where nothing was, or the file's name has another suffix.
    """
    from ruamel.yaml import YAML

    file = Path(checked_path(file, "file", ConstraintError))
    constraint = identified.supported if where_shown else identified.constraint
    if constraint is None:
        raise ConstraintError(f"there is no constraint to save: {identified.explanation}")
    if where_shown and identified.support is None:
        raise ConstraintError("what was identified is not of the tool: it has no region")
    if file.suffix not in SUFFIXES:
        raise ConstraintError(f"{file}: the name must end in {' or '.join(SUFFIXES)}")
    own = identified.robot
    about = {
        **CONSTRAINT.entries,
        "explanation": identified.explanation,
        "robot": {"name": own.name, "tool_link": own.tool_link, "tool": _listed(own.tool)},
        "found_in": {
            "rows": identified.rows,
            "demonstrations": identified.demonstrations,
            "noise_rad": identified.summary()["noise_rad"],
        },
        "constraint": constraint.to_json(),
    }
    writer = YAML(typ="safe", pure=True)
    writer.width = 1000
    with written(file) as part:
        writer.dump(about, part)


def load_constraint(file: str | Path, robot: SerialRobot | None = None) -> Constraint:
    """The constraint that `save_constraint` wrote, or of any file whose entry `constraint` is what
    `Constraint.to_json` gives.

    robot: who it is for; relations of one tool say nothing of another's.  Raises ConstraintError,
    one line, if the file is missing or is none, or of another robot or tool.
    """
    try:
        about: Any = read_yaml(Path(checked_path(file, "file", ConstraintError)))
    except (ParamsError, UnicodeDecodeError) as error:
        raise ConstraintError(str(error)) from None
    if not isinstance(about, dict):
        raise ConstraintError(f"{file}: not a constraint's file: must be entries by name")
    try:
        about = CONSTRAINT.updated(about)
        own = about.get("robot")  # what nobody found for an arm is for any
        if own is not None:
            names = own["name"], own["tool_link"]
            if robot is not None:
                _require_whose(names, own.get("tool"), robot)
        return constraint_from_json(about["constraint"], robot)
    except (ConstraintError, FormatError) as error:
        raise ConstraintError(f"{file}: {error}") from None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ConstraintError(f"{file}: not a constraint: {type(error).__name__} {error}") from None


def _require_whose(names: tuple[str, str], pose: Any, robot: SerialRobot) -> None:
    """pose: of the tool, which files lack that were written before it was."""
    if names != (robot.name, robot.tool_link):
        raise ConstraintError(
            f"found for {names[0]} with the tool {names[1]}, not {robot.name} with "
            f"{robot.tool_link}"
        )
    if pose is None:
        return
    tool = Placement(**{name: tuple(values) for name, values in pose.items()})
    if np.abs(tool.matrix - robot.chain.tool).max() > SAME_TOOL:
        raise ConstraintError(
            f"found for a tool {names[1]} at {_told(tool)} in the last joint's frame, not "
            f"at {_told(Placement.of_matrix(robot.chain.tool))}"
        )


def _listed(tool: Placement) -> dict[str, list[float]]:
    return {"position_m": list(tool.position_m), "rpy_rad": list(tool.rpy_rad)}


def _told(tool: Placement) -> str:
    return f"({' '.join(f'{x:.4g}' for x in (*tool.position_m, *tool.rpy_rad))})"
