"""What params.yaml names, as objects: the robot and the shapes around it."""

from dataclasses import dataclass

import numpy as np

from constraint_geodesics.params import Params, RobotParams, WorkcellParams
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot, load_robot
from constraint_geodesics.scene.arm import ADJACENT, load_arm
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.urdf import find_urdf, has_pybullet
from constraint_geodesics.scene.world import World


@dataclass(frozen=True)
class Scene:
    """A robot in its workcell.  Picklable, so that a worker process can open a world of its own."""

    robot: SerialRobot
    workcell: tuple[Shape, ...] = ()

    @classmethod
    def from_params(cls, params: Params) -> "Scene":
        """Raises RobotError if a URDF, link or limit does not exist."""
        return cls(robot_from(params.robot), workcell_from(params.workcell))

    def world(self) -> World:
        """A fresh PyBullet world; close it, or use it as a context manager."""
        return World(self.robot, self.workcell)

    def world_if_installed(self) -> World | None:
        """The same; None where there is no PyBullet."""
        return self.world() if has_pybullet() else None


def robot_from(params: RobotParams) -> SerialRobot:
    """The robot that parameters name: read from its own URDF where they name nothing beyond it."""
    if params.hold or params.tool or params.may_touch != ADJACENT:
        robot = load_arm(params).robot
    else:
        robot = load_robot(find_urdf(params.urdf), params.tool_link, params.limits_rad)
    for name, velocity in zip(robot.joint_names, robot.velocity, strict=True):
        if not np.isfinite(velocity):
            raise RobotError(f"{params.urdf}: {name} has no <limit velocity=…>: give its limit")
    return robot


def workcell_from(params: WorkcellParams) -> tuple[Shape, ...]:
    """The shapes that params.yaml lists."""
    return tuple(params.shapes.values())
