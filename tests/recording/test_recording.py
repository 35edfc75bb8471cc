"""Recordings are written with real robots and meshes, read back from the file, and compared."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from scipy.spatial.transform import Rotation
from tests.recording.files import (
    CHANGE,
    HELD_AT,
    START,
    TABLE,
    TRAY,
    batches,
    column,
    same_recordings,
    timelines,
)

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold, Pose
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.geometry.braking import Pace
from constraint_geodesics.params import PlannerParams
from constraint_geodesics.recording.goal import GoalView
from constraint_geodesics.recording.recorder import status_text
from constraint_geodesics.recording.recording import (
    About,
    LatentView,
    PathRecord,
    RecordingError,
    about_of,
    read_recording,
    record_path,
    rerun_command,
)
from constraint_geodesics.recording.viewer import open_recordings
from constraint_geodesics.robot.kinematics import load_robot, rotation_from_rpy
from constraint_geodesics.scene.urdf import data_path

FRAMES = 25
LIMIT_M, LIMIT_RAD = 0.01, 0.17
SLIDE = Constraint((0, 0, 1, 1, 1, 0), (0, 0, LIMIT_M, LIMIT_RAD, LIMIT_RAD, 0), HELD_AT)
XARM = ("xarm/xarm6_robot.urdf", "link6", START, CHANGE)
KUKA = (
    "kuka_iiwa/model.urdf",
    "lbr_iiwa_link_7",
    [0.3, 0.6, 0.1, -1.2, 0.4, 0.5, 0.2],
    [0.8, 0.3, -0.2, 0.4, 0.2, 0.4, -0.3],
)


def manifold_and_joints(urdf, tool_link, start, change, points=30):
    manifold = ConstraintManifold(load_robot(data_path() / urdf, tool_link), SLIDE)
    straight = np.array(start) + np.linspace(0.0, 1.0, points)[:, None] * np.array(change)
    found = retract(manifold, straight)
    assert found.converged.all()
    return manifold, found.joints


@pytest.fixture(scope="module")
def xarm():
    return manifold_and_joints(*XARM)


def path_of(joints, **changes):
    return replace(
        PathRecord("birrt", "slide", 2, 1, joints, "# birrt\n\nlength 1.2 rad"), **changes
    )


def recorded(folder, manifold, path, bodies=(), frames=FRAMES):
    """The file of its recording."""
    record_path(folder / "path.rrd", path, manifold, bodies, frames=frames)
    return folder / "path.rrd"


def latent_view(points, values):
    t = np.linspace(-1.0, 1.0, points)
    grid = np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)
    return LatentView(grid, values, np.stack([t, t**2 - 0.5], axis=1), ("z1", "z2"))


def pose_of_link(file, link, frame):
    """Compose the recorded transforms from the scene's root to a link at one frame."""
    edges = {}
    for chunk, batch in batches(file):
        if "Transform3D:child_frame" not in batch.schema.names:
            continue
        row = 0 if chunk.is_static else frame
        values = {
            name.split(":")[1]: batch.column(name)[row].as_py()[0]
            for name in batch.schema.names
            if ":" in name
        }
        assert values["child_frame"] not in edges, "a frame may have one parent only"
        edges[values["child_frame"]] = (values["parent_frame"], transform_of(values))
    pose = np.eye(4)
    while link != "tf#/":
        link, step = edges[link]
        pose = step @ pose
    return pose


def transform_of(values):
    transform = np.eye(4)
    transform[:3, 3] = values.get("translation", (0.0, 0.0, 0.0))
    if "mat3x3" in values:
        transform[:3, :3] = (
            np.array(values["mat3x3"]).reshape(3, 3).T
        )  # the columns one after another
    if "quaternion" in values:
        transform[:3, :3] = Rotation.from_quat(values["quaternion"]).as_matrix()
    return transform


