"""Whom a run on files of problems is for: the arm of a URDF, or the pipeline's own."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from constraint_geodesics.planner import Planner
from constraint_geodesics.robot.arm_file import write_arm
from constraint_geodesics.robot.description import Arm, arm_to, read_description
from constraint_geodesics.scene.arm import arms_folder
from constraint_geodesics.scene.urdf import find_urdf

MOST_OPEN = 4
"""Planners that a process keeps open."""


class ArmSource(Hashable, Protocol):
    """Opens a planner.  A value, equal where its planners are; picklable."""

    def open(self) -> Planner:
        """A planner with nothing around the arm but what always is."""
        ...


@dataclass(frozen=True)
class UrdfArm:
    """The arm of a URDF, a path or a name in pybullet_data.  held: values of joints that are not to
    move [rad or m]; they may lie beyond the URDF's limits, as those of opened fingers do in files
    that were made for another description of the robot.
    """

    urdf: str
    tool_link: str
    srdf: str | None = None
    held: tuple[tuple[str, float], ...] = ()

    def open(self) -> Planner:
        """Raises RobotError, one line, where no arm can be made of the URDF."""
        arm, beyond = self._described()
        held, urdf = dict(self.held), find_urdf(self.urdf)
        if not beyond:
            return Planner.from_urdf(urdf, self.tool_link, self.srdf, hold=held)
        # where they stand is written into a URDF of its own, in which they are fixed
        file, link = write_arm(replace(arm, held={**arm.held, **held}), arms_folder())
        return Planner.from_urdf(file, link, self.srdf)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the joints that move, in the order of a configuration.  Raises RobotError."""
        return tuple(joint.name for joint in self._described()[0].moved)

    @property
    def others(self) -> tuple[str, ...]:
        """Names of the joints that could move, and are held.  Raises RobotError."""
        return tuple(self._described()[0].held)

    @property
    def beyond_limits(self) -> Mapping[str, str]:
        """The limits of joints that are held beyond them, in words, by name.  Raises RobotError."""
        return self._described()[1]

    def _described(self) -> tuple[Arm, dict[str, str]]:
        description = read_description(find_urdf(self.urdf))
        known, within, beyond = description.by_name, {}, {}
        for name, value in self.held:
            joint = known.get(name)
            if joint is None or not joint.is_movable or joint.lower <= value <= joint.upper:
                within[name] = value  # what is no joint is refused where all others are
            else:
                within[name] = min(max(value, joint.lower), joint.upper)
                beyond[name] = joint.range
        return arm_to(description, self.tool_link, within), beyond


@dataclass(frozen=True)
class PipelineArm:
    """The arm of params.yaml in its workcell, by the planner's files in a folder."""

    folder: Path

    def open(self) -> Planner:
        """Raises BundleError, one line, where the files are missing or altered."""
        return Planner.load(self.folder)


_OPEN: dict[ArmSource, Planner] = {}
"""In the order in which they were asked for last."""


def opened(arm: ArmSource) -> Planner:
    """The arm's planner, one in each process, whose scene whoever asks sets before each query.  It
    is closed, and its world with it, once MOST_OPEN others are asked for.
    """
    planner = _OPEN.pop(arm, None) or arm.open()
    _OPEN[arm] = planner
    close_opened(MOST_OPEN)
    return planner


def close_opened(keep: int = 0) -> None:
    """Close all of them but the last so many."""
    while len(_OPEN) > keep:
        _OPEN.pop(next(iter(_OPEN))).close()
