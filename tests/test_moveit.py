"""MoveIt's planning scenes and motion requests."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from constraint_geodesics import bundle
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.goals.region import GoalRegion
from constraint_geodesics.moveit import MoveitError, add_moveit_scene, read_moveit_request
from constraint_geodesics.planner import Planner, SceneError
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.cylinder import Cylinder
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.scene.shape import Placement
from constraint_geodesics.scene.sphere import Sphere
from tests.planner_fixtures import pairs_of

UPRIGHT = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
QUARTER = Rotation.from_euler("z", 90, degrees=True)


def pose(x: float, y: float, z: float, turn: Rotation | None = None) -> dict[str, Any]:
    own = UPRIGHT if turn is None else dict(zip("xyzw", turn.as_quat().tolist(), strict=True))
    return {"position": {"x": x, "y": y, "z": z}, "orientation": own}


def an_object(name: str, kind: Any, sizes: list[float], at: dict[str, Any], **more: Any) -> dict:
    primitive = {"type": kind, "dimensions": sizes}
    return {
        "id": name,
        "header": {"frame_id": more.pop("frame", "world")},
        "primitives": [primitive],
        "primitive_poses": [at],
        **more,
    }


def a_scene(robot_names: tuple[str, ...]) -> dict[str, Any]:
    lists = {"position": [0.4, 0.3, 0.2], "orientation": [0.0, 0.0, 0.0, 1.0]}
    tetrahedron = {
        "vertices": [
            pose(*at)["position"] for at in ((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1))
        ],
        "triangles": [{"vertex_indices": f} for f in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))],
    }
    names = ["crate", "link6", "cup", "elsewhere"]
    return {
        "name": "scene",
        "robot_state": {
            "joint_state": {"name": list(robot_names), "position": [0.1] * len(robot_names)},
            "attached_collision_objects": [
                {
                    "link_name": "link6",
                    "touch_links": ["link5"],
                    "object": an_object("cup", 3, [0.1, 0.03], pose(0, 0, 0.07), frame="link6"),
                }
            ],
        },
        "world": {
            "octomap": {"octomap": {"data": []}},
            "collision_objects": [
                an_object(
                    "crate", 1, [0.1, 0.2, 0.3], pose(0.1, 0, 0), pose=pose(0.4, 0.2, 0.1, QUARTER)
                ),
                an_object("ball", "sphere", [0.05], lists),
                an_object("can", "cylinder", [0.2, 0.03], pose(-0.4, 0.3, 0.2), frame="link_base"),
                {
                    "id": "wedge",
                    "header": {"frame_id": ""},
                    "meshes": [tetrahedron],
                    "mesh_poses": [pose(0.5, -0.5, 0.1)],
                },
            ],
        },
        "allowed_collision_matrix": {
            "entry_names": names,
            "entry_values": [
                {"enabled": [a != b and "crate" in (a, b) for b in names]} for a in names
            ],
            "default_entry_names": ["ball"],
            "default_entry_values": [True],
        },
    }


@pytest.fixture
def planner() -> Iterator[Planner]:
    with Planner.load(bundle.PACKAGED) as loaded:
        yield loaded


def written(folder: Path, what: Any) -> Path:
    file = folder / "own.yaml"
    with file.open("w") as out:
        YAML(typ="safe", pure=True).dump(what, out)
    return file


def test_objects_come_where_they_are(planner: Planner, tmp_path: Path) -> None:
    file = written(tmp_path, a_scene(planner.robot.joint_names))
    joints = add_moveit_scene(file, planner.scene)
    assert list(joints) == list(planner.robot.joint_names)
    table, crate, ball, can, wedge = planner.scene.workcell
    assert table.name == "table"
    assert isinstance(crate, Box)
    # the box lies 0.1 m along the turned x axis of its object
    np.testing.assert_allclose(crate.centre_m, (0.4, 0.3, 0.1), atol=1e-12)
    assert crate.rpy_rad == pytest.approx((0.0, 0.0, 0.5 * math.pi))
    assert crate.size_m == (0.1, 0.2, 0.3)
    assert ball == Sphere("ball", (0.4, 0.3, 0.2), 0.05)
    assert can == Cylinder("can", Placement((-0.4, 0.3, 0.2)), 0.2, 0.03)
    assert isinstance(wedge, Mesh)
    assert wedge.at == Placement((0.5, -0.5, 0.1))
    assert len(wedge.pieces()) == 1
    (cup,) = planner.scene.attached
    assert cup.shape == Cylinder("cup", Placement((0.0, 0.0, 0.07)), 0.1, 0.03)
    assert (cup.link, cup.touching) == ("link6", ("link5",))
    allowed = planner.scene.now.allowed
    assert {("crate", "link6"), ("crate", "cup")} <= allowed
    assert ("cup", "link6") not in allowed  # the matrix says so, and its default none
    assert ("ball", "link3") in allowed
    assert not any("elsewhere" in pair for pair in allowed)


def test_of_two_defaults_both_must_allow(planner: Planner, tmp_path: Path) -> None:
    raw = a_scene(planner.robot.joint_names)
    raw["allowed_collision_matrix"] |= {
        "default_entry_names": ["ball", "link3"],
        "default_entry_values": [True, False],
    }
    add_moveit_scene(written(tmp_path, raw), planner.scene)
    allowed = planner.scene.now.allowed
    assert ("ball", "link4") in allowed
    assert ("ball", "link3") not in allowed


def test_what_is_attached_in_the_base_frame_is_where_the_arm_has_it(
    planner: Planner, tmp_path: Path
) -> None:
    raw, q = a_scene(planner.robot.joint_names), np.full(6, 0.1)
    place = planner.scene.link_pose(q, "link6") @ Placement((0.0, 0.0, 0.07)).matrix
    quaternion = Rotation.from_matrix(place[:3, :3])
    cup = raw["robot_state"]["attached_collision_objects"][0]["object"]
    cup |= {
        "header": {"frame_id": "world"},
        "primitive_poses": [pose(*place[:3, 3].tolist(), quaternion)],
    }
    add_moveit_scene(written(tmp_path, raw), planner.scene)
    (held,) = planner.scene.attached
    np.testing.assert_allclose(held.shape.at.matrix, Placement((0.0, 0.0, 0.07)).matrix, atol=1e-9)


def between(parent: str, child: str, above_m: float) -> dict[str, Any]:
    """A geometry_msgs/TransformStamped."""
    transform = {"translation": {"x": 0.0, "y": 0.0, "z": above_m}, "rotation": UPRIGHT}
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": transform}


def test_transforms_that_say_what_is_taken_for_granted_are_fine(
    planner: Planner, tmp_path: Path
) -> None:
    raw = a_scene(planner.robot.joint_names)
    raw["fixed_frame_transforms"] = [
        between("world", "world", 0.0),
        between("link_base", "world", 0.0),
        between("world", "camera", 1.0),  # nothing refers to it
    ]
    add_moveit_scene(written(tmp_path, raw), planner.scene)
    assert len(planner.scene.workcell) == 5


def of_two_parts(name: str, **more: Any) -> dict[str, Any]:
    """A cup with its handle."""
    cup = an_object(name, 3, [0.1, 0.03], pose(0, 0, 0.07), **more)
    cup["primitives"].append({"type": 1, "dimensions": [0.02, 0.02, 0.05]})
    cup["primitive_poses"].append(pose(0.04, 0, 0.07))
    return cup


def test_an_attached_object_takes_no_other_ones_place(planner: Planner, tmp_path: Path) -> None:
    """Its parts have made-up names; what stood around the arm under its own goes, whole."""
    raw = a_scene(planner.robot.joint_names)
    (held,) = raw["robot_state"]["attached_collision_objects"]
    held["object"] = of_two_parts("cup", frame="link6")
    objects, standing = raw["world"]["collision_objects"], pose(0.5, 0, 0.3)
    objects.append(an_object("cup_2", 3, [0.1, 0.03], standing))
    before = planner.scene.now
    with pytest.raises(MoveitError, match="its part 'cup_2' is called as another object"):
        add_moveit_scene(written(tmp_path, raw), planner.scene)
    assert planner.scene.now is before
    planner.scene.add(Box("cup", (0.5, 0.0, 0.3), (0.1, 0.1, 0.1)))
    before = planner.scene.now
    objects.pop()
    held["object"] = an_object("cup", 3, [0.1, 0.03], pose(0, 0, 0.07), frame="link6")
    with pytest.raises(MoveitError, match="its part 'cup' is called as another object"):
        add_moveit_scene(written(tmp_path, raw), planner.scene)
    assert planner.scene.now is before, "what is not the file's own stays"
    planner.scene.remove("cup")
    objects.append(of_two_parts("cup", pose=standing))
    held["object"] = an_object("cup", 3, [0.1, 0.03], pose(0, 0, 0.07), frame="link6")
    add_moveit_scene(written(tmp_path, raw), planner.scene)
    assert [one.name for one in planner.scene.attached] == ["cup"]
    assert not {"cup", "cup_2"} & {shape.name for shape in planner.scene.workcell}


def set_in(raw: Any, path: str, value: Any) -> Any:
    at = raw
    *outer, last = [int(p) if p.isdigit() else p for p in path.split(".")]
    for part in outer:
        at = at[part]
    at[last] = value
    return raw


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("world.collision_objects.0.primitives.0.type", 4, "is a cone"),
        ("world.collision_objects.0.primitives.0.type", "blob", "is a blob"),
        ("world.collision_objects.0.primitives.0.dimensions", [1, -1, 1], "3 positive numbers"),
        ("world.collision_objects.0.primitives.0.dimensions", [1], "3 positive numbers"),
        ("world.collision_objects.0.primitives.0.dimensions", "111", "dimensions: must be a list"),
        ("world.collision_objects.0.primitive_poses.0.position", "123", "3 finite numbers"),
        ("world.collision_objects.0.primitive_poses", [], "1 primitives, 0 primitive_poses"),
        ("world.collision_objects.0.primitives", [], "0 primitives, 1 primitive_poses"),
        ("world.collision_objects.0.planes", [{"coef": [0, 0, 1, 0]}], "plane"),
        ("world.collision_objects.0.header.frame_id", "link6", "moves with the arm"),
        ("world.collision_objects.0.header.frame_id", "map", "no link of the robot"),
        ("world.collision_objects.0.primitive_poses.0.orientation", [0, 0, 0, 0], "no orientation"),
        (
            "world.collision_objects.1.primitive_poses.0.position",
            [0, 0],
            "own.yaml: world.collision_objects[1]: [0, 0]: must be 3 finite numbers",
        ),
        (
            "world.collision_objects.2.primitives.0",
            {"type": 1},
            "own.yaml: world.collision_objects[2]: 'dimensions' is missing",
        ),
        (
            "world.collision_objects.0.id",
            "table",
            "own.yaml: world.collision_objects[0]: there is a shape called 'table' already",
        ),
        (
            "robot_state.attached_collision_objects.0.object",
            {"id": "cup"},
            "own.yaml: robot_state.attached_collision_objects[0]: 'cup' has neither",
        ),
        (
            "fixed_frame_transforms",
            [{"child_frame_id": "world", "transform": {"translation": [0, 0, 0]}}],
            "own.yaml: fixed_frame_transforms[0]: 'rotation' is missing",
        ),
        ("world.collision_objects.3.meshes.0.triangles", [], "no faces"),
        ("world.collision_objects", {"crate": 1}, "must be a list"),
        ("world.octomap.octomap.data", [1, 2], "octomap"),
        ("robot_state.attached_collision_objects.0.link_name", "hand", "'hand'"),
        ("robot_state.joint_state.position", [0.0], "6 names, 1 positions"),
        ("allowed_collision_matrix.entry_values", [], "4 names, 0 rows"),
        ("world", 3, "world = 3: must be entries"),
        ("world.collision_objects.0.operation", 1, "objects are added alone"),
        ("link_padding", [{"link_name": "link3", "padding": 0.01}], "link_padding"),
        ("link_scale", [{"link_name": "link3", "scale": 1.1}], "link_scale"),
        ("robot_state.multi_dof_joint_state", {"joint_names": ["base"]}, "multi_dof_joint_state"),
        ("robot_state.joint_state.velocity", [0, 0, 0.1, 0, 0, 0], "motions begin at rest"),
        ("fixed_frame_transforms", [between("link_base", "world", -0.8)], "'world' in 'link_base'"),
        ("fixed_frame_transforms", [between("map", "world", 0.1)], "'world' in 'map'"),
        ("fixed_frame_transforms", [between("world", "link_base", 0.8)], "'link_base' in 'world'"),
        ("allowed_collision_matrix.default_entry_values", [], "1 default names, 0 values"),
    ],
)
def test_what_can_not_be_kept_is_named(
    planner: Planner, tmp_path: Path, path: str, value: Any, said: str
) -> None:
    before, raw = planner.scene.now, set_in(a_scene(planner.robot.joint_names), path, value)
    with pytest.raises((MoveitError, SceneError, ValueError)) as error:
        add_moveit_scene(written(tmp_path, raw), planner.scene)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert planner.scene.now is before


@pytest.mark.parametrize(
    ("triangles", "said"),
    [
        ([], "no mesh: has no faces, or corners that are no finite numbers"),
        ([[0, 1, 9]], "no mesh: a face with a corner that is not there"),
        ([[0, 1, -2]], "no mesh: a face with a corner that is not there"),
        ([[0, 1, 2.9]], "no mesh: a face with a corner that is not there"),
        ([[0, 1, 2]], "a mesh without volume can't be bounded: take a box in its place"),
    ],
)
def test_a_fault_of_an_inline_mesh_is_told_by_its_object(
    planner: Planner, tmp_path: Path, triangles: list[list[int]], said: str
) -> None:
    """Not by a file that no user has written."""
    raw = a_scene(planner.robot.joint_names)
    (mesh,) = raw["world"]["collision_objects"][3]["meshes"]
    mesh["triangles"] = triangles
    if triangles == [[0, 1, 2]]:
        mesh["vertices"].pop()
    file = written(tmp_path, raw)
    with pytest.raises(MoveitError) as error:
        add_moveit_scene(file, planner.scene)
    assert str(error.value) == f"{file}: world.collision_objects[3]: 'wedge': {said}"


def a_request(planner: Planner) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    start, goal = pairs_of("free", 1, seed=1)[0]
    names = list(planner.robot.joint_names)
    joints = [
        {"joint_name": name, "position": value, "tolerance_above": 0.01, "tolerance_below": 0.01}
        for name, value in zip(names, goal.tolist(), strict=True)
    ]
    state = {"joint_state": {"name": names, "position": start.tolist()}}
    raw = {
        "group_name": "xarm6",
        "start_state": state,
        "goal_constraints": [{"joint_constraints": joints}],
        "max_velocity_scaling_factor": 0.5,
        "max_acceleration_scaling_factor": 0.0,
        "allowed_planning_time": 5.0,
    }
    return raw, start, goal


def test_a_request_is_planned(planner: Planner, tmp_path: Path) -> None:
    raw, start, goal = a_request(planner)
    request = read_moveit_request(written(tmp_path, raw), planner)
    assert (request.velocity_scale, request.acceleration_scale) == (0.5, 1.0)
    path = planner.plan(
        request.start, request.goals, request.constraint, velocity_scale=request.velocity_scale
    )
    assert path.status == "solved"
    np.testing.assert_array_equal(path.joints[[0, -1]], [start, goal])


def test_the_state_of_a_scene_is_where_a_request_begins(planner: Planner, tmp_path: Path) -> None:
    raw, start, _ = a_request(planner)
    del raw["start_state"]
    with pytest.raises(MoveitError, match="start_state: has no value for joint1"):
        read_moveit_request(written(tmp_path, raw), planner)
    state = dict(zip(planner.robot.joint_names, start.tolist(), strict=True))
    assert read_moveit_request(written(tmp_path, raw), planner, state).start == start.tolist()


def of_pose(planner: Planner, tolerances: tuple[float, float, float], turn: Rotation) -> dict:
    link = planner.robot.tool_link
    quaternion = dict(zip("xyzw", turn.as_quat().tolist(), strict=True))
    widths = {f"absolute_{k}_axis_tolerance": t for k, t in zip("xyz", tolerances, strict=True)}
    region = {
        "primitives": [{"type": 1, "dimensions": [0.02, 0.04, 0.06]}],
        "primitive_poses": [pose(0.4, 0.1, 0.3)],
    }
    return {
        "position_constraints": [{"link_name": link, "constraint_region": region}],
        "orientation_constraints": [{"link_name": link, "orientation": quaternion, **widths}],
    }


def test_a_pose_with_tolerances_is_a_region(planner: Planner, tmp_path: Path) -> None:
    raw, _, _ = a_request(planner)
    down = Rotation.from_euler("x", 180, degrees=True)
    raw["goal_constraints"] = [of_pose(planner, (0.1, 0.2, math.pi), down)]
    (goal,) = read_moveit_request(written(tmp_path, raw), planner).goals
    assert isinstance(goal, GoalRegion)
    assert list(goal.free) == ["yaw"]
    np.testing.assert_allclose(goal.tolerance, (0.01, 0.02, 0.03, 0.1, 0.1, 0.0))
    np.testing.assert_allclose(goal.pose.position, (0.4, 0.1, 0.3))
    np.testing.assert_allclose(goal.pose.rotation, down.as_matrix(), atol=1e-12)
    for written_as, free in ((3.14, ["yaw"]), (3.0, [])):
        raw["goal_constraints"] = [of_pose(planner, (0.1, 0.2, written_as), down)]
        (goal,) = read_moveit_request(written(tmp_path, raw), planner).goals
        assert list(goal.free) == free


def test_an_axis_is_along_the_bases_to_the_digits_that_files_have(
    planner: Planner, tmp_path: Path
) -> None:
    raw, _, _ = a_request(planner)
    for roll, is_along in ((3.14159, True), (3.1416, True), (math.pi - 1e-4, False)):
        turn = Rotation.from_euler("x", roll)
        raw["goal_constraints"] = [of_pose(planner, (0.1, 0.2, 3.14), turn)]
        if is_along:
            assert read_moveit_request(written(tmp_path, raw), planner).goals
        else:
            with pytest.raises(MoveitError, match="the z axis is free"):
                read_moveit_request(written(tmp_path, raw), planner)


def test_tolerances_about_other_axes_than_the_bases_become_the_least(
    planner: Planner, tmp_path: Path
) -> None:
    """All that is kept then, MoveIt's tolerances keep too; a free axis has no such bound."""
    raw, _, _ = a_request(planner)
    askew = Rotation.from_euler("xyz", [0.4, 0.7, -0.3])
    raw["goal_constraints"] = [of_pose(planner, (0.1, 0.2, 0.3), askew)]
    (goal,) = read_moveit_request(written(tmp_path, raw), planner).goals
    assert goal.tolerance[3:] == pytest.approx((0.1, 0.1, 0.1))
    raw["goal_constraints"] = [of_pose(planner, (0.1, 0.2, 4.0), askew)]
    with pytest.raises(MoveitError, match="the z axis is free"):
        read_moveit_request(written(tmp_path, raw), planner)


