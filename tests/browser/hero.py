"""README's picture: the arm carries its cup level past a pillar (`make screenshots`).

    python -m tests.browser.hero

The path is planned and certified, and must go where the way without the pillar does not.  It is
recorded, and what the recording's file says of joints and seconds is drawn by PyBullet's renderer,
which needs no graphics card.
"""

import itertools
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from constraint_geodesics import bundle, palette
from constraint_geodesics.constraints.constraint import Pose
from constraint_geodesics.params import load_params
from constraint_geodesics.planner import Planner
from constraint_geodesics.recording.colours import Colour, rgb
from constraint_geodesics.recording.recording import RecordingSummary, read_recording
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.scene.urdf import quiet
from constraint_geodesics.trajectory import Trajectory

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "hero.webp"
SIZE, FINER, LARGEST_BYTES = (640, 400), 2, 600_000
"""Pixels, how many times as many are drawn, and how large the file may be."""
MOVES_S, HOLDS_S, RATE_HZ = 3.2, (0.5, 0.9), 14
"""The motion is shown so slowly, its ends are held, and so many pictures a second."""
CONSTRAINT = "level_cup"
FROM, TO, REACH_M, HEIGHT_M = math.radians(-40.0), math.radians(40.0), 0.45, 0.3
"""Where the tool is at start and goal: the directions from the base, how far and how high."""
PILLAR = Cylinder("pillar", Placement((0.53, 0.0, 0.23)), length_m=0.46, radius_m=0.05)
"""Between them."""
EYE_M, TARGET_M, FIELD_DEG = (-0.06, -1.15, 1.05), (0.25, 0.0, 0.22), 36.0
GROUND_M = 0.72
LINE_M, DASH_M = 0.004, 0.035
"""Radius of the tool's line, and how far apart the places on the way without the pillar are."""
PAPER = tuple(round(0.35 * own + 0.65 * 255) for own in rgb(palette.LIGHT))


class NoPictureError(RuntimeError):
    """There is no path to be shown; the message says why."""


def main() -> int:
    """Write docs/images/hero.webp.  Exit code 1 if there is no certified path round the pillar."""
    cup = carried_cup()
    try:
        with tempfile.TemporaryDirectory() as folder:
            past, through = planned(cup)
            past.record(Path(folder) / "past.rrd", frames=round(MOVES_S * RATE_HZ))
            shown = read_recording(Path(folder) / "past.rrd")
            frames = list(pictures(past.scene.robot, cup, shown, through))
    except NoPictureError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    write(frames)
    print(f"{PICTURE.relative_to(ROOT)}  {PICTURE.stat().st_size // 1000} kB: {past.explanation}")
    return 0


def carried_cup() -> Cylinder:
    """The cup of the cup tasks."""
    cup = load_params(ROOT / "params.yaml").carried.shapes["cup"]
    if not isinstance(cup, Cylinder):
        raise TypeError(f"carried.shapes.cup in params.yaml is a {cup.kind}: must be a cylinder")
    return cup


def planned(cup: Cylinder) -> tuple[Trajectory, Trajectory]:
    """The path past the pillar, and that without it.  Raises NoPictureError unless both are
    certified and the second would meet the pillar.
    """
    begin, end = (Pose.from_rpy(*tool_at(angle)) for angle in (FROM, TO))
    with Planner.load(bundle.PACKAGED) as planner, tempfile.TemporaryDirectory() as folder:
        planner.scene.attach(cup, link=planner.robot.tool_link)
        starts = planner.ik(begin)
        if not len(starts):
            raise NoPictureError("no configuration reaches the start")
        start = starts[np.linalg.norm(starts, axis=1).argmin()]
        through = planner.plan(start, end, CONSTRAINT)
        planner.scene.add(PILLAR)
        past = planner.plan(start, end, CONSTRAINT, budget_s=2.0)
        for path, what in ((through, "without the pillar"), (past, "past the pillar")):
            if path.status != "solved" or path.certificate is None or path.certificate.violation:
                raise NoPictureError(f"the path {what} is not certified: {path.explanation}")
        file = Path(folder) / "through.csv"
        through.save(file)
        if planner.check(file).violation is None:
            raise NoPictureError("the way without the pillar does not meet it")
    return past, through


