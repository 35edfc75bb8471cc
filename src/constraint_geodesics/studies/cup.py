"""A timed path executed in simulation: position control under gravity, with an open cup of spheres
at the tool, which stays level or spills.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.scene.world import Physics, physics

GRAVITY = 9.81
"""[m/s²], along the negative z axis of the base frame."""
FRAME_RATE = 30.0
"""Frames that are kept of a second of execution."""
POSITION_GAIN = 0.2
"""Share of the position's error that the motors take off in a step."""
UNLIMITED = 1e4
"""[N or N m]"""

_Pose = tuple[Sequence[float], Sequence[float]]


@dataclass(frozen=True)
class CupSettings:
    """The cup, the spheres in it and the simulation; by default a cup 10 cm high and 7 cm wide,
    three quarters full.

    The cup is a bottom and a ring of `walls` upright boxes, `wall_m` thick.  It sits where a
    gripper would be, its nearest point `gap_m` in front of the tool link's origin along the tool's
    z axis, and it touches the spheres only: what the arm carries in the scene is around it, and the
    path was planned with that.  Spheres that have left it touch everything.  More of them than fit
    fall out.
    seed: of the places the spheres are dropped from.  settle_s: the rest before the path, in which
    they settle, and behind it, before they are counted.
    """

    spheres: int = 12
    sphere_radius_m: float = 0.012
    sphere_mass_kg: float = 0.01
    inner_radius_m: float = 0.03
    height_m: float = 0.1
    wall_m: float = 0.005
    walls: int = 12
    mass_kg: float = 0.1
    gap_m: float = 0.04
    friction: float = 0.3
    restitution: float = 0.2
    step_s: float = 1.0 / 480.0
    settle_s: float = 0.5
    seed: int = 0


def execution_name(query: int, kind: str) -> str:
    """Of an execution's files among those of one constraint; `kind` says what was executed."""
    return f"query{query}-{kind.replace(' ', '-')}"


@dataclass(frozen=True)
class Execution:
    """What became of an executed path.

    kept: spheres in the cup at the end, of `spheres` put in.  largest_tracking_error_rad: of any
    joint, between where it was and where the path has it.  largest_tilt_rad: angle of the cup's
    axis to the vertical.  Both are taken at every step of the path; `duration_s` is the path's.
    The frames go on through the rest behind it.
    """

    spheres: int
    kept: int
    largest_tracking_error_rad: float
    largest_tilt_rad: float
    duration_s: float
    times: Float[np.ndarray, "F"]
    """Of the frames [s], from 0 at the start of the path."""
    joints: Float[np.ndarray, "F D"]
    sphere_positions: Float[np.ndarray, "F S 3"]
    """In the base frame [m]."""
    cup_pose: Float[np.ndarray, "F 7"]
    """Centre of the cup [m] and quaternion x, y, z, w in the base frame; its z axis points to the
    opening.
    """

    @property
    def kept_share(self) -> float:
        """Share of the spheres that stayed in the cup."""
        return self.kept / self.spheres


def execute(
    scene: Scene,
    joints: Float[np.ndarray, "T D"],
    times: Float[np.ndarray, "T"],
    cup_axis_in_tool: Float[np.ndarray, "3"],
    settings: CupSettings | None = None,
) -> Execution:
    """Follow a timed path [rad, s] with a cup of spheres at the tool, and count the spheres that
    stay in it.

    The arm follows the cubics through the waypoints.  The motors hold it by position and velocity
    with no more than the URDF's effort; where that is 0 they are not limited.
    cup_axis_in_tool: direction of the cup's opening in the tool frame, of any length.
    The same arguments give the same result, in any process on one machine.
    """
    settings = settings or CupSettings()
    cup = _cup_in_tool(cup_axis_in_tool / np.linalg.norm(cup_axis_in_tool), settings)
    with replace(scene, attached=()).world() as world:
        simulation = _Simulation(physics(world), joints[0], cup, settings)
        return _follow(simulation, joints, times - times[0], settings)


def _follow(
    simulation: "_Simulation", q: np.ndarray, t: np.ndarray, settings: CupSettings
) -> Execution:
    path = CubicHermiteSpline(t, q, _velocities(q, t))
    rest, moving = (int(np.ceil(s / settings.step_s)) for s in (settings.settle_s, t[-1]))
    for _ in range(rest):
        simulation.step(q[0], np.zeros_like(q[0]))
    targets = path(np.minimum(settings.step_s * np.arange(moving + rest + 1), t[-1]))
    # the velocity that leads from one target to the next one: 0 from the goal on
    velocities = np.diff(targets, axis=0) / settings.step_s
    every = max(1, round(1.0 / (FRAME_RATE * settings.step_s)))
    frames, frame_times = [simulation.frame()], [0.0]
    error, tilt = 0.0, simulation.tilt()
    for k in range(moving + rest):
        simulation.step(targets[k], velocities[k])
        if k < moving:
            error = max(error, float(np.abs(simulation.joints() - targets[k + 1]).max()))
            tilt = max(tilt, simulation.tilt())
        if (k + 1) % every == 0 or k + 1 == moving + rest:
            frames.append(simulation.frame())
            kept = inside(*frames[-1][1:], settings)
            simulation.free_outside(kept)
            frame_times.append((k + 1) * settings.step_s)
    measured = (settings.spheres, int(kept.sum()), error, tilt, float(t[-1]))
    return Execution(*measured, np.array(frame_times), *map(np.array, zip(*frames, strict=True)))


