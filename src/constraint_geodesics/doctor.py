"""What commonly goes wrong with a checkout and its environment, and the mend: one finding a line.

Only the standard library is imported, and modules here that need no more, for packages that are
missing or broken are what this looks for; MLflow, Rerun, torch and PyBullet are known by the files
they are installed as.  So it runs where the command `geodesics` does not start:
`PYTHONPATH=src python3 -m constraint_geodesics.doctor`.  A wrong Python must be able to say that it
is one: the module keeps to what Python 3.8 reads, with annotations that are never evaluated.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections import Counter
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from constraint_geodesics.recording.folders import FOLDERS
from constraint_geodesics.tracking.left import left_runs

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping, Sequence, Sized
    from typing import Literal

    Status = Literal["ok", "note", "problem"]
    Answer = tuple[Status, str, str]
    """Status, message and mend."""
    Answers = Generator[Answer, None, str]
    """Yields what is amiss; returns what is said where nothing is, blank for nothing at all."""
    Check = Callable[[Path, "Surroundings"], Answers]

PACKAGE = "constraint_geodesics"
NEEDED_PYTHON = (3, 11)
"""Planning works with later ones, without PyBullet."""
NEW_ENVIRONMENT = "rm -rf .venv && make env"
INSTALL_LISTED = (
    "python -m pip install --require-hashes --no-deps --no-build-isolation -r requirements.hashes"
)
"""As `make env` does."""
ACTIVATE = "source .venv/bin/activate"
LEAST_FREE = 2_000_000_000
"""Bytes: an environment and one run of the pipeline take about that."""
LARGEST_CHECKED = 100_000_000
"""Bytes: a larger database is not read through."""
LONGEST_STATUS_S = 120.0
"""DVC hashes what it has not seen before."""
DATABASES = ("sqlite", "postgresql", "mysql", "mssql")
SERVICES = ("databricks", "databricks-uc", "uc")
COLOURS = {"ok": "\033[32m", "note": "\033[33m", "problem": "\033[31m"}


@dataclass(frozen=True)
class Finding:
    """One check's answer.  A note breaks nothing; only a problem makes the exit code 1."""

    check: str
    status: Status
    message: str
    mend: str
    """A command, or what to do; blank where there is nothing to mend."""


@dataclass(frozen=True)
class Surroundings:
    """The process and its environment, as the checks see them."""

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
        python, search = tuple(sys.version_info[:3]), tuple(sys.path)
        package, installed = Path(__file__).resolve().parent, versions_in(search)
        prefix, environ = Path(sys.prefix), dict(os.environ)
        return cls(python, sys.platform, prefix, search, environ, package, installed)


def examine(
    root: Path, here: Surroundings | None = None, checks: Mapping[str, Check] | None = None
) -> list[Finding]:
    """All findings about one checkout, by default of this process; a check that fails is a problem
    itself.
    """
    here, checks = here or Surroundings.here(), CHECKS if checks is None else checks
    return [found for name in checks for found in _examine_one(name, checks[name], root, here)]


def _examine_one(name: str, check: Check, root: Path, here: Surroundings) -> list[Finding]:
    answers: list[Answer] = []
    look = check(root, here)
    try:
        while True:
            answers.append(next(look))
    except StopIteration as end:
        if end.value and not answers:
            answers.append(("ok", end.value, ""))
    except Exception as error:
        message = f"could not be looked at: {type(error).__name__}: {' '.join(str(error).split())}"
        answers.append(_problem(message, "mend what the message names, then look again"))
    return [Finding(name, *one) for one in answers]


def exit_code(findings: Sequence[Finding]) -> int:
    """1 if there is a problem, else 0."""
    return int(any(finding.status == "problem" for finding in findings))


def as_json(findings: Sequence[Finding]) -> str:
    """One object: whether all is well, and the findings."""
    listed = [asdict(finding) for finding in findings]
    return json.dumps({"ok": not exit_code(findings), "findings": listed})


def as_text(findings: Sequence[Finding], colours: Mapping[str, str] | None = None) -> str:
    """One line a finding, the mend below it.  colours: a terminal's code for each status."""
    width = 1 + max((len(finding.check) for finding in findings), default=0)
    lines = []
    for finding in findings:
        status = f"{finding.status:<7}"
        if colours:
            status = f"{colours[finding.status]}{status}\033[0m"
        lines.append(f"{status}  {finding.check + ':':<{width}} {finding.message}")
        if finding.mend:
            lines.append(f"{'':<{10 + width}}mend: {finding.mend}")
    return "\n".join(lines)


