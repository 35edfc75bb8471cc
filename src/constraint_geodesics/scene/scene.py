"""What params.yaml names, as objects: the robot and the fixed bodies around it."""

from dataclasses import dataclass
from pathlib import Path

from constraint_geodesics.params import Params, RobotParams, WorkcellParams
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot, load_robot
from constraint_geodesics.scene.world import Body, Box, Solid, Sphere, World, data_path


@dataclass(frozen=True)
class Scene:
    """A robot in its workcell.  Picklable, so that a worker process can open a world of its own."""

    robot: SerialRobot
    workcell: tuple[Solid, ...] = ()

    @classmethod
    def from_params(cls, params: Params) -> "Scene":
        """Raises RobotError if a URDF, link or limit does not exist."""
        return cls(robot_from(params.robot), workcell_from(params.workcell))

    def world(self) -> World:
        """A fresh PyBullet world; close it, or use it as a context manager."""
        return World(self.robot, self.workcell)


def find_urdf(name: str) -> Path:
    """A URDF named by a path in this checkout, or by one in pybullet_data; RobotError if there is
    neither.
    """
    for candidate in (Path(name), data_path() / name):
        if candidate.is_file():
            return candidate
    raise RobotError(f"{name}: no such URDF, neither in this checkout nor in pybullet_data")


def robot_from(params: RobotParams) -> SerialRobot:
    """The robot that params.yaml names."""
    return load_robot(find_urdf(params.urdf), params.tool_link, params.limits_rad)


def workcell_from(params: WorkcellParams) -> tuple[Solid, ...]:
    """The fixed bodies that params.yaml lists."""
    boxes = [
        Box(name, box.centre_m, box.size_m, box.exempt_links) for name, box in params.boxes.items()
    ]
    bodies = [
        Body(name, find_urdf(body.urdf), body.position_m, body.rpy_rad, body.exempt_links)
        for name, body in params.urdfs.items()
    ]
    spheres = [
        Sphere(name, ball.centre_m, ball.radius_m, ball.exempt_links)
        for name, ball in params.spheres.items()
    ]
    return (*boxes, *spheres, *bodies)
