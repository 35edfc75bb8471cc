"""What is understood of somebody's URDF: the arm in it, the links that may touch and why, and what
is missing for a certified plan, with the mend.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from constraint_geodesics.params import PlannerParams, RobotParams
from constraint_geodesics.robot.description import Arm, arm_to, read_description
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.allowed_collisions import (
    SAMPLES,
    AllowedPair,
    Sampled,
    allowed_by_srdf,
    sampled,
)
from constraint_geodesics.scene.arm import ADJACENT, FOUND, LoadedArm, load_arm
from constraint_geodesics.scene.bodies import Body, may_meet
from constraint_geodesics.scene.pieces import read_pieces
from constraint_geodesics.scene.urdf import find_urdf, has_pybullet

_ASSUMED = PlannerParams()


@dataclass(frozen=True)
class Understood:
    """An arm, the pairs of its links that may touch, how many pairs are looked at, what sampled
    configurations show of them, and what is missing, a line each.  Without PyBullet there are no
    samples, and of an arm that can't be loaded no pairs.
    """

    arm: Arm
    allowed: tuple[AllowedPair, ...]
    looked_at: int | None
    sampled: Sampled | None
    missing: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """For people."""
        yield from self.arm.lines()
        yield (
            "accelerations, of which a URDF says nothing: "
            f"{_ASSUMED.acceleration_rad_s2:g} rad/s² of turning joints, "
            f"{_ASSUMED.acceleration_m_s2:g} m/s² of sliding ones; less with "
            "--acceleration-scale"
        )
        by_reason: dict[str, list[str]] = {}
        for first, second, reason in self.allowed:
            by_reason.setdefault(reason, []).append(f"{first} with {second}")
        for reason, pairs in by_reason.items():
            yield f"may touch, {reason}: {', '.join(pairs)}"
        if self.looked_at is not None:
            yield f"looked at for collisions: {self.looked_at} pairs of links"
        if self.sampled is not None:
            of = f"of {SAMPLES:,} sampled configurations"
            yield f"free of self-collision: {_percent(self.sampled.free)} {of}"
            for first, second, share in self.sampled.often:
                yield (
                    f"look at: {first} with {second} touch at {_percent(share)} {of}: where they "
                    "do not in truth, an SRDF may allow them"
                )
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
            "acceleration_assumed": {
                "rad_s2": _ASSUMED.acceleration_rad_s2,
                "m_s2": _ASSUMED.acceleration_m_s2,
            },
            "held": dict(arm.held),
            "may_touch": [
                {"links": [first, second], "reason": reason}
                for first, second, reason in self.allowed
            ],
            "pairs_looked_at": self.looked_at,
            "free_share": None if self.sampled is None else self.sampled.free,
            "touch_often": [
                {"links": [first, second], "share": share}
                for first, second, share in (self.sampled.often if self.sampled else ())
            ],
            "missing": list(self.missing),
        }


def understand(params: RobotParams) -> Understood:
    """Read a URDF as far as it goes.  Raises RobotError, one line with the mend, where no arm can
    be made of it.
    """
    arm = arm_to(read_description(find_urdf(params.urdf)), params.tool_link, params.hold)
    missing = list(_missing(arm))
    if params.may_touch not in (ADJACENT, FOUND):
        allowed_by_srdf(Path(params.may_touch), arm.description)
    try:
        loaded = load_arm(params)
        shown = loaded.sampled
        if shown is None and has_pybullet():
            shown = sampled(loaded.robot)
    except RobotError as error:
        missing.append(str(error))
        return Understood(arm, (), None, None, tuple(missing))
    return Understood(arm, loaded.allowed, _looked_at(loaded), shown, tuple(missing))


def _looked_at(loaded: LoadedArm) -> int:
    """How many pairs of links are looked at for collisions."""
    links = read_pieces(loaded.robot.urdf)
    bodies = [Body(own.name, 0, own.pieces, own.parent) for own in links if own.pieces]
    allowed = frozenset(map(frozenset, loaded.robot.allowed))
    return sum(may_meet(first, second, allowed) for first, second in combinations(bodies, 2))


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


def _percent(share: float) -> str:
    """Whole percents, or what is left of them near none and all."""
    return f"{100.0 * share:.3g} %"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
