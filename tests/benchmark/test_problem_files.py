"""Files of problems: MotionBenchMaker's record and MoveIt's files, dimensions and poses as there,
fingers where the file has them; and every bad file one line.
"""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from tests.benchmark.problem_fixtures import (
    JOINTS,
    LYING,
    OPEN_M,
    READY,
    TURNED,
    UPRIGHT,
    moveit_pair,
    post,
    problem,
    shape,
    small_file,
    written,
)

from constraint_geodesics.benchmark.arm_source import UrdfArm, opened
from constraint_geodesics.benchmark.problem_files import (
    FREE,
    OF_REQUEST,
    ProblemFileError,
    every,
    read_problems,
    told,
)
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.sphere import Sphere

PANDA = UrdfArm("franka_panda/panda.urdf", "panda_hand")


@pytest.mark.parametrize("name", ["small.json", "small.json.gz"])
def test_all_problems_of_a_file_are_read_in_their_order(tmp_path, name) -> None:
    found = read_problems(written(small_file(), tmp_path / name))
    assert [(own.group, own.number) for own in found] == [("posts", 0), ("posts", 1), ("crate", 0)]
    assert found[0].start.tolist() == READY
    assert found[1].start.tolist() == TURNED
    assert {own.constraint_name for own in found} == {FREE}
    assert all(own.constraint.is_free for own in found)
    assert [shape.name for shape in found[2].scene.workcell] == ["crate"]


def test_shapes_are_as_large_and_lie_where_moveit_has_them(tmp_path) -> None:
    record = small_file()
    record["scenes"] = {
        "all": [
            problem(
                shape("lid", "box", [0.1, 0.2, 0.3], [0.5, -0.1, 0.6], LYING),
                shape("bar", "cylinder", [0.8, 0.05], [1.5, 0.0, 0.4], LYING),
                shape("ball", "sphere", [0.12], [0.0, 0.9, 0.3], UPRIGHT),
            )
        ]
    }
    (found,) = read_problems(written(record, tmp_path / "all.json"))
    lid, bar, ball = found.scene.workcell
    assert isinstance(lid, Box)
    assert isinstance(bar, Cylinder)
    assert isinstance(ball, Sphere)
    # edge lengths, of a box that is turned by a quarter about y: z and x change places
    corners = np.concatenate([piece.corners for piece in lid.pieces()])
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.3, 0.2, 0.1], atol=1e-12)
    np.testing.assert_allclose(0.5 * (corners.min(0) + corners.max(0)), [0.5, -0.1, 0.6])
    # length along what was z, then the radius
    rim = np.concatenate([piece.corners for piece in bar.pieces()])
    np.testing.assert_allclose(np.ptp(rim[:, 0]), 0.8, atol=0.02)
    np.testing.assert_allclose(np.ptp(rim[:, 2]), 0.1, atol=0.01)
    assert (bar.length_m, bar.radius_m, ball.radius_m) == (0.8, 0.05, 0.12)


def test_values_are_those_of_the_joints_that_the_file_names(tmp_path) -> None:
    record = small_file()
    record["joints"] = JOINTS[::-1]
    found = read_problems(written(record, tmp_path / "small.json"))
    assert found[0].start.tolist() == READY[::-1]


def test_fingers_stand_where_the_file_has_them_beyond_their_limits_too(tmp_path) -> None:
    first = read_problems(written(small_file(), tmp_path / "small.json"))[0]
    assert isinstance(first.arm, UrdfArm)
    assert set(first.arm.beyond_limits) == {"panda_finger_joint1", "panda_finger_joint2"}
    fingers = ["panda_leftfinger", "panda_rightfinger"]
    gaps = []
    for arm in (first.arm, PANDA):
        with opened(arm).scene.world() as world:
            left, right = world.link_poses(first.start, fingers)
        gaps.append(float(np.linalg.norm(left[:3, 3] - right[:3, 3])))
    assert gaps[0] - gaps[1] == pytest.approx(2 * OPEN_M, abs=1e-6), "closed at rest"


def test_values_within_their_limits_are_held_as_they_are(tmp_path) -> None:
    record = small_file()
    record["scenes"] = {"one": [problem(open_m=0.03)]}
    (found,) = read_problems(written(record, tmp_path / "one.json"))
    assert isinstance(found.arm, UrdfArm)
    assert not found.arm.beyond_limits
    assert dict(found.arm.held) == dict.fromkeys(found.arm.others, 0.03)


