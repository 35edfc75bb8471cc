"""Checks of what Rerun shows: its window and its recordings."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from constraint_geodesics.doctor.surroundings import Surroundings, answer_of, few, numbers

if TYPE_CHECKING:
    from collections.abc import Iterator

    from constraint_geodesics.doctor.surroundings import Look, Said


def check_display(root: Path, here: Surroundings) -> Look:
    """Rerun's window needs a display; its viewer in a browser needs none."""
    del root
    shown = next((name for name in ("WAYLAND_DISPLAY", "DISPLAY") if here.environ.get(name)), None)
    if shown is None and here.platform.startswith("linux"):
        said = "there is none (DISPLAY and WAYLAND_DISPLAY are unset), so Rerun's window can't open"
        yield "note", said, "geodesics replay FILE --web"
    return f"{shown}={here.environ[shown]}" if shown else f"the one of {here.platform}"


def check_recordings(root: Path, here: Surroundings) -> Look:
    """Rerun's viewer opens recordings of its own version and the one before; `rerun` must be the
    one installed here.

    A file begins with RRF and a digit, then one byte each of major, minor and patch version.
    """
    installed = here.installed.get("rerun-sdk")
    if installed is None:
        yield "note", "rerun-sdk is not installed: recordings can't be written or opened", ""
        return ""
    own = numbers(installed)[:2]
    files = [
        file
        for folder in ("data/recordings", "first_path")
        for file in (root / folder).rglob("*.rrd")
    ]
    broken: list[str] = []
    versions: Counter[tuple[int, ...]] = Counter()
    for file in files:
        with file.open("rb") as content:
            head = content.read(8)
        if len(head) == 8 and head[:3] == b"RRF":
            versions[tuple(head[4:7])] += 1
        else:
            broken.append(file.relative_to(root).as_posix())
    if broken:
        mend = (
            f"rm {shlex.quote(broken[0])}, and record it again: dvc repro, or geodesics "
            f"plan --record"
        )
        yield (
            "problem",
            f"{len(broken)} of {len(files)} are no recordings (cut short?): {few(broken)}",
            mend,
        )
    for version, count in sorted(versions.items()):
        named = f"{count} of {len(files)} are of Rerun {'.'.join(map(str, version))}"
        if version[:2] > own:
            mend = (
                f"python -m pip install rerun-sdk=={'.'.join(map(str, version))}, or record "
                f"them again: dvc repro"
            )
            yield (
                "problem",
                f"{named}, newer than the installed {installed}, which may not open them",
                mend,
            )
        elif version[:2] < (own[0], own[1] - 1):
            mend = "python -m rerun rrd migrate FILE, or record them again: dvc repro"
            yield (
                "note",
                f"{named}; the installed {installed} promises to open only those of the "
                f"version before",
                mend,
            )
    yield from _other_viewer(here, installed)
    return f"{len(files)} found, all for the installed Rerun {installed}"


def _other_viewer(here: Surroundings, installed: str) -> Iterator[Said]:
    """`geodesics replay` starts its own viewer; who types `rerun` gets the first on PATH."""
    found = shutil.which("rerun", path=here.environ.get("PATH"))
    if found is None or Path(found).resolve().parent == (here.prefix / "bin").resolve():
        return
    try:
        told = answer_of([found, "--version"], Path(), here.environ, 10.0).stdout
    except (OSError, subprocess.TimeoutExpired):
        told = ""
    version = re.search(r"\d+\.\d+\.\d+\S*", told)
    if version is None:
        yield (
            "note",
            f"{found} does not tell its version; this environment has {installed}",
            "geodesics replay FILE",
        )
    elif version[0] != installed:
        said = (
            f"`rerun` on PATH is {found} of version {version[0]}, but this environment has "
            f"{installed}"
        )
        yield "note", said, "geodesics replay FILE, which starts the right one"
