"""`geodesics doctor` on conditions made for real: a failure is found and its mend named, a sound
state left alone.
"""

import ast
import fcntl
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
import venv
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
import rerun as rr
import yaml
from mlflow import MlflowClient
from mlflow.exceptions import MlflowException
from tests.test_cli_plan import said_aloud, strict

from constraint_geodesics import bundle
from constraint_geodesics.doctor import (
    CHECKS,
    COLOURS,
    Finding,
    Surroundings,
    as_text,
    check_disk,
    check_pipeline,
    examine,
    exit_code,
    numbers,
    versions_in,
)
from constraint_geodesics.robot.kinematics import RobotError
from constraint_geodesics.scene.urdf import data_path, find_urdf

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = Path(bundle.__file__).parent
SOURCES = PACKAGE.parent
ENVIRON = {n: v for n, v in os.environ.items() if not n.startswith(("MLFLOW_", "DVC_", "GIT_"))}
FROM_SOURCES = {**ENVIRON, "PYTHONPATH": str(SOURCES)}
HERE = replace(Surroundings.here(), environ=ENVIRON)


def look(check: str, root: Path, here: Surroundings = HERE) -> list[Finding]:
    return examine(root, here, {check: CHECKS[check]})


def only(findings: list[Finding], status: str) -> Finding:
    """The one finding, of this status, in one line; what is amiss has a mend."""
    (finding,) = findings
    assert finding.status == status, finding
    assert "\n" not in finding.message + finding.mend
    assert bool(finding.mend) == (status != "ok")
    return finding


def with_environ(**changes: str | None) -> Surroundings:
    changed = {**ENVIRON, **changes}
    return replace(HERE, environ={n: value for n, value in changed.items() if value is not None})


def run(
    *command: str | Path, folder: Path, environ: Mapping[str, str] = ENVIRON
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        env=dict(environ),
        capture_output=True,
        text=True,
        check=False,
    )


def distribution(
    site: Path, name: str, version: str, url: str | None = None, needs: Sequence[str] = ()
) -> None:
    """What pip leaves of an installed package; url: of one that is installed from a folder, to be
    changed there; needs: its requirements.
    """
    folder = site / f"{name.replace('-', '_')}-{version}.dist-info"
    folder.mkdir(parents=True)
    lines = [f"Name: {name}", f"Version: {version}", *(f"Requires-Dist: {own}" for own in needs)]
    (folder / "METADATA").write_text("\n".join(["Metadata-Version: 2.1", *lines, ""]))
    if url is not None:
        about = {"dir_info": {"editable": True}, "url": url}
        (folder / "direct_url.json").write_text(json.dumps(about))


def checkout(folder: Path) -> Path:
    (folder / "src" / "constraint_geodesics").mkdir(parents=True)
    return folder


# Python, packages, torch


@pytest.mark.parametrize(
    ("version", "status"), [((3, 12, 1), "note"), ((3, 10, 4), "problem"), ((3, 8, 0), "problem")]
)
def test_another_python_is_named(tmp_path, version, status) -> None:
    found = only(look("python", tmp_path, replace(HERE, python=version)), status)
    assert found.message.startswith(f"this is Python {'.'.join(map(str, version))}; 3.11 is needed")
    assert "make env PYTHON=python3.11" in found.mend


def test_the_checkouts_own_environment_is_pointed_at(tmp_path) -> None:
    venv.create(tmp_path / ".venv", with_pip=False)
    found = only(look("python", tmp_path, replace(HERE, python=(3, 10, 1))), "problem")
    assert found.mend == "source .venv/bin/activate"
    found = only(look("python", tmp_path, replace(HERE, python=(3, 11, 9))), "ok")
    assert found.message == "3.11.9"


def imported_at_once(file: Path) -> set[Path]:
    """A module and all of this package that it imports while it is imported itself."""
    reached = {file, PACKAGE / "__init__.py"}
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE.name):
            reached |= imported_at_once(SOURCES / f"{node.module.replace('.', '/')}.py")
    return reached