def test_a_held_orientation_is_a_constraint(planner: Planner, tmp_path: Path) -> None:
    raw, _, _ = a_request(planner)
    own = of_pose(planner, (0.1, 0.1, 3.2), Rotation.identity())["orientation_constraints"]
    raw["path_constraints"] = {"orientation_constraints": own}
    kept = read_moveit_request(written(tmp_path, raw), planner).constraint
    assert kept.axes == (0, 0, 0, 1, 1, 0)
    assert kept.tolerance == (0.0, 0.0, 0.0, 0.1, 0.1, 0.0)
    assert kept.is_placed
    raw["path_constraints"] = {"position_constraints": [{}]}
    with pytest.raises(MoveitError, match=r"path_constraints\.position_constraints"):
        read_moveit_request(written(tmp_path, raw), planner)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("goal_constraints", [], "there is none"),
        ("goal_constraints.0.joint_constraints", [], "must be joints, or one position"),
        (
            "goal_constraints.0.joint_constraints.0.joint_name",
            "elbow",
            "elbow is no joint that is planned",
        ),
        (
            "goal_constraints.0.joint_constraints.0.position",
            "far",
            "own.yaml: goal_constraints[0]: could not convert",
        ),
        (
            "path_constraints",
            {"orientation_constraints": [{"orientation": [0, 0, 0, 1]}]},
            "own.yaml: path_constraints: 'absolute_x_axis_tolerance' is missing",
        ),
        ("start_state.joint_state.name", ["joint1"], "1 names, 6 positions"),
        ("max_velocity_scaling_factor", "fast", "could not convert"),
        ("max_cartesian_speed", 0.2, "max_cartesian_speed"),
        ("trajectory_constraints", {"constraints": [{}]}, "trajectory_constraints"),
        ("start_state.attached_collision_objects", [{}], "attached_collision_objects"),
        ("start_state.multi_dof_joint_state", {"joint_names": ["base"]}, "multi_dof_joint_state"),
        ("start_state.joint_state.velocity", [0.1], "motions begin at rest"),
    ],
)
def test_what_is_no_request_is_named(
    planner: Planner, tmp_path: Path, path: str, value: Any, said: str
) -> None:
    raw = set_in(a_request(planner)[0], path, value)
    with pytest.raises(MoveitError) as error:
        read_moveit_request(written(tmp_path, raw), planner)
    assert said in str(error.value)
    assert str(error.value).startswith(str(tmp_path))