def tool_at(angle: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Position [m] and roll, pitch, yaw [rad] of a tool that points away from the base."""
    place = REACH_M * math.cos(angle), REACH_M * math.sin(angle), HEIGHT_M
    return place, (0.5 * math.pi, 0.0, angle + 0.5 * math.pi)


def pictures(
    robot: SerialRobot, cup: Cylinder, shown: RecordingSummary, through: Trajectory
) -> Iterator[Image.Image]:
    """One a frame of the recording."""
    with quiet():
        import pybullet
    client = pybullet.connect(pybullet.DIRECT)
    try:
        stage = Stage(pybullet, robot, cup)
        stage.line(cup_places(robot, cup, shown.joints), rgb(palette.planner_colour("planner")))
        stage.dashes(cup_places(robot, cup, through.joints), rgb(palette.GREY))
        for joints in shown.joints:
            stage.pose(joints)
            yield stage.picture()
    finally:
        pybullet.disconnect(client)


def cup_poses(
    robot: SerialRobot, cup: Cylinder, joints: Float[np.ndarray, "n D"]
) -> Float[np.ndarray, "n 4 4"]:
    """The cup's frame in the base frame, of some configurations [rad]."""
    poses = np.tile(np.eye(4), (len(joints), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = robot.forward(joints)
    return np.asarray(poses @ cup.pose.matrix)


def cup_places(
    robot: SerialRobot, cup: Cylinder, joints: Float[np.ndarray, "n D"]
) -> Float[np.ndarray, "n 3"]:
    """Its middle [m]."""
    return cup_poses(robot, cup, joints)[:, :3, 3]


class Stage:
    """The arm with its cup on a disc, as PyBullet draws it."""

    def __init__(self, bullet: Any, robot: SerialRobot, cup: Cylinder) -> None:
        self._bullet, self._robot, self._cup = bullet, robot, cup
        with quiet():
            self._arm = bullet.loadURDF(str(robot.urdf), useFixedBase=True)
        names = {
            bullet.getJointInfo(self._arm, k)[1].decode(): k
            for k in range(bullet.getNumJoints(self._arm))
        }
        self._joints = [names[name] for name in robot.joint_names]
        grey, light = rgb(palette.GREY), rgb(palette.LIGHT)
        for link in range(-1, len(names)):
            standing, flange = link < self._joints[0], link == self._joints[-1]
            own = rgba(grey if standing or flange else light)
            bullet.changeVisualShape(self._arm, link, rgbaColor=own, specularColor=[0.0] * 3)
        self._cylinder(GROUND_M, 0.02, light, (0.0, 0.0, -0.011))
        length, middle = PILLAR.length_m, PILLAR.pose.position_m
        self._cylinder(PILLAR.radius_m, length, rgb(palette.VERMILION), middle)
        self._held = [
            (self._cylinder(cup.radius_m, cup.length_m, rgb(palette.SKY)), 0.0),
            # what is in it, so that one sees that it is level
            (self._cylinder(0.86 * cup.radius_m, 0.004, rgb(palette.BLUE)), 0.5 * cup.length_m),
        ]

    def line(self, places: Float[np.ndarray, "n 3"], colour: Colour) -> None:
        """A line through some places [m]."""
        dense = along(places, 0.008)
        for a, b in itertools.pairwise(dense):
            turn, length = turned_to(b - a), float(np.linalg.norm(b - a))
            self._cylinder(LINE_M, 1.2 * length, colour, 0.5 * (a + b), turn)

    def dashes(self, places: Float[np.ndarray, "n 3"], colour: Colour) -> None:
        """Places on a line [m]."""
        bullet = self._bullet
        shape = bullet.createVisualShape(
            bullet.GEOM_SPHERE, radius=1.2 * LINE_M, rgbaColor=rgba(colour)
        )
        for place in along(places, DASH_M):
            bullet.createMultiBody(0, -1, shape, basePosition=place.tolist())

    def pose(self, joints: Float[np.ndarray, "D"]) -> None:
        """Move arm and cup to a configuration [rad]."""
        for index, value in zip(self._joints, joints.tolist(), strict=True):
            self._bullet.resetJointState(self._arm, index, value)
        (pose,) = cup_poses(self._robot, self._cup, joints[None])
        for body, higher in self._held:
            place, turn = pose[:3, 3] + higher * pose[:3, 2], turned_to(pose[:3, 2])
            self._bullet.resetBasePositionAndOrientation(body, place.tolist(), turn)

    def picture(self) -> Image.Image:
        """What the eye sees."""
        bullet, (width, height) = self._bullet, (FINER * SIZE[0], FINER * SIZE[1])
        view = bullet.computeViewMatrix(EYE_M, TARGET_M, (0.0, 0.0, 1.0))
        lens = bullet.computeProjectionMatrixFOV(FIELD_DEG, SIZE[0] / SIZE[1], 0.1, 5.0)
        light = {"lightDirection": (1.0, -0.3, 2.2), "lightDistance": 3.0, "shadow": 1}
        light |= {"lightAmbientCoeff": 0.55, "lightDiffuseCoeff": 0.5, "lightSpecularCoeff": 0.0}
        drawn = bullet.getCameraImage(
            width, height, view, lens, renderer=bullet.ER_TINY_RENDERER, **light
        )
        pixels = np.reshape(np.array(drawn[2], np.uint8), (height, width, 4))[..., :3].copy()
        nothing = np.reshape(np.array(drawn[4]), (height, width)) < 0
        pixels[nothing] = PAPER
        return Image.fromarray(pixels).resize(SIZE, Image.Resampling.LANCZOS)

    def _cylinder(
        self,
        radius_m: float,
        length_m: float,
        colour: Colour,
        place: Sequence[float] | Float[np.ndarray, "3"] = (0.0, 0.0, 0.0),
        turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    ) -> int:
        bullet = self._bullet
        # PyBullet's own cylinder has rounded edges in this light
        surface, own = cylinder_mesh(radius_m, length_m), rgba(colour)
        shape = bullet.createVisualShape(bullet.GEOM_MESH, rgbaColor=own, **surface)
        at = [float(x) for x in place]
        body = bullet.createMultiBody(0, -1, shape, basePosition=at, baseOrientation=list(turn))
        return int(body)


def cylinder_mesh(radius_m: float, length_m: float, sides: int = 64) -> dict[str, Any]:
    """Triangles of a cylinder about the origin, along z, as PyBullet takes them."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=1)
    up, k = np.array([0.0, 0.0, 1.0]), np.arange(sides)
    ends = [radius_m * out + sign * 0.5 * length_m * up for sign in (-1.0, 1.0)]
    normals = [out, out, np.tile(-up, (sides, 1)), np.tile(up, (sides, 1))]
    after = (k + 1) % sides
    wall = [[k, after, sides + after], [k, sides + after, sides + k]]
    fan = np.stack([np.zeros(sides - 2, int), k[1:-1], k[2:]])
    caps = [2 * sides + fan[::-1], 3 * sides + fan]
    triangles = [np.stack(own, axis=1) for own in wall] + [own.T for own in caps]
    return {
        "vertices": np.concatenate([*ends, *ends]).tolist(),
        "normals": np.concatenate(normals).tolist(),
        "indices": np.concatenate(triangles).reshape(-1).tolist(),
        "uvs": np.zeros((4 * sides, 2)).tolist(),
    }


def along(places: Float[np.ndarray, "n 3"], apart_m: float) -> Float[np.ndarray, "m 3"]:
    """Places on the line through some, about so far apart."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], max(2, round(float(length[-1]) / apart_m) + 1))
    return np.stack([np.interp(at, length, column) for column in places.T], axis=1)


def turned_to(axis: Float[np.ndarray, "3"]) -> list[float]:
    """The quaternion x, y, z, w that turns the z axis into another."""
    x, y, z = (axis / np.linalg.norm(axis)).tolist()
    if z < -1.0 + 1e-9:
        return [1.0, 0.0, 0.0, 0.0]
    turn = np.array([-y, x, 0.0, 1.0 + z])
    return list((turn / np.linalg.norm(turn)).tolist())


def rgba(colour: Colour) -> list[float]:
    """A colour as PyBullet takes it."""
    return [own / 255 for own in colour] + [1.0]


def write(frames: Sequence[Image.Image]) -> None:
    """Write the animation.  Raises ValueError if it is too large for README."""
    times = [round(1000 / RATE_HZ)] * len(frames)
    times[0] += round(1000 * HOLDS_S[0])
    times[-1] += round(1000 * HOLDS_S[1])
    how = {"duration": times, "loop": 0, "quality": 80, "method": 6, "minimize_size": True}
    frames[0].save(PICTURE, format="WEBP", save_all=True, append_images=frames[1:], **how)
    if (size := PICTURE.stat().st_size) > LARGEST_BYTES:
        raise ValueError(f"{PICTURE}: {size} bytes: must be {LARGEST_BYTES} at most")


if __name__ == "__main__":
    raise SystemExit(main())