def evaluated_annotations(tree: ast.Module) -> list[ast.AST]:
    """Those that a Python reads while it imports the module, but for names and constants."""
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    if any(node.module == "__future__" for node in imports):
        return []
    given = [node.annotation for node in ast.walk(tree) if isinstance(node, ast.arg)]
    given += [node.returns for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [node for node in given if isinstance(node, ast.Subscript | ast.BinOp)]


NEWER = {"cache", "pairwise", "batched", "tomllib", "StrEnum"}
"""Of the standard library, what Python 3.8 does not have."""


def test_an_older_python_can_import_the_module() -> None:
    """And all that it imports: what that Python does not have stands in annotations alone, which it
    never evaluates.
    """
    files = imported_at_once(PACKAGE / "doctor.py") | imported_at_once(PACKAGE / "__init__.py")
    assert {"doctor.py", "left.py", "folders.py", "kernel_digest.py"} <= {own.name for own in files}
    for file in files:
        tree = ast.parse(file.read_text(), feature_version=(3, 8))
        assert evaluated_annotations(tree) == [], file
        names = [n.name for node in tree.body for n in getattr(node, "names", ())]
        assert not NEWER & set(names), file


def old_pythons() -> list[str]:
    """Those of this machine: of the path, or of pyenv."""
    named = [shutil.which(f"python3.{minor}") for minor in (8, 9, 10)]
    kept = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [*filter(None, named), *map(str, sorted(kept.glob("3.[89].*/bin/python")))]
    return [
        own
        for own in found
        if subprocess.run([own, "-c", ""], check=False, capture_output=True).returncode == 0
    ]


@pytest.mark.parametrize("python", old_pythons())
def test_an_older_python_says_that_it_is_one(python, tmp_path) -> None:
    done = run(
        python, "-B", "-m", "constraint_geodesics.doctor", folder=tmp_path, environ=FROM_SOURCES
    )
    assert done.returncode == 1, done.stderr
    assert "3.11 is needed" in done.stdout


def test_it_runs_without_any_package(tmp_path) -> None:
    """A Python that sees nothing but the standard library and src."""
    shutil.copy(ROOT / "requirements.lock", tmp_path)
    shutil.copy(ROOT / "params.yaml", tmp_path)
    words = ("-S", "-m", "constraint_geodesics.doctor", "--json")
    done = run(sys.executable, *words, folder=tmp_path, environ=FROM_SOURCES)
    assert done.stderr == ""
    assert done.returncode == 1
    answer = json.loads(done.stdout)
    assert answer["ok"] is False
    findings = {entry["check"]: entry for entry in answer["findings"]}
    count = len((ROOT / "requirements.lock").read_text().splitlines())
    assert findings["packages"]["message"].startswith(
        f"{count} of {count} are missing: aiohappyeyeballs, aiohttp, "
    )
    assert findings["packages"]["message"].endswith(f"and {count - 4} more")
    assert "neither in this checkout nor in pybullet_data" in findings["robot"]["message"]
    assert "could not be looked at" not in done.stdout


def test_packages_are_compared_with_the_lock(tmp_path) -> None:
    site = tmp_path / "site"
    there = {"torch": "2.13.0+cpu", "Ruamel_Yaml": "0.19.1", "numpy": "1.26.4", "extra": "1"}
    for name, version in there.items():
        distribution(site, name, version)
    here = replace(HERE, installed=versions_in([str(site)]))
    lock = tmp_path / "requirements.lock"
    lock.write_text("# pinned\ntorch==2.13.0\nruamel.yaml==0.19.1\n")
    assert only(look("packages", tmp_path, here), "ok").message == "all 2 of requirements.lock"
    lock.write_text("torch==2.13.0\nruamel.yaml==0.19.1\nnumpy==2.4.6\nPyYAML==6.0.3\n")
    missing, other = look("packages", tmp_path, here)
    assert missing.message == "1 of 4 are missing: PyYAML"
    assert other.message == "1 of 4 are of another version: numpy 1.26.4, not 2.4.6"
    assert missing.status == other.status == "problem"
    words = missing.mend.split()
    assert words[:4] == ["python", "-m", "pip", "install"]
    assert (ROOT / words[-1]).is_file()
    makefile = (ROOT / "Makefile").read_text()
    (hashed,) = re.findall(r"^HASHED := (.*)$", makefile, re.M)
    assert set(words[4:-2]) == set(hashed.split()) - {"$(INSTALL)", "--no-compile"}
    lock.write_text("torch==2.12.0\n")
    found = only(look("packages", tmp_path, here), "problem")
    assert "torch 2.13.0+cpu, not 2.12.0" in found.message


def test_an_environment_for_planning_alone_lacks_nothing(tmp_path) -> None:
    site, lock = tmp_path / "site", tmp_path / "requirements.lock"
    needs = ("numba>=0.63", 'pybullet; python_version < "3.12"', 'dvc==3.67.1; extra == "pipeline"')
    distribution(site, "constraint-geodesics", "0.1.0", needs=needs)
    distribution(site, "numba", "0.68.0")
    lock.write_text("numba==0.68.0\ndvc==3.67.1\n")

    def here() -> Surroundings:
        return replace(HERE, search=(str(site),), installed=versions_in([str(site)]))

    found = only(look("packages", tmp_path, here()), "note")
    assert found.message == "1 of 2 are missing, of the pipeline: dvc; planning works without"
    shutil.rmtree(site / "numba-0.68.0.dist-info")
    assert only(look("packages", tmp_path, here()), "problem").message.startswith("2 of 2")


def test_of_two_versions_the_one_that_python_finds_counts(tmp_path) -> None:
    distribution(tmp_path / "first", "numpy", "2.4.6")
    distribution(tmp_path / "second", "numpy", "1.26.4")
    (tmp_path / "first" / "scipy-1.17.1.dist-info").mkdir()  # broken: nothing in it
    folders = [str(tmp_path / "first"), str(tmp_path / "second")]
    assert versions_in(folders) == {"numpy": "2.4.6"}
    ask = f"from constraint_geodesics.doctor import versions_in; print(versions_in({folders}))"
    # without site packages: one of MLflow's replaces Python's own way to look
    done = run(sys.executable, "-S", "-c", ask, folder=tmp_path, environ=FROM_SOURCES)
    assert done.stdout == "{'numpy': '2.4.6'}\n"


@pytest.mark.parametrize(
    ("installed", "parts"),
    [
        ({"torch": "2.13.0+cu130"}, ("2.13.0+cu130:",)),
        (
            {"torch": "2.13.0", "nvidia-cublas": "13.0", "triton": "3.6"},
            ("and 2 packages", "-y nvidia-cublas triton"),
        ),
        ({"torch": "2.13.0+rocm7.0"}, ("2.13.0+rocm7.0",)),
    ],
)
def test_torch_for_a_graphics_card_is_noted(tmp_path, installed, parts) -> None:
    (tmp_path / "requirements.lock").write_text("torch==2.13.0\n")
    found = only(look("torch", tmp_path, replace(HERE, installed=installed)), "note")
    for part in parts:
        assert part in f"{found.message} {found.mend}"
    assert "torch==2.13.0 again in its build for the processor" in found.mend


def test_torch_for_the_processor_is_well(tmp_path) -> None:
    for installed in ({"torch": "2.13.0+cpu", "nvidia-ml-py": "13.0"}, {"torch": "2.13.0"}):
        assert only(look("torch", tmp_path, replace(HERE, installed=installed)), "ok").mend == ""


# A moved checkout


def in_checkout(root: Path, site: Path, package: Path | None = None) -> Surroundings:
    used = (root / "src" / "constraint_geodesics").resolve() if package is None else package
    return replace(HERE, search=(str(site),), prefix=root / "no environment", package=used)


def test_a_moved_checkout_is_recognised(tmp_path) -> None:
    old, site = checkout(tmp_path / "old place"), tmp_path / "site"
    distribution(site, "constraint-geodesics", "0.1.0", old.as_uri())
    assert only(look("install", old, in_checkout(old, site)), "ok").message.startswith(
        "constraint_geodesics from"
    )
    new = old.rename(tmp_path / "new")
    found = only(look("install", new, in_checkout(new, site)), "problem")
    assert f"from {old}, which is no longer there" in found.message
    assert found.mend == "rm -rf .venv && make env"


def test_the_package_of_another_checkout_is_recognised(tmp_path) -> None:
    own, other, site = checkout(tmp_path / "own"), checkout(tmp_path / "other"), tmp_path / "site"
    distribution(site, "constraint-geodesics", "0.1.0", other.as_uri())
    used = other / "src" / "constraint_geodesics"
    found = only(look("install", own, in_checkout(own, site, used)), "problem")
    assert str(used) in found.message
    assert found.mend == "python -m pip install --no-deps --editable ."
    found = only(look("install", own, in_checkout(own, site)), "note")
    assert f"from {other}, another checkout; only PYTHONPATH" in found.message
    here = in_checkout(other, site, own / "src" / "constraint_geodesics")
    assert only(look("install", other, here), "problem").mend == "unset PYTHONPATH"


def test_a_folder_that_is_no_checkout_is_noted(tmp_path) -> None:
    other, site = checkout(tmp_path / "other"), tmp_path / "site"
    distribution(site, "constraint-geodesics", "0.1.0", other.as_uri())
    found = only(look("install", tmp_path, in_checkout(tmp_path, site)), "note")
    assert "no checkout" in found.message
    assert found.mend == f"cd {other}"


def test_programs_of_a_moved_or_copied_environment_are_recognised(tmp_path) -> None:
    old = checkout(tmp_path / "old")
    venv.create(old / ".venv", with_pip=False)
    program = old / ".venv" / "bin" / "geodesics"
    program.write_text(f"#!{old}/.venv/bin/python\nprint('here')\n")
    (old / ".venv" / "bin" / "long").write_text(
        f"#!/bin/sh\n'''exec' \"{old}/.venv/bin/python\" \"$0\" \"$@\"\n' '''\nprint('here')\n"
    )
    for file in (program, program.with_name("long")):
        file.chmod(0o755)
        assert run(file, folder=tmp_path).stdout == "here\n"
    site = tmp_path / "site"
    distribution(site, "constraint-geodesics", "0.1.0", old.as_uri())
    assert only(look("install", old, replace(in_checkout(old, site), prefix=old / ".venv")), "ok")

    copy = Path(shutil.copytree(old, tmp_path / "copy", symlinks=True))
    here = replace(in_checkout(copy, site), prefix=copy / ".venv")
    named = [finding for finding in look("install", copy, here) if ".venv" in finding.message]
    assert only(named, "problem").message == (
        f"geodesics, long in {copy}/.venv/bin start {old}/.venv/bin/python, of another environment"
    )
    new = old.rename(tmp_path / "new")
    with pytest.raises(FileNotFoundError):
        run(new / ".venv" / "bin" / "geodesics", folder=tmp_path)
    here = replace(in_checkout(new, site), prefix=new / ".venv")
    package, programs = look("install", new, here)
    assert "no longer there" in package.message
    assert programs.message == (
        f"geodesics, long in {new}/.venv/bin start {old}/.venv/bin/python, which does not exist"
    )
    assert package.mend == programs.mend == "rm -rf .venv && make env"


# git and the disk


def test_a_checkout_without_git_is_recognised(tmp_path) -> None:
    root = checkout(tmp_path / "downloaded")
    here = with_environ(GIT_CEILING_DIRECTORIES=str(tmp_path))
    found = only(look("git", root, here), "problem")
    assert "no git repository" in found.message
    assert "dvc config core.no_scm true" in found.mend
    nowhere = with_environ(PATH=str(tmp_path))
    assert only(look("git", root, nowhere), "problem").mend == "install git"
    run("git", "init", "--quiet", folder=root)
    assert only(look("git", root, here), "ok").message == f"a repository in {root}"


def test_a_checkout_of_another_user_is_recognised(tmp_path) -> None:
    root = checkout(tmp_path)
    run("git", "init", "--quiet", folder=root)
    here = with_environ(
        GIT_TEST_ASSUME_DIFFERENT_OWNER="1", HOME=str(tmp_path), GIT_CONFIG_NOSYSTEM="1"
    )
    found = only(look("git", root, here), "problem")
    assert found.mend == f"git config --global --add safe.directory {root}"
    run(*found.mend.split(), folder=root, environ=here.environ)
    assert only(look("git", root, here), "ok")


def test_a_folder_that_can_not_be_written_and_a_full_disk_are_recognised(tmp_path) -> None:
    assert only(look("disk", tmp_path), "ok").message.endswith("GB free")
    assert not list(tmp_path.iterdir())
    problems = [found.message for found in look("disk", Path("/proc")) if found.status == "problem"]
    assert [message for message in problems if "/proc can't be written" in message]
    (full,) = check_disk(tmp_path, HERE, least=10**18)
    assert full[0] == "problem"
    assert full[1].endswith("GB free, where a run needs 1000000000")


# The robot


def robot_checkout(root: Path, urdf: str) -> Path:
    parameters = yaml.safe_load((ROOT / "params.yaml").read_text())
    parameters["robot"]["urdf"] = urdf
    root.mkdir(exist_ok=True)
    (root / "params.yaml").write_text(yaml.safe_dump(parameters))
    return root


def test_the_packaged_robot_is_whole(tmp_path) -> None:
    robot_checkout(tmp_path, "xarm/xarm6_robot.urdf")
    assert only(look("robot", tmp_path), "ok").message == "xarm/xarm6_robot.urdf with 14 meshes"


def test_a_urdf_that_is_nowhere_is_recognised(tmp_path, monkeypatch) -> None:
    robot_checkout(tmp_path, "xarm/xarm9_robot.urdf")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RobotError):
        find_urdf("xarm/xarm9_robot.urdf")
    found = only(look("robot", tmp_path), "problem")
    assert found.message.startswith("xarm/xarm9_robot.urdf, which params.yaml names, is neither")
    assert found.mend == "mend the name in params.yaml"


