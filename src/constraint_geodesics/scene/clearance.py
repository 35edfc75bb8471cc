"""Clearance of a robot's links to the shapes of its workcell, compiled: what keeps curves out of a
collision.

Every shape is rounded boxes.  Every link is a set of points: the corners of its collision hulls
that lie furthest out in evenly spread directions, as good as the hull itself against the flat side
of a box, and where there are round shapes points on the hull's faces as well.
PyBullet remains the judge: this model knows neither the contact of the arm with itself nor bodies
given as meshes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.spatial import ConvexHull

from constraint_geodesics.robot.kernels import frame_of, joint_frame
from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.world import World, directions

DIRECTIONS = 48
"""Directions in which a link's outermost corners are looked for."""
FACE_SPACING = 0.03
"""Distance of the points on a hull's faces, at most [m]: a sphere of 0.1 m reaches 1 mm in between
them.
"""
GROUP = 12
"""Points that are passed over together where a ball around them is far enough."""
_COMPILE = {"cache": True, "fastmath": {"contract"}, "error_model": "numpy", "nogil": True}


class ClearanceArrays(NamedTuple):
    """A clearance model as the compiled kernels take it.

    points (K, 3) [m]; shapes (B, 16 + D): centre, half edges, rounding and turn (9) of the boxes,
    and their exempt links; groups (G, 7) of neighbouring points, those of one joint together:
    centre and radius of a ball around them, the first point, the one after the last, the joint.
    """

    points: np.ndarray
    shapes: np.ndarray
    groups: np.ndarray


@dataclass(frozen=True)
class ClearanceModel:
    """Points of the links, and the rounded boxes they must keep clear of.

    points (K, 3) [m] in the frame that the joint `joints` (K,) carries; boxes (B, 16): centre, half
    edges and rounding [m], and turn, of each; exempt (B, D): which of them the links carried by a
    joint may touch.
    """

    points: Float[np.ndarray, "K 3"]
    joints: Int[np.ndarray, "K"]
    boxes: Float[np.ndarray, "B 16"]
    exempt: Bool[np.ndarray, "B D"]

    @cached_property
    def arrays(self) -> ClearanceArrays:
        """For the kernels."""
        order, groups, first = [np.empty(0, np.int64)], [np.empty((0, 7))], 0
        for joint in np.unique(self.joints):
            for rows in _neighbours(self.points, np.flatnonzero(self.joints == joint)):
                centre = self.points[rows].mean(axis=0)
                radius = np.linalg.norm(self.points[rows] - centre, axis=1).max()
                groups.append(np.array([[*centre, radius, first, first + len(rows), joint]], float))
                order.append(rows)
                first += len(rows)
        boxes = np.concatenate([self.boxes, self.exempt], axis=1)
        points = np.ascontiguousarray(self.points[np.concatenate(order)])
        return ClearanceArrays(points, boxes, np.concatenate(groups))

    def clearance(
        self, robot: SerialRobot, q: Float[np.ndarray, "*batch D"]
    ) -> Float[np.ndarray, "*batch"]:
        """Smallest distance of any link to any box it must not touch [m], negative inside; inf
        without boxes.
        """
        flat = np.ascontiguousarray(q, np.float64).reshape(-1, robot.dof)
        smallest = np.empty(len(flat))
        clearance_batch(robot.chain, self.arrays, np.inf, flat, smallest)
        return smallest.reshape(q.shape[:-1])


def no_clearance(dof: int) -> ClearanceModel:
    """The model of an empty workcell."""
    nothing = np.empty((0, dof), bool)
    return ClearanceModel(np.empty((0, 3)), np.empty(0, np.int64), np.empty((0, 16)), nothing)


def clearance_model(robot: SerialRobot, workcell: Sequence[Shape]) -> ClearanceModel:
    """The model of one robot among shapes; what is no rounded box is left to PyBullet."""
    solids = [(shape, box) for shape in workcell for box in shape.rounded_boxes()]
    if not solids:
        return no_clearance(robot.dof)
    with World(robot) as world:
        hulls = [hull for hull in world.hulls() if hull.joint >= 0]
    if not hulls:
        return no_clearance(robot.dof)
    points_of = surface if any(box.rounding > 0.0 for _, box in solids) else outermost
    kept = sorted(((h.joint, points_of(h.points)) for h in hulls), key=lambda link: link[0])
    exempt = np.zeros((len(solids), robot.dof), bool)
    for b, (shape, _) in enumerate(solids):
        exempt[b, [hull.joint for hull in hulls if hull.link in shape.exempt_links]] = True
    return ClearanceModel(
        np.concatenate([points for _, points in kept]),
        np.concatenate([np.full(len(points), joint) for joint, points in kept]),
        np.array([np.concatenate([np.ravel(part) for part in box]) for _, box in solids]),
        exempt,
    )


