"""The same question has the same answer in every process, whatever seed Python's hashes have: no
order that matters is that of a set.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from constraint_geodesics import bundle
from constraint_geodesics.identification import identify
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.trajectory import Trajectory

ROOT = Path(__file__).parents[2]
CUP = Cylinder("cup", Placement((0.0, 0.0, 0.075), (-1.5708, 0.0, 0.0)), 0.1, 0.037)
SAY = "from tests.laws.test_determinism import say; say()"


def say() -> None:
    """In a scene that has changed: what the search takes for bodies, paths, what these keep to."""
    rng = np.random.default_rng(5)
    places = rng.uniform([0.3, -0.6, 0.1], [0.8, 0.6, 0.9], (8, 3)).tolist()
    with Planner.load(bundle.PACKAGED) as planner:
        planner.scene.add(*(Sphere(f"ball{k}", tuple(at), 0.05) for k, at in enumerate(places)))
        planner.scene.attach(CUP, "link6")
        tray = Box("tray", (0.0, 0.0, 0.0), (0.05, 0.05, 0.05))
        planner.scene.attach(tray, "link2", touching=["link1", "link3", "ball1"])
        planner.scene.allow("cup", "ball3")
        planner.scene.remove("ball2", "ball5")
        pairs = planner.nodes("level_cup")[20:32].reshape(6, 2, 6)
        task = planner._preparation.task(planner.constraints["level_cup"])
        paths = [planner.plan(*pair, "level_cup") for pair in pairs]
        paths.append(planner.replan(paths[0], 0.4))
        shown = [path.joints for path in paths if path.status == "solved"]
        arrays = [one.tobytes() for one in task.clearance.arrays[:3]]
        for one in (arrays, *map(_told, paths), identify(shown, planner.robot).explanation):
            print(hashlib.sha256(repr(one).encode()).hexdigest(), repr(one)[:60])


def _told(path: Trajectory) -> list[Any]:
    told: list[Any] = [path.status, path.explanation, path.joints.tobytes(), path.times.tobytes()]
    told += [(way.source, way.length_rad) for way in path.statistics.ways]
    if path.certificate is not None:
        told += [path.certificate.rests_on, path.certificate.clearance_m]
    return told


def _said(seed: str) -> list[str]:
    environment = os.environ | {"PYTHONHASHSEED": seed}
    own = {"cwd": ROOT, "env": environment, "capture_output": True, "text": True}
    run = subprocess.run([sys.executable, "-c", SAY], check=False, **own)
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()


def test_answers_do_not_depend_on_the_order_of_sets() -> None:
    first, second = map(_said, ("0", "8"))
    assert len(first) == 9
    assert sum("['solved'" in line for line in first) >= 3
    assert first == second