def test_missing_meshes_are_recognised(tmp_path) -> None:
    """The URDF alone, then with its meshes beside it, in a folder above it, and without one of
    them.
    """
    name = "robots/arm/arm.urdf"
    root = robot_checkout(tmp_path, name)
    (root / name).parent.mkdir(parents=True)
    shutil.copy(data_path() / "xarm" / "xarm6_robot.urdf", root / name)
    found = only(look("robot", root), "problem")
    assert re.search(
        r"14 of its meshes are missing: package://xarm_description/.* and 10 more$", found.message
    )
    meshes = root / "robots" / "xarm_description"
    shutil.copytree(data_path() / "xarm" / "xarm_description", meshes)
    assert only(look("robot", root), "ok").message.startswith(f"{name} with 14 meshes")
    (meshes / "meshes" / "xarm6" / "visual" / "link3.stl").unlink()
    found = only(look("robot", root), "problem")
    assert (
        "1 of its meshes are missing: package://xarm_description/meshes/xarm6/visual/link3.stl"
        in found.message
    )
    assert str(root / name) in found.mend


def test_what_a_planner_takes_along_is_found_beside_its_card(tmp_path) -> None:
    root = robot_checkout(tmp_path, "arm.urdf")
    shutil.copy(ROOT / "tests" / "robots" / "six_axis.urdf", root / "arm.urdf")
    shutil.copy(ROOT / "tests" / "robots" / "wrist.obj", root)
    (root / "data/planner/files").mkdir(parents=True)
    shutil.move(root / "arm.urdf", root / "data/planner/files/arm.urdf")
    shutil.move(root / "wrist.obj", root / "data/planner/files/wrist.obj")
    params = yaml.safe_load((root / "params.yaml").read_text())
    params["robot"]["urdf"] = "files/arm.urdf"
    (root / "params.yaml").unlink()
    (root / "data/planner/planner.json").write_text(json.dumps(params))
    assert "files/arm.urdf with" in only(look("robot", root), "ok").message