def test_a_file_that_is_none_is_one_line(planner: Planner, tmp_path: Path) -> None:
    for text, said in (("a: [", "not YAML"), ("- 1", "must be entries"), ("", "must be entries")):
        (tmp_path / "own.yaml").write_text(text)
        with pytest.raises(MoveitError, match=said):
            add_moveit_scene(tmp_path / "own.yaml", planner.scene)
        with pytest.raises(MoveitError, match=said):
            read_moveit_request(tmp_path / "own.yaml", planner)


FREE = 4.0
PATTERNS = [
    *[(None, own) for own in ((0.1, 0.1, 0.1), (1.0, 1.0, 0.2), (0.6, 0.1, 0.9))],
    *[(None, own) for own in ((0.3, 0.2, FREE), (FREE, 0.3, 0.2))],
    *[(None, own) for own in ((2.0, 2.5, 2.0), (1.8, 2.0, FREE))],
    *[(1, own) for own in ((0.3, 0.2, 0.1), (FREE, FREE, 0.3), (FREE, 0.3, FREE))],
]
TURNS = [(0, 0, 0), (math.pi, 0, 0), (0, 0, math.pi / 2), (math.pi / 2, 0, math.pi / 2)]


def moveit_keeps(off: Rotation, tolerances: tuple[float, ...], vectors: bool) -> bool:
    """Its test of a rotation away from the one that is wanted, about that one's axes."""
    angles = np.abs(off.as_rotvec() if vectors else off.as_euler("XYZ"))
    return bool((angles <= np.array(tolerances) + 1e-6).all())