def show(findings: Sequence[Finding], *, json_wanted: bool) -> int:
    """Print the findings.  Returns the exit code."""
    # no colours where standard output is no terminal, or they are not wanted
    colours = COLOURS if sys.stdout.isatty() and not os.environ.get("NO_COLOR") else None
    print(as_json(findings) if json_wanted else as_text(findings, colours))
    return exit_code(findings)


def _problem(message: str, mend: str) -> Answer:
    return "problem", message, mend


def _note(message: str, mend: str = "") -> Answer:
    return "note", message, mend


# what the checks have in common


def versions_in(search: Sequence[str]) -> dict[str, str]:
    """Versions of the distributions in some folders, by normalised name; of two, the one that
    Python finds first.
    """
    versions: dict[str, str] = {}
    for found in metadata.distributions(path=list(search)):
        # a broken installation says nothing of itself, so it counts as missing; Pythons differ in
        # what they raise
        with suppress(OSError, TypeError):
            about = found.metadata
            if about["Name"]:
                versions.setdefault(_normal(about["Name"]), about["Version"] or "")
    return versions


def numbers(version: str) -> tuple[int, ...]:
    """Major, minor and patch version."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


def _locked(root: Path) -> dict[str, str]:
    """Versions of requirements.lock by the names it has for them; none without that file."""
    file = root / "requirements.lock"
    lines = file.read_text("utf-8").splitlines() if file.is_file() else []
    pinned = [line.partition("#")[0].partition(";")[0].partition("==") for line in lines]
    return {name.strip(): version.strip() for name, equal, version in pinned if equal}


def _normal(name: str) -> str:
    """A distribution's name as the index compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _few(names: Sequence[str], most: int = 4) -> str:
    """The first of some names, and how many more there are."""
    more = len(names) - most
    return f"{', '.join(names[:most])} and {more} more" if more > 0 else ", ".join(names)


def _is_checkout(folder: Path) -> bool:
    """Whether a folder holds this project's sources."""
    return (folder / "src" / PACKAGE).is_dir()


def _in_another_environment(root: Path, here: Surroundings) -> bool:
    """Whether the checkout has an environment, and this process runs in another."""
    own = root / ".venv"
    return (own / "pyvenv.cfg").is_file() and own.resolve() != here.prefix.resolve()


def _completing(root: Path, here: Surroundings) -> str:
    """How the environment gets what it lacks."""
    if _in_another_environment(root, here):
        return ACTIVATE
    return INSTALL_LISTED if (here.prefix / "pyvenv.cfg").is_file() else "make env"


def _on_path(here: Surroundings, name: str) -> Path | None:
    """A package's file or folder, found without importing the package."""
    found = (Path(folder) / name for folder in here.search)
    return next((path for path in found if path.exists()), None)