def test_another_arm_can_be_named_by_the_file_or_by_who_asks(tmp_path) -> None:
    record = small_file()
    record |= {"urdf": PANDA.urdf, "tool_link": "panda_grasptarget"}
    found = read_problems(written(record, tmp_path / "own.json"))
    assert found[0].scene.robot.tool_link == "panda_grasptarget"  # in the place of its robot
    del record["robot"]
    assert read_problems(written(record, tmp_path / "own.json"))[0].arm == found[0].arm
    given = read_problems(written(small_file(), tmp_path / "small.json"), PANDA)
    assert given[0].scene.robot.tool_link == "panda_hand"


def test_every_nth_problem_is_of_each_group(tmp_path) -> None:
    record = small_file()
    record["scenes"]["posts"] *= 3
    found = every(read_problems(written(record, tmp_path / "small.json")), 3)
    assert [(own.group, own.number) for own in found] == [("posts", 0), ("posts", 3), ("crate", 0)]


def test_a_fingerprint_tells_what_an_answer_depends_on(tmp_path) -> None:
    record = small_file()
    seen = set()
    for change in (
        lambda r: None,
        lambda r: r["scenes"]["posts"][0]["shapes"][0].update(dimensions=[0.8, 0.04]),
        lambda r: r["scenes"]["posts"][0].update(goal=[*READY[:6], 0.7]),
        lambda r: r["scenes"]["posts"][0]["held"].update(panda_finger_joint1=0.01),
    ):
        changed = copy.deepcopy(record)
        change(changed)
        first = read_problems(written(changed, tmp_path / "small.json"))[0]
        seen.add(json.dumps({k: v for k, v in told(first).items() if k != "contents"}))
    assert len(seen) == 4


BAD = [
    (lambda r: r.update(robot="pr2"), "robot='pr2': known are panda: say which with --urdf"),
    (lambda r: r.pop("robot"), "robot=None: known are panda"),
    (lambda r: r.pop("joints"), "joints is missing"),
    (lambda r: r.update(urdf="kuka_iiwa/model.urdf"), "tool_link is missing: urdf and tool_link"),
    (lambda r: r.update(tool_link="panda_link8"), "urdf is missing: urdf and tool_link"),
    (lambda r: r.update(scenes={}), "scenes"),
    (lambda r: r.update(joints=JOINTS[:6]), "those of franka_panda/panda.urdf to panda_hand are"),
    (lambda r: first(r).update(start=READY[:6]), "scenes.posts[0].start: 6 numbers for 7 joints"),
    (lambda r: first(r).update(goal=[*READY[:6], "far"]), "scenes.posts.0.goal.6='far'"),
    (lambda r: first(r)["held"].update(thumb=0.1), "'thumb' can't be held"),
    (
        lambda r: first(r)["shapes"].append(post(1.0, 1.0)),
        "scenes.posts[0].shapes[1]: there is a shape called 'post' already",
    ),
    (
        lambda r: first(r)["shapes"][0].update(name="panda_link3"),
        "scenes.posts[0].shapes[0]: 'panda_link3' is a link of the robot",
    ),
    (lambda r: r["scenes"].update(crate=[]), "scenes.crate: has no problems"),
    (lambda r: first(r)["shapes"][0].update(type="cone"), "'post' is a cone: must be one of"),
    (
        lambda r: first(r)["shapes"][0].update(dimensions=[0.8, -0.03]),
        "scenes.posts[0].shapes[0]: 'post': dimensions [0.8, -0.03]: must be 2 positive numbers",
    ),
    (
        lambda r: first(r)["shapes"][0].update(orientation_xyzw=[0.0] * 4),
        "scenes.posts[0].shapes[0]: [0.0, 0.0, 0.0, 0.0]: no orientation",
    ),
    (lambda r: first(r)["shapes"][0].update(mass=1.0), "mass=1.0: there is no such parameter"),
]


def first(record):
    return record["scenes"]["posts"][0]


@pytest.mark.parametrize(("spoil", "said"), BAD)
def test_a_bad_entry_is_one_line_with_the_file(tmp_path, spoil, said) -> None:
    record = small_file()
    spoil(record)
    file = written(record, tmp_path / "bad.json")
    with pytest.raises(ProblemFileError) as raised:
        read_problems(file)
    line = str(raised.value)
    assert line.startswith(f"{file}: ")
    assert said in line
    assert "\n" not in line