@pytest.mark.parametrize(("parameterization", "tolerances"), PATTERNS)
@pytest.mark.parametrize("turn", TURNS)
def test_what_is_kept_here_moveit_keeps(
    planner: Planner,
    tmp_path: Path,
    parameterization: int | None,
    tolerances: tuple[float, float, float],
    turn: tuple[float, float, float],
) -> None:
    """Configurations of the path constraint, by MoveIt's formulas."""
    raw, _, _ = a_request(planner)
    wanted = Rotation.from_euler("xyz", turn)
    (own,) = of_pose(planner, tolerances, wanted)["orientation_constraints"]
    if parameterization is not None:
        own["parameterization"] = parameterization
    raw["path_constraints"] = {"orientation_constraints": [own]}
    kept = read_moveit_request(written(tmp_path, raw), planner).constraint
    manifold = ConstraintManifold(planner.robot, kept)
    rng = np.random.default_rng(0)
    # within, and at the edge
    share = rng.choice([1.0, 0.6], 1500)
    found = retract(manifold, planner.robot.sample(1500, rng), Retraction(), band=share)
    q = found.joints[found.converged]
    assert len(q) > 100
    reached = Rotation.from_matrix(planner.robot.forward(q)[1])
    for one in wanted.inv() * reached:
        assert moveit_keeps(one, tolerances, parameterization == 1)


