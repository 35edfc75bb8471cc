"""Degrees where rad are asked for are recognised, and said in rad."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics import bundle
from constraint_geodesics.cli_degrees import refuse_degrees
from constraint_geodesics.planner import PlannerError
from constraint_geodesics.robot.kinematics import load_robot
from tests.planner_fixtures import nodes_of, packaged_planner, pairs_of
from tests.test_cli_plan import called, error_line, words_of

OWN = ("--planner", str(bundle.PACKAGED))
GANTRY = Path(__file__).parent / "robots" / "gantry.urdf"


@pytest.fixture
def geodesics(monkeypatch, capfd):
    """The command in this process: its exit code and what it wrote."""

    def start(*words: str) -> tuple[int, str, str]:
        return called(monkeypatch, capfd, [*words, *OWN])

    return start


def test_ends_in_degrees_are_refused_with_what_to_paste(geodesics) -> None:
    start, goal = (np.degrees(q) for q in pairs_of("level_cup", 1, seed=1)[0])
    words = ("plan", f"--start={words_of(start)}", f"--goal={words_of(goal)}")
    code, out, err = geodesics(*words, "--constraint", "level_cup")
    assert (code, out) == (2, "")
    line = error_line(err)
    assert "--start looks like degrees: joint" in line
    pasted = shlex.split(line.split("in rad: ")[1])
    assert pasted[::2] == ["--start", "--goal"]
    code, out, _ = geodesics("plan", *pasted, "--constraint", "level_cup")
    assert (code, out[:7]) == (0, "solved:")


def test_a_goal_in_degrees_beside_a_tool_pose_is_refused_too(geodesics) -> None:
    start, goal = pairs_of("level_cup", 1, seed=1)[0]
    words = (f"--start={words_of(start)}", f"--goal={words_of(np.degrees(goal))}")
    _, _, err = geodesics("plan", *words, "--constraint", "free")
    line = error_line(err)
    assert "--goal looks like degrees" in line
    pasted = shlex.split(line.split("in rad: ")[1])
    ends = [[float(x) for x in words.split()] for words in pasted[1::2]]
    assert np.array(ends) == pytest.approx(np.array([start, goal]), abs=1e-6), "the start was not"
    pose = ("--goal-pose", "0.4 0.2 0.4 180 0 30")
    code, out, err = geodesics("plan", words[0], *pose, "--constraint", "free")
    assert (code, out) == (2, "")
    line = error_line(err)
    assert "--goal-pose: roll pitch yaw = 180 0 30 look like degrees" in line
    mended = [float(word) for word in shlex.split(line.split("in rad: ")[1])[1].split()]
    assert mended == pytest.approx([0.4, 0.2, 0.4, np.pi, 0.0, np.pi / 6], abs=1e-6)


def test_a_file_in_degrees_is_refused_with_its_first_row(geodesics, tmp_path) -> None:
    path = packaged_planner().plan(*pairs_of("level_cup", 1, seed=1)[0], "level_cup")
    file, names = tmp_path / "path.csv", ",".join(packaged_planner().robot.joint_names)
    np.savetxt(file, np.degrees(path.joints), delimiter=",", header=names, comments="")
    code, out, err = geodesics("check", str(file), "--constraint", "level_cup")
    assert (code, out) == (2, "")
    line = error_line(err)
    assert line.startswith(f"error: {file} looks like degrees: joint")
    first = [float(word) for word in re.search(r"first row is (\S+)$", line)[1].split(",")]
    assert first == pytest.approx(path.joints[0], abs=1e-6)
    np.savetxt(file, path.joints + 2.0 * np.pi, delimiter=",", header=names, comments="")
    code, out, _ = geodesics("check", str(file), "--constraint", "level_cup")
    assert (code, out.split(":")[0]) == (3, "joint_limits"), "a whole turn is no degrees"


def test_no_configuration_in_rad_is_taken_for_degrees() -> None:
    """Nor one that is a whole turn off, nor what would be out of reach in degrees too."""
    robot = packaged_planner().robot
    nodes = nodes_of("free")[0][:200]
    assert nodes.shape == (200, robot.dof)
    for q in nodes:
        for off in (0.0, 2.0 * np.pi, -2.0 * np.pi):
            refuse_degrees({"--start": (q + off).tolist()}, robot)
    refuse_degrees({"--start": [1e4] * robot.dof, "--goal": None}, robot)
    refuse_degrees({"--start": [90.0]}, robot)


def test_what_slides_stays_in_metres(tmp_path) -> None:
    text = GANTRY.read_text().replace('"continuous"', '"revolute"')
    urdf = tmp_path / GANTRY.name
    urdf.write_text(text.replace("<limit velocity", '<limit lower="-3.1" upper="3.1" velocity'))
    robot = load_robot(urdf, "hand")
    slides = robot.chain.prismatic
    assert slides.any()
    q = np.where(slides, 0.3, 60.0)
    with pytest.raises(PlannerError) as refused:
        refuse_degrees({"--start": q.tolist()}, robot)
    said = shlex.split(str(refused.value).split("in rad: ")[1])[1]
    values = np.array([float(word) for word in said.split()])
    assert values == pytest.approx(np.where(slides, 0.3, np.radians(60.0)), abs=1e-6)
    refuse_degrees({"--start": np.where(slides, 30.0, 0.5).tolist()}, robot)
