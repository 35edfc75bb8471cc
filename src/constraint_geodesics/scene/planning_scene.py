"""The scene of a planner, which changes between queries."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from threading import RLock, get_ident
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.attached import Attached
from constraint_geodesics.scene.names import require_texts
from constraint_geodesics.scene.scene import Scene, SceneError
from constraint_geodesics.scene.shape import Placement, Shape
from constraint_geodesics.scene.world import World
from constraint_geodesics.values import checked_joints, shown

LinkPoses = Callable[[Float[np.ndarray, "D"], str], Float[np.ndarray, "4 4"]]


class PlanningScene:
    """Shapes around the robot, shapes that it carries, and what may touch.  Every change is in
    force for the next query; what raises SceneError, or RobotError for a shape that can't be
    bounded, has changed nothing, and so has what is interrupted.  While one thread changes it, or
    its planner answers, others that change it wait.

    follow: takes the changed scene, all or nothing.  links: names of all links of the robot.
    link_pose: of one of them in the base frame at a configuration [rad].
    """

    def __init__(
        self,
        scene: Scene,
        follow: Callable[[Scene], None],
        links: Collection[str],
        link_pose: LinkPoses,
    ) -> None:
        self.lock = RLock()  # the planner's, too
        self._now = self._lasting = scene
        self._guest: int | None = None  # the thread that includes shapes for a while
        self._follow = follow
        self._robot = scene.robot
        self.links, self._link_pose = links, link_pose

    @property
    def now(self) -> Scene:
        """As it is: a value that no later change alters, without what another thread includes."""
        return self._now if self._guest == get_ident() else self._lasting

    @property
    def robot(self) -> SerialRobot:
        """The robot."""
        return self._robot

    @property
    def workcell(self) -> tuple[Shape, ...]:
        """The shapes around it."""
        return self.now.workcell

    @property
    def attached(self) -> tuple[Attached, ...]:
        """What it carries."""
        return self.now.attached

    def world(self) -> World:
        """A fresh PyBullet world of the scene as it is now."""
        return self.now.world()

    def link_pose(self, q: Float[np.ndarray, "D"], link: str) -> Float[np.ndarray, "4 4"]:
        """Of a link's frame in the base frame at a configuration [rad]."""
        require_texts(link)
        if link not in self.links:
            raise SceneError(f"no link is called {link!r}: {', '.join(self.links)}")
        return self._link_pose(checked_joints(q, self.robot.dof, "q", SceneError), link)

    def add(self, *shapes: Shape) -> None:
        """Put shapes around the robot, in the base frame, beside what is there.  Several at once
        cost little more than one.
        """
        self.change(lambda now: now.adding(*shapes))

    def remove(self, *names: str) -> None:
        """Take shapes away."""
        self.change(lambda now: now.removing(*names))

    def move(self, name: str, pose: Any) -> None:
        """Put a shape's own frame, that about its middle or of its file, elsewhere: in the base
        frame, or for what is attached in its link's.  pose: a Pose, or a Placement.
        """
        self.change(lambda now: now.moving(name, Placement.of(pose)))

    def attach(self, shape: Shape, link: str, touching: Sequence[str] = ()) -> None:
        """Let a link carry a shape, placed in the link's frame; a shape around the robot of that
        name is taken away.  touching: names of links and shapes that may touch it.
        """
        if not isinstance(shape, Shape):
            raise SceneError(f"{shown(shape)} can't be attached: it is no shape")
        if isinstance(touching, str) or not isinstance(touching, Sequence):
            raise SceneError(f"touching = {shown(touching)}: must be a list of names")
        require_texts(link, *touching)
        self.change(lambda now: now.attaching(Attached(shape, link, tuple(touching))))

    def detach(self, name: str, at: Float[np.ndarray, "D"] | None = None) -> None:
        """Carry a shape no longer.  at: the configuration [rad] at which it is let go: it stays
        around the robot where it is then; without one it is gone.
        """
        with self.lock:
            held = next((one for one in self._now.attached if one.name == name), None)
            stays = None
            if at is not None and held is not None:
                pose = self.link_pose(at, held.link) @ held.shape.at.matrix
                stays = Placement.of_matrix(pose)
            self.become(self._now.detaching(name, stays))

    def allow(self, first: str, second: str) -> None:
        """Let two bodies touch: shapes, attached or not, or links, by their names."""
        self.change(lambda now: now.allowing(first, second))

    @contextmanager
    def including(self, shapes: Sequence[Shape]) -> Iterator[None]:
        """With more shapes for a while, and no other thread's."""
        with self.lock:
            before, outer = self._now, self._guest
            try:
                if shapes:
                    self._guest = get_ident()
                    self.become(before.adding(*shapes))
                yield
            finally:
                try:
                    if shapes and self._now is not before:
                        self._end_with(before)
                finally:
                    self._guest = outer

    def _end_with(self, scene: Scene) -> None:
        """Become it, an interrupt or not."""
        try:
            self.become(scene)
        except KeyboardInterrupt:
            self.become(scene)
            raise

    def change(self, changed: Callable[[Scene], Scene]) -> None:
        """Become what a function makes of the scene, all of it or nothing, with no other thread's
        change between.
        """
        with self.lock:
            self.become(changed(self._now))

    def become(self, scene: Scene) -> None:
        """Take all of another scene of the same robot."""
        if not isinstance(scene, Scene):
            raise SceneError(f"scene = {shown(scene)}: must be a Scene")
        if not _are_same(scene.robot, self.robot):
            raise SceneError(f"a scene of another robot: this one is {self.robot.name}")
        if scene.robot is not self.robot:  # it came by pickle
            scene = replace(scene, robot=self.robot)
        with self.lock:
            before = self._now
            try:
                self._follow(scene)
                self._now = scene
                if self._guest is None:
                    self._lasting = scene
            except BaseException:
                # after an interrupt some may have followed, and others not
                self._now = before
                if self._guest is None:
                    self._lasting = before
                self._follow(before)
                raise


def _are_same(first: SerialRobot, second: SerialRobot) -> bool:
    """Whether all is the same that a scene takes of a robot."""
    files = (first.urdf, first.allowed) == (second.urdf, second.allowed)
    return files and first.moves_like(second)