@pytest.mark.parametrize(
    ("parameterization", "tolerances"),
    [
        *[(None, (0.3, FREE, 0.3)), (None, (FREE, FREE, 0.3)), (0, (FREE, 0.3, FREE))],
        *[(1, (0.3, 0.2, FREE)), (1, (FREE, 0.3, 0.2)), (1, (0.3, FREE, 0.3))],
    ],
)
def test_what_no_constraint_lies_within_is_refused(
    planner: Planner, tmp_path: Path, parameterization: int | None, tolerances: Any
) -> None:
    raw, _, _ = a_request(planner)
    (own,) = of_pose(planner, tolerances, Rotation.identity())["orientation_constraints"]
    if parameterization is not None:
        own["parameterization"] = parameterization
    raw["path_constraints"] = {"orientation_constraints": [own]}
    with pytest.raises(MoveitError, match="no constraint here lies within that"):
        read_moveit_request(written(tmp_path, raw), planner)


def test_texts_are_no_flags(planner: Planner, tmp_path: Path) -> None:
    raw = a_scene(planner.robot.joint_names)
    raw["allowed_collision_matrix"]["default_entry_values"] = ["no"]
    with pytest.raises(MoveitError, match="'no': must be true or false"):
        add_moveit_scene(written(tmp_path, raw), planner.scene)