def test_a_viewer_that_was_slow_takes_our_layout_too(tmp_path):
    manifold, joints = manifold_and_joints(*XARM)
    file = tmp_path / "path.rrd"
    record_path(file, path_of(joints), manifold, [TABLE], frames=FRAMES)
    told = subprocess.run(
        rerun_command("rrd", "print", str(file)), capture_output=True, text=True, check=True
    ).stdout
    (activated,) = [line for line in told.splitlines() if "BlueprintActivation" in line]
    assert "make_active: true" in activated


@pytest.mark.parametrize(("robot", "meshes"), [(XARM, 7), (KUKA, 8)], ids=["xarm6", "kuka"])
def test_recording_reads_back_as_the_path(robot, meshes, tmp_path):
    manifold, joints = manifold_and_joints(*robot)
    file = tmp_path / "folder" / "path.rrd"
    record_path(file, path_of(joints), manifold, [TABLE, TRAY], frames=FRAMES)
    summary = read_recording(file)
    assert summary.application_id == "constraint_geodesics"
    assert re.fullmatch(r"slide-query2-birrt-seed1-[0-9a-f]{8}", summary.recording_id)
    assert summary.about == About("birrt", "slide", query=2, seed=1)
    assert summary.meshes == meshes + 1, "the robot's visual meshes and the tray's"
    assert "/workcell/table" in summary.entity_paths
    assert not any("collision" in entity for entity in summary.entity_paths)
    assert summary.has_blueprint
    assert summary.joints.shape == (FRAMES, manifold.robot.dof)
    np.testing.assert_array_equal(summary.joints[[0, -1]], joints[[0, -1]])
    np.testing.assert_allclose(
        summary.tool_ends, manifold.robot.forward(joints[[0, -1]])[0], atol=1e-6
    )
    assert file.stat().st_size < 2e6


@pytest.mark.parametrize("robot", [XARM, KUKA], ids=["xarm6", "kuka"])
def test_recorded_transforms_put_the_tool_where_the_kinematics_do(robot, tmp_path):
    manifold, joints = manifold_and_joints(*robot)
    file = recorded(tmp_path, manifold, path_of(joints))
    shown = read_recording(file).joints
    for frame in (0, 11, FRAMES - 1):
        position, rotation = manifold.robot.forward(shown[frame])
        pose = pose_of_link(file, robot[1], frame)
        np.testing.assert_allclose(pose[:3, 3], position, atol=1e-6)
        np.testing.assert_allclose(pose[:3, :3], rotation, atol=1e-6)


def test_body_of_the_workcell_stands_at_its_pose(xarm, tmp_path):
    manifold, joints = xarm
    file = recorded(tmp_path, manifold, path_of(joints), [TABLE, TRAY])
    pose = pose_of_link(file, "tray/base_link", 0)
    np.testing.assert_allclose(pose[:3, 3], TRAY.position_m, atol=1e-6)
    np.testing.assert_allclose(pose[:3, :3], rotation_from_rpy(np.array(TRAY.rpy_rad)), atol=1e-6)
    np.testing.assert_allclose(
        column(file, "/workcell/table", "Boxes3D:centers"), [[TABLE.centre_m]]
    )
    half = column(file, "/workcell/table", "Boxes3D:half_sizes")
    np.testing.assert_allclose(half, [[[1.2, 1.2, 0.05]]])


def test_frames_are_at_the_path_s_own_seconds(xarm, tmp_path):
    manifold, _ = xarm
    corner = np.zeros((4, 6))
    corner[2:, 0], corner[1:, 4] = 0.6, 0.2  # a corner, then a point twice: the arm waits there
    times = np.array([0.0, 0.5, 2.0, 3.0])
    file = recorded(tmp_path, manifold, path_of(corner, times=times), frames=7)
    summary = read_recording(file)
    np.testing.assert_allclose(summary.times, np.arange(7) / 2.0, atol=1e-9)
    np.testing.assert_allclose(summary.joints[[0, 1, 4, 6]], corner[[0, 1, 2, 3]], atol=1e-12)
    np.testing.assert_allclose(summary.joints[2], [0.2, 0.0, 0.0, 0.0, 0.2, 0.0], atol=1e-12)