def outermost(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The points that lie furthest out in any of DIRECTIONS evenly spread directions."""
    return np.ascontiguousarray(
        points[np.unique((points @ directions(DIRECTIONS).T).argmax(axis=0))]
    )


def surface(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Points on the convex hull of the outermost points, at most FACE_SPACING apart along its
    faces.
    """
    corners = outermost(points)
    found = [corners]
    for face in corners[ConvexHull(corners).simplices]:
        pieces = int(
            np.ceil(max(np.linalg.norm(face[k] - face[k - 1]) for k in range(3)) / FACE_SPACING)
        )
        shares = [(i, j, pieces - i - j) for i in range(pieces + 1) for j in range(pieces + 1 - i)]
        found.append(np.array(shares, float) @ face / pieces)
    return np.ascontiguousarray(np.unique(np.concatenate(found).round(9), axis=0))


def _neighbours(
    points: Float[np.ndarray, "K 3"], rows: Int[np.ndarray, "n"]
) -> list[Int[np.ndarray, "m"]]:
    """The rows in groups of at most GROUP points, halved along their widest side until they are."""
    if len(rows) <= GROUP:
        return [rows]
    side = int(np.ptp(points[rows], axis=0).argmax())
    sorted_rows = rows[np.argsort(points[rows, side], kind="stable")]
    half = len(rows) // 2
    return _neighbours(points, sorted_rows[:half]) + _neighbours(points, sorted_rows[half:])


@njit(**_COMPILE)
def link_clearances(chain, model, far, q, distances, normals, nearest, joint_origins, joint_axes):
    """For the links carried by each joint: distance (D,) [m] to the nearest box, the direction (D,
    3) away from it and the point (D, 3) that is nearest, in the base frame; joint origins and axes
    (D, 3) come with it. Links that are further away than `far` [m] get a bound from below instead.
    """
    origins, axes, prismatic, base, _ = chain
    points, boxes, groups = model
    frame = frame_of(base)
    g = 0
    for j in range(q.shape[0]):
        distances[j] = np.inf
        frame = joint_frame(origins, axes, prismatic, q, j, frame, joint_origins, joint_axes)
        p0, p1, p2, r00, r01, r02, r10, r11, r12, r20, r21, r22 = frame
        passed_over = np.inf
        while g < groups.shape[0] and groups[g, 6] == j:
            u, v, w = groups[g, 0], groups[g, 1], groups[g, 2]
            x = p0 + r00 * u + r01 * v + r02 * w
            y = p1 + r10 * u + r11 * v + r12 * w
            z = p2 + r20 * u + r21 * v + r22 * w
            radius, first, last = groups[g, 3], int(groups[g, 4]), int(groups[g, 5])
            g += 1
            for b in range(boxes.shape[0]):
                if boxes[b, 16 + j] != 0.0:
                    continue
                dx, dy, dz = _from_centre(boxes[b], x, y, z)
                ex, ey, ez = abs(dx) - boxes[b, 3], abs(dy) - boxes[b, 4], abs(dz) - boxes[b, 5]
                bound = max(ex, ey, ez)
                if bound > 0.0:
                    ex, ey, ez = max(ex, 0.0), max(ey, 0.0), max(ez, 0.0)
                    bound = np.sqrt(ex * ex + ey * ey + ez * ez)
                bound -= boxes[b, 6] + radius
                if bound > far or bound >= distances[j]:
                    passed_over = min(passed_over, bound)
                    continue
                for k in range(first, last):
                    _nearer(frame, points[k], boxes[b], j, (distances, normals, nearest))
        if distances[j] > far:
            distances[j] = min(distances[j], passed_over)


@njit(inline="always", **_COMPILE)
def _from_centre(box, x, y, z):
    """A point of the base frame, from a box's centre and along its edges."""
    x, y, z = x - box[0], y - box[1], z - box[2]
    return (
        x * box[7] + y * box[10] + z * box[13],
        x * box[8] + y * box[11] + z * box[14],
        x * box[9] + y * box[12] + z * box[15],
    )


@njit(inline="always", **_COMPILE)
def _nearer(frame, point, box, j, found):
    """Take a point of the links that joint j carries for the nearest, if it is nearer to the box
    than all before; found: distances, normals and nearest points so far.
    """
    distances, normals, nearest = found
    p0, p1, p2, r00, r01, r02, r10, r11, r12, r20, r21, r22 = frame
    x = p0 + r00 * point[0] + r01 * point[1] + r02 * point[2]
    y = p1 + r10 * point[0] + r11 * point[1] + r12 * point[2]
    z = p2 + r20 * point[0] + r21 * point[1] + r22 * point[2]
    dx, dy, dz = _from_centre(box, x, y, z)
    ex, ey, ez = abs(dx) - box[3], abs(dy) - box[4], abs(dz) - box[5]
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
    distance -= box[6]
    if distance < distances[j]:
        distances[j] = distance
        normals[j, 0] = nx * box[7] + ny * box[8] + nz * box[9]
        normals[j, 1] = nx * box[10] + ny * box[11] + nz * box[12]
        normals[j, 2] = nx * box[13] + ny * box[14] + nz * box[15]
        nearest[j, 0], nearest[j, 1], nearest[j, 2] = x, y, z


@njit(**_COMPILE)
def clearance_row(prismatic, link, normals, nearest, joint_origins, joint_axes, row):
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
            n[0] * (a[1] * z - a[2] * y)
            + n[1] * (a[2] * x - a[0] * z)
            + n[2] * (a[0] * y - a[1] * x)
        )


@njit(**_COMPILE)
def clearance_batch(chain, model, far, q, smallest):
    """Smallest distance of any link to any box, of q (B, D) into smallest (B,); beyond `far` a
    bound from below.
    """
    dof = q.shape[1]
    distances, normals, nearest = np.empty(dof), np.empty((dof, 3)), np.empty((dof, 3))
    joint_origins, joint_axes = np.empty((dof, 3)), np.empty((dof, 3))
    for b in range(q.shape[0]):
        link_clearances(
            chain, model, far, q[b], distances, normals, nearest, joint_origins, joint_axes
        )
        value = np.inf
        for j in range(dof):
            value = min(value, distances[j])
        smallest[b] = value