def test_poses_are_in_the_frame_that_their_header_names(planner: Planner, tmp_path: Path) -> None:
    raw, _, _ = a_request(planner)
    raw["goal_constraints"] = [of_pose(planner, (0.1, 0.1, 0.1), Rotation.identity())]
    for kind in ("position_constraints", "orientation_constraints"):
        moved = raw["goal_constraints"][0][kind][0]
        moved["header"] = {"frame_id": "link6"}
        with pytest.raises(MoveitError, match="moves with the arm"):
            read_moveit_request(written(tmp_path, raw), planner)
        moved["header"] = {"frame_id": "map"}
        with pytest.raises(MoveitError, match="no link of the robot"):
            read_moveit_request(written(tmp_path, raw), planner)
        moved["header"] = {"frame_id": "link_base"}
    (goal,) = read_moveit_request(written(tmp_path, raw), planner).goals
    np.testing.assert_allclose(goal.pose.position, (0.4, 0.1, 0.3))
    own = of_pose(planner, (0.1, 0.1, 0.1), Rotation.identity())["orientation_constraints"]
    own[0]["header"] = {"frame_id": "link6"}
    raw["path_constraints"] = {"orientation_constraints": own}
    with pytest.raises(MoveitError, match="moves with the arm"):
        read_moveit_request(written(tmp_path, raw), planner)


