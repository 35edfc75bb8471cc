"""A planner's files: what is written is read again, and nothing that was altered is."""

import errno
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics import bundle, cli
from constraint_geodesics.bundle import (
    CARD,
    ROADMAPS,
    Bundle,
    BundleError,
    card_digest,
    open_bundle,
    read_bundle,
)
from constraint_geodesics.geodesics import learned_method
from constraint_geodesics.geometry.graph import components
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.planner import Planner
from constraint_geodesics.search.roadmap import Roadmap
from tests.planner_fixtures import packaged_bundle

ARRAYS = (ROADMAPS,)
FILES = (CARD, *ARRAYS)


@pytest.fixture(scope="module")
def packaged() -> Bundle:
    return packaged_bundle()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(bundle.PACKAGED, tmp_path / "planner"))


def edit(folder: Path, **entries: object) -> None:
    """Change entries of the card, and its checksum with them."""
    card = {**json.loads((folder / CARD).read_text()), **entries}
    if isinstance(card["sha256"], dict):
        card["sha256"][CARD] = card_digest(card)
    (folder / CARD).write_text(json.dumps(card))


def refused(folder: Path) -> str:
    with pytest.raises(BundleError) as error:
        read_bundle(folder)
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 400
    return text


def test_the_packaged_bundle_holds_what_a_planner_needs(packaged: Bundle) -> None:
    assert {path.name for path in bundle.PACKAGED.iterdir()} == {*FILES, learned_method.FOLDER}
    assert sum(path.stat().st_size for path in bundle.PACKAGED.rglob("*")) < 5e6
    assert set(packaged.roadmaps) <= set(packaged.constraints)
    assert {"free", "level_cup", "slide", "tool_down"} <= set(packaged.roadmaps)
    for roadmap in packaged.roadmaps.values():
        assert len(roadmap.joints) >= 500
        assert roadmap.edges.max() < len(roadmap.joints)
        np.testing.assert_array_equal(
            roadmap.labels, components(len(roadmap.joints), roadmap.edges)
        )
        straight = np.linalg.norm(np.diff(roadmap.joints[roadmap.edges], axis=1)[:, 0], axis=1)
        assert (roadmap.lengths >= straight * (1.0 - 1e-5)).all(), "stored in single precision"


def test_what_is_written_is_read_again(packaged: Bundle, tmp_path) -> None:
    packaged.write(tmp_path / "one")
    again = read_bundle(tmp_path / "one")
    for name in ("robot", "workcell", "planner", "judge", "constraints"):
        assert getattr(again, name) == getattr(packaged, name)
    assert set(again.roadmaps) == set(packaged.roadmaps)
    for name, roadmap in packaged.roadmaps.items():
        for field in ("joints", "edges", "lengths", "labels"):
            np.testing.assert_array_equal(
                getattr(again.roadmaps[name], field), getattr(roadmap, field)
            )
    again.write(tmp_path / "two")
    for name in FILES:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    for name in ARRAYS:
        assert (tmp_path / "one" / name).read_bytes() == (bundle.PACKAGED / name).read_bytes()


def test_a_graph_of_many_nodes_keeps_its_edges(packaged: Bundle, tmp_path) -> None:
    """More nodes than 16 bits can number."""
    n = 2**16 + 10
    joints = np.zeros((n, 2), np.float32).astype(float)
    joints[:, 0] = np.arange(n)
    edges = np.array([[0, n - 1], [5, 2**16]])
    large = Roadmap(joints, edges, np.ones(2), components(n, edges))
    replace(packaged, roadmaps={"free": large}).write(tmp_path)
    np.testing.assert_array_equal(read_bundle(tmp_path).roadmaps["free"].edges, edges)


def test_writing_over_a_bundle_leaves_the_new_one(packaged: Bundle, folder) -> None:
    changed = replace(
        packaged, planner=packaged.planner.model_copy(update={"roadmap_nodes": 123}), roadmaps={}
    )
    changed.write(folder)
    again = read_bundle(folder)
    assert again.planner.roadmap_nodes == 123
    assert not again.roadmaps


@pytest.mark.parametrize("name", ARRAYS)
def test_any_altered_byte_is_noticed(folder, name) -> None:
    content = (folder / name).read_bytes()
    rng = np.random.default_rng(0)
    for place in (0, len(content) - 1, *rng.integers(len(content), size=5)):
        altered = bytearray(content)
        altered[place] ^= 1 << int(rng.integers(8))
        (folder / name).write_bytes(altered)
        assert name in refused(folder)


def test_an_altered_byte_of_the_card_is_noticed(folder) -> None:
    content = (folder / CARD).read_bytes()
    place = content.index(b"0.3")
    (folder / CARD).write_bytes(content[:place] + b"0.7" + content[place + 3 :])
    assert CARD in refused(folder)


@pytest.mark.parametrize("name", FILES)
def test_a_missing_or_shortened_file_is_named(folder, name) -> None:
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2])
    assert name in refused(folder)
    (folder / name).write_bytes(b"")
    assert name in refused(folder)
    (folder / name).unlink()
    assert name in refused(folder)