@pytest.mark.parametrize("robot", [XARM, KUKA], ids=["xarm6", "kuka"])
def test_a_path_without_times_goes_as_fast_as_the_planner_would(robot, tmp_path):
    manifold, joints = manifold_and_joints(*robot)
    twice = np.insert(joints, [4, len(joints)], joints[[4, -1]], axis=0)  # rows that take no time
    file = recorded(tmp_path, manifold, path_of(twice), frames=400)
    times, shown = read_recording(file).times, read_recording(file).joints
    acceleration = np.full(manifold.robot.dof, PlannerParams().acceleration_rad_s2)
    planned = Pace(manifold.robot.velocity, acceleration).times(joints, None)
    assert times[-1] == pytest.approx(planned[-1], abs=1e-9)
    np.testing.assert_array_equal(shown[[0, -1]], joints[[0, -1]])
    speeds = np.abs(np.diff(shown, axis=0)) / np.diff(times)[:, None]
    assert (speeds <= manifold.robot.velocity * (1.0 + 1e-5)).all()


def test_an_arm_that_stands_still_is_shown_for_a_second(xarm, tmp_path):
    manifold, joints = xarm
    file = recorded(tmp_path, manifold, path_of(joints[[0, 0]]), frames=3)
    np.testing.assert_allclose(read_recording(file).times, [0.0, 0.5, 1.0], atol=1e-9)


def test_residuals_are_shown_in_people_s_units_with_their_limits(xarm, tmp_path):
    manifold, joints = xarm
    file = recorded(tmp_path, manifold, path_of(joints))
    position, rotation = manifold.robot.forward(read_recording(file).joints)
    # roll and pitch held: the reference's vertical, seen from the tool, keeps its direction
    cosine = rotation[:, 2, :] @ SLIDE.reference.rotation[2]
    tilt = np.array(column(file, "/constraint/deg/tilt", "Scalars:scalars"))
    np.testing.assert_allclose(tilt[:, 0], np.degrees(np.arccos(cosine)), atol=1e-6)
    np.testing.assert_allclose(tilt[:, 1], np.degrees(LIMIT_RAD))
    height = np.array(column(file, "/constraint/mm/z", "Scalars:scalars"))
    np.testing.assert_allclose(height[:, 0], 1e3 * np.abs(position[:, 2] - 0.3), atol=1e-6)
    np.testing.assert_allclose(height[:, 1], 1e3 * LIMIT_M)


def test_free_constraint_has_no_residual(xarm, tmp_path):
    manifold = ConstraintManifold(xarm[0].robot, Constraint((0,) * 6))
    file = recorded(tmp_path, manifold, path_of(xarm[1]))
    assert not any("constraint" in entity for entity in read_recording(file).entity_paths)


def test_unequal_angle_tolerances_are_shown_each_by_itself(xarm, tmp_path):
    uneven = replace(SLIDE, axes=(0, 0, 0, 1, 1, 0), tolerance=(0.0, 0.0, 0.0, 0.1, 0.2, 0.0))
    manifold = ConstraintManifold(xarm[0].robot, uneven)
    file = recorded(tmp_path, manifold, path_of(xarm[1]))
    for axis, limit in (("roll", 0.1), ("pitch", 0.2)):
        series = np.array(column(file, f"/constraint/deg/{axis}", "Scalars:scalars"))
        np.testing.assert_allclose(series[:, 1], np.degrees(limit))


