"""A planner's folder works where the URDF and the meshes that it was made of are not."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from constraint_geodesics import bundle
from constraint_geodesics.bundle import CARD, Bundle, BundleError, card_digest, open_bundle
from constraint_geodesics.constraints.constraint import Constraint, Pose
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.mesh import Mesh
from constraint_geodesics.taken_along import FILES, as_taken
from tests.planner_fixtures import packaged_bundle
from tests.scene.mesh_files import Brick, write_bricks

ROBOTS = Path(__file__).resolve().parent / "robots"
FREE = Constraint((0,) * 6)
GOAL = [0.3, 0.2, -0.2, 0.1, 0.2, 0.3]


@pytest.fixture(scope="module")
def handed_on(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A planner's folder whose own files are gone, and a path that it planned before."""
    here = Path(tmp_path_factory.mktemp("here"))
    shutil.copytree(ROBOTS, here / "robots")
    (here / "robots" / "wrist.mtl").write_text("newmtl grey\nKd 0.5 0.5 0.5\n")
    part = Mesh("part", here / "robots" / "wrist.obj", Pose(np.array([2.0, 0.0, 0.0]), np.eye(3)))
    urdf = here / "robots" / "six_axis.urdf"
    with Planner.from_urdf(urdf, "tool", workcell=[part]) as planner:
        path = planner.plan([0.0] * 6, GOAL, FREE)
        assert path.status == "solved", path.explanation
        planner.bundle.write(here / "planner")
    there = Path(tmp_path_factory.mktemp("there")) / "planner"
    shutil.move(here / "planner", there)
    shutil.rmtree(here)
    return there, path.joints


@pytest.fixture
def folder(handed_on, tmp_path) -> Path:
    return Path(shutil.copytree(handed_on[0], tmp_path / "planner"))


def sealed(folder: Path, card: dict) -> Path:
    card["sha256"][CARD] = card_digest(card)
    (folder / CARD).write_text(json.dumps(card))
    return folder


def card_of(folder: Path) -> dict:
    return dict(json.loads((folder / CARD).read_text()))


def a_mesh(folder: Path) -> Path:
    return next((folder / FILES).rglob("wrist.obj"))


