"""What params.yaml names, as objects: the robot and the shapes around it; and what it carries."""

from dataclasses import dataclass, replace

import numpy as np

from constraint_geodesics.params import Params, RobotParams, WorkcellParams
from constraint_geodesics.robot.description import arm_to, read_description
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot, load_robot
from constraint_geodesics.scene.arm import ADJACENT, load_arm
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.names import SceneError as SceneError
from constraint_geodesics.scene.names import require_texts, shapes_of
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.urdf import find_urdf, has_pybullet
from constraint_geodesics.scene.world import World


@dataclass(frozen=True)
class Scene:
    """A robot in its workcell, and what it carries.  Picklable, so that a worker process can open a
    world of its own.

    allowed: pairs of names, of shapes and of links, that may touch, beside those that the robot
    allows.  What changes a scene gives another one; it raises SceneError where that can't be.
    """

    robot: SerialRobot
    workcell: tuple[Shape, ...] = ()
    attached: tuple[Attached, ...] = ()
    allowed: frozenset[tuple[str, str]] = frozenset()

    @classmethod
    def from_params(cls, params: Params, constraint: str = "") -> "Scene":
        """constraint: name of the one in whose task the arm carries something, if it does.  Raises
        RobotError if a URDF, link or limit does not exist.
        """
        scene = cls(robot_from(params.robot), workcell_from(params.workcell))
        if constraint in params.carried.constraints:
            for shape in workcell_from(params.carried):
                scene = scene.attaching(Attached(shape, params.robot.tool_link))
        return scene

    def world(self) -> World:
        """A fresh PyBullet world; close it, or use it as a context manager."""
        return World(self.robot, self.workcell, self.attached, self.allowed)

    def world_if_installed(self) -> World | None:
        """The same; None where there is no PyBullet."""
        return self.world() if has_pybullet() else None

    @property
    def names(self) -> tuple[str, ...]:
        """Of all shapes."""
        shapes = (*self.workcell, *(one.shape for one in self.attached))
        return tuple(shape.name for shape in shapes)

    def adding(self, *shapes: Shape) -> "Scene":
        """With more shapes, whose names are new."""
        taken = set(self.names)
        for shape in shapes_of(shapes, "shapes"):
            if shape.name in taken:
                raise SceneError(f"there is a shape called {shape.name!r} already: remove it first")
        return replace(self, workcell=(*self.workcell, *shapes))

    def removing(self, *names: str) -> "Scene":
        """Without shapes that are not attached, and what they may touch."""
        for name in names:
            self._shape(name)
        left = tuple(shape for shape in self.workcell if shape.name not in names)
        return replace(self, workcell=left)._forgetting(*names)

    def moving(self, name: str, at: Placement) -> "Scene":
        """With a shape's own frame elsewhere: in the base frame, or for one that is attached in its
        link's.
        """
        for one in self.attached:
            if one.name == name:
                moved = replace(one, shape=one.shape.placed(at))
                others = (moved if other is one else other for other in self.attached)
                return replace(self, attached=tuple(others))
        moved_shape = self._shape(name).placed(at)
        around = (moved_shape if other.name == name else other for other in self.workcell)
        return replace(self, workcell=tuple(around))

    def attaching(self, held: Attached) -> "Scene":
        """With a shape that a link carries; one of that name around the arm is taken away, and what
        it may touch as well unless it is the same shape elsewhere.
        """
        if held.name in {one.name for one in self.attached}:
            raise SceneError(f"{held.name!r} is attached already: detach it first")
        found = self
        for shape in self.workcell:
            if shape.name == held.name and not shape.is_like(held.shape):
                found = found._forgetting(held.name)
        around = tuple(shape for shape in self.workcell if shape.name != held.name)
        return replace(found, workcell=around, attached=(*found.attached, held))

    def detaching(self, name: str, stays: Placement | None = None) -> "Scene":
        """Without a shape that a link carries, and what it may touch.  stays: where in the base
        frame it is from then on, and may touch what it might; without one it is gone.
        """
        left = tuple(one for one in self.attached if one.name != name)
        if len(left) == len(self.attached):
            raise SceneError(f"nothing called {name!r} is attached{_of(self.attached)}")
        if stays is None:
            return replace(self, attached=left)._forgetting(name)
        (held,) = (one for one in self.attached if one.name == name)
        return replace(self, attached=left, workcell=(*self.workcell, held.shape.placed(stays)))

    def allowing(self, first: str, second: str) -> "Scene":
        """With two bodies, links or shapes, that may touch."""
        require_texts(first, second)
        return replace(self, allowed=self.allowed | {(first, second)})

    def _forgetting(self, *names: str) -> "Scene":
        """Without what the names may touch."""
        gone = set(names)
        attached = tuple(
            replace(one, touching=tuple(other for other in one.touching if other not in gone))
            if gone & set(one.touching)
            else one
            for one in self.attached
        )
        allowed = frozenset(pair for pair in self.allowed if not gone & set(pair))
        return replace(self, attached=attached, allowed=allowed)

    def _shape(self, name: str) -> Shape:
        for shape in self.workcell:
            if shape.name == name:
                return shape
        raise SceneError(f"there is no shape called {name!r}{_of(self.workcell)}")


def _of(named: tuple[Shape, ...] | tuple[Attached, ...]) -> str:
    return f": {', '.join(one.name for one in named)}" if named else ": there is none at all"


def robot_from(params: RobotParams) -> SerialRobot:
    """The robot that parameters name: read from its own URDF where they name nothing beyond it."""
    file = find_urdf(params.urdf)
    plain = not (params.hold or params.tool or params.may_touch != ADJACENT)
    if plain:
        plain = arm_to(read_description(file), params.tool_link).is_as_written
    if plain:
        robot = load_robot(file, params.tool_link, params.limits_rad)
    else:
        robot = load_arm(params).robot
    for name, velocity in zip(robot.joint_names, robot.velocity, strict=True):
        if not np.isfinite(velocity):
            raise RobotError(f"{params.urdf}: {name} has no <limit velocity=…>: give its limit")
    return robot


def workcell_from(params: WorkcellParams) -> tuple[Shape, ...]:
    """The shapes that params.yaml lists."""
    return tuple(params.shapes.values())