def test_meshes_are_looked_for_where_ros_has_packages(tmp_path) -> None:
    root = robot_checkout(tmp_path / "checkout", "arm.urdf")
    shutil.copy(data_path() / "xarm" / "xarm6_robot.urdf", root / "arm.urdf")
    assert "14 of its meshes are missing" in only(look("robot", root), "problem").message
    here = with_environ(ROS_PACKAGE_PATH=str(data_path() / "xarm"))
    assert only(look("robot", root, here), "ok")


def test_meshes_missing_from_pybullets_own_are_installed_again(tmp_path) -> None:
    site = tmp_path / "site" / "pybullet_data"
    shutil.copytree(data_path() / "xarm", site / "xarm", ignore=shutil.ignore_patterns("link1.stl"))
    (tmp_path / "requirements.lock").write_text("pybullet==3.2.7\n")
    robot_checkout(tmp_path, "xarm/xarm6_robot.urdf")
    here = replace(HERE, search=(str(site.parent),))
    found = only(look("robot", tmp_path, here), "problem")
    assert "visual/link1.stl" in found.message
    assert found.mend == "python -m pip install --force-reinstall --no-deps pybullet==3.2.7"
    (site / "xarm" / "xarm6_robot.urdf").write_text("<robot><link")
    assert "not XML" in only(look("robot", tmp_path, here), "problem").message