def test_it_plans_the_same_paths_elsewhere(handed_on, monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    with Planner.load(handed_on[0]) as planner:
        assert [shape.name for shape in planner.scene.workcell] == ["part"]
        path = planner.plan([0.0] * 6, GOAL, FREE)
    np.testing.assert_array_equal(path.joints, handed_on[1])


def test_the_files_lie_in_the_folder_under_their_contents(folder) -> None:
    names = {file.relative_to(folder).as_posix() for file in (folder / FILES).rglob("*.*")}
    assert sorted(Path(name).name.split("-")[0] for name in names) == [
        "six_axis",
        "wrist.mtl",
        "wrist.obj",
    ]
    assert names <= card_of(folder)["sha256"].keys()
    assert str(folder) not in (folder / CARD).read_text()


def a_robot(folder: Path, drawn: Path) -> Path:
    """A copy of the tests' robots; one's URDF shows a mesh besides."""
    assert drawn.is_file()
    shutil.copytree(ROBOTS, folder / "robots")
    urdf = folder / "robots" / "six_axis.urdf"
    shown = f'<visual><geometry><mesh filename="{drawn}"/></geometry></visual>'
    head, mark, rest = urdf.read_text().partition("<collision>")
    urdf.write_text(head + shown + mark + rest)
    return urdf


@pytest.mark.parametrize("name", ["link.stl", "link.obj", "link.dae"])
def test_a_file_that_is_no_mesh_is_not_handed_on(name, tmp_path) -> None:
    """A robot's folder may come from somebody to whom the planner goes back.  PyBullet loads no
    robot that shows a file of another name.
    """
    secret = tmp_path / "secret"
    secret.write_text("v 1 2\nhunter2\n")
    os.symlink(secret, tmp_path / name)
    urdf = a_robot(tmp_path, tmp_path / name)
    os.symlink(secret, tmp_path / "robots" / "wrist.mtl")
    with Planner.from_urdf(urdf, "tool") as planner:
        planner.bundle.write(tmp_path / "planner")
    written = [file for file in (tmp_path / "planner").rglob("*") if file.is_file()]
    assert {"six_axis", "wrist.obj"} <= {file.name.split("-")[0] for file in written}
    assert not [file for file in written if b"hunter2" in file.read_bytes()]


def test_what_is_shown_is_handed_on(tmp_path) -> None:
    write_bricks(tmp_path / "cover.stl", [Brick((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))])
    urdf = a_robot(tmp_path, tmp_path / "cover.stl")
    with Planner.from_urdf(urdf, "tool") as planner:
        planner.bundle.write(tmp_path / "planner")
    assert [file.name for file in (tmp_path / "planner").rglob("cover.*")] == ["cover.stl"]


def test_written_again_it_is_the_same(folder, tmp_path) -> None:
    open_bundle(folder)[0].write(tmp_path / "again")
    assert (tmp_path / "again" / CARD).read_bytes() == (folder / CARD).read_bytes()


def test_the_same_robot_is_told_by_its_files(folder, tmp_path) -> None:
    first = open_bundle(folder)[0].robot
    other = open_bundle(Path(shutil.copytree(folder, tmp_path / "other")))[0].robot
    assert first != other
    assert as_taken(first) == as_taken(other)
    assert as_taken(first) != as_taken(packaged_bundle().robot)


def test_what_is_pybullet_s_stays_there(tmp_path) -> None:
    packaged_bundle().write(tmp_path)
    assert not (tmp_path / FILES).exists()
    assert card_of(tmp_path)["robot"]["urdf"] == "xarm/xarm6_robot.urdf"


def test_a_file_that_was_altered_or_is_missing_is_named(folder) -> None:
    mesh = a_mesh(folder)
    mesh.write_text(mesh.read_text() + "# more\n")
    with pytest.raises(BundleError, match=r"wrist\.obj: altered"):
        open_bundle(folder)
    mesh.unlink()
    with pytest.raises(BundleError, match=r"wrist\.obj: No such file"):
        open_bundle(folder)


@pytest.mark.parametrize("name", [f"{FILES}/../../secret", f"{FILES}/\0", f"{FILES}/link"])
def test_what_lies_outside_is_not_read(folder, name) -> None:
    (folder.parent / "secret").write_text("hunter2")
    os.symlink(folder.parent / "secret", folder / FILES / "link")
    card = card_of(folder)
    card["sha256"][name] = "0" * 64
    with pytest.raises(BundleError, match=r"outside|no name of a file"):
        open_bundle(sealed(folder, card))


def test_a_file_without_a_checksum_is_refused(folder) -> None:
    card = card_of(folder)
    del card["sha256"][card["robot"]["urdf"]]
    with pytest.raises(BundleError, match="checksum is missing"):
        open_bundle(sealed(folder, card))


@pytest.fixture
def cached(handed_on, monkeypatch, tmp_path) -> Path:
    """Where files that MLflow takes away again are kept; MLflow's are those of `handed_on`."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    @contextmanager
    def fetched(source: str) -> Iterator[Path]:
        place = tmp_path / "fetched"
        yield Path(shutil.copytree(handed_on[0], place))
        shutil.rmtree(place)

    monkeypatch.setattr(bundle, "plug", lambda _: fetched)
    return tmp_path / "cache"


def test_mlflow_s_folder_may_go_away(cached) -> None:
    for _ in range(2):
        found, where = open_bundle("models:/arm/1")
        assert isinstance(found, Bundle)
        assert Path(found.robot.urdf).is_relative_to(cached)
        with Planner(found, where) as planner:
            assert planner.plan([0.0] * 6, GOAL, FREE).status == "solved"


@pytest.mark.parametrize("damage", ["cut", "gone"])
def test_a_damaged_copy_is_made_again(cached, damage) -> None:
    open_bundle("models:/arm/1")
    (mesh,) = cached.rglob("wrist.obj")
    whole = mesh.read_bytes()
    mesh.unlink()
    if damage == "cut":
        mesh.write_bytes(whole[:10])
    for _ in range(2):
        assert isinstance(open_bundle("models:/arm/1")[0], Bundle)
        assert mesh.read_bytes() == whole