def test_latent_curve_and_sub_manifold_are_drawn_upright(xarm, tmp_path):
    manifold, joints = xarm
    components = np.repeat([0, 1, -1], [400, 400, 100])
    latent = latent_view(len(joints), components)
    file = recorded(tmp_path, manifold, path_of(joints, latent=latent))
    points = np.array(column(file, "/latent/submanifold", "Points2D:positions")[0])
    np.testing.assert_allclose(points * [1, -1], latent.points, atol=1e-6)
    colours = np.array(column(file, "/latent/submanifold", "Points2D:colors")[0])
    assert [len(set(colours[components == index])) for index in (0, 1, -1)] == [1, 1, 1]
    assert len(set(colours)) == 3
    moving = np.array(column(file, "/latent/position", "Points2D:positions"))[:, 0]
    np.testing.assert_allclose(moving[[0, -1]] * [1, -1], latent.curve[[0, -1]], atol=1e-6)
    for name, end in (("start", 0), ("goal", -1)):
        marker = np.array(column(file, f"/latent/{name}", "Points2D:positions"))
        np.testing.assert_allclose(marker[0] * [1, -1], latent.curve[[end]], atol=1e-6)


def test_joints_are_shown_within_their_limits(xarm, tmp_path):
    manifold, joints = xarm
    robot, file = manifold.robot, tmp_path / "path.rrd"
    record_path(file, path_of(joints), manifold, [], frames=FRAMES)
    shown = np.array(column(file, "/joint_range", "Scalars:scalars"))
    middle, half = (robot.lower + robot.upper) / 2, (robot.upper - robot.lower) / 2
    np.testing.assert_allclose(shown[:, :6] * half + middle, read_recording(file).joints)
    np.testing.assert_array_equal(shown[:, 6:], np.tile([1.0, -1.0], (FRAMES, 1)))
    names = column(file, "/joint_range", "SeriesLines:names")[0]
    assert names == [*robot.joint_names, "upper limit", "lower limit"]
    np.testing.assert_array_equal(column(file, "/joints", "lower")[0], robot.lower)
    np.testing.assert_array_equal(column(file, "/joints", "upper")[0], robot.upper)


def test_what_is_kept_is_shown_as_a_share_of_what_the_judge_grants(xarm, tmp_path):
    manifold, joints = xarm
    exact = replace(SLIDE, tolerance=(0.0,) * 6)
    off = joints + np.linspace(0.0, 1e-3, len(joints))[:, None] * np.eye(6)[1]
    for kept, granted in ((exact, 1e-3), (SLIDE, 1e-4)):
        held = replace(manifold, constraint=kept)
        file = recorded(tmp_path, held, path_of(off, tolerance=granted))
        shown = held.violation(read_recording(file).joints)
        shares = []
        for name, own, unit in (("z", LIMIT_M, "mm"), ("tilt", LIMIT_RAD, "deg")):
            limit = granted + (own if kept is SLIDE else 0.0)
            values = np.array(column(file, f"/constraint/{unit}/{name}", "Scalars:scalars"))[:, 0]
            share = np.array(column(file, f"/share/{name}", "Scalars:scalars"))
            in_si = 1e-3 * values if unit == "mm" else np.radians(values)
            np.testing.assert_allclose(share[:, 0], 100.0 * in_si / limit, atol=1e-9)
            np.testing.assert_array_equal(share[:, 1], 100.0)
            words = column(file, f"/share/{name}", "SeriesLines:names")[0]
            assert words[0] == name
            assert words[1].startswith("limit, ")
            assert words[1].endswith(f" {unit}")
            shares.append(share[:, 0])
        broken = np.max(shares, axis=0) > 100.0
        np.testing.assert_array_equal(broken, shown > granted)
        assert np.max(shares) > 1.0, "seen beside its limit"


def test_the_status_says_what_the_judge_allows():
    row = dict.fromkeys(("query", "seed", "length_rad", "tool_length_m"), 1)
    row |= {"planner": "birrt", "valid": True, "max_violation_rad": 0.0, "max_violation_m": 0.0}
    assert "0.0573°, 1.0000 mm" in status_text(row, "slide", 1e-3)


