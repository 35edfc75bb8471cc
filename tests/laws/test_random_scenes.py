"""Random scenes and changes of them: what is certified is free by a judge of its own, a change that
fails has changed nothing, and what has followed all changes is what is made anew.

GEODESICS_RANDOM_SCENES=50 looks at so many scenes of two arms in place of a few of one.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import packaged_bundle
from tests.scene.judge import Judge
from tests.scene.random_scenes import FREE, RandomScene

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import clearance_model
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.point_cloud import PointCloud
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.scene.shape import Placement, Shape

DEEP_M = 1e-4
"""Overlap that no certified path has."""
STEP_RAD = 0.005
CHANGES, LINES, QUERIES = 24, 80, 2
FINGERS = {"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04}
MORE = int(os.environ.get("GEODESICS_RANDOM_SCENES", "0"))
SEEDS = [("xarm", seed) for seed in (1, 2, 4, 6, 13)]  # whose meshes are soon divided
if MORE:
    SEEDS = [(arm, seed) for seed in range(MORE) for arm in ("xarm", "panda")]


@cache
def planner_of(arm: str) -> Planner:
    """Among what it never meets, until that moves."""
    crate = Box("crate", (0.9, 0.9, 0.1), (0.2, 0.2, 0.2))
    if arm == "panda":
        urdf = "franka_panda/panda.urdf"
        return Planner.from_urdf(urdf, "panda_hand", hold=FINGERS, workcell=[crate])
    own = packaged_bundle()
    return Planner(replace(own, workcell=own.workcell.including(crate)), "with a crate")


@pytest.fixture(scope="module", autouse=True)
def _closed() -> Iterator[None]:
    yield
    for arm in {arm for arm, _ in SEEDS}:
        planner_of(arm).close()
    planner_of.cache_clear()


@pytest.mark.parametrize(("arm", "seed"), SEEDS)
def test_random_changes(arm: str, seed: int, tmp_path: Path) -> None:
    planner = planner_of(arm)
    first = planner.scene.now
    random = RandomScene(planner, seed, tmp_path)
    try:
        for _ in range(CHANGES):
            random.change()
            if random.rng.random() < 0.3:
                random.fail()
        is_as_made_anew(random)
        random.carry()
        random.read_anew()
        while len(free_places(random)) < 20:
            random.take_away()  # what touches for good
        touching, paths = lines_are_judged(random), paths_are_judged(random)
        if not MORE:  # of scenes by the hundred some are too full
            assert touching >= 10
            assert paths >= 1
        is_as_made_anew(random)
    except BaseException:
        print(*random.log, sep="\n")
        raise
    finally:
        planner.scene.become(first)


def free_places(random: RandomScene) -> np.ndarray:
    q = random.planner.robot.sample(200, random.rng)
    return q[random.planner._certifier.collisions.free(q)]


def is_as_made_anew(random: RandomScene) -> None:
    """Search, certificate and PyBullet."""
    planner, now = random.planner, random.now
    q, own = planner.robot.sample(50, random.rng), planner._certifier
    search = planner._preparation.task(FREE).clearance.clearance(planner.robot, q)
    fresh = clearance_model(now, own.collisions.apart).clearance(planner.robot, q)
    np.testing.assert_allclose(search, fresh, atol=1e-6)
    with Certifier(now, own.limits) as anew:
        assert own._world is not None
        assert anew._world is not None
        bodies, others = own.collisions.collider.bodies, anew.collisions.collider.bodies
        assert bodies.keys() == others.keys()
        for key, body in bodies.items():
            assert (body.frame, body.carrier) == (others[key].frame, others[key].carrier)
            for piece, other in zip(body.pieces, others[key].pieces, strict=True):
                np.testing.assert_allclose(piece.corners, other.corners, atol=1e-9)
        np.testing.assert_array_equal(own._world.free(q), anew._world.free(q))
        np.testing.assert_array_equal(own.collisions.free(q), anew.collisions.free(q))
        more = anew.collisions.apart - own.collisions.apart
        near = [own.collisions.clearance(row) for row in q]
        again = [anew.collisions.clearance(row) for row in q]
        if not more:
            np.testing.assert_allclose(near, again, atol=1e-6)
        # one that is made anew leaves out more pairs that never meet
        assert (np.array(near) <= np.array(again) + 1e-6).all()


def lines_are_judged(random: RandomScene) -> int:
    """Short lines, and how many of them touch something: none of those that do is certified,
    PyBullet's world says the same of all but surfaces, and hardly any place is refused that touches
    nothing.
    """
    own, robot, rng = random.planner._certifier, random.planner.robot, random.rng
    free = free_places(random)[: LINES // 2]
    starts = np.concatenate([free, robot.sample(LINES - len(free), rng)])
    ends = starts + rng.normal(size=starts.shape) * 0.4
    shapes = (*random.now.workcell, *(one.shape for one in random.now.attached))
    surfaces = {shape.name for shape in shapes if isinstance(shape, (Mesh, PointCloud))}
    touched = 0
    with Judge(random.now, random.bricks) as judge:
        apart = np.array([row for row in starts if judge.deepest(row)[0] > 0.0])
        assert len(apart) >= 20
        assert own._world is not None
        assert own._world.free(apart).mean() > 0.9
        assert own.collisions.free(apart).mean() > 0.9
        for line in np.stack([starts, np.clip(ends, robot.lower, robot.upper)], axis=1):
            judged = [(row, *judge.deepest(row)) for row in dense(line, 0.03)]
            touching = [(row, names) for row, least, names in judged if least < -DEEP_M]
            for row, names in touching:
                assert not own.collisions.is_free(row), names
                if surfaces.isdisjoint(names):
                    assert not own._world.is_free(row), names
            if touching:
                touched += 1
                assert own.collisions.along(line).violation is not None
    return touched


def paths_are_judged(random: RandomScene) -> int:
    """How many paths were: some of them through shapes of one query alone, and around one that is
    on the way.
    """
    planner, rng, now = random.planner, random.rng, random.now
    free, judged = free_places(random), 0
    for number in range(QUERIES if len(free) > 1 else 0):
        start, goal = free[rng.choice(len(free), 2, replace=False)]
        middle = planner.scene.link_pose(0.5 * (start + goal), random.links[-1])
        beside: Shape = random.shape(f"beside{number}")
        on_way = random.shape(f"on_way{number}").placed(Placement.of_matrix(middle))
        path = planner.plan(start, goal, "free", scene=[beside, on_way])
        assert random.now is now
        if path.status != "solved":
            continue
        asked = path.asked.scene
        assert asked.workcell == (*now.workcell, beside, on_way)
        assert (asked.attached, asked.allowed) == (now.attached, now.allowed)
        assert_free(asked, random, path.joints)
        judged += 1
    return judged


def assert_free(scene: Scene, random: RandomScene, joints: np.ndarray) -> None:
    with Judge(scene, random.bricks) as judge:
        least, what = min(judge.deepest(row) for row in dense(joints))
    assert least > -DEEP_M, what


def dense(joints: np.ndarray, step: float = STEP_RAD) -> np.ndarray:
    """The same path, with a row at least every so often [rad]."""
    rows = [joints[:1]]
    for first, last in pairwise(joints):
        count = int(np.ceil(np.linalg.norm(last - first) / step)) + 1
        rows.append(first + np.linspace(0.0, 1.0, count)[1:, None] * (last - first))
    return np.concatenate(rows)
