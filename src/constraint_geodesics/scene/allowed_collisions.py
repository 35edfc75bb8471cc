"""Pairs of an arm's links that may touch: those that an SRDF disables, or those that can't be kept
apart whatever the arm does.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from constraint_geodesics.robot.description import Description, read_description
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot
from constraint_geodesics.scene.world import World, physics

SAMPLES = 2000
"""Configurations that are looked at."""
ALWAYS = 0.95
"""Share of them at which two links touch that always do: they are modelled into each other."""


class AllowedPair(NamedTuple):
    """Two links that may touch, in the order of the URDF, and why."""

    first: str
    second: str
    reason: str


def allowed_by_srdf(srdf: Path, description: Description) -> tuple[AllowedPair, ...]:
    """The pairs that an SRDF disables.  Raises RobotError for a file that is none, and for links
    that the robot has not.
    """
    try:
        root = ElementTree.parse(srdf).getroot()
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise RobotError(f"{srdf}: no SRDF: {error}") from None
    found = []
    for element in root.iter("disable_collisions"):
        pair = [element.get(name, "") for name in ("link1", "link2")]
        for link in pair:
            if link not in description.links:
                where = f"{srdf}: <disable_collisions> names the link {link!r}"
                raise RobotError(f"{where}: {description.file.name} has no such link")
        first, second = sorted(pair, key=description.links.index)
        found.append(AllowedPair(first, second, element.get("reason") or "SRDF"))
    return tuple(dict.fromkeys(found))


def allowed_by_sampling(
    robot: SerialRobot, samples: int = SAMPLES, seed: int = 0
) -> tuple[AllowedPair, ...]:
    """Pairs of links with collision shapes that are adjacent (no other such link between them on
    the tree), rigid (no joint that moves between them), or touch at ALWAYS of the configurations
    drawn within the limits, by PyBullet.
    """
    description = read_description(robot.urdf)
    found = {pair[:2]: pair for pair in _by_structure(description, set(robot.joint_names))}
    others = replace(robot, allowed=frozenset(found))
    for first, second, share in _touching(others, samples, seed):
        first, second = sorted((first, second), key=description.links.index)
        if share >= ALWAYS:
            found[first, second] = AllowedPair(first, second, "always touch")
    return tuple(found.values())


def _by_structure(description: Description, moved: set[str]) -> Iterator[AllowedPair]:
    """Adjacent and rigid pairs."""
    shaped = [
        link.get("name", "")
        for link in description.tree.findall("link")
        if link.find("collision") is not None
    ]
    shaped.sort(key=description.links.index)
    for place, second in enumerate(shaped):
        above = _above(description, second)
        nearest = next((link for link, _ in above if link in shaped), None)
        for first in shaped[:place]:
            if _anchor(description, first, moved) == _anchor(description, second, moved):
                yield AllowedPair(first, second, "rigid")
            elif first == nearest:
                yield AllowedPair(first, second, "adjacent")


def _above(description: Description, link: str) -> list[tuple[str, str]]:
    """The links above one, the nearest first, and the joints that lead down from them."""
    return [(joint.parent, joint.name) for joint in reversed(description.path(link))]


def _anchor(description: Description, link: str, moved: set[str]) -> str:
    """The joint that last moves a link; "" for none."""
    return next((name for _, name in _above(description, link) if name in moved), "")


def _touching(robot: SerialRobot, samples: int, seed: int) -> Iterator[tuple[str, str, float]]:
    """Links that touch, and at which share of configurations."""
    counts: dict[tuple[int, int], int] = {}
    with World(robot) as world:
        own = physics(world)
        bullet, body = own.bullet, own.body
        names = {-1: bullet.getBodyInfo(body)[0].decode()}
        for i in range(bullet.getNumJoints(body)):
            names[i] = bullet.getJointInfo(body, i)[12].decode()
        for q in robot.sample(samples, np.random.default_rng(seed)):
            bullet.resetJointStatesMultiDof(body, own.joints, q[:, None].tolist())
            bullet.performCollisionDetection()
            contacts = bullet.getContactPoints(bodyA=body, bodyB=body)
            for pair in {tuple(sorted(c[3:5])) for c in contacts if c[8] < 0.0}:
                counts[pair] = counts.get(pair, 0) + 1
    for (a, b), count in counts.items():
        yield names[a], names[b], count / samples
