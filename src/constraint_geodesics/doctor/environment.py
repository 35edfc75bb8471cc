"""Checks of the Python in use and the packages it has."""

from __future__ import annotations

import json
import re
import shlex
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote, urlsplit

from constraint_geodesics.doctor.surroundings import (
    ACTIVATE,
    NEW_ENVIRONMENT,
    PACKAGE,
    Surroundings,
    completing,
    few,
    is_checkout,
    locked,
    normal,
    own_environment,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from constraint_geodesics.doctor.surroundings import Look, Said

NEEDED_PYTHON = (3, 11)


def check_python(root: Path, here: Surroundings) -> Look:
    """PyBullet has wheels for Python 3.11 and none for later ones."""
    version, needed = ".".join(map(str, here.python)), ".".join(map(str, NEEDED_PYTHON))
    if here.python[:2] == NEEDED_PYTHON:
        return version
    if own_environment(root, here) is not None:
        yield (
            "problem",
            f"this is Python {version}; {needed} is needed, and .venv has its own",
            ACTIVATE,
        )
    else:
        mend = f"install Python {needed}, then: {NEW_ENVIRONMENT} PYTHON=python{needed}"
        yield (
            "problem",
            f"this is Python {version}; {needed} is needed (PyBullet has no wheels for others)",
            mend,
        )
    return ""


def check_packages(root: Path, here: Surroundings) -> Look:
    """Every package of requirements.lock, in the version it names."""
    wanted = locked(root)
    if not wanted:
        yield "note", "there is no requirements.lock here to compare versions with", ""
        return ""
    missing = [name for name in wanted if normal(name) not in here.installed]
    other = [
        f"{name} {here.installed[normal(name)]}, not {version}"
        for name, version in wanted.items()
        if normal(name) in here.installed and not _same(here.installed[normal(name)], version)
    ]
    mend = completing(root, here)
    if missing:
        yield "problem", f"{len(missing)} of {len(wanted)} are missing: {few(missing)}", mend
    if other:
        yield "problem", f"{len(other)} of {len(wanted)} are of another version: {few(other)}", mend
    return f"all {len(wanted)} of requirements.lock"


def check_torch(root: Path, here: Surroundings) -> Look:
    """Networks are trained on the processor, so that a build for a graphics card only takes
    gigabytes.
    """
    version = here.installed.get("torch")
    if version is None:
        yield "note", "not installed", ""
        return ""
    release, _, build = version.partition("+")
    names = [
        n for n in here.installed if n.startswith("nvidia-") or n in ("triton", "pytorch-triton")
    ]
    unused = sorted(set(names) - {"nvidia-ml-py"})  # which only reads a card's state, and is small
    if not unused and not re.match(r"cu|rocm|xpu", build):
        return f"{version}, without packages for a graphics card"
    beside = f", and {len(unused)} packages for graphics cards" if unused else ""
    mend = (
        f"install torch=={locked(root).get('torch', release)} again in its build for the processor"
    )
    if unused:
        mend += f", then: python -m pip uninstall -y {' '.join(unused)}"
    yield (
        "note",
        f"{version}{beside}: gigabytes that nothing here uses, training is on the processor",
        mend,
    )
    return ""


def check_install(root: Path, here: Surroundings) -> Look:
    """The package in use is this checkout's, and the environment has not been moved."""
    yield from _of_package(root, here)
    yield from _of_scripts(root, here)
    return f"{PACKAGE} from {here.package}"


def _same(version: str, wanted: str) -> bool:
    """A pinned version without a build takes every build, as pip does."""
    return version == wanted or ("+" not in wanted and version.partition("+")[0] == wanted)


def _of_package(root: Path, here: Surroundings) -> Iterator[Said]:
    target = _installed_from(here)
    if not is_checkout(root):
        found = target is not None and is_checkout(target)
        mend = f"cd {shlex.quote(str(target))}" if found else ""
        yield (
            "note",
            f"this folder is no checkout of {PACKAGE}: of its files nothing can be said",
            mend,
        )
        return
    if own_environment(root, here) is not None:
        yield "note", f"this is the Python of {here.prefix}, not that of .venv", ACTIVATE
    own = root.resolve() / "src" / PACKAGE
    used, mend = here.package == own, "python -m pip install --no-deps --editable ."
    if target is not None and not is_checkout(target):
        gone = f"the environment has the package from {target}, which is no longer there"
        yield "problem", f"{gone} (was this checkout moved?)", NEW_ENVIRONMENT
    elif not used:
        in_place = target is not None and target.resolve() == root.resolve()
        said = (
            f"the package in use is {here.package}, not this checkout's: changes here have "
            f"no effect"
        )
        yield "problem", said, "unset PYTHONPATH" if in_place else mend
    elif target is None:
        yield "note", "the package is not installed, only found by PYTHONPATH or from src", mend
    elif target.resolve() != root.resolve():
        said = (
            f"the environment has the package from {target}, another checkout; only "
            f"PYTHONPATH puts this one first"
        )
        yield "note", said, mend


def _installed_from(here: Surroundings) -> Path | None:
    """The checkout that pip was told to install from, for changes in it to be seen at once."""
    for found in metadata.distributions(name=PACKAGE.replace("_", "-"), path=list(here.search)):
        about = json.loads(found.read_text("direct_url.json") or "{}")
        if about.get("dir_info", {}).get("editable"):
            return Path(unquote(urlsplit(about["url"]).path))
    return None


def _of_scripts(root: Path, here: Surroundings) -> Iterator[Said]:
    """The programs of an environment name their Python by its full path, which does not move with
    them.
    """
    own = root / ".venv"
    for prefix in dict.fromkeys(folder.resolve() for folder in (own, here.prefix)):
        if not (prefix / "pyvenv.cfg").is_file():
            continue
        programs = prefix / "bin"
        broken, foreign = [], []
        for script in sorted(file for file in programs.glob("*") if file.is_file()):
            python = _interpreter(script)
            if python is None:
                continue
            if not python.exists():
                broken.append((script.name, python))
            elif python.name.startswith("python") and python.parent.resolve() != programs:
                foreign.append((script.name, python))
        again = (
            NEW_ENVIRONMENT if prefix == own.resolve() else f"make the environment {prefix} again"
        )
        for scripts, what in (
            (broken, "which does not exist"),
            (foreign, "of another environment"),
        ):
            if scripts:
                message = (
                    f"{few([name for name, _ in scripts])} in {programs} start "
                    f"{scripts[0][1]}, {what}"
                )
                yield "problem", message, again


def _interpreter(script: Path) -> Path | None:
    """The full path of the program that a script is for; None if it names none."""
    with script.open("rb") as content:
        first, second = (content.readline(500).decode("utf-8", "replace") for _ in range(2))
    if not first.startswith("#!"):
        return None
    words = first[2:].split()
    if (
        words and Path(words[0]).name == "sh" and second.startswith("'''exec'")
    ):  # pip's way with a long path
        words = shlex.split(second[len("'''exec'") :].partition('"$0"')[0])
    named = bool(words) and Path(words[0]).is_absolute() and Path(words[0]).name != "env"
    return Path(words[0]) if named else None