def test_without_meshes_a_recording_is_small_and_names_the_urdfs(xarm, tmp_path):
    manifold, joints = xarm
    latent = latent_view(len(joints), np.zeros(900))
    whole, slim = tmp_path / "whole.rrd", tmp_path / "slim.rrd"
    for file, meshes in ((whole, True), (slim, False)):
        record_path(
            file, path_of(joints, latent=latent, meshes=meshes), manifold, [TABLE, TRAY], frames=100
        )
    small, large = read_recording(slim), read_recording(whole)
    assert (small.meshes, large.meshes) == (0, 8)
    assert slim.stat().st_size < whole.stat().st_size / 5
    assert small.recording_id == large.recording_id
    assert set(small.entity_paths) < set(large.entity_paths)
    assert column(slim, "/robot", "urdf") == [["xarm/xarm6_robot.urdf"]]
    assert column(slim, "/workcell/tray", "urdf") == [["tray/traybox.urdf"]]


def test_ids_tell_paths_apart_that_share_their_name(xarm, tmp_path):
    manifold, joints = xarm
    paths = {"one": joints, "same": joints.copy(), "other": joints[::-1]}
    for name, own in paths.items():
        record_path(tmp_path / name, path_of(own, meshes=False), manifold, [], frames=FRAMES)
    one, same, other = (read_recording(tmp_path / name).recording_id for name in paths)
    assert one == same != other


def test_recordings_from_before_they_said_so_are_known_by_their_ids():
    assert about_of("level_cup_relaxed-query3-BiRRT, tangent bundle + band-seed4", []) == About(
        "BiRRT, tangent bundle + band", "level_cup_relaxed", query=3, seed=4
    )
    executed = About("planned-path", "level_cup", query=0, executed=True)
    assert about_of("level_cup-query0-planned-path-executed", []) == executed
    assert about_of("another", []) == About()


def test_inclusion_values_become_a_scale_of_colours(xarm, tmp_path):
    manifold, joints = xarm
    values = np.linspace(0.0, 3.0, 900)
    values[5] = np.nan
    latent = latent_view(len(joints), values)
    file = recorded(tmp_path, manifold, path_of(joints, latent=latent))
    colours = column(file, "/latent/submanifold", "Points2D:colors")[0]
    assert len(set(colours)) > 200
    assert colours[0] != colours[-1]


def test_equal_paths_give_equal_recordings(xarm, tmp_path):
    manifold, joints = xarm
    path = path_of(joints, latent=latent_view(len(joints), np.zeros(900, dtype=int)))
    first, second = tmp_path / "first.rrd", tmp_path / "second.rrd"
    record_path(first, path, manifold, [TABLE], frames=FRAMES)
    record_path(second, path, manifold, [TABLE], frames=FRAMES)
    assert same_recordings(first, second)
    assert timelines(first) == {"time"}


