"""Which links may touch: an SRDF's word, and what sampled configurations show of an arm whose hand
turns above a table.
"""

import re
from pathlib import Path

import pytest

from constraint_geodesics.robot.description import Description, read_description
from constraint_geodesics.robot.kinematics import RobotError, load_robot
from constraint_geodesics.scene.allowed_collisions import (
    AllowedPair,
    allowed_by_sampling,
    allowed_by_srdf,
    sampled,
)

BOX = '<collision><origin xyz="{}"/><geometry><box size="{}"/></geometry></collision>'
TURN = (
    '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>'
    '<origin xyz="{3}"/><axis xyz="0 0 1"/>'
    '<limit lower="-3.141592653589793" upper="3.141592653589793" velocity="1"/></joint>'
)


def write_arm(folder: Path, above_m: float, table_x_m: float = 0.0) -> Path:
    """A table, an upper arm far above it, and a hand that ends so far above it [m]; the table is
    2 m wide, around x.
    """
    file = folder / "arm.urdf"
    file.write_text(
        '<robot name="arm">'
        f'<link name="table">{BOX.format(f"{table_x_m} 0 -0.05", "2 2 0.1")}</link>'
        f'<link name="upper">{BOX.format("0.15 0 0", "0.3 0.05 0.05")}</link>'
        f'<link name="hand">{BOX.format(f"0 0 {above_m}", "0.05 0.05 0.4")}</link>'
        '<link name="tip"/>'
        + TURN.format("shoulder", "table", "upper", "0 0 0.5")
        + TURN.format("wrist", "upper", "hand", "0.3 0 -0.3")
        + '<joint name="end" type="fixed"><parent link="hand"/><child link="tip"/></joint></robot>'
    )
    return file


@pytest.mark.parametrize(
    ("above_m", "reason"),
    [(-0.001, "always touch"), (0.0002, "always within 0.5 mm"), (0.002, None)],
)
def test_links_that_nothing_keeps_apart_may_touch(tmp_path, above_m, reason) -> None:
    robot = load_robot(write_arm(tmp_path, above_m), "hand")
    allowed, shown = allowed_by_sampling(robot, 200)
    structure = [("table", "upper", "adjacent"), ("upper", "hand", "adjacent")]
    assert list(allowed) == structure + ([("table", "hand", reason)] if reason else [])
    assert shown == ((), 1.0)


def test_links_that_touch_often_are_named_with_their_share(tmp_path) -> None:
    """The hand is over a table on one side for half of all angles."""
    robot = load_robot(write_arm(tmp_path, -0.001, table_x_m=1.0), "hand")
    allowed, shown = allowed_by_sampling(robot, 500)
    assert [pair.reason for pair in allowed] == ["adjacent", "adjacent"]
    ((first, second, share),) = shown.often
    assert (first, second) == ("table", "hand")
    assert 0.45 < share < 0.65
    assert shown.free == pytest.approx(1.0 - share)
    assert sampled(robot, 500) == shown  # of these adjacent links PyBullet looks at none


@pytest.fixture
def arm(tmp_path: Path) -> Description:
    return read_description(write_arm(tmp_path, 0.1))


def disabled(first: str, second: str, more: str = "") -> str:
    return f'<disable_collisions link1="{first}" link2="{second}"{more}/>'


DEFAULT = '<disable_default_collisions link="hand"/>'


@pytest.mark.parametrize(
    ("content", "pairs"),
    [
        ("", []),
        (disabled("hand", "table", ' reason="Never"'), [("table", "hand", "Never")]),
        (disabled("hand", "table") + disabled("table", "hand"), [("table", "hand", "SRDF")]),
        (DEFAULT, [("table", "hand", "SRDF"), ("upper", "hand", "SRDF")]),
        (DEFAULT + '<enable_collisions link1="hand" link2="table"/>', [("upper", "hand", "SRDF")]),
        (
            '<enable_collisions link1="upper" link2="table"/>' + disabled("table", "upper"),
            [("table", "upper", "SRDF")],
        ),
    ],
)
def test_an_srdf_disables_pairs_and_links_and_enables_pairs_again(
    arm, tmp_path, content, pairs
) -> None:
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(f'<robot name="arm">{content}</robot>')
    assert allowed_by_srdf(srdf, arm) == tuple(AllowedPair(*pair) for pair in pairs)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no SRDF: .*: give the path of one"),
        ("", "no SRDF: .*: give the path of one"),
        ("<html/>", "<html> is the root element: it must be <robot>"),
        (disabled("hand", "hnad"), "<disable_collisions> names the link 'hnad'"),
        (DEFAULT.replace("hand", "hnad"), "<disable_default_collisions> names the link 'hnad'"),
        ("<enable_collisions link1='hand'/>", "<enable_collisions> names the link ''"),
    ],
)
def test_what_is_no_srdf_of_the_robot_is_one_line(arm, tmp_path, content, said) -> None:
    srdf = tmp_path / "arm.srdf"
    if content is not None:
        root = content if content in ("", "<html/>") else f"<robot>{content}</robot>"
        srdf.write_text(root)
    with pytest.raises(RobotError, match=f"^{re.escape(str(srdf))}: .*{said}") as caught:
        allowed_by_srdf(srdf, arm)
    assert "\n" not in str(caught.value)
