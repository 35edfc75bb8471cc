"""`geodesics robot`: what is understood of somebody's URDF, and what is wrong with it."""

from pathlib import Path

import pytest

from constraint_geodesics.scene.urdf import data_path
from tests.robot.test_description import ARM
from tests.test_cli_plan import called, strict

PANDA = data_path() / "franka_panda" / "panda.urdf"


@pytest.fixture
def robot(monkeypatch, capfd):
    """The command in this process: its exit code and what it wrote."""

    def start(*words: str) -> tuple[int, str, str]:
        return called(monkeypatch, capfd, ("robot", *words))

    return start


def test_without_a_tool_link_those_there_are_are_listed(robot) -> None:
    code, out, _ = robot(str(PANDA))
    assert code == 0
    assert "panda_grasptarget: carried by 7 joints" in out
    code, out, _ = robot(str(PANDA), "--json")
    assert strict(out)["tool_links"]["panda_grasptarget"] == 7


def test_chain_held_joints_and_pairs_are_told(robot) -> None:
    words = (str(PANDA), "--tool-link", "panda_grasptarget", "--hold", "panda_finger_joint1=0.03")
    code, out, err = robot(*words, "--json")
    assert (code, err) == (0, "")
    about = strict(out)
    assert [joint["name"] for joint in about["joints"]] == [f"panda_joint{k}" for k in range(1, 8)]
    assert about["joints"][0] == {
        "name": "panda_joint1",
        "type": "revolute",
        "lower": -2.9671,
        "upper": 2.9671,
        "velocity": 2.175,
    }
    assert about["held"]["panda_finger_joint1"] == 0.03
    reasons = {tuple(pair["links"]): pair["reason"] for pair in about["may_touch"]}
    assert reasons["panda_link6", "panda_link7"] == "adjacent"
    assert reasons["panda_link7", "panda_hand"] == "rigid"
    assert ("panda_link5", "panda_hand") not in reasons
    assert about["missing"] == []
    assert about["pairs_looked_at"] == 55 - len(about["may_touch"])
    assert 0.7 < about["free_share"] < 0.9
    assert about["touch_often"] == []
    code, out, _ = robot(*words)
    assert code == 0
    assert "panda_joint7: revolute" in out
    assert "may touch, rigid: panda_link7 with panda_hand" in out
    share = f"{100.0 * about['free_share']:.3g}"
    assert f"free of self-collision: {share} % of 2,000 sampled configurations" in out


def test_an_srdf_says_which_links_may_touch(robot, tmp_path: Path) -> None:
    srdf = tmp_path / "panda.srdf"
    srdf.write_text(
        '<robot name="panda"><disable_collisions link1="panda_link2" link2="panda_link0" '
        'reason="Never"/></robot>'
    )
    words = (str(PANDA), "--tool-link", "panda_hand", "--srdf", str(srdf))
    code, out, _ = robot(*words, "--json")
    assert code == 0
    pairs = [{"links": ["panda_link0", "panda_link2"], "reason": "Never"}]
    about = strict(out)
    assert about["may_touch"] == pairs
    # of 55 pairs 10 hang on each other, but for the fingers beside the hand; the SRDF has one more
    assert about["pairs_looked_at"] == 55 - 9 - 1
    # the last link and the hand behind it, which no SRDF allows here, are within each other
    assert about["free_share"] == 0.0
    assert {"links": ["panda_link7", "panda_hand"], "share": 1.0} in about["touch_often"]
    assert "look at: panda_link7 with panda_hand touch at 100 %" in robot(*words)[1]
    srdf.write_text(srdf.read_text().replace("panda_link2", "link2"))
    code, out, err = robot(*words)
    assert (code, out) == (2, "")
    assert f"{srdf}: <disable_collisions> names the link 'link2'" in err


def test_what_is_missing_comes_with_its_mend(robot, tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    text = ARM.replace(' velocity="2"', "").replace(
        '<link name="hand"/>',
        '<link name="hand"><visual><geometry><sphere radius="1"/></geometry></visual></link>',
    )
    file.write_text(text)
    code, out, _ = robot(str(file), "--tool-link", "hand", "--json")
    assert code == 0
    speed, shape = strict(out)["missing"]
    assert speed.startswith("roll has no velocity: give <limit velocity")
    assert shape.startswith("hand is drawn but has no <collision>")
    file.write_text(ARM.replace('<box size="0.1 0.1 1"/>', '<box size="0 1 1"/>'))
    (line,) = strict(robot(str(file), "--tool-link", "hand", "--json")[1])["missing"]
    assert "box" in line
    assert str(file) in line


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("missing.urdf",), "missing.urdf: no such URDF"),
        ((str(PANDA.parent),), "is a folder"),
        ((str(PANDA), "--tool-link", "hand"), "there is no link 'hand'"),
        ((str(PANDA), "--tool-link", "panda_hand", "--hold", "x"), "--hold 'x'"),
        ((str(PANDA), "--tool-link", "panda_hand", "--hold", "x=1"), "'x' can't be held"),
        ((str(PANDA), "--tool-link", "panda_hand", "--hold", "panda_joint1=nan"), "a number"),
        ((str(PANDA), "--tool-link", "panda_hand", "--hold", "panda_joint1=inf"), "a number"),
        ((str(PANDA), "--tool-link", "panda_hand", "--hold", "panda_joint1=1e10"), "hold"),
    ],
)
def test_wrong_usage_is_one_line(robot, words: tuple[str, ...], said: str) -> None:
    code, out, err = robot(*words)
    assert (code, out) == (2, "")
    assert said in err
    assert len(err.strip().splitlines()) == 1
