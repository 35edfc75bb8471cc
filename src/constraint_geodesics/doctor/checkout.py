"""Checks of the checkout itself: git, room, the robot's files and compiled kernels."""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from constraint_geodesics.doctor.surroundings import (
    PACKAGE,
    Surroundings,
    answer_of,
    completing,
    few,
    is_checkout,
    locked,
    on_path,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

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
        workcell = parameters["workcell"]
        for shape in {**workcell.get("urdfs", {}), **workcell.get("shapes", {})}.values():
            if "urdf" in shape:
                named.setdefault(shape["urdf"], where)
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


def check_kernels(root: Path, here: Surroundings) -> Look:
    """Numba notices a change of the file a kernel stands in, but not of one whose kernels it calls.

    Caches older than their own file are of no use to numba, so they are not counted.
    """
    package = root / "src" / PACKAGE if is_checkout(root) else here.package
    texts = {file: file.read_text("utf-8") for file in package.rglob("*.py")}
    changed = {file: file.stat().st_mtime for file, text in texts.items() if "numba" in text}
    caches, stale, newer = 0, [], set()
    for file, own in changed.items():
        called = [
            other for other in _reached(file, package, texts) if other in changed and other != file
        ]
        for cache in (file.parent / "__pycache__").glob(f"{file.stem}.*.nb[ic]"):
            caches += 1
            made = cache.stat().st_mtime
            later = [other for other in called if own <= made < changed[other]]
            if later:
                stale.append(cache)
                newer.update(later)
    if not stale:
        return f"{caches} files of compiled kernels, none older than a kernel that it calls"
    names = few(sorted(file.relative_to(package).as_posix() for file in newer))
    folder = "src" if is_checkout(root) else shlex.quote(str(package))
    mend = f"find {folder} -name '*.nb[ic]' -delete"
    yield (
        "problem",
        f"{len(stale)} of {caches} files of compiled kernels are older than {names}, which "
        f"they call",
        mend,
    )
    return ""


def _reached(file: Path, package: Path, texts: Mapping[Path, str]) -> set[Path]:
    """All files of the package that a file imports, those that they import, and so on."""
    found: set[Path] = set()
    left = [file]
    while left:
        own = left.pop()
        if own in found or own not in texts:
            continue
        found.add(own)
        for node in ast.walk(ast.parse(texts[own])):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE:
                folder = package.joinpath(*str(node.module).split(".")[1:])
                left.append(folder.with_suffix(".py"))
                left += [folder / f"{name.name}.py" for name in node.names]
    return found
