"""Clearance of a robot's links to the boxes of its workcell, compiled: what keeps curves out of a collision.

Every link is a set of points, the corners of its collision hulls that lie furthest out in evenly spread directions;
against the flat side of a box that is as good as the hull itself.  PyBullet remains the judge: this model knows
neither the contact of the arm with itself nor bodies given as meshes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from constraint_geodesics.robot.bullet import Body, Box, World, directions
from constraint_geodesics.robot.kernels import frame_of, joint_frame
from constraint_geodesics.robot.kinematics import SerialRobot

DIRECTIONS = 48
"""Directions in which a link's outermost corners are looked for."""
_COMPILE = {"cache": True, "fastmath": {"contract"}, "error_model": "numpy", "nogil": True}


@dataclass(frozen=True)
class ClearanceModel:
    """Points of the links, and the boxes they must keep clear of.

    points (K, 3) [m] in the frame that the joint `joints` (K,) carries; boxes (B, 2, 3): centre and half edges [m];
    exempt (B, D): which boxes the links carried by a joint may touch.
    """

    points: Float[np.ndarray, "K 3"]
    joints: Int[np.ndarray, "K"]
    boxes: Float[np.ndarray, "B 2 3"]
    exempt: Bool[np.ndarray, "B D"]

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """For the kernels: points with their joints (K, 4), boxes with what is exempt (B, 6 + D), reaches (D,)."""
        points = np.concatenate([self.points, self.joints[:, None]], axis=1)
        reach = np.zeros(self.exempt.shape[1])
        np.maximum.at(reach, self.joints, np.linalg.norm(self.points, axis=1))
        return points, np.concatenate([self.boxes.reshape(-1, 6), self.exempt], axis=1), reach

    def clearance(self, robot: SerialRobot, q: Float[np.ndarray, "*batch D"]) -> Float[np.ndarray, "*batch"]:
        """Smallest distance of any link to any box it must not touch [m], negative inside; inf without boxes."""
        flat = np.ascontiguousarray(q, np.float64).reshape(-1, robot.dof)
        smallest = np.empty(len(flat))
        clearance_batch(robot.chain.arrays, self.arrays, np.inf, flat, smallest)
        return smallest.reshape(q.shape[:-1])


def no_clearance(dof: int) -> ClearanceModel:
    """The model of an empty workcell."""
    return ClearanceModel(np.empty((0, 3)), np.empty(0, np.int64), np.empty((0, 2, 3)), np.empty((0, dof), bool))


def clearance_model(robot: SerialRobot, workcell: Sequence[Box | Body]) -> ClearanceModel:
    """The model of one robot among the boxes of its workcell; bodies given by a URDF are left to PyBullet."""
    boxes = [body for body in workcell if isinstance(body, Box)]
    if not boxes:
        return no_clearance(robot.dof)
    with World(robot) as world:
        hulls = world.hulls()
    kept = [(hull.joint, outermost(hull.points)) for hull in hulls if hull.joint >= 0]
    if not kept:
        return no_clearance(robot.dof)
    kept.sort(key=lambda link: link[0])
    exempt = np.zeros((len(boxes), robot.dof), bool)
    for b, box in enumerate(boxes):
        for hull in hulls:
            if hull.joint >= 0 and hull.link in box.exempt_links:
                exempt[b, hull.joint] = True
    return ClearanceModel(
        np.concatenate([points for _, points in kept]),
        np.concatenate([np.full(len(points), joint) for joint, points in kept]),
        np.array([[box.centre, [0.5 * edge for edge in box.size]] for box in boxes]),
        exempt,
    )


