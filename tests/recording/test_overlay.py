"""Recordings put together: real recordings are written, composed as `geodesics replay` does, and
read from the file.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from tests.recording.files import CHANGE, HELD_AT, START, TABLE, TRAY, batches, column, timelines

from constraint_geodesics.constraints.constraint import Constraint, ConstraintManifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.palette import planner_colour
from constraint_geodesics.recording.colours import rgb
from constraint_geodesics.recording.goal import GoalView
from constraint_geodesics.recording.overlay import (
    OTHERS_OPACITY,
    labels_of,
    opened,
    overlaid,
    shades,
    side_by_side,
)
from constraint_geodesics.recording.recording import (
    About,
    Frames,
    LatentView,
    PathRecord,
    RecordingError,
    read_recording,
    record_path,
)
from constraint_geodesics.recording.viewer import prepared, save_recordings
from constraint_geodesics.robot.kinematics import load_robot
from constraint_geodesics.scene.capsule import Capsule
from constraint_geodesics.scene.shape import Shape
from constraint_geodesics.scene.sphere import Sphere
from constraint_geodesics.scene.urdf import data_path

FRAMES = 10
BALL = Sphere("keep_out", (0.3, 0.3, 0.6), 0.1)
PIPE = Capsule("pipe", (-0.4, 0.2, 0.5), (-0.4, 0.5, 0.8), 0.05)
LEVEL = Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, 0.1, 0.1, 0), HELD_AT)
CHANGES = CHANGE, np.array([0.8, -0.2, 0.1, 0, 0, 0])
VISUAL = ("link_base", *(f"link{k}" for k in range(1, 7)))


class Writer:
    """Writes recordings of one arm that keeps a tool level."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.written = folder, 0
        self.goal: GoalView | None = None
        self.manifold = ConstraintManifold(
            load_robot(data_path() / "xarm/xarm6_robot.urdf", "link6"), LEVEL
        )

    def __call__(
        self,
        planner: str,
        change: int = 0,
        *,
        constraint: str = "level_cup",
        seed: int = 0,
        meshes: bool = False,
        bodies: tuple[Shape, ...] = (TABLE,),
        latent: bool = False,
        frames: int = FRAMES,
    ) -> Path:
        joints = retract(
            self.manifold, START + np.linspace(0.0, 1.0, 20)[:, None] * CHANGES[change]
        ).joints
        curve = np.stack([np.linspace(-1, 1, 20), np.linspace(0, 0.5 * change, 20)], axis=1)
        grid = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), axis=-1).reshape(
            -1, 2
        )
        view = LatentView(grid, np.zeros(25, int), curve, ("z1", "z2")) if latent else None
        text = f"text of {planner} {seed}"
        record = PathRecord(
            planner, constraint, 0, seed, joints, text, view, goal=self.goal, meshes=meshes
        )
        self.written += 1
        file = self.folder / f"{self.written}.rrd"
        record_path(file, record, self.manifold, bodies, frames=frames)
        return file


@pytest.fixture
def write(tmp_path: Path) -> Writer:
    (tmp_path / "written").mkdir()
    return Writer(tmp_path / "written")


def together(tmp_path: Path, *files: Path, apart: bool = False) -> Path:
    (tmp_path / "opened").mkdir()
    (file,) = prepared(files, tmp_path / "opened", apart=apart)
    return file


def entities(file: Path) -> set[str]:
    return {chunk.entity_path for chunk, _ in batches(file)}


def test_two_planners_are_two_robots_in_their_colours(write: Writer, tmp_path: Path) -> None:
    file = together(tmp_path, write("learned_geodesic", 0), write("birrt", 1))
    for entity, planner, opacity in (
        ("path0_learned_geodesic", "learned_geodesic", 1.0),
        ("path1_birrt", "birrt", OTHERS_OPACITY),
    ):
        red, green, blue = rgb(planner_colour(planner))
        tint = red << 24 | green << 16 | blue << 8 | round(255 * opacity)
        for link in VISUAL:
            mesh = f"/{entity}/robot/xarm6/visual_geometries/{link}/visual_0"
            assert column(file, mesh, "Asset3D:albedo_factor") == [[tint]]
            assert len(column(file, mesh, "Asset3D:blob")[0][0]) > 1000
            assert column(file, mesh, "CoordinateFrame:frame")[0][0].startswith(f"{entity}/")
        assert column(file, f"/{entity}/tool/trace", "LineStrips3D:colors") == [[tint | 255]]
    assert rgb(planner_colour("learned_geodesic")) != rgb(planner_colour("birrt"))