# Display and recordings


def test_no_display_is_noted(tmp_path) -> None:
    none = replace(with_environ(DISPLAY=None, WAYLAND_DISPLAY=None), platform="linux")
    assert "--web" in only(look("display", tmp_path, none), "note").mend
    for there in (
        with_environ(DISPLAY=":0"),
        with_environ(DISPLAY="", WAYLAND_DISPLAY="wayland-0"),
    ):
        assert only(look("display", tmp_path, replace(there, platform="linux")), "ok")
    assert only(look("display", tmp_path, replace(none, platform="darwin")), "ok")


def recorded(root: Path) -> Path:
    """A recording as the installed Rerun writes it."""
    file = root / "data" / "recordings" / "stage" / "path.rrd"
    file.parent.mkdir(parents=True)
    stream = rr.RecordingStream("doctor")
    stream.save(str(file))
    stream.log("point", rr.Points3D([[0.0, 0.0, 0.0]]))
    stream.disconnect()
    return file


def test_recordings_of_another_rerun_are_recognised(tmp_path) -> None:
    file = recorded(tmp_path)
    here = with_environ(PATH=str(tmp_path))
    found = only(look("recordings", tmp_path, here), "ok")
    assert found.message == f"1 found, all for the installed Rerun {rr.__version__}"
    written = file.read_bytes()
    major, minor, patch = numbers(rr.__version__)
    assert written[4:7] == bytes((major, minor, patch)), "where Rerun writes its version"
    for later, status, said in (
        (1, "problem", "newer than the installed"),
        (-2, "note", "only those of the version before"),
    ):
        file.write_bytes(written[:5] + bytes((minor + later,)) + written[6:])
        found = only(look("recordings", tmp_path, here), status)
        assert f"1 of 1 are of Rerun {major}.{minor + later}.{patch}" in found.message
        assert said in found.message
    file.write_bytes(written[:5] + bytes((minor - 1,)) + written[6:])
    assert only(look("recordings", tmp_path, here), "ok")
    file.write_bytes(written[:5])
    found = only(look("recordings", tmp_path, here), "problem")
    assert "1 of 1 are no recordings (cut short?): data/recordings/stage/path.rrd" in found.message


