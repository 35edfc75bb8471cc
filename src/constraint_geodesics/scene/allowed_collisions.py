"""Pairs of an arm's links that may touch: those that an SRDF disables, or those that can't be kept
apart whatever the arm does; and what sampled configurations show of the others.
"""

import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from constraint_geodesics.robot.description import Description, read_description
from constraint_geodesics.robot.kinematics import RobotError, SerialRobot
from constraint_geodesics.scene.world import World, physics
from constraint_geodesics.xml_files import XmlFileError, read_xml

SAMPLES = 2000
"""Configurations that are looked at."""
ALWAYS = 0.95
"""Share of them at which two links touch that always do: they are modelled into each other."""
NEAR_M = 5e-4
"""Links that are always nearer than this [m] are taken for links that always touch: no path keeps
them apart, and PyBullet alone can tell such distances from contacts.
"""
_MISSES = 5
"""A pair that was further apart so often, and too often for ALWAYS so far, is asked no more."""
OFTEN = 0.3
"""Share of them from which on a user should look at two links that touch."""


class AllowedPair(NamedTuple):
    """Two links that may touch, in the order of the URDF, and why."""

    first: str
    second: str
    reason: str


class OftenTouching(NamedTuple):
    """Two links that may not touch, and the share of sampled configurations at which they do."""

    first: str
    second: str
    share: float


class Sampled(NamedTuple):
    """What sampled configurations show of an arm alone: links that touch often, those that do so
    most first, and the share of configurations at which none do.
    """

    often: tuple[OftenTouching, ...]
    free: float


class _Seen(NamedTuple):
    """For each configuration the pairs of links that touch; and at how many a pair is nearer than
    NEAR_M, where that may be at ALWAYS of them.
    """

    touched: list[set[tuple[str, str]]]
    near: Counter[tuple[str, str]]


def allowed_by_srdf(srdf: Path, description: Description) -> tuple[AllowedPair, ...]:
    """The pairs that an SRDF disables: one by one, or all those of a link but the ones that it
    enables again.  Raises RobotError for a file that is none, and for links that the robot has not.
    """
    try:
        root = read_xml(srdf)
    except (OSError, XmlFileError) as error:
        raise RobotError(f"{srdf}: no SRDF: {error}: give the path of one") from None
    if root.tag != "robot":
        raise RobotError(f"{srdf}: no SRDF: <{root.tag}> is the root element: it must be <robot>")

    def named(tag: str, *attributes: str) -> Iterator[tuple[ElementTree.Element, list[str]]]:
        for element in root.iter(tag):
            links = [element.get(name, "") for name in attributes]
            for link in links:
                if link not in description.links:
                    where = f"{srdf}: <{tag}> names the link {link!r}"
                    raise RobotError(f"{where}: {description.file.name} has no such link")
            yield element, sorted(links, key=description.links.index)

    by_default = {link for _, (link,) in named("disable_default_collisions", "link")}
    found = {
        (first, second): "SRDF"
        for first, second in combinations(_shaped(description), 2)
        if first in by_default or second in by_default
    }
    for _, (first, second) in named("enable_collisions", "link1", "link2"):
        found.pop((first, second), None)
    for element, (first, second) in named("disable_collisions", "link1", "link2"):
        found[first, second] = element.get("reason") or "SRDF"
    return tuple(AllowedPair(*pair, reason) for pair, reason in found.items())


def allowed_by_sampling(
    robot: SerialRobot, samples: int = SAMPLES, seed: int = 0
) -> tuple[tuple[AllowedPair, ...], Sampled]:
    """Pairs of links with collision shapes that are adjacent (no other such link between them on
    the tree), rigid (no joint that moves between them), or touch, or are nearer than NEAR_M, at
    ALWAYS of the configurations drawn within the limits, by PyBullet; and what these show of the
    others.
    """
    description = read_description(robot.urdf)
    found = {pair[:2]: pair for pair in _by_structure(description, set(robot.joint_names))}
    others = replace(robot, allowed=frozenset(found))
    apart = [pair for pair in combinations(_shaped(description), 2) if pair not in found]
    seen = _look(others, description, samples, seed, apart)
    touching = Counter(pair for touched in seen.touched for pair in touched)
    for pair in apart:
        if seen.near[pair] >= ALWAYS * samples:
            always = touching[pair] >= ALWAYS * samples
            reason = "always touch" if always else f"always within {1e3 * NEAR_M:g} mm"
            found[pair] = AllowedPair(*pair, reason)
    return tuple(found.values()), _summed(seen, found)