def test_frames_of_the_robots_are_apart_and_hang_together(write: Writer, tmp_path: Path) -> None:
    """Every frame has one parent, and leads to the scene's root."""
    file = together(
        tmp_path, write("planner", 0, bodies=(TABLE, TRAY)), write("birrt", 1, bodies=(TABLE, TRAY))
    )
    parents: dict[str, str] = {}
    drawn = set()
    for _, batch in batches(file):
        if "Transform3D:child_frame" in batch.schema.names:
            child, parent = (
                batch.column(f"Transform3D:{end}_frame")[0].as_py()[0]
                for end in ("child", "parent")
            )
            assert child not in parents
            parents[child] = parent
        if "CoordinateFrame:frame" in batch.schema.names:
            drawn.add(batch.column("CoordinateFrame:frame")[0].as_py()[0])
    for frame in drawn:
        while frame != "tf#/":
            frame = parents[frame]
    for entity in ("path0_planner", "path1_birrt"):
        assert {f"{entity}/{link}" for link in VISUAL} <= drawn
    assert "tray/base_link" in drawn


def test_every_series_has_one_line_a_planner(write: Writer, tmp_path: Path) -> None:
    sources = write("planner", 0), write("birrt", 1)
    file = together(tmp_path, *sources)
    for source, entity, name in zip(
        sources, ("path0_planner", "path1_birrt"), ("planner", "birrt"), strict=True
    ):
        joints = read_recording(source).joints
        own = np.concatenate(
            [column(file, f"/joint/joint{k}/{entity}", "Scalars:scalars") for k in range(1, 7)],
            axis=1,
        )
        np.testing.assert_array_equal(own, joints)
        for series in ("constraint/deg/tilt", "share/tilt"):
            before = np.array(column(source, f"/{series}", "Scalars:scalars"))
            np.testing.assert_array_equal(
                column(file, f"/{series}/{entity}", "Scalars:scalars"), before[:, :1]
            )
            assert column(file, f"/{series}/{entity}", "SeriesLines:names") == [[name]]
        colours = column(file, f"/joint_range/{entity}", "SeriesLines:colors")[0]
        red, green, blue = rgb(planner_colour(name))
        assert set(colours) == {red << 24 | green << 16 | blue << 8 | 255}
        assert len(colours) == 6
    robot = write.manifold.robot
    assert (
        column(file, "/joint/joint3/upper_limit", "Scalars:scalars") == [[robot.upper[2]]] * FRAMES
    )
    limits = [
        entity for entity in entities(file) if entity.startswith("/constraint/deg/tilt/limit")
    ]
    np.testing.assert_allclose(column(file, *limits, "Scalars:scalars"), np.degrees(0.1))
    assert column(file, "/status", "TextDocument:text") == [
        ["text of planner 0\n\ntext of birrt 0"]
    ]


def test_what_is_shared_is_there_once(write: Writer, tmp_path: Path) -> None:
    bodies = (TABLE, TRAY, BALL, PIPE)
    sources = [
        write(name, latent=True, bodies=bodies, meshes=name == "prm")
        for name in ("planner", "birrt", "prm")
    ]
    found = entities(together(tmp_path, *sources))
    for shared in (
        "workcell/table",
        "workcell/keep_out",
        "workcell/pipe",
        "latent/submanifold",
        "tool/start",
        "tool/goal",
    ):
        assert sum(entity.endswith(shared) for entity in found) == 1, shared
    assert (
        sum(entity.startswith("/workcell/tray") and "/visual_" in entity for entity in found) == 1
    )
    assert sum(entity.startswith("/latent/curve/") for entity in found) == 3


def test_side_by_side_each_recording_has_its_own_surroundings(
    write: Writer, tmp_path: Path
) -> None:
    file = together(
        tmp_path,
        write("planner", bodies=(TABLE,)),
        write("birrt", bodies=(TABLE, BALL)),
        apart=True,
    )
    found = entities(file)
    assert {
        "/path0_planner/workcell/table",
        "/path1_birrt/workcell/table",
        "/path1_birrt/workcell/keep_out",
    } <= found
    assert "/path0_planner/workcell/keep_out" not in found
    tints = {
        column(file, f"/{e}/robot/xarm6/visual_geometries/link1/visual_0", "Asset3D:albedo_factor")[
            0
        ][0]
        & 255
        for e in ("path0_planner", "path1_birrt")
    }
    assert tints == {255}
    assert RrdReader(file).blueprints()


def test_seeds_of_one_planner_differ_in_shade_and_words() -> None:
    first, second, third, other = shades(["#0072B2", "#0072B2", "#0072B2", "#E69F00"])
    assert (first, other) == (rgb("#0072B2"), rgb("#E69F00"))
    assert first < second < third < (255, 255, 255)
    abouts = [About("birrt", "free", query=0, seed=seed) for seed in (0, 1)] + [
        About("prm", "free", query=0, seed=0)
    ]
    assert labels_of(abouts) == ["birrt, seed 0", "birrt, seed 1", "prm"]
    assert labels_of([About("birrt", "free", query=0, seed=0)] * 2) == [
        "birrt, seed 0 (1)",
        "birrt, seed 0 (2)",
    ]
    several = [
        About("birrt", "free", scene, query, 0)
        for scene, query in (("table", 0), ("keep_out", 100))
    ]
    assert labels_of(several) == ["birrt, table, query 0", "birrt, keep_out, query 100"]


