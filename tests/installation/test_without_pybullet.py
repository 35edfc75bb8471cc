"""Planning, checking and drawing without PyBullet: on a robot that is given by its own files."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.test_cli_plan import error_line

from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import Constraint
from constraint_geodesics.robot.kinematics import load_robot
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.scene import Scene

ROBOT = Path(__file__).resolve().parents[1] / "robots" / "six_axis.urdf"
POST = Box("post", (0.45, 0.0, 0.4), (0.06, 0.06, 0.8))
START, GOAL = [-0.9, 0.7, 0.6, 0.2, 0.3, 0.0], [0.8, 0.7, 0.6, 0.2, 0.3, 0.0]
BLOCKED = """
import sys
sys.modules["pybullet"] = sys.modules["pybullet_data"] = None
"""
PLANS = (
    BLOCKED
    + """
import json
from dataclasses import replace
from pathlib import Path
import numpy as np
from constraint_geodesics import Constraint, Planner
from constraint_geodesics.bundle import PACKAGED, read_bundle
from constraint_geodesics.params import RobotParams, WorkcellParams
from constraint_geodesics.scene.box import Box

given = json.loads(sys.stdin.read())
robot = RobotParams(urdf=given["urdf"], tool_link="tool")
post = Box("post", *(tuple(own) for own in given["post"]))
bundle = replace(
    read_bundle(PACKAGED), robot=robot, workcell=WorkcellParams(shapes={"post": post}), roadmaps={}
)
bundle.write(Path("planner"))
with Planner(bundle, "this test") as planner:
    level = Constraint(axes=(0, 0, 0, 1, 1, 0), tolerance=(0, 0, 0, 0.6, 0.6, 0))
    path = planner.plan(given["start"], given["goal"], level)
    start, goal = np.array(given["start"]), np.array(given["goal"])
    inside = planner.plan(0.85 * start + 0.15 * goal, goal, "free")
    certificate = path.certificate
path.save("path.csv")
path.draw("path.png")
answer = {
    "status": path.status, "line": path.explanation, "joints": path.joints.tolist(),
    "clearance": path.clearance_m, "certificate": certificate and certificate.summary(),
    "inside": inside.explanation,
}
print(json.dumps(answer))
"""
)
COMMAND = BLOCKED + "from constraint_geodesics import cli; sys.argv = {words!r}; cli.main()"


def run(program: str, folder: Path, text: str = "") -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program]
    return subprocess.run(
        command, cwd=folder, input=text, capture_output=True, text=True, check=False
    )


def test_a_path_is_planned_drawn_and_certified_round_an_obstacle(tmp_path) -> None:
    post = POST.centre_m, POST.size_m
    for file in ROBOT.parent.iterdir():  # a planner's files name what lies beside them
        (tmp_path / file.name).write_bytes(file.read_bytes())
    own = tmp_path / ROBOT.name
    given = {"urdf": str(own), "post": post, "start": START, "goal": GOAL}
    done = run(PLANS, tmp_path, json.dumps(given))
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert answer["status"] == "solved", answer["line"]
    assert answer["clearance"] > 0.0
    assert answer["certificate"]["asked_pybullet"] == 0
    assert "no PyBullet" in answer["certificate"]["rests_on"]
    assert answer["certificate"]["largest_pose_difference"] is None
    assert answer["inside"].startswith("the start touches the workcell: ")
    assert (tmp_path / "path.png").stat().st_size > 10_000

    words = ["geodesics", "check", "path.csv", "--planner", "planner"]
    checked = run(COMMAND.format(words=words), tmp_path)
    assert checked.returncode == 0, checked.stderr
    assert checked.stdout.startswith("valid: ")

    joints = np.array(answer["joints"])  # PyBullet says the same of it
    scene = Scene(load_robot(ROBOT, "tool"), (POST,))
    with Certifier(scene) as certifier, scene.world() as world:
        certificate = certifier.certify(joints, Constraint((0,) * 6))
        assert certificate.valid, certificate.violation
        assert certificate.clearance_m == pytest.approx(answer["clearance"], abs=1e-6)
        assert world.free(joints).all()


def test_what_the_proof_leaves_open_is_refused(monkeypatch) -> None:
    """Under a plate 0.05 mm above the arm PyBullet's distances decide, and nothing else does."""
    robot, upright = load_robot(ROBOT, "tool"), np.zeros((2, 6))
    upright[1] = 1e-9

    def under(height: float) -> Scene:
        return Scene(robot, (Box("plate", (0.0, 0.0, height), (2.0, 2.0, 0.1)),))

    with Certifier(under(1.28)) as certifier:
        touching = 1.28 - certifier.collisions.clearance(upright[0])
    close = under(touching + 5e-5)
    free = Constraint((0,) * 6)
    with Certifier(close) as certifier:
        certificate = certifier.certify(upright, free)
        assert certificate.valid, certificate.violation
        assert certificate.asked_pybullet
        assert certifier.collisions.is_free(upright[0])
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with Certifier(close) as certifier:
        violation = certifier.certify(upright, free).violation
        assert violation is not None
        assert violation.kind == "clearance"
        assert not certifier.collisions.is_free(upright[0])
        assert certifier.collisions.what_touches(upright[0]).startswith("the workcell: ")
    with Certifier(under(touching + 2e-4)) as certifier:
        assert certifier.certify(upright, free).valid


def test_pairs_that_may_touch_are_asked_for_in_one_line(tmp_path) -> None:
    words = ["geodesics", "robot", str(ROBOT), "--tool-link", "tool"]
    cache = f"import os; os.environ['XDG_CACHE_HOME'] = {str(tmp_path)!r}; sys.argv"
    program = COMMAND.replace("sys.argv", cache)
    done = run(program.format(words=words), tmp_path)
    assert done.returncode == 0, done.stderr
    (line,) = [own for own in done.stdout.splitlines() if "PyBullet" in own]
    assert line.startswith(f"missing: {ROBOT}: ")
    assert line.endswith("name an SRDF (--srdf), or use Python 3.11")
    srdf = tmp_path / "arm.srdf"
    srdf.write_text("<robot/>")
    done = run(program.format(words=[*words, "--srdf", str(srdf)]), tmp_path)
    assert done.returncode == 0, done.stderr
    assert "missing" not in done.stdout
    assert "looked at for collisions" in done.stdout


def test_the_arm_that_comes_with_pybullet_is_asked_for_in_one_line(tmp_path) -> None:
    ends = ("--start=0 0 -1 0 0 0", "--goal=0 0 -1 0 0 0", "--constraint=free")
    done = run(COMMAND.format(words=["geodesics", "plan", *ends]), tmp_path)
    assert done.returncode == 2
    line = error_line(done.stderr)
    assert line.startswith("error: xarm/xarm6_robot.urdf: no such URDF here, and PyBullet")