@pytest.mark.parametrize("change", ["seed", "text", "joints", "latent"])
def test_different_paths_give_different_recordings(change, xarm, tmp_path):
    manifold, joints = xarm
    other = joints.copy()
    other[len(joints) // 2] += 1e-6
    changed = {
        "seed": 9,
        "text": "other",
        "joints": other,
        "latent": latent_view(len(joints), np.zeros(900)),
    }[change]
    record_path(tmp_path / "first.rrd", path_of(joints), manifold, [TABLE], frames=FRAMES)
    record_path(
        tmp_path / "second.rrd",
        replace(path_of(joints), **{change: changed}),
        manifold,
        [TABLE],
        frames=FRAMES,
    )
    assert not same_recordings(tmp_path / "first.rrd", tmp_path / "second.rrd")


@pytest.mark.parametrize("robot", [XARM, KUKA], ids=["package", "relative"])
def test_missing_mesh_is_refused_before_anything_is_written(robot, tmp_path):
    manifold, joints = manifold_and_joints(*robot)
    urdf = tmp_path / "lonely" / "robot.urdf"
    urdf.parent.mkdir()
    shutil.copy(data_path() / robot[0], urdf)
    lonely = replace(manifold, robot=load_robot(urdf, robot[1]))
    with pytest.raises(RecordingError, match=r"robot\.urdf: no mesh could be read for .*visual_0"):
        record_path(tmp_path / "path.rrd", path_of(joints), lonely, [], frames=FRAMES)
    assert not (tmp_path / "path.rrd").exists()


def test_one_missing_mesh_is_named(tmp_path):
    manifold, joints = manifold_and_joints(*KUKA)
    shutil.copytree(data_path() / "kuka_iiwa", tmp_path / "kuka")
    (tmp_path / "kuka" / "meshes" / "link_3.obj").unlink()
    broken = replace(manifold, robot=load_robot(tmp_path / "kuka" / "model.urdf", KUKA[1]))
    with pytest.raises(RecordingError, match=r"read for lbr_iiwa_link_3/visual_0$"):
        record_path(tmp_path / "path.rrd", path_of(joints), broken, [], frames=FRAMES)


@pytest.mark.parametrize("before", [None, "/some/packages"])
def test_package_path_is_restored(before, xarm, tmp_path, monkeypatch):
    if before is None:
        monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    else:
        monkeypatch.setenv("ROS_PACKAGE_PATH", before)
    record_path(tmp_path / "path.rrd", path_of(xarm[1]), xarm[0], [], frames=FRAMES)
    assert os.environ.get("ROS_PACKAGE_PATH") == before


def test_paths_that_do_not_fit_are_refused(xarm, tmp_path):
    manifold, joints = xarm
    latent = latent_view(len(joints) - 1, np.zeros(841))
    holed = joints.copy()
    holed[3, 2] = np.nan
    cases = [
        (path_of(joints[:, :5]), FRAMES, r"joints of shape \(30, 5\): must be \(T, 6\)"),
        (path_of(joints[:1]), FRAMES, "T of 2 or more"),
        (path_of(holed), FRAMES, "not finite"),
        (path_of(joints), 1, "frames = 1: must be 2 or more"),
        (path_of(joints, times=np.arange(29.0)), FRAMES, r"times of shape \(29,\): .* \(30,\)"),
        (path_of(joints, times=np.arange(30.0) + 1.0), FRAMES, "times must be finite and rise"),
        (path_of(joints, times=np.full(30, np.nan)), FRAMES, "times must be finite and rise"),
        (
            path_of(joints, latent=latent),
            FRAMES,
            r"latent curve of shape \(29, 2\): must be \(30, 2\)",
        ),
    ]
    for path, frames, message in cases:
        with pytest.raises(RecordingError, match=message):
            record_path(tmp_path / "path.rrd", path, manifold, [], frames=frames)


def test_what_is_not_a_recording_of_a_path_is_refused(tmp_path):
    missing, garbage, other = (
        tmp_path / "missing.rrd",
        tmp_path / "garbage.rrd",
        tmp_path / "other.rrd",
    )
    garbage.write_bytes(b"not a recording" * 20)
    with rr.RecordingStream("other") as stream:
        stream.save(other)
        stream.log("points", rr.Points3D([[0, 0, 0]]))
    for file, message in (
        (missing, "no such recording"),
        (garbage, "not a recording"),
        (other, "at /joints"),
    ):
        with pytest.raises(RecordingError, match=message):
            read_recording(file)
    with pytest.raises(RecordingError, match="no such recording"):
        open_recordings([other, missing], web=True)


def test_viewer_is_served_on_loopback_alone(xarm, tmp_path):
    manifold, joints = xarm
    file = recorded(tmp_path, manifold, path_of(joints))
    code = (
        "from pathlib import Path; from constraint_geodesics.recording.viewer import "
        "open_recordings; "
        f"open_recordings([Path({str(file)!r})], web=True)"
    )
    viewer = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ},
    )
    try:
        assert viewer.stdout is not None
        address = viewer.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        page = address.split("?")[0]
        assert b"rerun" in wait_for(page).lower()
        ports = {int(part.split("/")[0].split("?")[0]) for part in address.split("127.0.0.1:")[1:]}
        assert listening(ports) == {("0100007F", port) for port in ports}
    finally:
        os.killpg(viewer.pid, signal.SIGKILL)
        viewer.wait()