def _run(
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


# the Python in use and the packages it has


def check_python(root: Path, here: Surroundings) -> Answers:
    """PyBullet has wheels for Python 3.11 and none for later ones; the lock is for that one."""
    version, needed = ".".join(map(str, here.python)), ".".join(map(str, NEEDED_PYTHON))
    if here.python[:2] == NEEDED_PYTHON:
        return version
    answer, message = _problem, f"this is Python {version}; {needed} is needed"
    if here.python > NEEDED_PYTHON:
        answer, message = _note, f"{message} by PyBullet and the pipeline; planning works without"
    if _in_another_environment(root, here):
        yield answer(f"{message}, and .venv has its own", ACTIVATE)
    else:
        mend = f"install Python {needed}, then: {NEW_ENVIRONMENT} PYTHON=python{needed}"
        yield answer(message, mend)
    return ""


def check_packages(root: Path, here: Surroundings) -> Answers:
    """Every package of requirements.lock, in the version it names."""
    wanted = _locked(root)
    if not wanted:
        yield _note("there is no requirements.lock here to compare versions with")
        return ""
    found = {name: here.installed.get(_normal(name)) for name in wanted}
    missing = [name for name, version in found.items() if version is None]
    other = [
        f"{name} {version}, not {wanted[name]}"
        for name, version in found.items()
        if version is not None and not _same(version, wanted[name])
    ]
    if missing and _for_planning_alone(here):
        message = f"{len(missing)} of {len(wanted)} are missing, of the pipeline: {_few(missing)}"
        yield _note(f"{message}; planning works without", "make env")
        missing = []
    for names, what in ((missing, "missing"), (other, "of another version")):
        if names:
            message = f"{len(names)} of {len(wanted)} are {what}: {_few(names)}"
            yield _problem(message, _completing(root, here))
    return f"all {len(wanted)} of requirements.lock"


def _for_planning_alone(here: Surroundings) -> bool:
    """Whether the environment has all that planning needs and not what runs the pipeline."""
    found = metadata.distributions(name=PACKAGE.replace("_", "-"), path=list(here.search))
    needed = [line for own in found for line in own.requires or () if ";" not in line]
    names = [re.split(r"[^\w.-]", line)[0] for line in needed]
    there = [_normal(name) in here.installed for name in names]
    return "dvc" not in here.installed and bool(there) and all(there)


def _same(version: str, wanted: str) -> bool:
    """A pinned version without a build takes every build, as pip does."""
    return version == wanted or ("+" not in wanted and version.partition("+")[0] == wanted)


def check_torch(root: Path, here: Surroundings) -> Answers:
    """Networks are trained on the processor: a build for a graphics card only takes gigabytes."""
    version = here.installed.get("torch")
    if version is None:
        yield _note("not installed")
        return ""
    release, _, build = version.partition("+")
    for_cards = [n for n in here.installed if re.match(r"nvidia-|(pytorch-)?triton$", n)]
    unused = sorted(set(for_cards) - {"nvidia-ml-py"})  # only reads a card's state, and is small
    if not unused and not re.match(r"cu|rocm|xpu", build):
        return f"{version}, without packages for a graphics card"
    more = f", and {len(unused)} packages for graphics cards" if unused else ""
    pinned = _locked(root).get("torch", release)
    mend = f"install torch=={pinned} again in its build for the processor"
    if unused:
        mend += f", then: python -m pip uninstall -y {' '.join(unused)}"
    waste = "gigabytes that nothing here uses, training is on the processor"
    yield _note(f"{version}{more}: {waste}", mend)
    return ""


def check_install(root: Path, here: Surroundings) -> Answers:
    """The package in use is this checkout's, and the environment has not been moved."""
    yield from _of_package(root, here)
    yield from _of_scripts(root, here)
    return f"{PACKAGE} from {here.package}"


def _of_package(root: Path, here: Surroundings) -> Iterator[Answer]:
    target = _installed_from(here)
    if not _is_checkout(root):
        found = target is not None and _is_checkout(target)
        mend = f"cd {shlex.quote(str(target))}" if found else ""
        yield _note(
            f"this folder is no checkout of {PACKAGE}: of its files nothing can be said", mend
        )
        return
    if _in_another_environment(root, here):
        yield _note(f"this is the Python of {here.prefix}, not that of .venv", ACTIVATE)
    mend = "python -m pip install --no-deps --editable ."
    in_place = target is not None and target.resolve() == root.resolve()
    if target is not None and not _is_checkout(target):
        gone = f"the environment has the package from {target}, which is no longer there"
        yield _problem(f"{gone} (was this checkout moved?)", NEW_ENVIRONMENT)
    elif here.package != root.resolve() / "src" / PACKAGE:
        other = f"the package in use is {here.package}, not this checkout's"
        yield _problem(
            f"{other}: changes here have no effect", "unset PYTHONPATH" if in_place else mend
        )
    elif target is None:
        yield _note("the package is not installed, only found by PYTHONPATH or from src", mend)
    elif not in_place:
        other = f"the environment has the package from {target}, another checkout"
        yield _note(f"{other}; only PYTHONPATH puts this one first", mend)


def _installed_from(here: Surroundings) -> Path | None:
    """The checkout that pip installed from, where changes in it are seen at once."""
    for found in metadata.distributions(name=PACKAGE.replace("_", "-"), path=list(here.search)):
        about = json.loads(found.read_text("direct_url.json") or "{}")
        if about.get("dir_info", {}).get("editable"):
            return Path(unquote(urlsplit(about["url"]).path))
    return None


def _of_scripts(root: Path, here: Surroundings) -> Iterator[Answer]:
    """The programs of an environment name their Python by its full path."""
    own = (root / ".venv").resolve()
    for prefix in dict.fromkeys((own, here.prefix.resolve())):
        if not (prefix / "pyvenv.cfg").is_file():
            continue
        programs = prefix / "bin"
        wrong: dict[str, list[tuple[str, Path]]] = {"which does not exist": []}
        for script in sorted(file for file in programs.glob("*") if file.is_file()):
            python = _interpreter(script)
            if python is None:
                continue
            if not python.exists():
                wrong["which does not exist"].append((script.name, python))
            elif python.name.startswith("python") and python.parent.resolve() != programs:
                wrong.setdefault("of another environment", []).append((script.name, python))
        again = NEW_ENVIRONMENT if prefix == own else f"make the environment {prefix} again"
        for what, scripts in wrong.items():
            if scripts:
                names = _few([name for name, _ in scripts])
                yield _problem(f"{names} in {programs} start {scripts[0][1]}, {what}", again)


def _interpreter(script: Path) -> Path | None:
    """The full path of the program that a script is for; None if it names none."""
    with script.open("rb") as content:
        first, second = (content.readline(500).decode("utf-8", "replace") for _ in range(2))
    if not first.startswith("#!"):
        return None
    words, in_shell = first[2:].split(), "'''exec'"
    if words and Path(words[0]).name == "sh" and second.startswith(in_shell):  # pip, a long path
        words = shlex.split(second[len(in_shell) :].partition('"$0"')[0])
    named = bool(words) and Path(words[0]).is_absolute() and Path(words[0]).name != "env"
    return Path(words[0]) if named else None


# the checkout itself: git, room, the robot's files


def check_git(root: Path, here: Surroundings) -> Answers:
    """DVC refuses to run outside of a git repository, and a run names its commit."""
    if not _is_checkout(root):
        return ""
    git = shutil.which("git", path=here.environ.get("PATH"))
    if git is None:
        message = "git is not installed: no stage can tell the commit it runs from"
        yield _problem(message, "install git")
        return ""
    command = [git, "-C", str(root), "rev-parse", "--show-toplevel"]
    answer = _run(command, root, {**here.environ, "LC_ALL": "C"}, 10.0)
    if answer.returncode == 0:
        return f"a repository in {answer.stdout.strip()}"
    if "dubious ownership" in answer.stderr:
        mend = f"git config --global --add safe.directory {shlex.quote(str(root.resolve()))}"
        yield _problem("git refuses this checkout, because another user owns it", mend)
    else:
        message = "this is no git repository: DVC refuses to run, and runs name no commit"
        yield _problem(message, "clone the project with git, or: dvc config core.no_scm true")
    return ""


def check_disk(root: Path, here: Surroundings, least: int = LEAST_FREE) -> Answers:
    """Room for a run, and folders that can be written.  least: bytes."""
    del here
    own = [root / name for name in ("data", "reports", ".dvc", ".geodesics")]
    for folder in (root, *(folder for folder in own if folder.is_dir())):
        try:
            with tempfile.TemporaryFile(dir=str(folder)):
                pass
        except OSError as error:
            owned = f"sudo chown -R $(id -u) {shlex.quote(str(folder))}"
            message = f"{folder.resolve()} can't be written: {error.strerror}"
            yield _problem(message, f"{owned}, or work in a checkout of your own")
    free = shutil.disk_usage(root).free
    if free < least:
        mend = "delete what is not needed; `dvc gc --workspace` drops results of earlier parameters"
        yield _problem(f"{free / 1e9:.1f} GB free, where a run needs {least / 1e9:.0f}", mend)
    return f"{free / 1e9:.0f} GB free"


def check_robot(root: Path, here: Surroundings) -> Answers:
    """The URDFs that params.yaml and the planner's files name, and their meshes."""
    data, counted = _on_path(here, "pybullet_data"), []
    pinned = _locked(root).get("pybullet")
    # not at the top: a Python that is too old can't import it, and is told so before
    from constraint_geodesics.xml_files import XmlFileError, read_xml

    reinstall = "python -m pip install --force-reinstall --no-deps pybullet"
    reinstall += f"=={pinned}" if pinned else ""
    for name, where in _urdf_names(root, here).items():
        places = [root / name, (root / where).parent / name, *([data / name] if data else [])]
        urdf = next((place for place in places if place.is_file()), None)
        if urdf is None:
            message = (
                f"{name}, which {where} names, is neither in this checkout nor in pybullet_data"
            )
            yield _problem(
                message, f"mend the name in {where}" if data else _completing(root, here)
            )
            continue
        packaged = data is not None and data in urdf.parents
        try:
            meshes = [mesh.get("filename", "") for mesh in read_xml(urdf).iter("mesh")]
        except (OSError, XmlFileError) as error:
            yield _problem(f"{urdf}: not XML: {error}", reinstall if packaged else "mend the file")
            continue
        missing = list(dict.fromkeys(mesh for mesh in meshes if not _mesh_found(mesh, urdf, here)))
        counted.append(f"{name} with {len(meshes)} meshes")
        if missing:
            put = f"put them in one of the folders above {urdf}, as the URDF names them"
            message = f"{urdf}: {len(missing)} of its meshes are missing: {_few(missing)}"
            yield _problem(message, reinstall if packaged else put)
    return ", ".join(counted)


def _urdf_names(root: Path, here: Surroundings) -> dict[str, str]:
    """URDFs by name, and the file that names each."""
    described: list[tuple[str, Any]] = []
    params = root / "params.yaml"
    with suppress(ImportError):  # the planner's files name the robot as well
        import yaml

        if params.is_file():
            described.append((params.name, yaml.safe_load(params.read_text("utf-8"))))
    cards = (
        folder / "planner.json" for folder in (root / "data/planner", here.package / "pretrained")
    )
    card = next((file for file in cards if file.is_file()), None)
    if card is not None:
        described.append((str(card), json.loads(card.read_text("utf-8"))))
    named: dict[str, str] = {}
    for where, parameters in described:
        bodies = [
            *(parameters["workcell"].get("shapes") or {}).values(),
            *((parameters.get("carried") or {}).get("shapes") or {}).values(),
        ]
        named.setdefault(parameters["robot"]["urdf"], where)
        for urdf in (body["urdf"] for body in bodies if "urdf" in body):
            named.setdefault(urdf, where)
    return named


def _mesh_found(name: str, urdf: Path, here: Surroundings) -> bool:
    """PyBullet and Rerun look in all folders above a URDF; the planner also where ROS does."""
    bare = re.sub(r"^(package|model|file)://", "", name)
    named = (here.environ.get(of, "") for of in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"))
    ros = [Path(entry) for entries in named for entry in entries.split(os.pathsep) if entry]
    packages = [place for own in ros for place in (own, own / "share", own.parent)]
    return any((folder / bare).is_file() for folder in (*urdf.resolve().parents, *packages))


# Rerun's window and its recordings


def check_display(root: Path, here: Surroundings) -> Answers:
    """Rerun's window needs a display; its viewer in a browser needs none."""
    del root
    shown = next((name for name in ("WAYLAND_DISPLAY", "DISPLAY") if here.environ.get(name)), None)
    if shown is None and here.platform.startswith("linux"):
        none = "there is none (DISPLAY and WAYLAND_DISPLAY are unset), so Rerun's window can't open"
        yield _note(none, "geodesics replay FILE --web")
    return f"{shown}={here.environ[shown]}" if shown else f"the one of {here.platform}"


def check_recordings(root: Path, here: Surroundings) -> Answers:
    """Rerun's viewer opens recordings of its own version and the one before; `rerun` must be the
    one installed here.

    A file begins with RRF and a digit, then one byte each of major, minor and patch version.
    """
    installed = here.installed.get("rerun-sdk")
    if installed is None:
        yield _note("rerun-sdk is not installed: recordings can't be written or opened")
        return ""
    files = [file for folder in FOLDERS for file in (root / folder).rglob("*.rrd")]
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
        message = f"{len(broken)} of {len(files)} are no recordings (cut short?): {_few(broken)}"
        again = "and record it again: dvc repro, or geodesics plan --record"
        yield _problem(message, f"rm {shlex.quote(broken[0])}, {again}")
    yield from _of_versions(versions, len(files), installed)
    yield from _other_viewer(here, installed)
    return f"{len(files)} found, all for the installed Rerun {installed}"


def _of_versions(
    versions: Mapping[tuple[int, ...], int], files: int, installed: str
) -> Iterator[Answer]:
    own = numbers(installed)[:2]
    again = "or record them again: dvc repro --single-item --force record_paths"
    for version, count in sorted(versions.items()):
        name = ".".join(map(str, version))
        these = f"{count} of {files} are of Rerun {name}"
        if version[:2] > own:
            newer = f"{these}, newer than the installed {installed}, which may not open them"
            yield _problem(newer, f"python -m pip install rerun-sdk=={name}, {again}")
        elif version[:2] < (own[0], own[1] - 1):
            promise = f"the installed {installed} promises to open only those of the version before"
            yield _note(f"{these}; {promise}", f"python -m rerun rrd migrate FILE, {again}")


def _other_viewer(here: Surroundings, installed: str) -> Iterator[Answer]:
    """`geodesics replay` starts its own viewer; who types `rerun` gets the first on PATH."""
    found = shutil.which("rerun", path=here.environ.get("PATH"))
    if found is None or Path(found).resolve().parent == (here.prefix / "bin").resolve():
        return
    version = None
    with suppress(OSError, subprocess.TimeoutExpired):
        answer = _run([found, "--version"], Path(), here.environ, 10.0)
        version = re.search(r"\d+\.\d+\.\d+\S*", answer.stdout)
    own = f"this environment has {installed}"
    if version is None:
        yield _note(f"{found} does not say its version; {own}", "geodesics replay FILE")
    elif version[0] != installed:
        message = f"`rerun` on PATH is {found} of version {version[0]}, but {own}"
        yield _note(message, "geodesics replay FILE, which starts the right one")


# what runs leave behind: MLflow's store and DVC's outputs


def check_mlflow(root: Path, here: Surroundings) -> Answers:
    """The store's address, its database's schema, and runs in a folder that is not shown."""
    uri = here.environ.get("MLFLOW_TRACKING_URI") or "sqlite:///mlflow.db"
    files_allowed = here.environ.get("MLFLOW_ALLOW_FILE_STORE", "").lower() in ("true", "1")
    wrong, file = _wrong_address(uri, files_allowed), None
    if wrong:
        hidden = re.sub(r"//[^/@]*@", "//", uri)  # an address may hold a password
        other = "give a server's address or sqlite:////path/to/mlflow.db"
        yield _problem(
            f"MLFLOW_TRACKING_URI={hidden}: {wrong}", f"unset MLFLOW_TRACKING_URI, or {other}"
        )
    elif re.match(r"sqlite(\+\w+)?:///[^:]", uri):
        file = root / uri.partition(":///")[2].partition("?")[0]
    if file is not None and file.exists():
        yield from _of_database(file, root, here)
    yield from _of_runs(root)
    kept = (root / "mlruns").glob("*/*/meta.yaml")
    if runs := [meta for meta in kept if "run_id:" in meta.read_text("utf-8")]:
        message = f"{len(runs)} runs in mlruns/, a store of files that `geodesics ui` does not show"
        target = "sqlite:///mlruns.db"
        mend = (
            f"mlflow migrate-filestore --source . --target {target}, then look with "
            f"MLFLOW_TRACKING_URI={target} geodesics ui; or rm -r mlruns"
        )
        yield _note(message, mend)
    if file is None:
        return f"runs in the store that MLFLOW_TRACKING_URI names ({uri.partition(':')[0]})"
    return f"runs in {file.name}" if file.exists() else "no runs yet"


def _of_runs(root: Path) -> Iterator[Answer]:
    """What killed stages left behind."""
    left = left_runs(root)
    if left:
        names = _few(list(dict.fromkeys(run.name for run in left)))
        unsent = sum(run.unsent for run in left)
        were = "was" if len(left) == 1 else "were"
        message = (
            f"{_stages(left)} {were} killed or could not reach MLflow, "
            f"where runs stay RUNNING: {names}"
        )
        if unsent:
            message += f"; MLflow did not take {unsent} things that they told it"
        yield _note(message, "geodesics recover")


def _wrong_address(uri: str, files_allowed: bool) -> str:
    """Why MLflow can't use an address; blank if it can."""
    scheme, separator, rest = uri.partition("://")
    dialect = scheme.partition("+")[0]
    if dialect == "file" or (":" not in uri and dialect not in SERVICES):
        refused = "names a folder; this version of MLflow refuses to keep runs in files"
        return "" if files_allowed else refused
    if dialect == "sqlite" and rest and not rest.startswith("/"):
        return "an SQLite file stands behind three slashes, or four if its path is absolute"
    if dialect in ("http", "https"):
        try:
            host, _ = urlsplit(uri).hostname, urlsplit(uri).port
        except ValueError as error:
            return str(error)
        return "" if host else "names no server"
    known = dialect in SERVICES or (dialect in DATABASES and separator)
    return "" if known else "is of no kind that MLflow knows"


def _of_database(file: Path, root: Path, here: Surroundings) -> Iterator[Answer]:
    within = root.resolve() in file.resolve().parents
    name = shlex.quote(os.path.relpath(str(file), str(root)) if within else str(file))
    aside = f"mv {name} {name}.broken; the next stage begins a new one (reports/ has every figure)"
    try:
        tables, version, whole = _read_database(file)
    except sqlite3.Error as error:
        if "locked" in str(error):
            yield _note(f"{name} is in use, so it was not read")
        else:
            yield _problem(f"{name} can't be read: {error}", aside)
        return
    if whole != "ok":
        yield _problem(f"{name} is damaged: {' '.join(whole.split())[:100]}", aside)
        return
    folder = _on_path(here, "mlflow/store/db_migrations/versions")
    if not tables or folder is None:  # new, or there is no MLflow to compare it with
        return
    known, newest = _schemas(folder)
    installed = here.installed.get("mlflow", "")
    schema = f"{name} has schema {version}"
    if not version:
        message = f"{name} is half made, or no database of MLflow's: it names no schema"
        yield _problem(message, aside)
    elif version not in known:
        later = numbers(_locked(root).get("mlflow", installed)) > numbers(installed)
        newer = INSTALL_LISTED if later else "python -m pip install --upgrade mlflow"
        unknown = f"which the installed MLflow {installed} does not know: a newer one wrote it"
        yield _problem(f"{schema}, {unknown}", f"{newer}, or put it aside: mv {name} {name}.newer")
    elif version not in newest:
        message = f"{schema} of an older MLflow; {installed} needs {', '.join(sorted(newest))}"
        yield _problem(message, f"cp {name} {name}.old && mlflow db upgrade sqlite:///{name}")


def _read_database(file: Path) -> tuple[set[str], str, str]:
    """Names of the tables, Alembic's version of the schema, and "ok" if the file is whole."""
    address = f"{file.resolve().as_uri()}?mode=ro"
    with closing(sqlite3.connect(address, uri=True, timeout=1.0)) as database:
        named = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        tables, version, whole = {name for (name,) in named}, "", "ok"
        if "alembic_version" in tables:
            row = database.execute("SELECT version_num FROM alembic_version").fetchone()
            version = str(row[0]) if row else ""
        if file.stat().st_size <= LARGEST_CHECKED:
            whole = str(database.execute("PRAGMA quick_check(1)").fetchone()[0])
    return tables, version, whole


def _schemas(folder: Path) -> tuple[set[str], set[str]]:
    """All versions of the schema that the installed MLflow knows, and the newest: the one that no
    other follows.
    """
    known, followed = set(), set()
    for file in folder.glob("*.py"):
        text = file.read_text("utf-8")
        own = re.search(r"^revision\b[^=\n]*=\s*[\"'](\w+)", text, re.MULTILINE)
        before = re.search(r"^down_revision\b[^=\n]*=(.*)", text, re.MULTILINE)
        if own and before:
            known.add(own[1])
            followed.update(re.findall(r"[\"'](\w+)", before[1]))
    return known, known - followed


def check_pipeline(root: Path, here: Surroundings, longest_s: float = LONGEST_STATUS_S) -> Answers:
    """Stages out of date, and those whose outputs are merely not here, as in a fresh clone."""
    if not (root / "dvc.yaml").is_file():
        return ""
    unseen = "the stages were not looked at"
    if "dvc" not in here.installed:
        yield _note(f"DVC is not installed: {unseen}")
        return ""
    command = [sys.executable, "-m", "dvc", "status", "--json"]
    try:
        answer = _run(command, root, here.environ, longest_s)
    except subprocess.TimeoutExpired:
        yield _note(f"`dvc status` took longer than {longest_s:g} s: {unseen}", "dvc status")
        return ""
    if answer.returncode == 0:
        yield from _of_stages(json.loads(answer.stdout))
        return "all stages are up to date"
    line = " ".join(answer.stderr.split()).replace("ERROR: ", "", 1)
    if "Unable to acquire lock" in line or "is busy, it is being blocked by" in line:
        yield _note(f"DVC is at work here: {unseen}", "look again when it has ended")
    elif "is not a git repository" in line:
        yield _note(f"DVC refuses to run outside of a git repository: {unseen}")
    elif "dvc.lock" in line:
        found = re.search(r"(?:stages/(?:sweep/)?)?dvc\.lock", line)
        broken = "dvc.lock" if found is None else found.group()
        kept = (root / ".geodesics/locks" / broken).is_file()
        mend = "geodesics recover" if kept else f"git checkout -- {broken}"
        yield _problem(f"DVC can't read {broken}: {line[:200]}", mend)
    else:
        named = "mend the file that the message names"
        yield _problem(f"DVC can't read the pipeline: {line[:200]}", named)
    return ""


def _of_stages(answer: Mapping[str, Sequence[Any]]) -> Iterator[Answer]:
    """answer: what changed of each stage that is not up to date (`dvc status --json`)."""
    outs = {name: _changes(entries, "changed outs") for name, entries in answer.items()}
    everything = {path: how for own in outs.values() for path, how in own.items()}
    absent = {path: how for path, how in everything.items() if how in ("deleted", "not in cache")}
    lacking: dict[str, list[str]] = {}
    changed: dict[str, list[str]] = {}
    for name, entries in answer.items():
        deps = _changes(entries, "changed deps")
        other = [entry for entry in entries if not isinstance(entry, dict)]
        # a folder that lost some of its outputs is called modified, one within such an output
        # deleted
        reasons = [path for path in outs[name] if path not in absent]
        made = [path for path in deps if any(_touch(path, out) for out in absent)]
        reasons += [path for path in deps if path == "params.yaml" or path not in made]
        if reasons or other:
            changed[name] = [_reason(path, deps.get(path)) for path in reasons] + other
        elif outs[name]:  # one that lacks inputs only is mended with those that make them
            lacking[name] = []
    for file, own in _by_file(changed):
        names = [name.rpartition(":")[2] for name in own]
        names[0] += f" ({_few(next(iter(own.values())), 2)})"
        message = f"{_stages(own)} out of date: {_few(names)}"
        apart = f"{message}; of {file}, which `dvc repro` alone does not run"
        yield _note(apart, f"dvc repro {file}") if file else _problem(message, "dvc repro")
    for file, own in _by_file(lacking):
        yield _of_lacking(file, own, [path for name in own for path in outs[name]], absent)


def _of_lacking(
    file: str, own: Mapping[str, Any], paths: Sequence[str], absent: Mapping[str, str]
) -> Answer:
    outputs = f"outputs of {_stages(own)}"
    if all(absent[path] == "deleted" for path in paths):
        kept = [path for path in paths if path.startswith("reports/")]
        mend = "dvc checkout"
        if kept:  # these alone: others may have changed since their commit
            mend += f" && git checkout -- {' '.join(kept)}"
        return _note(f"{outputs} were deleted, and can be fetched back", mend)
    mend = f"dvc repro {file}" if file else "make repro"
    return _note(f"{outputs} are not here, as in a fresh clone; planning works without", mend)


def _changes(entries: Sequence[Any], kind: str) -> dict[str, Any]:
    found = [entry.get(kind, {}) for entry in entries if isinstance(entry, dict)]
    return {path: how for changes in found for path, how in changes.items()}


def _touch(path: str, other: str) -> bool:
    """One is the other or lies within it."""
    return f"{path}/".startswith(f"{other}/") or f"{other}/".startswith(f"{path}/")


def _reason(path: str, how: Any) -> str:
    return f"{path}: {_few(list(how))}" if isinstance(how, dict) else path


def _by_file(stages: Mapping[str, list[str]]) -> list[tuple[str, dict[str, list[str]]]]:
    """Stages by the file that describes them, blank for dvc.yaml itself, which comes first."""
    files: dict[str, dict[str, list[str]]] = {}
    for name, why in stages.items():
        files.setdefault(name.rpartition(":")[0], {})[name] = why
    return sorted(files.items())


def _stages(counted: Sized) -> str:
    return "1 stage" if len(counted) == 1 else f"{len(counted)} stages"


CHECKS: Mapping[str, Check] = {
    "python": check_python,
    "packages": check_packages,
    "torch": check_torch,
    "install": check_install,
    "git": check_git,
    "disk": check_disk,
    "robot": check_robot,
    "display": check_display,
    "recordings": check_recordings,
    "mlflow": check_mlflow,
    "pipeline": check_pipeline,
}
"""In the order in which they are mended; the slow one last."""


def main() -> int:
    """The same as `geodesics doctor`, where that does not start."""
    about = "Look for what is wrong with this checkout and its environment, and say the mend."
    parser = argparse.ArgumentParser(prog=f"python -m {PACKAGE}.doctor", description=about)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return show(examine(Path()), json_wanted=parser.parse_args().json)


if __name__ == "__main__":
    sys.exit(main())