class _Simulation:
    """A robot at rest at a configuration, with the cup fixed to its tool and the spheres above the
    cup's bottom.
    """

    def __init__(
        self, world: Physics, start: np.ndarray, cup_in_tool: _Pose, settings: CupSettings
    ) -> None:
        self._world = world
        self._bullet = bullet = world.bullet
        bullet.setGravity(0.0, 0.0, -GRAVITY)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=settings.step_s, numSolverIterations=100, deterministicOverlappingPairs=1
        )
        bullet.resetJointStatesMultiDof(
            world.body, world.joints, start[:, None].tolist(), targetVelocities=[[0.0]] * len(start)
        )
        efforts = [bullet.getJointInfo(world.body, joint)[10] for joint in world.joints]
        self._efforts = [effort if effort > 0 else UNLIMITED for effort in efforts]
        state = bullet.getLinkState(world.body, world.tool, computeForwardKinematics=1)
        in_base = bullet.multiplyTransforms(*state[4:6], *cup_in_tool)
        self._cup = self._add_cup(cup_in_tool, in_base, settings)
        centres = _places(settings, np.random.default_rng(settings.seed))
        self._spheres = [self._add_sphere(centre, settings) for centre in centres]
        self._held = set(self._spheres)

    def step(self, position: np.ndarray, velocity: np.ndarray) -> None:
        """Drive the joints towards a position [rad] and velocity [rad/s] for one step."""
        self._bullet.setJointMotorControlArray(
            self._world.body,
            self._world.joints,
            self._bullet.POSITION_CONTROL,
            targetPositions=position.tolist(),
            targetVelocities=velocity.tolist(),
            forces=self._efforts,
            positionGains=[POSITION_GAIN] * len(self._efforts),
            velocityGains=[1.0] * len(self._efforts),
        )
        self._bullet.stepSimulation()

    def joints(self) -> Float[np.ndarray, "D"]:
        """Where the joints are [rad]."""
        states = self._bullet.getJointStates(self._world.body, self._world.joints)
        return np.array([state[0] for state in states])

    def tilt(self) -> float:
        """Angle of the cup's axis to the vertical [rad]."""
        _, (x, y, z, w) = self._pose(self._cup)
        return float(
            np.arctan2(2.0 * np.hypot(x * z + w * y, y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
        )

    def frame(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joints (D,) [rad], centres of the spheres (S, 3) [m] and pose of the cup (7,)."""
        centres = np.array([self._pose(sphere)[0] for sphere in self._spheres])
        return self.joints(), centres, np.concatenate(self._pose(self._cup))

    def free_outside(self, held: Bool[np.ndarray, "S"]) -> None:
        """Let the spheres that have left the cup touch the robot and the workcell from now on."""
        for sphere, kept in zip(self._spheres, held, strict=True):
            if sphere in self._held and not kept:
                self._set_collisions(sphere, enabled=1)
                self._held.remove(sphere)

    def _set_collisions(self, body: int, enabled: int) -> None:
        """Between a body and the robot and workcell."""
        for other in (self._world.body, *self._world.fixed):
            for link in range(-1, self._bullet.getNumJoints(other)):
                self._bullet.setCollisionFilterPair(body, other, -1, link, enabled)

    def _pose(self, body: int) -> _Pose:
        position, quaternion = self._bullet.getBasePositionAndOrientation(body)
        return position, quaternion

    def _add_cup(self, cup_in_tool: _Pose, pose: _Pose, settings: CupSettings) -> int:
        bullet, world = self._bullet, self._world
        halves, centres, turns = _cup_boxes(settings)
        shape = bullet.createCollisionShapeArray(
            shapeTypes=[bullet.GEOM_BOX] * len(halves),
            halfExtents=halves,
            collisionFramePositions=centres,
            collisionFrameOrientations=turns,
        )
        cup = bullet.createMultiBody(settings.mass_kg, shape, -1, *pose)
        self._set_collisions(cup, enabled=0)
        self._add_surface(cup, settings)
        # a constraint counts from the centre of mass of the parent link
        local = bullet.getDynamicsInfo(world.body, world.tool)[3:5]
        place = bullet.multiplyTransforms(*bullet.invertTransform(*local), *cup_in_tool)
        origin, ends = (0, 0, 0), (world.body, world.tool, cup, -1)
        grip = bullet.createConstraint(
            *ends, bullet.JOINT_FIXED, origin, place[0], origin, place[1]
        )
        bullet.changeConstraint(grip, maxForce=UNLIMITED, erp=0.8)
        return int(cup)

    def _add_sphere(self, centre_in_cup: np.ndarray, settings: CupSettings) -> int:
        bullet = self._bullet
        shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=settings.sphere_radius_m)
        position, _ = bullet.multiplyTransforms(
            *self._pose(self._cup), centre_in_cup.tolist(), (0, 0, 0, 1)
        )
        sphere = bullet.createMultiBody(settings.sphere_mass_kg, shape, -1, position)
        self._set_collisions(sphere, enabled=0)
        self._add_surface(sphere, settings)
        return int(sphere)

    def _add_surface(self, body: int, settings: CupSettings) -> None:
        self._bullet.changeDynamics(
            body,
            -1,
            lateralFriction=settings.friction,
            restitution=settings.restitution,
            rollingFriction=1e-4,
            spinningFriction=1e-4,
            linearDamping=0.0,
            angularDamping=0.0,
        )


def _velocities(q: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Velocities at the waypoints, of the parabola through each and its neighbours; rest at both
    ends.
    """
    dt = np.diff(t)[:, None]
    v = np.diff(q, axis=0) / dt
    inner = (dt[:-1] * v[1:] + dt[1:] * v[:-1]) / (dt[:-1] + dt[1:])
    rest = np.zeros((1, q.shape[1]))
    return np.concatenate([rest, inner, rest])


def _cup_in_tool(
    axis: np.ndarray, settings: CupSettings
) -> tuple[tuple[float, float, float], tuple[float, ...]]:
    """Pose of the cup's centre in the tool frame: its opening along `axis`, all of it beyond the
    gap along z.
    """
    across = np.eye(3)[np.abs(axis).argmin()]
    across = np.cross(across, axis)
    across /= np.linalg.norm(across)
    rotation = np.column_stack([across, np.cross(axis, across), axis])
    outer = settings.inner_radius_m + settings.wall_m
    reach = outer * np.hypot(axis[0], axis[1]) + 0.5 * settings.height_m * abs(axis[2])
    position = (0.0, 0.0, settings.gap_m + float(reach))
    return position, tuple(Rotation.from_matrix(rotation).as_quat().tolist())


def carried_cup(axis: Float[np.ndarray, "3"], settings: CupSettings | None = None) -> Cylinder:
    """A cylinder round the cup's walls in the tool's frame, as what the arm carries: its opening
    along `axis`.
    """
    settings = settings or CupSettings()
    x, y, z = (axis / np.linalg.norm(axis)).tolist()
    position, _ = _cup_in_tool(np.array([x, y, z]), settings)
    turn = (-float(np.arcsin(y)), float(np.arctan2(x, z)), 0.0)  # of its z axis onto the cup's
    corner = (settings.inner_radius_m + settings.wall_m) / np.cos(np.pi / settings.walls)
    radius = 1e-3 * float(np.ceil(1e3 * corner))
    return Cylinder("cup", Placement(position, turn), settings.height_m, radius)


def _cup_boxes(settings: CupSettings) -> tuple[list[list[float]], ...]:
    """Half edges, centres and quaternions of the bottom and the walls in the cup's frame."""
    half_wall = 0.5 * settings.wall_m
    outer, middle = settings.inner_radius_m + settings.wall_m, settings.inner_radius_m + half_wall
    halves = [[outer, outer, half_wall]]
    centres = [[0.0, 0.0, half_wall - 0.5 * settings.height_m]]
    turns = [[0.0, 0.0, 0.0, 1.0]]
    for angle in 2.0 * np.pi * np.arange(settings.walls) / settings.walls:
        halves.append([half_wall, outer * np.tan(np.pi / settings.walls), 0.5 * settings.height_m])
        centres.append([middle * np.cos(angle), middle * np.sin(angle), 0.0])
        turns.append([0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)])
    return halves, centres, turns


def _places(settings: CupSettings, rng: np.random.Generator) -> Float[np.ndarray, "S 3"]:
    """Centres of the spheres in the cup's frame before they fall: rings of them, each turned by
    chance.
    """
    apart = 2.2 * settings.sphere_radius_m
    ring = settings.inner_radius_m - 0.5 * apart
    per_layer = int(np.pi / np.arcsin(min(1.0, 0.5 * apart / ring)))
    layer, place = np.divmod(np.arange(settings.spheres), per_layer)
    angle = 2.0 * np.pi * (place / per_layer + rng.uniform(size=layer[-1] + 1)[layer])
    radius = ring * (1.0 - 0.02 * rng.uniform(size=settings.spheres))
    height = settings.wall_m - 0.5 * settings.height_m + apart * (layer + 0.6)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])


def inside(
    centres: np.ndarray, cup_pose: np.ndarray, settings: CupSettings
) -> Bool[np.ndarray, "S"]:
    """Which spheres have their centre in the cup, below its rim."""
    local = Rotation.from_quat(cup_pose[3:]).inv().apply(centres - cup_pose[:3])
    return (np.hypot(local[:, 0], local[:, 1]) < settings.inner_radius_m + settings.wall_m) & (
        np.abs(local[:, 2]) < 0.5 * settings.height_m
    )