def test_another_rerun_on_the_path_is_noted(tmp_path) -> None:
    other = tmp_path / "rerun"
    other.write_text("#!/bin/sh\necho 'rerun-cli 0.22.1 [rustc 1.81.0] x86_64-unknown-linux-gnu'\n")
    other.chmod(0o755)
    here = with_environ(PATH=f"{tmp_path}:{ENVIRON['PATH']}")
    found = only(look("recordings", tmp_path, here), "note")
    assert f"{other} of version 0.22.1, but this environment has {rr.__version__}" in found.message
    own = with_environ(PATH=f"{HERE.prefix / 'bin'}:{tmp_path}")
    assert only(look("recordings", tmp_path, own), "ok")


# MLflow's store


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    """A database that the installed MLflow made."""
    file = tmp_path_factory.mktemp("store") / "mlflow.db"
    MlflowClient(f"sqlite:///{file}").create_experiment("geodesics")
    return file


def altered(store: Path, root: Path, statement: str) -> Path:
    file = Path(shutil.copy(store, root / "mlflow.db"))
    with closing(sqlite3.connect(file)) as database:
        database.execute(statement)
        database.commit()
    return file


UPGRADE, MOVED = "mlflow db upgrade sqlite:///mlflow.db", "mv mlflow.db mlflow.db.newer"


def test_a_store_of_this_mlflow_is_well(store, tmp_path) -> None:
    assert only(look("mlflow", tmp_path), "ok").message == "no runs yet"
    assert only(look("mlflow", store.parent), "ok").message == "runs in mlflow.db"
    there = with_environ(MLFLOW_TRACKING_URI=f"sqlite:///{store}")
    assert only(look("mlflow", tmp_path, there), "ok").message == "runs in mlflow.db"


@pytest.mark.parametrize(
    ("version", "parts"),
    [
        ("451aebb31d03", ("of an older MLflow", f"cp mlflow.db mlflow.db.old && {UPGRADE}")),
        ("ffffffffffff", ("a newer one wrote it", "pip install --upgrade mlflow", MOVED)),
    ],
)
def test_a_store_of_another_schema_is_recognised(store, tmp_path, version, parts) -> None:
    file = altered(store, tmp_path, f"UPDATE alembic_version SET version_num = '{version}'")
    with pytest.raises(MlflowException, match=version):
        MlflowClient(f"sqlite:///{file}").search_experiments()
    found = only(look("mlflow", tmp_path), "problem")
    assert f"schema {version}" in found.message
    for part in parts:
        assert part in f"{found.message} {found.mend}"


def test_a_half_made_store_is_recognised(store, tmp_path) -> None:
    altered(store, tmp_path, "DELETE FROM alembic_version")
    assert "half made" in only(look("mlflow", tmp_path), "problem").message


def test_a_broken_store_is_recognised(store, tmp_path) -> None:
    file = Path(shutil.copy(store, tmp_path / "mlflow.db"))
    file.write_bytes(store.read_bytes()[: store.stat().st_size // 2])
    found = only(look("mlflow", tmp_path), "problem")
    assert re.search("damaged|can't be read: .*malformed", found.message)
    file.write_bytes(b"<<<<<<< HEAD\n" * 1000)
    found = only(look("mlflow", tmp_path), "problem")
    assert "can't be read: file is not a database" in found.message
    assert found.mend.startswith("mv mlflow.db mlflow.db.broken")


def test_a_store_in_use_is_no_broken_one(store, tmp_path) -> None:
    file = Path(shutil.copy(store, tmp_path / "mlflow.db"))
    with closing(sqlite3.connect(file, isolation_level=None)) as database:
        database.execute("BEGIN EXCLUSIVE")
        (found,) = look("mlflow", tmp_path)
    assert found.status == "note"
    assert "in use" in found.message


def test_runs_in_files_are_noted(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    client = MlflowClient((tmp_path / "mlruns").as_uri())
    assert only(look("mlflow", tmp_path), "ok"), "an empty store is nothing to move"
    experiment = client.create_experiment("old")
    for _ in range(2):
        client.create_run(experiment)
    found = only(look("mlflow", tmp_path), "note")
    assert found.message.startswith("2 runs in mlruns/")
    assert "mlflow migrate-filestore --source . --target sqlite:///mlruns.db" in found.mend


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("localhost:5000", "no kind"),
        ("./mlruns", "refuses to keep runs in files"),
        ("http://", "no server"),
        ("file:///tmp/mlruns", "refuses to keep runs in files"),
        ("http://127.0.0.1:99999", "Port out of range"),
        ("sqlite://mlflow.db", "three slashes"),
        ("sqlite:", "no kind"),
        ("postgres://me:secret@host/runs", "no kind"),
    ],
)
def test_an_address_that_mlflow_can_not_use_is_recognised(tmp_path, uri, said) -> None:
    found = only(look("mlflow", tmp_path, with_environ(MLFLOW_TRACKING_URI=uri)), "problem")
    assert found.message.startswith(f"MLFLOW_TRACKING_URI={uri.replace('me:secret@', '')}: ")
    assert said in found.message
    assert "secret" not in found.message


@pytest.mark.parametrize(
    "uri", ["http://127.0.0.1:5000", "https://runs", "postgresql+psycopg2://me:secret@host/runs"]
)
def test_an_address_that_mlflow_can_use_is_well(tmp_path, uri) -> None:
    found = only(look("mlflow", tmp_path, with_environ(MLFLOW_TRACKING_URI=uri)), "ok")
    assert "secret" not in found.message


# The pipeline


PIPELINE = """\
stages:
  draw:
    cmd: >-
      mkdir -p data/drawn/{one,two} && cp params.yaml data/drawn/one/p &&
      cp draw.py data/drawn/two/p
    params: [count]
    deps: [draw.py]
    outs: [data/drawn/one, data/drawn/two]
  show:
    cmd: ls data/drawn > shown.txt && mkdir -p reports && cp draw.py reports/shown.md
    deps: [data/drawn]
    outs:
      - shown.txt
      - reports/shown.md:
          cache: false
"""
BESIDE = (
    "stages:\n  measure:\n    wdir: ..\n    cmd: cp draw.py slow.txt\n    deps: "
    "[draw.py]\n    outs: [slow.txt]\n"
)


def dvc(root: Path, *words: str) -> None:
    done = run(sys.executable, "-m", "dvc", *words, folder=root)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory) -> Path:
    """A committed pipeline that has run."""
    root = tmp_path_factory.mktemp("pipeline")
    (root / "params.yaml").write_text("count: 1\n")
    (root / "draw.py").write_text("# 1\n")
    (root / "dvc.yaml").write_text(PIPELINE.replace("{one,two}", "one data/drawn/two"))
    (root / "data" / "drawn").mkdir(parents=True)
    (root / "data" / "drawn" / "README").write_text("a folder that git keeps\n")
    run("git", "init", "--quiet", folder=root)
    dvc(root, "init", "--quiet")
    dvc(root, "config", "core.analytics", "false")
    dvc(root, "repro", "--quiet")
    run("git", "add", "--all", folder=root)
    identity = ("-c", "user.name=test", "-c", "user.email=test@example.com")
    assert run("git", *identity, "commit", "--quiet", "-m", "ran", folder=root).returncode == 0
    return root