def test_a_viewer_does_not_report_how_it_is_used(xarm, tmp_path, monkeypatch):
    """Whatever this user's own settings are, which stay as they are."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "user"))
    subprocess.run(rerun_command("analytics", "enable"), capture_output=True, check=True)
    asked, call = rerun_command("analytics", "config"), subprocess.check_output
    assert json.loads(call(asked))["analytics_enabled"]
    started = []

    def instead(command, *, env):
        started.append((command, json.loads(call(asked, env=env))))
        return 0

    monkeypatch.setattr(subprocess, "call", instead)
    file = recorded(tmp_path, xarm[0], path_of(xarm[1]))
    assert open_recordings([file], web=True) == 0
    ((command, settings),) = started
    assert "--serve-web" in command
    assert settings["analytics_enabled"] is False
    assert json.loads(call(asked))["analytics_enabled"]


def test_without_a_display_the_browser_is_named(xarm, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    path = path_of(xarm[1], meshes=False)
    record_path(tmp_path / "path.rrd", path, xarm[0], [], frames=FRAMES)
    with pytest.raises(RecordingError, match="no display .* add --web"):
        open_recordings([tmp_path / "path.rrd"], web=False)


def wait_for(page, seconds=20.0):
    deadline = time.monotonic() + seconds
    while True:
        try:
            with urllib.request.urlopen(page, timeout=5) as answer:
                return answer.read()
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def listening(ports):
    """Addresses (as the kernel lists them) that listen on any of the ports."""
    rows = [
        row.split()
        for table in ("tcp", "tcp6")
        for row in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    addresses = [row[1].split(":") for row in rows if row[3] == "0A"]
    return {(address, int(port, 16)) for address, port in addresses if int(port, 16) in ports}


def test_what_a_query_asked_to_reach_is_drawn(xarm, tmp_path):
    """The arm at every configuration that was looked at, the region's pose, box and free angle."""
    manifold, joints = xarm
    robot = manifold.robot
    pose = Pose(*robot.forward(joints[-1]))
    region = Constraint((1, 1, 1, 1, 1, 0), (0.02, 0.03, 0.0, 0.0, 0.0, 0.0), pose)
    looked_at = np.stack([joints[-1], joints[-2]])
    path = path_of(joints, goal=GoalView(looked_at, (region,)), meshes=False)
    read = batches(recorded(tmp_path, manifold, path))
    found = {chunk.entity_path: batch for chunk, batch in read if "/goal/" in chunk.entity_path}
    assert set(found) == {
        "/goal/looked_at",
        *(f"/goal/region_0/{name}" for name in ("pose", "places", "free_yaw")),
    }
    lines = found["/goal/looked_at"].column("LineStrips3D:strips")[0].as_py()
    np.testing.assert_allclose(lines, robot.skeleton(looked_at), atol=1e-6)
    box = found["/goal/region_0/places"].column("Boxes3D:half_sizes")[0].as_py()
    np.testing.assert_allclose(box, [[0.02, 0.03, 0.0]], atol=1e-8)
    circle = np.array(found["/goal/region_0/free_yaw"].column("LineStrips3D:strips")[0].as_py()[0])
    np.testing.assert_allclose(circle[:, 2], pose.position[2], atol=1e-6)
    reach = np.linalg.norm(circle - pose.position, axis=1)
    np.testing.assert_allclose(reach, reach[0], atol=1e-6)


def test_a_single_configuration_has_no_goal_to_draw(xarm, tmp_path):
    manifold, joints = xarm
    file = recorded(tmp_path, manifold, path_of(joints, meshes=False))
    assert not any(
        "goal/" in entity for entity in read_recording(file).entity_paths if "tool" not in entity
    )
