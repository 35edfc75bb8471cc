"""Checks of the checkout itself: git, room and the robot's files."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from constraint_geodesics.doctor.surroundings import (
    Surroundings,
    answer_of,
    completing,
    few,
    is_checkout,
    locked,
    on_path,
)

if TYPE_CHECKING:
    from constraint_geodesics.doctor.surroundings import Look

LEAST_FREE = 2_000_000_000
"""Bytes: an environment and one run of the pipeline take about that."""


def check_git(root: Path, here: Surroundings) -> Look:
    """DVC refuses to run outside of a git repository, and a run names the commit it was made
    from.
    """
    if not is_checkout(root):
        return ""
    git = shutil.which("git", path=here.environ.get("PATH"))
    if git is None:
        yield (
            "problem",
            "git is not installed: no stage can tell the commit it runs from",
            "install git",
        )
        return ""
    command = [git, "-C", str(root), "rev-parse", "--show-toplevel"]
    answer = answer_of(command, root, {**here.environ, "LC_ALL": "C"}, 10.0)
    if answer.returncode == 0:
        return f"a repository in {answer.stdout.strip()}"
    if "dubious ownership" in answer.stderr:
        mend = f"git config --global --add safe.directory {shlex.quote(str(root.resolve()))}"
        yield "problem", "git refuses this checkout, because another user owns it", mend
    else:
        mend = "clone the project with git, or: dvc config core.no_scm true"
        yield (
            "problem",
            "this is no git repository: DVC refuses to run, and runs name no commit",
            mend,
        )
    return ""


def check_disk(root: Path, here: Surroundings, least: int = LEAST_FREE) -> Look:
    """Room for a run, and folders that can be written.  least: bytes."""
    del here
    for folder in (root, *(root / name for name in ("data", "reports", ".dvc", ".geodesics"))):
        if folder != root and not folder.is_dir():
            continue
        try:
            with tempfile.TemporaryFile(dir=str(folder)):
                pass
        except OSError as error:
            mend = (
                f"sudo chown -R $(id -u) {shlex.quote(str(folder))}, or work in a checkout "
                f"of your own"
            )
            yield "problem", f"{folder.resolve()} can't be written: {error.strerror}", mend
    free = shutil.disk_usage(root).free
    if free < least:
        mend = "delete what is not needed; `dvc gc --workspace` drops results of earlier parameters"
        yield "problem", f"{free / 1e9:.1f} GB free, where a run needs {least / 1e9:.0f}", mend
    return f"{free / 1e9:.0f} GB free"


def check_robot(root: Path, here: Surroundings) -> Look:
    """The URDFs that params.yaml and the planner's files name, found as the planner finds them, and
    their meshes.
    """
    data, counted = on_path(here, "pybullet_data"), []
    for name, where in _urdf_names(root, here).items():
        places = [root / name, *([data / name] if data else [])]
        urdf = next((place for place in places if place.is_file()), None)
        if urdf is None:
            lacking = (
                f"{name}, which {where} names, is neither in this checkout nor in pybullet_data"
            )
            yield (
                "problem",
                lacking,
                f"mend the name in {where}" if data else completing(root, here),
            )
            continue
        packaged = data is not None and data in urdf.parents
        try:
            meshes = [mesh.get("filename", "") for mesh in ElementTree.parse(urdf).iter("mesh")]
        except ElementTree.ParseError as error:
            yield (
                "problem",
                f"{urdf}: not XML: {error}",
                _reinstall_pybullet(root) if packaged else "mend the file",
            )
            continue
        missing = list(dict.fromkeys(mesh for mesh in meshes if not _mesh_found(mesh, urdf)))
        counted.append(f"{name} with {len(meshes)} meshes")
        if missing:
            put = f"put them in one of the folders above {urdf}, as the URDF names them"
            lacking = f"{urdf}: {len(missing)} of its meshes are missing: {few(missing)}"
            yield "problem", lacking, _reinstall_pybullet(root) if packaged else put
    return ", ".join(counted)


def _urdf_names(root: Path, here: Surroundings) -> dict[str, str]:
    """URDFs by name, and the file that names each."""
    named: dict[str, str] = {}
    described: list[tuple[str, Any]] = []
    params = root / "params.yaml"
    if params.is_file():
        try:
            import yaml
        except ImportError:  # the planner's files name the robot as well
            pass
        else:
            described.append((params.name, yaml.safe_load(params.read_text("utf-8"))))
    cards = (
        root / "data" / "planner" / "planner.json",
        here.package / "pretrained" / "planner.json",
    )
    card = next((file for file in cards if file.is_file()), None)
    if card is not None:
        described.append((str(card), json.loads(card.read_text("utf-8"))))
    for where, parameters in described:
        named.setdefault(parameters["robot"]["urdf"], where)
        for body in parameters["workcell"]["urdfs"].values():
            named.setdefault(body["urdf"], where)
    return named


def _mesh_found(name: str, urdf: Path) -> bool:
    """PyBullet and Rerun look in all folders above a URDF."""
    bare = re.sub(r"^(package|model|file)://", "", name)
    return any((folder / bare).is_file() for folder in urdf.resolve().parents)


def _reinstall_pybullet(root: Path) -> str:
    wanted = locked(root).get("pybullet")
    return (
        f"python -m pip install --force-reinstall --no-deps "
        f"pybullet{f'=={wanted}' if wanted else ''}"
    )
