"""What the checks are told of a process and its environment, and what they have in common."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence

    Status = Literal["ok", "note", "problem"]
    Said = tuple[Status, str, str]
    """Status, message and mend."""
    Look = Generator[Said, None, str]
    """Yields what is amiss; returns what is said where nothing is, blank for nothing at all."""
    Check = Callable[[Path, "Surroundings"], Look]

PACKAGE = "constraint_geodesics"
NEW_ENVIRONMENT = "rm -rf .venv && make env"
INSTALL_LOCK = "python -m pip install -r requirements.lock"
ACTIVATE = "source .venv/bin/activate"
FEW = 4
"""Names in one message."""


@dataclass(frozen=True)
class Surroundings:
    """The process and its environment, as the checks are told of them."""

    python: tuple[int, ...]
    """Its version."""
    platform: str
    prefix: Path
    """Folder of its environment."""
    search: tuple[str, ...]
    """Where it looks for packages."""
    environ: Mapping[str, str]
    package: Path
    """Folder of the package in use."""
    installed: Mapping[str, str]
    """Versions of the distributions, by normalised name."""

    @classmethod
    def here(cls) -> Surroundings:
        """Those of this process."""
        search = tuple(sys.path)
        return cls(
            tuple(sys.version_info[:3]),
            sys.platform,
            Path(sys.prefix),
            search,
            dict(os.environ),
            Path(__file__).resolve().parents[1],
            versions_in(search),
        )


def versions_in(search: Sequence[str]) -> dict[str, str]:
    """Versions of the distributions in some folders, by normalised name; of two, the one that
    Python finds first.
    """
    versions: dict[str, str] = {}
    for found in metadata.distributions(path=list(search)):
        # a broken installation tells nothing of itself, so it counts as missing; Pythons differ in
        # what they raise
        with suppress(OSError, TypeError):
            about = found.metadata
            if about["Name"]:
                versions.setdefault(normal(about["Name"]), about["Version"] or "")
    return versions


def locked(root: Path) -> dict[str, str]:
    """Versions of requirements.lock by the names it has for them; none where there is no such
    file.
    """
    file = root / "requirements.lock"
    lines = file.read_text("utf-8").splitlines() if file.is_file() else []
    pinned = [line.partition("#")[0].partition(";")[0].partition("==") for line in lines]
    return {name.strip(): version.strip() for name, equal, version in pinned if equal}


def normal(name: str) -> str:
    """A distribution's name as the index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def numbers(version: str) -> tuple[int, ...]:
    """Major, minor and patch version."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


def few(names: Sequence[str], most: int = FEW) -> str:
    """The first of some names, and how many more there are."""
    more = len(names) - most
    return f"{', '.join(names[:most])} and {more} more" if more > 0 else ", ".join(names)


def is_checkout(folder: Path) -> bool:
    """Whether a folder holds this project's sources."""
    return (folder / "src" / PACKAGE).is_dir()


def own_environment(root: Path, here: Surroundings) -> Path | None:
    """The checkout's environment, if this process runs in another."""
    own = root / ".venv"
    return (
        own if (own / "pyvenv.cfg").is_file() and own.resolve() != here.prefix.resolve() else None
    )


def completing(root: Path, here: Surroundings) -> str:
    """How the environment gets what it lacks."""
    if own_environment(root, here) is not None:
        return ACTIVATE
    return INSTALL_LOCK if (here.prefix / "pyvenv.cfg").is_file() else "make env"


def on_path(here: Surroundings, name: str) -> Path | None:
    """A package's file or folder, found without importing the package."""
    found = (Path(folder) / name for folder in here.search)
    return next((path for path in found if path.exists()), None)


def answer_of(
    command: Sequence[str], folder: Path, environ: Mapping[str, str], longest_s: float
) -> subprocess.CompletedProcess[str]:
    """Run a command that asks nothing.  Raises TimeoutExpired."""
    return subprocess.run(
        command,
        cwd=str(folder),
        env=dict(environ),
        timeout=longest_s,
        check=False,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
