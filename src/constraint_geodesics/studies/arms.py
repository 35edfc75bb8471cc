"""Arms as others describe them, and how long each takes from its URDF to its first certified path.

Run as a program it takes that time once, in a process that has planned nothing before.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import numpy as np

from constraint_geodesics import warmup
from constraint_geodesics.extras import MissingExtraError
from constraint_geodesics.pipeline.threads import ONE_THREAD
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.urdf import find_urdf

ROBOT_DATA = "example-robot-data"
"""The package that most of the arms come from: URDFs and meshes, no code."""
_FOLDER = "cmeel.prefix/share/example-robot-data/robots"
TRIES = 100
"""Random pairs of configurations that are asked for until one of them has a path."""


class ArmFile(NamedTuple):
    """A URDF, the link that carries the tool, and whether it is one of example-robot-data's; the
    others are pybullet_data's.  srdf: beside it, where the links that may touch are not to be found
    by sampling.
    """

    urdf: str
    tool_link: str
    in_robot_data: bool = True
    srdf: str = ""

    @property
    def path(self) -> Path:
        """Where it lies.  Raises MissingExtraError where example-robot-data is not installed."""
        return robots_folder() / self.urdf if self.in_robot_data else find_urdf(self.urdf)

    def planner(self) -> Planner:
        """A planner for it, alone in its scene."""
        srdf = robots_folder() / self.srdf if self.srdf else None
        return Planner.from_urdf(self.path, self.tool_link, srdf)


ARMS = {
    "xArm 6": ArmFile("xarm/xarm6_robot.urdf", "link6", False),
    # its upper arm's hull touches the base's wherever it turns over: its SRDF allows that
    "UR5": ArmFile(
        "ur_description/urdf/ur5_robot.urdf", "tool0", srdf="ur_description/srdf/ur5.srdf"
    ),
    "Kinova": ArmFile("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "iiwa": ArmFile("kuka_iiwa/model.urdf", "lbr_iiwa_link_7", False),
    "Panda": ArmFile("franka_panda/panda.urdf", "panda_grasptarget", False),
    "xArm 7": ArmFile("xarm_description/urdf/xarm7.urdf", "link7"),
    "PR2": ArmFile("pr2_description/urdf/pr2.urdf", "r_gripper_tool_frame"),
    "TIAGo": ArmFile("tiago_description/robots/tiago.urdf", "arm_tool_link"),
}
"""Of six joints, then of seven and more."""
SIX_JOINTS = ("xArm 6", "UR5", "Kinova")
REDUNDANT = tuple(name for name in ARMS if name not in SIX_JOINTS)
"""Those that reach a pose by families of configurations."""


def robots_folder() -> Path:
    """Folder of the robots of example-robot-data.  Raises MissingExtraError, one line, where it is
    not installed.
    """
    try:
        installed = metadata.distribution(ROBOT_DATA)
    except metadata.PackageNotFoundError:
        mend = 'pip install "constraint-geodesics[bench]" brings it'
        raise MissingExtraError(f"{ROBOT_DATA} is not installed: {mend}") from None
    return Path(str(installed.locate_file(_FOLDER)))


@dataclass(frozen=True)
class FirstPath:
    """How the first path came about.  made_s: the planner from the URDF; planned_s: from then to
    the path's certificate.  asked: pairs of configurations until one had a path.
    """

    status: str
    length_rad: float
    made_s: float
    planned_s: float
    asked: int


def first_path(arm: str, seed: int) -> FirstPath:
    """Plan between random configurations until a path is certified, in this process.

    The kernels are compiled before, and the package is imported: neither counts.  What a planner
    imports when it needs it does, and so does reading the compiled kernels.
    """
    warmup.ensure()
    rng, began = np.random.default_rng(seed), time.perf_counter()
    with ARMS[arm].planner() as planner:
        made = time.perf_counter()
        asked, solved = 0, False
        while not solved and asked < TRIES:
            start, goal = planner.robot.sample(2, rng)
            answer = planner.plan(start, goal, "free")
            asked, solved = asked + 1, answer.status == "solved"
        took = time.perf_counter() - made
    return FirstPath(answer.status, answer.length_rad, made - began, took, asked)


def first_paths(arm: str, seed: int, times: int = 2) -> list[FirstPath]:
    """The same in as many new processes one after another: the first finds an empty cache of arms,
    the others what it has kept.

    Raises RuntimeError, one line, if a process fails.
    """
    command = [sys.executable, "-P", "-m", "constraint_geodesics.studies.arms", arm, str(seed)]
    paths = os.pathsep.join(filter(None, sys.path))
    with tempfile.TemporaryDirectory() as cache:
        # the kernels are kept beside their files, and are found all the same
        own = ONE_THREAD | {"PYTHONPATH": paths, "XDG_CACHE_HOME": cache}
        found = []
        for _ in range(times):
            done = subprocess.run(
                command, env=os.environ | own, capture_output=True, text=True, check=False
            )
            if done.returncode:
                last = (done.stderr.splitlines() or [f"exit code {done.returncode}"])[-1]
                raise RuntimeError(f"{arm}: no first path: {last}")
            found.append(FirstPath(**json.loads(done.stdout.splitlines()[-1])))
    return found


if __name__ == "__main__":
    print(json.dumps(asdict(first_path(sys.argv[1], int(sys.argv[2])))))
