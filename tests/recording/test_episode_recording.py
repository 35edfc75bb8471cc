"""Recordings of a real episode, read back from the file."""

from pathlib import Path

import numpy as np
import pytest
from tests.planner_fixtures import packaged_planner
from tests.recording.files import batches, column, timelines

from constraint_geodesics.recording.episode_recording import EpisodeRecord, Stretch, record_episode
from constraint_geodesics.recording.recording import About, read_recording
from constraint_geodesics.studies import episodes as study

LINE = "LineStrips3D:strips"


@pytest.fixture(scope="module")
def record() -> EpisodeRecord:
    planner = packaged_planner()
    with study.carrying(planner, "level_cup"):
        episode = study.drawn(planner, "level_cup", 1, 0)
        happenings = list(study.run(episode, study.Replanner(planner)))
    report = study.report(episode, happenings)
    stretches = [Stretch(begins, path.times, path.joints) for begins, path in report.legs]
    seen = {one.obstacle.name: one.at_s for one in report.seen}
    about = "replan", "level_cup", 1, episode.first.scene, episode.obstacles
    ended = report.duration_s, "**replan**"
    return EpisodeRecord(*about, seen, stretches, *ended, kept=episode.first.constraint)


@pytest.fixture(scope="module")
def file(record: EpisodeRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recordings") / "episode.rrd"
    record_episode(file, record)
    return file


def begins_s(file: Path, entity: str) -> list[float]:
    """When something of an entity is there first [s]; nothing where it always is."""
    found = []
    for chunk, batch in batches(file):
        if chunk.entity_path == entity and chunk.timeline_names:
            (times,) = (batch.column(name).to_pylist() for name in chunk.timeline_names)
            found += [time.total_seconds() for time in times]
    return sorted(found)


def test_the_motion_is_in_seconds(file: Path, record: EpisodeRecord) -> None:
    summary = read_recording(file)
    assert summary.about == About("replan", "level_cup", query=1, executed=True)
    assert summary.has_blueprint
    assert summary.meshes == 7
    assert timelines(file) == {"time"}
    at_s = np.array(begins_s(file, "/joints"))
    np.testing.assert_allclose(summary.joints, record.joints(at_s), atol=1e-6)
    assert at_s[-1] == pytest.approx(record.over_s)


def test_the_tool_and_the_cup_s_level_plane_move_with_the_arm(
    file: Path, record: EpisodeRecord
) -> None:
    (cup,) = record.scene.attached
    assert f"/attached/{cup.name}" in read_recording(file).entity_paths
    tool = record.scene.robot.forward(read_recording(file).joints)[0]
    for entity in ("/tool/frame", "/tool/place"):
        places = np.array(column(file, entity, "Transform3D:translation"))[:, 0]
        np.testing.assert_allclose(places, tool, atol=1e-6)
    share = np.array(column(file, "/share/tilt", "Scalars:scalars"))
    assert 0.0 < share[:, 0].max() < 100.0
    np.testing.assert_array_equal(share[:, 1], 100.0)


def test_an_obstacle_is_a_shadow_until_it_is_seen(file: Path, record: EpisodeRecord) -> None:
    assert record.seen_s
    entities = read_recording(file).entity_paths
    for shape in record.obstacles:
        name = shape.name.replace(" ", "\\ ")
        assert f"/hidden/{name}" in entities
        assert begins_s(file, f"/hidden/{name}") == []
        seen = [record.seen_s[shape.name]] if shape.name in record.seen_s else []
        assert begins_s(file, f"/workcell/{name}") == pytest.approx(seen)


def test_the_path_changes_with_every_answer(file: Path, record: EpisodeRecord) -> None:
    begins = [one.begins_s for one in record.stretches]
    assert begins_s(file, "/tool/plan") == pytest.approx(begins)
    old = [begins_s(file, f"/tool/ways/{k}") for k in range(len(begins) - 1)]
    assert old == [[pytest.approx(one)] for one in begins[1:]]
    (line,) = column(file, "/tool/ways/0", LINE)[0]
    tool = packaged_planner().robot.forward(record.stretches[0].joints[[0, -1]])[0]
    np.testing.assert_allclose([line[0], line[-1]], tool, atol=1e-6)