def sampled(robot: SerialRobot, samples: int = SAMPLES, seed: int = 0) -> Sampled:
    """What configurations drawn within the limits show of a robot whose allowed pairs are known."""
    return _summed(_look(robot, read_description(robot.urdf), samples, seed), ())


def _summed(seen: _Seen, allowed: Collection[tuple[str, str]]) -> Sampled:
    left = [{pair for pair in touched if pair not in allowed} for touched in seen.touched]
    counts = Counter(pair for touched in left for pair in touched)
    shares = (OftenTouching(*pair, count / len(left)) for pair, count in counts.items())
    often = sorted((own for own in shares if own.share >= OFTEN), key=lambda own: (-own.share, own))
    return Sampled(tuple(often), sum(not touched for touched in left) / len(left))


def _by_structure(description: Description, moved: set[str]) -> Iterator[AllowedPair]:
    """Adjacent and rigid pairs."""
    shaped = _shaped(description)
    anchors: list[str] = []
    for second in shaped:
        joints = description.path(second)[::-1]
        nearest = next((joint.parent for joint in joints if joint.parent in shaped), None)
        anchors.append(next((joint.name for joint in joints if joint.name in moved), ""))
        for first, anchor in zip(shaped, anchors[:-1], strict=False):
            if anchor == anchors[-1]:
                yield AllowedPair(first, second, "rigid")
            elif first == nearest:
                yield AllowedPair(first, second, "adjacent")


def _shaped(description: Description) -> list[str]:
    """Links with collision shapes, in order."""
    links = description.tree.findall("link")
    shaped = {link.get("name", "") for link in links if link.find("collision") is not None}
    return [link for link in description.links if link in shaped]


def _look(
    robot: SerialRobot,
    description: Description,
    samples: int,
    seed: int,
    apart: Iterable[tuple[str, str]] = (),
) -> _Seen:
    """apart: pairs of which it is also asked how often they are nearer than NEAR_M."""
    seen, misses = _Seen([], Counter()), dict.fromkeys(apart, 0)
    with World(robot) as world:
        own = physics(world)
        bullet, body = own.bullet, own.body
        names = {-1: bullet.getBodyInfo(body)[0].decode()}
        for i in range(bullet.getNumJoints(body)):
            names[i] = bullet.getJointInfo(body, i)[12].decode()
        index = {name: i for i, name in names.items()}
        rank = {i: description.links.index(name) for i, name in names.items()}
        for number, q in enumerate(robot.sample(samples, np.random.default_rng(seed)), 1):
            bullet.resetJointStatesMultiDof(body, own.joints, q[:, None].tolist())
            bullet.performCollisionDetection()
            contacts = bullet.getContactPoints(bodyA=body, bodyB=body)
            ends = {tuple(sorted(c[3:5], key=rank.__getitem__)) for c in contacts if c[8] < 0.0}
            touched = {
                (names[first], names[second])
                for first, second in ends
                # PyBullet also lists contacts of links that are apart again
                if any(c[8] < 0.0 for c in bullet.getClosestPoints(body, body, 0.0, first, second))
            }
            seen.touched.append(touched)
            for first, second in list(misses):
                if (first, second) in touched or bullet.getClosestPoints(
                    body, body, NEAR_M, index[first], index[second]
                ):
                    seen.near[first, second] += 1
                    continue
                misses[first, second] += 1
                if misses[first, second] > max(_MISSES, (1.0 - ALWAYS) * number):
                    del misses[first, second]
    return seen
