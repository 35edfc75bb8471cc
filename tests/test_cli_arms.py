"""`plan`, `ik` and `check` for tool poses, regions, and the arm of any URDF."""

import re

import numpy as np
import pytest

from constraint_geodesics import bundle
from constraint_geodesics.constraints.constraint import Pose
from constraint_geodesics.planner import Planner
from tests.planner_fixtures import packaged_planner, pairs_of
from tests.test_cli_plan import called, error_line, strict, words_of

PANDA = ("--urdf", "franka_panda/panda.urdf", "--tool-link", "panda_grasptarget")
OWN = ("--planner", str(bundle.PACKAGED))
Q = "--start=0 -0.3 0 -2.0 0 1.8 0.5"
POSE = "0.4 0.2 0.4 3.14159265 0 0.5"


@pytest.fixture
def geodesics(monkeypatch, capfd):
    """The command in this process: its exit code and what it wrote."""

    def start(*words: str) -> tuple[int, str, str]:
        return called(monkeypatch, capfd, words)

    return start


def test_a_path_to_a_region_of_another_arm_is_planned_written_and_certified(
    geodesics, tmp_path
) -> None:
    file = str(tmp_path / "path.csv")
    free = ("--goal-free", "yaw", "--constraint", "free")
    words = ("plan", *PANDA, Q, "--goal-pose", POSE, *free, "--out", file)
    code, out, _ = geodesics(*words, "--json", "--trajectory")
    assert code == 0, out
    answer = strict(out)
    assert answer["status"] == "solved"
    last = answer["trajectory"]["points"][-1]
    duration = last["time_from_start"]["sec"] + 1e-9 * last["time_from_start"]["nanosec"]
    assert duration == pytest.approx(answer["duration_s"], abs=1e-9)
    assert len(last["positions"]) == len(answer["trajectory"]["joint_names"]) == 7
    code, out, _ = geodesics("check", file, *PANDA)
    assert (code, out.split(":")[0]) == (0, "valid")
    slower = geodesics(*words, "--json", "--velocity-scale", "0.1")[1]
    assert strict(slower)["duration_s"] > 2.0 * answer["duration_s"]


def test_a_tool_pose_moves_what_is_brought_to_the_goal(geodesics) -> None:
    numbers = "0.01 0.02 0.1 0.1 -0.4 2.0"
    words = ("plan", *PANDA, Q, "--goal-pose", POSE, "--constraint", "free", "--json")
    code, out, _ = geodesics(*words, "--trajectory", "--tool-pose", numbers)
    assert code == 0, out
    last = np.array(strict(out)["trajectory"]["points"][-1]["positions"])
    with Planner.from_urdf(PANDA[1], PANDA[3]) as bare:
        position, rotation = bare.robot.forward(last)
    tool, goal = (
        Pose.from_rpy(own[:3], own[3:])
        for own in ([float(word) for word in text.split()] for text in (numbers, POSE))
    )
    np.testing.assert_allclose(position + rotation @ tool.position, goal.position, atol=1e-4)
    np.testing.assert_allclose(rotation @ tool.rotation, goal.rotation, atol=1e-4)


def test_configurations_of_a_pose_are_printed(geodesics) -> None:
    planner, (_, goal) = packaged_planner(), pairs_of("level_cup", 1, seed=1)[0]
    position, rotation = planner.robot.forward(goal)
    pitch = -np.arcsin(rotation[2, 0])
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    pose = words_of(np.array([*position, roll, pitch, yaw]))
    code, out, _ = geodesics("ik", *OWN, f"--pose={pose}", "--json")
    answer = strict(out)
    assert code == 0
    assert answer["joint_names"] == list(planner.robot.joint_names)
    wanted = planner.ik(Pose(position, rotation))
    assert len(answer["configurations"]) == len(wanted)
    code, out, _ = geodesics("ik", *OWN, f"--pose={pose}")
    printed = np.array([line.split() for line in out.splitlines()], float)
    assert np.abs(printed[:, None] - wanted).max(axis=-1).min(axis=0).max() < 1e-6
    code, out, err = geodesics("ik", *OWN, "--pose", "3 0 0 0 0 0")
    assert (code, out) == (3, "")
    assert "reaches this pose and touches nothing" in err


def test_a_start_that_is_off_is_moved_on_request(geodesics) -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    ends = (f"--start={words_of(start + 0.002)}", f"--goal={words_of(goal)}")
    words = ("plan", *OWN, *ends, "--constraint", "level_cup")
    code, out, _ = geodesics(*words)
    assert (code, "keeps it" in out) == (3, True)
    assert geodesics(*words, "--snap")[0] == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((*PANDA, Q), "the goal is missing"),
        ((*PANDA, Q, "--goal-pose", POSE, "--goal", "0 0 0 0 0 0 0"), "or there are two"),
        ((*PANDA, Q, "--goal", "0 0 0 0 0 0 0", "--goal-free", "yaw"), "need --goal-pose"),
        ((*PANDA, Q, "--goal-pose", "0.4 0.2 0.4"), "--goal-pose.*six finite numbers"),
        ((*PANDA, Q, "--goal-pose", POSE, "--goal-free", "yow"), "free = 'yow'"),
        ((*PANDA, Q, "--goal-pose", POSE, "--goal-tolerance", "0.1 0.1"), "tolerance has 2"),
        (
            (*PANDA, Q, "--goal-pose", POSE, "--goal-tolerance", "0 0 0 10 10 0"),
            r"tolerance\[roll\] = 10: must be at most π",
        ),
        ((*PANDA, Q, "--goal-pose", POSE, "--constraint", "level_cup"), "must be one of free"),
        ((*PANDA, Q, "--goal-pose", POSE, "--velocity-scale", "2"), "velocity_scale = 2"),
        ((*PANDA[:2], Q, "--goal-pose", POSE), "which link.*geodesics robot"),
        ((*PANDA[:3], "hand", Q, "--goal-pose", POSE), "there is no link 'hand'"),
        ((*PANDA, Q, "--goal-pose", POSE, *OWN), "--urdf goes without"),
        ((*PANDA, Q, "--goal-pose", POSE, "--hold", "finger"), "joint=value"),
        ((*PANDA, Q, "--goal-pose", POSE, "--tool-pose", "1 2"), "--tool-pose.*six finite numbers"),
        ((*OWN, Q, "--goal-pose", POSE, "--tool-link", "hand"), "need --urdf"),
        (("--urdf", "no.urdf", "--tool-link", "hand", Q, "--goal-pose", POSE), "no such URDF"),
    ],
)
def test_wrong_usage_is_code_two_and_one_line(geodesics, words, said) -> None:
    given = () if "--constraint" in words else ("--constraint", "free")
    code, out, err = geodesics("plan", *words, *given)
    assert (code, out) == (2, "")
    assert re.search(said, error_line(err)), err