@pytest.fixture
def ran(pipeline, tmp_path) -> Path:
    """A copy of it, with its cache."""
    return Path(shutil.copytree(pipeline, tmp_path / "ran", symlinks=True))


def test_a_pipeline_up_to_date_is_well(ran) -> None:
    assert only(look("pipeline", ran), "ok").message == "all stages are up to date"


def test_changed_parameters_and_code_are_recognised(ran) -> None:
    (ran / "params.yaml").write_text("count: 2\n")
    found = only(look("pipeline", ran), "problem")
    assert found.message == "1 stage out of date: draw (params.yaml: count)"
    assert found.mend == "dvc repro"
    (ran / "params.yaml").write_text("count: 1\n")
    (ran / "draw.py").write_text("# 2\n")
    assert only(look("pipeline", ran), "problem").message == "1 stage out of date: draw (draw.py)"
    dvc(ran, "repro", "--quiet")
    assert only(look("pipeline", ran), "ok")


def test_a_fresh_clone_is_not_called_changed(pipeline, tmp_path) -> None:
    clone = tmp_path / "clone"
    run("git", "clone", "--quiet", pipeline, clone, folder=tmp_path)
    found = only(look("pipeline", clone), "note")
    said = "outputs of 2 stages are not here, as in a fresh clone; planning works without"
    assert found.message == said
    assert found.mend == "make repro"
    (clone / "draw.py").write_text("# 2\n")
    changed, absent = look("pipeline", clone)
    assert (changed.status, changed.message) == ("problem", "1 stage out of date: draw (draw.py)")
    assert absent.message.startswith("outputs of 1 stage are not here")


def test_outputs_that_the_cache_has_are_checked_out(ran) -> None:
    """And those that git keeps come back from there."""
    shutil.rmtree(ran / "data" / "drawn" / "one")
    found = only(look("pipeline", ran), "note")
    assert found.mend == "dvc checkout"
    dvc(ran, *found.mend.split()[1:])
    assert only(look("pipeline", ran), "ok")
    (ran / "shown.txt").unlink()
    (ran / "reports" / "shown.md").unlink()
    found = only(look("pipeline", ran), "note")
    assert found.message == "outputs of 1 stage were deleted, and can be fetched back"
    first, second = found.mend.split(" && ")
    assert second == "git checkout -- reports/shown.md", "no other report is reverted"
    dvc(ran, *first.split()[1:])
    assert run(*second.split(), folder=ran).returncode == 0
    assert only(look("pipeline", ran), "ok")


