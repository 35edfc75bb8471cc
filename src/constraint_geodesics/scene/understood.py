"""What is understood of somebody's URDF: the arm in it, the links that may touch and why, and what
is missing for a certified plan, with the mend.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from constraint_geodesics.params import RobotParams
from constraint_geodesics.robot.description import Arm, arm_to, read_description
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.allowed_collisions import AllowedPair, allowed_by_srdf
from constraint_geodesics.scene.arm import ADJACENT, FOUND, load_arm
from constraint_geodesics.scene.pieces import read_pieces
from constraint_geodesics.scene.urdf import find_urdf


@dataclass(frozen=True)
class Understood:
    """An arm, the pairs of its links that may touch, how many pairs are looked at, and what is
    missing, a line each.
    """

    arm: Arm
    allowed: tuple[AllowedPair, ...]
    looked_at: int
    missing: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """For people."""
        yield from self.arm.lines()
        by_reason: dict[str, list[str]] = {}
        for first, second, reason in self.allowed:
            by_reason.setdefault(reason, []).append(f"{first} with {second}")
        for reason, pairs in by_reason.items():
            yield f"may touch, {reason}: {', '.join(pairs)}"
        yield f"looked at for collisions: {self.looked_at} pairs of links"
        for line in self.missing:
            yield f"missing: {line}"

    def summary(self) -> dict[str, Any]:
        """The same as JSON takes it; limits that there are none of are null."""
        arm = self.arm
        return {
            "robot": arm.description.name,
            "root": arm.description.links[0],
            "tool_link": arm.tool_link,
            "joints": [
                {
                    "name": joint.name,
                    "type": joint.kind,
                    "lower": _finite(joint.lower),
                    "upper": _finite(joint.upper),
                    "velocity": _finite(joint.velocity),
                }
                for joint in arm.moved
            ],
            "held": dict(arm.held),
            "may_touch": [
                {"links": [first, second], "reason": reason}
                for first, second, reason in self.allowed
            ],
            "pairs_looked_at": self.looked_at,
            "missing": list(self.missing),
        }


def understand(params: RobotParams) -> Understood:
    """Read a URDF as far as it goes.  Raises RobotError, one line with the mend, where no arm can
    be made of it.
    """
    arm = arm_to(read_description(find_urdf(params.urdf)), params.tool_link, params.hold)
    missing = list(_missing(arm))
    links = arm.description.tree.findall("link")
    shaped = sum(link.find("collision") is not None for link in links)
    count = shaped * (shaped - 1) // 2
    if params.may_touch not in (ADJACENT, FOUND):
        allowed_by_srdf(Path(params.may_touch), arm.description)
    try:
        loaded = load_arm(params)
        read_pieces(loaded.robot.urdf)
    except RobotError as error:
        missing.append(str(error))
        return Understood(arm, (), count, tuple(missing))
    return Understood(arm, loaded.allowed, count - len(loaded.allowed), tuple(missing))


def _missing(arm: Arm) -> Iterator[str]:
    """What the file does not say."""
    for joint in arm.moved:
        if not math.isfinite(joint.velocity):
            yield f'{joint.name} has no velocity: give <limit velocity="…">, or no path is timed'
    carried = {joint.child for joint in arm.moved}
    for link in arm.description.tree.findall("link"):
        seen, felt = link.find("visual") is not None, link.find("collision") is not None
        if link.get("name") in carried and seen and not felt:
            yield f"{link.get('name')} is drawn but has no <collision>: nothing keeps it clear"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