def spoiled(folder: Path, content: bytes) -> Path:
    file = folder / "bad.json.gz"
    file.write_bytes(content)
    return file


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"{", "neither JSON nor MoveIt's YAML"),
        (b"\xff\xfe\x00", "neither JSON nor MoveIt's YAML"),
        (b"[1, 2]", "input should be"),
        (b"\x1f\x8b\x08\x00torn", "gzipped, and damaged"),
    ],
)
def test_what_is_no_file_of_problems_is_one_line(tmp_path, content, said) -> None:
    with pytest.raises(ProblemFileError, match=said) as raised:
        read_problems(spoiled(tmp_path, content))
    assert "\n" not in str(raised.value)


def test_a_missing_file_and_an_empty_folder_are_one_line(tmp_path) -> None:
    with pytest.raises(ProblemFileError, match="none.json: No such file"):
        read_problems(tmp_path / "none.json")
    with pytest.raises(ProblemFileError, match="has no planning scenes of MoveIt"):
        read_problems(tmp_path)


HELD = """
path_constraints:
  orientation_constraints:
    - {link_name: panda_hand, orientation: [1, 0, 0, 0], absolute_x_axis_tolerance: 0.2,
       absolute_y_axis_tolerance: 0.2, absolute_z_axis_tolerance: 3.2}
"""


def test_moveits_files_say_what_the_record_says(tmp_path) -> None:
    moveit_pair(tmp_path / "crate", "0001")
    moveit_pair(tmp_path / "crate", "0007", HELD)
    found = read_problems(tmp_path)
    assert [(own.group, own.number) for own in found] == [("crate", 1), ("crate", 7)]
    record = read_problems(written(small_file(), tmp_path / "small.json"))[-1]
    assert told(found[0]) == told(record)
    assert [own.constraint_name for own in found] == [FREE, OF_REQUEST]
    assert found[1].constraint.axes == (0, 0, 0, 1, 1, 0)
    alone = read_problems(tmp_path / "crate" / "scene0007.yaml")
    assert told(alone[0]) == told(found[1])
    arm = found[0].arm
    assert not opened(arm).scene.workcell, "what is read stays in no planner"


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("_left_7", "_right_8"), [7, 8]),
        (("_left_1", "_right_1"), [0, 1]),
        (("", "0"), [0, 1]),
        (("1", "_1_of_2", "_of_2"), [0, 1, 2]),
    ],
)
def test_numbers_that_names_do_not_tell_are_counted(tmp_path, names, numbers) -> None:
    for name in names:
        moveit_pair(tmp_path / "crate", name)
    assert [own.number for own in read_problems(tmp_path)] == numbers
    assert {own.group for own in read_problems(tmp_path / "crate")} == {"crate"}


def test_folders_that_are_named_alike_are_groups_of_their_own(tmp_path) -> None:
    for folder in ("b/tests", "a/tests", "a"):
        moveit_pair(tmp_path / folder, "1")
    assert [own.group for own in read_problems(tmp_path)] == ["a", "a/tests", "b/tests"]
    moveit_pair(tmp_path / "a" / "a", "1")
    line = "two problems are number 1 of 'a': give one another name"
    with pytest.raises(ProblemFileError, match=line):
        read_problems(tmp_path / "a")


def test_a_shape_of_moveits_that_is_named_like_a_link_is_one_line_with_the_file(tmp_path) -> None:
    moveit_pair(tmp_path / "crate", "1")
    scene = tmp_path / "crate" / "scene1.yaml"
    scene.write_text(scene.read_text().replace("id: crate", "id: panda_link3"))
    with pytest.raises(ProblemFileError, match="'panda_link3' is a link of the robot") as raised:
        read_problems(tmp_path)
    assert str(raised.value).startswith(f"{scene}: ")


def test_a_scene_without_a_request_and_a_goal_of_poses_are_refused(tmp_path) -> None:
    moveit_pair(tmp_path / "crate", "0001")
    request = tmp_path / "crate" / "request0001.yaml"
    text = request.read_text()
    head = text[: text.index("goal_constraints")]
    request.write_text(
        head
        + """
goal_constraints:
  - position_constraints:
      - link_name: panda_hand
        constraint_region:
          primitives: [{type: box, dimensions: [0.01, 0.01, 0.01]}]
          primitive_poses: [{position: [0.4, 0.2, 0.5], orientation: [0, 0, 0, 1]}]
"""
    )
    with pytest.raises(ProblemFileError, match="must be one set of joint values"):
        read_problems(tmp_path)
    request.unlink()
    with pytest.raises(ProblemFileError, match="has no request beside it: request0001.yaml"):
        read_problems(tmp_path)