def test_an_altered_output_is_recognised(ran) -> None:
    (ran / "shown.txt").unlink()
    (ran / "shown.txt").write_text("by hand\n")
    assert only(look("pipeline", ran), "problem").message == "1 stage out of date: show (shown.txt)"


def test_a_pipeline_beside_the_main_one_is_noted(ran) -> None:
    (ran / "stages").mkdir()
    (ran / "stages" / "dvc.yaml").write_text(BESIDE)
    found = only(look("pipeline", ran), "note")
    assert found.message.startswith("1 stage out of date: measure (")
    assert found.mend == "dvc repro stages/dvc.yaml"
    dvc(ran, *found.mend.split()[1:], "--quiet")
    assert only(look("pipeline", ran), "ok")


def test_a_lock_file_broken_by_a_merge_is_recognised(ran) -> None:
    schema = "schema: '2.0'\n"
    (ran / "dvc.lock").write_text(f"<<<<<<< HEAD\n{schema}=======\n{schema}>>>>>>> other\n")
    found = only(look("pipeline", ran), "problem")
    assert "DVC can't read dvc.lock" in found.message
    run(*found.mend.split(), folder=ran)
    assert only(look("pipeline", ran), "ok")


def test_dvc_at_work_or_too_slow_is_noted(ran) -> None:
    (late,) = check_pipeline(ran, HERE, longest_s=0.01)
    assert late[0] == "note"
    assert "took longer than 0.01 s" in late[1]
    with (ran / ".dvc" / "tmp" / "lock").open("r+") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (found,) = look("pipeline", ran)
    assert found.status == "note"
    assert found.message == "DVC is at work here: the stages were not looked at"


def test_a_stage_that_runs_is_no_trouble(ran) -> None:
    (ran / "dvc.yaml").write_text(PIPELINE.replace("cp params.yaml", "sleep 60 && cp params.yaml"))
    command = [sys.executable, "-m", "dvc", "repro", "--quiet"]
    with subprocess.Popen(command, cwd=ran, env=ENVIRON, start_new_session=True) as working:
        try:
            locked, until = ran / ".dvc" / "tmp" / "rwlock", time.monotonic() + 60.0
            while not (locked.is_file() and json.loads(locked.read_text() or "{}").get("write")):
                assert working.poll() is None
                assert time.monotonic() < until
                time.sleep(0.05)
            found = only(look("pipeline", ran), "note")
        finally:
            os.killpg(working.pid, signal.SIGKILL)
    assert found.message == "DVC is at work here: the stages were not looked at"


def test_without_a_pipeline_nothing_is_said(tmp_path) -> None:
    assert look("pipeline", tmp_path) == []


# The command


def test_a_check_that_fails_is_a_problem_and_the_others_go_on(tmp_path) -> None:
    (tmp_path / "requirements.lock").write_bytes(b"\xff\xfe==1\n")
    findings = examine(tmp_path, HERE, {name: CHECKS[name] for name in ("packages", "display")})
    assert findings[0].status == "problem"
    assert findings[0].message.startswith("could not be looked at: UnicodeDecodeError: ")
    assert findings[1].check == "display"
    assert exit_code(findings) == 1
    assert exit_code(findings[1:]) == 0


def test_the_text_is_aligned_and_coloured_on_demand() -> None:
    findings = [
        Finding("disk", "ok", "82 GB free", ""),
        Finding("packages", "problem", "2 are missing", "make env"),
    ]
    assert as_text(findings).splitlines() == [
        "ok       disk:     82 GB free",
        "problem  packages: 2 are missing",
        "                   mend: make env",
    ]
    coloured = as_text(findings, COLOURS)
    assert coloured.startswith("\033[32mok     \033[0m  disk:")
    assert re.sub(r"\033\[\d+m", "", coloured) == as_text(findings)


def command(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    own = (sys.executable, "-m", "constraint_geodesics.cli")
    return run(*own, *words, folder=folder, environ=FROM_SOURCES)


def test_the_command_tells_by_its_exit_code(tmp_path) -> None:
    robot_checkout(tmp_path, "xarm/xarm9_robot.urdf")
    done = command("doctor", folder=tmp_path)
    assert (done.returncode, said_aloud(done.stderr)) == (1, [])
    assert "\033" not in done.stdout
    lines = done.stdout.splitlines()
    assert [line for line in lines if re.match(r"problem  robot: +xarm/xarm9_robot.urdf", line)]
    assert all(re.match(r"(ok     |note   |problem)  \w+: +\S| +mend: \S", line) for line in lines)
    done = command("doctor", "--json", folder=tmp_path)
    assert done.returncode == 1
    answer = strict(done.stdout)
    assert answer["ok"] is False
    (robot,) = [entry for entry in answer["findings"] if entry["check"] == "robot"]
    assert robot["status"] == "problem"
    assert robot["mend"] == "mend the name in params.yaml"
