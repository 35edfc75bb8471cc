"""The chain that PyBullet itself loaded, or without it the one of urdf_chain.py, as kernels.py
describes it: unit quaternions along the joints.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from constraint_geodesics.certification.certificate import CertificationError
from constraint_geodesics.scene.world import LoadedChain


class Chain(NamedTuple):
    """The chain as kernels.py describes it."""

    turns: Float[np.ndarray, "D+1 4"]
    offsets: Float[np.ndarray, "D+1 3"]
    prismatic: np.ndarray
    lengths: Float[np.ndarray, "D+1"]


def read_chain(loaded: LoadedChain, dof: int) -> Chain:
    """PyBullet's chain of inertial frames as a chain of joint frames whose z axis is the
    joint's.
    """
    turns: list[np.ndarray] = []
    offsets: list[np.ndarray] = []
    prismatic: list[bool] = []
    turn, arm, joint = (
        _wxyz(loaded.quaternion),
        np.array(loaded.position),
        np.array(loaded.position),
    )
    tool = np.array([1.0, 0.0, 0.0, 0.0])
    for link in loaded.links:
        joint = arm + rotated(turn, np.array(link.joint_position))
        turn = _product(turn, _wxyz(link.quaternion))
        tool = _wxyz(link.inertial_quaternion) * np.array([1.0, -1.0, -1.0, -1.0])
        if link.column is not None:
            if link.kind not in ("revolute", "prismatic") or link.column != len(turns):
                raise CertificationError(
                    f"link {link.name!r}: joint {link.column} of type {link.kind}, where "
                    f"joint {len(turns)} of a "
                    "serial arm was expected"
                )
            aligned = _from_z_to(np.array(link.axis))
            turns.append(_product(turn, aligned))
            offsets.append(joint)
            prismatic.append(link.kind == "prismatic")
            turn, joint = aligned * np.array([1.0, -1.0, -1.0, -1.0]), np.zeros(3)
        elif link.kind != "fixed":
            raise CertificationError(
                f"link {link.name!r}: a {link.kind} joint that no joint value moves"
            )
        arm = joint + rotated(turn, rotated(tool, np.array(link.inertial_position)))
    if len(turns) != dof:
        raise CertificationError(f"the chain has {len(turns)} joints, the robot has {dof}")
    turns.append(_product(turn, tool))
    offsets.append(joint)
    return Chain(
        np.array(turns),
        np.array(offsets),
        np.array(prismatic),
        np.sqrt(np.square(np.array(offsets)).sum(axis=1)),
    )


def _wxyz(quaternion: tuple[float, float, float, float]) -> np.ndarray:
    """A unit quaternion (w, x, y, z) from PyBullet's (x, y, z, w)."""
    q = np.array([quaternion[3], *quaternion[:3]])
    return q / np.sqrt((q * q).sum())


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    vector = a[0] * b[1:] + b[0] * a[1:] + _across(a[1:], b[1:])
    return np.concatenate([[a[0] * b[0] - (a[1:] * b[1:]).sum()], vector])


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A vector turned by a unit quaternion (w, x, y, z)."""
    return v + 2.0 * _across(q[1:], _across(q[1:], v) + q[0] * v)


def _across(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A × b, of which `np.cross` makes ten times the work."""
    (x, y, z), (u, v, w) = a, b
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def _from_z_to(axis: np.ndarray) -> np.ndarray:
    """A unit quaternion that turns e_z to the direction of `axis`."""
    x, y, z = axis / np.sqrt((axis * axis).sum())
    if z > 0.0:
        q = np.array([1.0 + z, -y, x, 0.0])
    elif x == 0.0 and y == 0.0:
        return np.array([0.0, 1.0, 0.0, 0.0])
    else:  # the same, without what cancels
        q = np.array([(x * x + y * y) / (1.0 - z), -y, x, 0.0])
    return q / np.sqrt((q * q).sum())


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """The unit quaternion (w, x, y, z) whose rotation is nearest: Bar-Itzhack's symmetric
    eigenvector (2000).
    """
    if rotation.shape != (3, 3):
        raise CertificationError(f"the reference's rotation has shape {rotation.shape}: not (3, 3)")
    return np.array(_nearest_quaternion(rotation.tobytes()))


@lru_cache(maxsize=1024)
def _nearest_quaternion(entries: bytes) -> tuple[float, float, float, float]:
    rotation = np.frombuffer(entries).reshape(3, 3)
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6:
        raise CertificationError(
            f"the reference's rotation is {rotation.tolist()}: must be orthonormal"
        )
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1].tolist()
    return w, x, y, z