def outermost(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The points that lie furthest out in any of DIRECTIONS evenly spread directions."""
    return np.ascontiguousarray(points[np.unique((points @ directions(DIRECTIONS).T).argmax(axis=0))])


@njit(**_COMPILE)
def link_clearances(chain, model, far, q, distances, normals, nearest, joint_origins, joint_axes):  # type: ignore[no-untyped-def]
    """For the links carried by each joint: distance (D,) [m] to the nearest box, the direction (D, 3) away from it
    and the point (D, 3) that is nearest, in the base frame; joint origins and axes (D, 3) come with it.
    Links that are further away than `far` [m], by the sphere around their joint, get a bound from below instead.
    """
    origins, axes, prismatic, base, _ = chain
    points, boxes, reach = model
    frame = frame_of(base)
    next_point = 0
    for j in range(q.shape[0]):
        distances[j] = np.inf
        frame = joint_frame(origins, axes, prismatic, q, j, frame, joint_origins, joint_axes)
        p0, p1, p2, r00, r01, r02, r10, r11, r12, r20, r21, r22 = frame
        bound = np.inf
        for b in range(boxes.shape[0]):
            if boxes[b, 6 + j] == 0.0:
                ex = max(abs(p0 - boxes[b, 0]) - boxes[b, 3], 0.0)
                ey = max(abs(p1 - boxes[b, 1]) - boxes[b, 4], 0.0)
                ez = max(abs(p2 - boxes[b, 2]) - boxes[b, 5], 0.0)
                bound = min(bound, np.sqrt(ex * ex + ey * ey + ez * ez) - reach[j])
        is_far = bound > far
        if is_far:
            distances[j] = bound
        while next_point < points.shape[0] and points[next_point, 3] == j:
            if is_far:
                next_point += 1
                continue
            u, v, w = points[next_point, 0], points[next_point, 1], points[next_point, 2]
            next_point += 1
            x = p0 + r00 * u + r01 * v + r02 * w
            y = p1 + r10 * u + r11 * v + r12 * w
            z = p2 + r20 * u + r21 * v + r22 * w
            for b in range(boxes.shape[0]):
                if boxes[b, 6 + j] != 0.0:
                    continue
                dx, dy, dz = x - boxes[b, 0], y - boxes[b, 1], z - boxes[b, 2]
                ex, ey, ez = abs(dx) - boxes[b, 3], abs(dy) - boxes[b, 4], abs(dz) - boxes[b, 5]
                if ex <= 0.0 and ey <= 0.0 and ez <= 0.0:
                    distance = max(ex, ey, ez)
                    nx = (1.0 if dx > 0.0 else -1.0) if distance == ex else 0.0
                    ny = (1.0 if dy > 0.0 else -1.0) if distance == ey and nx == 0.0 else 0.0
                    nz = (1.0 if dz > 0.0 else -1.0) if nx == 0.0 and ny == 0.0 else 0.0
                else:
                    ox, oy, oz = max(ex, 0.0), max(ey, 0.0), max(ez, 0.0)
                    distance = np.sqrt(ox * ox + oy * oy + oz * oz)
                    nx = (ox if dx > 0.0 else -ox) / distance
                    ny = (oy if dy > 0.0 else -oy) / distance
                    nz = (oz if dz > 0.0 else -oz) / distance
                if distance < distances[j]:
                    distances[j] = distance
                    normals[j, 0], normals[j, 1], normals[j, 2] = nx, ny, nz
                    nearest[j, 0], nearest[j, 1], nearest[j, 2] = x, y, z


@njit(**_COMPILE)
def clearance_row(prismatic, link, normals, nearest, joint_origins, joint_axes, row):  # type: ignore[no-untyped-def]
    """Gradient (D,) of the distance of the links that joint `link` carries."""
    n, p = normals[link], nearest[link]
    row[:] = 0.0
    for j in range(link + 1):
        a, o = joint_axes[j], joint_origins[j]
        if prismatic[j]:
            row[j] = n[0] * a[0] + n[1] * a[1] + n[2] * a[2]
            continue
        x, y, z = p[0] - o[0], p[1] - o[1], p[2] - o[2]
        row[j] = (
            n[0] * (a[1] * z - a[2] * y) + n[1] * (a[2] * x - a[0] * z) + n[2] * (a[0] * y - a[1] * x)
        )  # fmt: skip


@njit(**_COMPILE)
def clearance_batch(chain, model, far, q, smallest):  # type: ignore[no-untyped-def]
    """Smallest distance of any link to any box, of q (B, D) into smallest (B,); beyond `far` a bound from below."""
    dof = q.shape[1]
    distances, normals, nearest = np.empty(dof), np.empty((dof, 3)), np.empty((dof, 3))
    joint_origins, joint_axes = np.empty((dof, 3)), np.empty((dof, 3))
    for b in range(q.shape[0]):
        link_clearances(chain, model, far, q[b], distances, normals, nearest, joint_origins, joint_axes)
        value = np.inf
        for j in range(dof):
            value = min(value, distances[j])
        smallest[b] = value