def test_nothing_of_a_request_is_dropped(planner: Planner, tmp_path: Path) -> None:
    raw, _, _ = a_request(planner)
    raw["goal_constraints"][0] |= of_pose(planner, (0.1, 0.1, 0.1), Rotation.identity())
    with pytest.raises(MoveitError, match="goes without joint_constraints"):
        read_moveit_request(written(tmp_path, raw), planner)
    raw, _, _ = a_request(planner)
    raw["goal_constraints"][0]["joint_constraints"].append({"joint_name": "lift", "position": 1})
    with pytest.raises(MoveitError, match="lift is no joint that is planned"):
        read_moveit_request(written(tmp_path, raw), planner)
    raw, _, _ = a_request(planner)
    raw["start_state"]["joint_state"]["position"][2] = math.nan
    with pytest.raises(MoveitError, match="joint3 is nan"):
        read_moveit_request(written(tmp_path, raw), planner)


def test_a_scene_of_another_format_and_rows_that_disagree(planner: Planner, tmp_path: Path) -> None:
    with pytest.raises(MoveitError, match="neither world nor robot_state"):
        add_moveit_scene(written(tmp_path, {"shapes": {}}), planner.scene)
    raw = a_scene(planner.robot.joint_names)
    raw["allowed_collision_matrix"] = {
        "entry_names": ["crate", "link6", "table"],
        "entry_values": [
            {"enabled": [False, True, True]},
            {"enabled": [False, False, False]},
            {"enabled": [True, False, False]},
        ],
    }
    add_moveit_scene(written(tmp_path, raw), planner.scene)
    assert planner.scene.now.allowed == {("crate", "table")}