def test_a_folder_that_is_none_is_refused(tmp_path, folder) -> None:
    assert "nowhere" in refused(tmp_path / "nowhere")
    assert CARD in refused(tmp_path)
    assert CARD in refused(folder / CARD)


@pytest.mark.parametrize(
    "text", ["[]", "null", "3", '"planner"', "{}", "{", "", "\x00", '{"format": 1}']
)
def test_a_card_that_is_none_is_refused(folder, text) -> None:
    (folder / CARD).write_text(text)
    assert CARD in refused(folder)


def test_other_bytes_than_text_are_refused(folder) -> None:
    (folder / CARD).write_bytes(b"\xff\xfe\x00\xd8")
    assert CARD in refused(folder)


def test_another_format_is_refused_by_its_number(folder) -> None:
    edit(folder, format=3)
    assert re.search(r"format 3.*format 2", refused(folder))


@pytest.mark.parametrize(
    "entry", ["robot", "workcell", "constraints", "planner", "judge", "format", "sha256"]
)
def test_a_card_without_an_entry_is_refused(folder, entry) -> None:
    card = json.loads((folder / CARD).read_text())
    del card[entry]
    (folder / CARD).write_text(json.dumps(card))
    assert CARD in refused(folder)


@pytest.mark.parametrize("entry", ["robot", "workcell", "planner", "judge"])
@pytest.mark.parametrize("value", [None, 3, [], {"nothing": 1}])
def test_an_entry_that_is_none_is_refused(folder, entry, value) -> None:
    edit(folder, **{entry: value})
    assert CARD in refused(folder)


def test_a_list_of_constraints_is_refused(folder) -> None:
    edit(folder, constraints=[])
    assert CARD in refused(folder)


def test_a_graph_without_its_constraint_is_refused(folder) -> None:
    constraints = json.loads((folder / CARD).read_text())["constraints"]
    del constraints["slide"]
    edit(folder, constraints=constraints)
    with pytest.raises(BundleError, match="slide"):
        Planner.load(folder)


def test_a_graph_of_another_arm_is_refused(packaged: Bundle, tmp_path) -> None:
    name, graph = next(iter(packaged.roadmaps.items()))
    fewer = {name: replace(graph, joints=graph.joints[:, :5])}
    replace(packaged, roadmaps=fewer).write(tmp_path)
    with pytest.raises(BundleError, match=f"the roadmap of {name} has 5 joints.*the arm has 6"):
        Planner.load(tmp_path)


def test_a_bundle_says_where_it_came_from(folder, tmp_path, monkeypatch) -> None:
    assert open_bundle(folder)[1] == str(folder)
    assert open_bundle(str(folder))[1] == str(folder)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert "package" in open_bundle()[1]
    shutil.copytree(bundle.PACKAGED, tmp_path / "checkout" / bundle.PIPELINE)
    monkeypatch.chdir(tmp_path / "checkout")
    assert str(bundle.PIPELINE) in open_bundle()[1]
    (tmp_path / "checkout" / bundle.PIPELINE / ROADMAPS).unlink()
    with pytest.raises(BundleError, match=ROADMAPS):
        open_bundle()


def test_the_package_takes_what_the_pipeline_built(packaged: Bundle, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError, match="holds no planner"):
        cli.package()
    layout = Layout()
    packaged.write(layout.planner)
    layout.learned.mkdir(parents=True)
    (layout.learned / "learned.json").write_text("{}")
    cli.package()
    assert set(read_bundle(layout.pretrained).roadmaps) == set(packaged.roadmaps)
    assert (layout.pretrained / "learned" / "learned.json").is_file()
    assert [own.name for own in layout.pretrained.parent.iterdir()] == [layout.pretrained.name]


@pytest.mark.parametrize("at", ["copy", "swap"])
def test_a_copy_that_fails_leaves_the_packaged_planner(at: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    layout = Layout()
    for folder, text in ((layout.planner, "new"), (layout.pretrained, "old")):
        folder.mkdir(parents=True)
        for name in ("planner.json", "roadmaps.safetensors"):
            (folder / name).write_text(text)
    roadmaps, rename = layout.planner / "roadmaps.safetensors", Path.rename

    def refused(own, target):
        if own.name == "made":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(target))
        return rename(own, target)

    with monkeypatch.context() as patch:
        if at == "copy":
            roadmaps.unlink()
            roadmaps.symlink_to("nowhere")
        else:
            patch.setattr(Path, "rename", refused)
        with pytest.raises(OSError, match=r"No such file|Input/output error"):
            cli.package()
    assert {own.read_text() for own in layout.pretrained.iterdir()} == {"old"}
    assert [own.name for own in layout.pretrained.parent.iterdir()] == [layout.pretrained.name]
    roadmaps.unlink()
    roadmaps.write_text("new")
    cli.package()
    assert {own.read_text() for own in layout.pretrained.iterdir()} == {"new"}