def test_one_recording_opens_as_it_is_with_the_meshes_it_names(
    write: Writer, tmp_path: Path
) -> None:
    whole, slim = (
        write("planner", meshes=True, bodies=(TABLE, TRAY)),
        write("planner", bodies=(TABLE, TRAY)),
    )
    assert prepared([whole], tmp_path, apart=False) == [whole]
    (file,) = prepared([slim], tmp_path, apart=False)
    before, after = read_recording(whole), read_recording(file)
    assert after.meshes == before.meshes == 8
    assert set(after.entity_paths) == set(before.entity_paths)
    assert (after.recording_id, after.has_blueprint) == (before.recording_id, True)
    assert all(
        any(f"/{link}/visual_0" in entity for entity in after.entity_paths) for link in VISUAL
    )


def test_paths_of_several_constraints_open_each_by_itself(write: Writer, tmp_path: Path) -> None:
    files = write("planner", constraint="slide"), write("birrt")
    shown = prepared(files, tmp_path, apart=False)
    assert [read_recording(file).meshes for file in shown] == [7, 7]
    with pytest.raises(RecordingError, match="several constraints can't be saved as one"):
        save_recordings(files, tmp_path / "out.rrd")


def test_what_can_not_be_laid_over_each_other_is_refused(write: Writer, tmp_path: Path) -> None:
    plain, other = write("planner"), write("birrt", bodies=(TABLE, BALL))
    with pytest.raises(
        RecordingError, match=r"1\.rrd and .*2\.rrd have different bodies .*--side-by-side"
    ):
        prepared([plain, other], tmp_path, apart=False)


def test_executed_paths_are_shown_beside_paths_and_not_over_each_other(
    write: Writer, tmp_path: Path
) -> None:
    planned = opened(write("planner"))
    executed = replace(planned, file=Path("run.rrd"), about=replace(planned.about, executed=True))
    with pytest.raises(RecordingError, match="executed paths are not laid over each other"):
        overlaid([executed, executed])
    beside = {chunk.entity_path for chunk in side_by_side([planned, executed]).chunks}
    assert sum(entity.endswith("/tool/frame/axes") for entity in beside) == 2


def test_recordings_of_an_earlier_release_are_opened_among_themselves(
    write: Writer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have frames instead of seconds."""
    new = write("planner")
    counted = property(lambda self: rr.TimeColumn("frame", sequence=range(len(self.joints))))
    monkeypatch.setattr(Frames, "time", counted)
    old = write("planner"), write("birrt")
    assert timelines(old[0]) == {"frame"}
    assert read_recording(old[0]).times is None
    assert timelines(together(tmp_path, *old)) == {"frame"}
    with pytest.raises(
        RecordingError, match=r"1\.rrd is in seconds, and .*2\.rrd, of an earlier .* in frames"
    ):
        prepared([new, old[0]], tmp_path, apart=True)


def test_of_paths_over_each_other_the_goal_is_drawn_once(write: Writer, tmp_path: Path) -> None:
    write.goal = GoalView(np.stack([START, START + CHANGE]), (LEVEL,))
    sources = write("planner"), write("birrt", 1)
    over = entities(together(tmp_path, *sources))
    (tmp_path / "apart").mkdir()
    apart = entities(together(tmp_path / "apart", *sources, apart=True))
    for found, count in ((over, 1), (apart, 2)):
        assert sum(entity.endswith("/goal/looked_at") for entity in found) == count
        assert sum(entity.endswith("/tool/frame/axes") for entity in found) == 2


def test_series_with_spaces_in_their_name_keep_it(write: Writer, tmp_path: Path) -> None:
    held = Constraint((0, 0, 1, 1, 1, 1), (0, 0, 0, 0.1, 0.2, 0.1), LEVEL.reference)
    write.manifold = ConstraintManifold(write.manifold.robot, held)
    apart = together(tmp_path, write("planner"), write("birrt"))
    assert column(apart, "/constraint/deg/pitch/path1_birrt", "SeriesLines:names") == [
        ["birrt: pitch"]
    ]
    assert column(apart, "/constraint/mm/z/path1_birrt", "SeriesLines:names") == [["birrt"]]
    write.manifold = ConstraintManifold(
        write.manifold.robot, Constraint((0, 0, 0, 1, 1, 1), (0,) * 6, LEVEL.reference)
    )
    (tmp_path / "as_one").mkdir()
    as_one = together(tmp_path / "as_one", write("planner"), write("birrt"))
    assert column(
        as_one, "/constraint/deg/roll\\ pitch\\ yaw/path1_birrt", "SeriesLines:names"
    ) == [["birrt"]]


def test_a_saved_comparison_opens_again(write: Writer, tmp_path: Path) -> None:
    save_recordings([write("planner"), write("birrt", frames=15)], tmp_path / "sent" / "both.rrd")
    sent = tmp_path / "sent" / "both.rrd"
    assert prepared([sent], tmp_path, apart=False) == [sent]
    with pytest.raises(
        RecordingError, match=r"both\.rrd: not a recording of one path: open it by itself"
    ):
        prepared([sent, sent], tmp_path, apart=False)
    assert list(tmp_path.glob("*.rrd")) == []
