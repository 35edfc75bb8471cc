"""Checks of what runs leave behind: MLflow's store and DVC's outputs."""

from __future__ import annotations

import json
import os
import re
import shlex
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from constraint_geodesics.doctor.surroundings import (
    INSTALL_LOCK,
    Surroundings,
    answer_of,
    few,
    locked,
    numbers,
    on_path,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from constraint_geodesics.doctor.surroundings import Look, Said

LARGEST_CHECKED = 100_000_000
"""Bytes: a larger database is not read through."""
LONGEST_STATUS_S = 120.0
"""DVC hashes what it has not seen before."""
DATABASES = ("sqlite", "postgresql", "mysql", "mssql")
SERVICES = ("databricks", "databricks-uc", "uc")


def check_mlflow(root: Path, here: Surroundings) -> Look:
    """The address of the store, the schema of its database, and runs in a folder that the dashboard
    does not show.
    """
    uri = here.environ.get("MLFLOW_TRACKING_URI") or "sqlite:///mlflow.db"
    wrong = _wrong_address(
        uri, here.environ.get("MLFLOW_ALLOW_FILE_STORE", "").lower() in ("true", "1")
    )
    file = None
    if wrong:
        hidden = re.sub(r"//[^/@]*@", "//", uri)  # an address may hold a password
        mend = (
            "unset MLFLOW_TRACKING_URI, or give a server's address or sqlite:////path/to/mlflow.db"
        )
        yield "problem", f"MLFLOW_TRACKING_URI={hidden}: {wrong}", mend
    elif re.match(r"sqlite(\+\w+)?:///[^:]", uri):
        file = root / uri.partition(":///")[2].partition("?")[0]
    if file is not None and file.exists():
        yield from _of_database(file, root, here)
    runs = [
        meta
        for meta in (root / "mlruns").glob("*/*/meta.yaml")
        if "run_id:" in meta.read_text("utf-8")
    ]
    if runs:
        mend = (
            "mlflow migrate-filestore --source . --target sqlite:///mlruns.db, then look "
            "with MLFLOW_TRACKING_URI="
        )
        found = f"{len(runs)} runs in mlruns/, a store of files that `geodesics ui` does not show"
        yield "note", found, f"{mend}sqlite:///mlruns.db geodesics ui; or rm -r mlruns"
    if file is None:
        return f"runs in the store that MLFLOW_TRACKING_URI names ({uri.partition(':')[0]})"
    return f"runs in {file.name}" if file.exists() else "no runs yet"


def _wrong_address(uri: str, files_allowed: bool) -> str:
    """Why MLflow can't use an address; blank if it can."""
    scheme, separator, rest = uri.partition("://")
    dialect = scheme.partition("+")[0]
    if dialect == "file" or (":" not in uri and dialect not in SERVICES):
        return (
            ""
            if files_allowed
            else "names a folder; this version of MLflow refuses to keep runs in files"
        )
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


def _of_database(file: Path, root: Path, here: Surroundings) -> Iterator[Said]:
    name = shlex.quote(
        os.path.relpath(str(file), str(root))
        if root.resolve() in file.resolve().parents
        else str(file)
    )
    aside = f"mv {name} {name}.broken; the next stage begins a new one (reports/ has every figure)"
    try:
        tables, version, whole = _read_database(file)
    except sqlite3.Error as error:
        if "locked" in str(error):
            yield "note", f"{name} is in use, so it was not read", ""
        else:
            yield "problem", f"{name} can't be read: {error}", aside
        return
    if whole != "ok":
        yield "problem", f"{name} is damaged: {' '.join(whole.split())[:100]}", aside
        return
    folder = on_path(here, "mlflow/store/db_migrations/versions")
    if not tables or folder is None:  # new, or there is no MLflow to compare it with
        return
    known, newest = _schemas(folder)
    installed = here.installed.get("mlflow", "")
    if not version:
        yield (
            "problem",
            f"{name} is half made, or no database of MLflow's: it names no schema",
            aside,
        )
    elif version not in known:
        said = (
            f"{name} has schema {version}, which the installed MLflow {installed} does not "
            f"know: a newer one wrote it"
        )
        lock = locked(root).get("mlflow", installed)
        newer = (
            INSTALL_LOCK
            if numbers(lock) > numbers(installed)
            else "python -m pip install --upgrade mlflow"
        )
        yield "problem", said, f"{newer}, or put it aside: mv {name} {name}.newer"
    elif version not in newest:
        said = (
            f"{name} has schema {version} of an older MLflow; {installed} needs "
            f"{', '.join(sorted(newest))}"
        )
        yield "problem", said, f"cp {name} {name}.old && mlflow db upgrade sqlite:///{name}"


def _read_database(file: Path) -> tuple[set[str], str, str]:
    """Names of the tables, Alembic's version of the schema, and "ok" if the file is whole."""
    with closing(
        sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro", uri=True, timeout=1.0)
    ) as database:
        tables = {
            name
            for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        }
        rows = (
            database.execute("SELECT version_num FROM alembic_version")
            if "alembic_version" in tables
            else ()
        )
        version = next((str(number) for (number,) in rows), "")
        small = file.stat().st_size <= LARGEST_CHECKED
        whole = str(database.execute("PRAGMA quick_check(1)").fetchone()[0]) if small else "ok"
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


def check_pipeline(root: Path, here: Surroundings, longest_s: float = LONGEST_STATUS_S) -> Look:
    """What `dvc status` says: stages out of date, and those whose outputs are merely not here, as
    in a fresh clone.
    """
    if not (root / "dvc.yaml").is_file():
        return ""
    if "dvc" not in here.installed:
        yield "note", "DVC is not installed: the stages were not looked at", ""
        return ""
    try:
        answer = answer_of(
            [sys.executable, "-m", "dvc", "status", "--json"], root, here.environ, longest_s
        )
    except subprocess.TimeoutExpired:
        yield (
            "note",
            f"`dvc status` took longer than {longest_s:g} s: the stages were not looked at",
            "dvc status",
        )
        return ""
    if answer.returncode != 0:
        yield from _of_refusal(answer.stderr)
        return ""
    yield from _of_stages(json.loads(answer.stdout))
    return "all stages are up to date"


def _of_refusal(told: str) -> Iterator[Said]:
    line = " ".join(told.split()).replace("ERROR: ", "", 1)
    if "Unable to acquire lock" in line:
        yield (
            "note",
            "DVC is at work here: the stages were not looked at",
            "look again when it has ended",
        )
    elif "is not a git repository" in line:
        yield (
            "note",
            "DVC refuses to run outside of a git repository: the stages were not looked at",
            "",
        )
    elif "dvc.lock" in line:
        yield "problem", f"DVC can't read dvc.lock: {line[:200]}", "git checkout -- dvc.lock"
    else:
        yield (
            "problem",
            f"DVC can't read the pipeline: {line[:200]}",
            "mend the file that the message names",
        )


def _of_stages(answer: Mapping[str, Sequence[Any]]) -> Iterator[Said]:
    """answer: for each stage that is not up to date what changed, as `dvc status --json` prints
    it.
    """
    outs = {name: _changes(entries, "changed outs") for name, entries in answer.items()}
    absent = {
        path: how
        for own in outs.values()
        for path, how in own.items()
        if how in ("deleted", "not in cache")
    }
    lacking: dict[str, list[str]] = {}
    changed: dict[str, list[str]] = {}
    for name, entries in answer.items():
        deps = _changes(entries, "changed deps")
        other = [entry for entry in entries if not isinstance(entry, dict)]
        # a folder that lost some of its outputs is called modified, one within such an output
        # deleted
        reasons = [path for path in outs[name] if path not in absent]
        reasons += [
            path
            for path in deps
            if path == "params.yaml" or not any(_touch(path, out) for out in absent)
        ]
        if reasons or other:
            changed[name] = [_reason(path, deps.get(path)) for path in reasons] + other
        elif outs[name]:  # one that lacks inputs only is mended with those that make them
            lacking[name] = []
    for file, own in _by_file(changed):
        names = [name.rpartition(":")[2] for name in own]
        names[0] += f" ({few(next(iter(own.values())), 2)})"
        said = f"{_stages(own)} out of date: {few(names)}"
        if file:
            yield (
                "note",
                f"{said}; of {file}, which `dvc repro` alone does not run",
                f"dvc repro {file}",
            )
        else:
            yield "problem", said, "dvc repro"
    for file, own in _by_file(lacking):
        paths = [path for name in own for path in outs[name]]
        if all(absent[path] == "deleted" for path in paths):
            kept = (
                " && git checkout -- reports"
                if any(path.startswith("reports/") for path in paths)
                else ""
            )
            yield (
                "note",
                f"outputs of {_stages(own)} were deleted, and can be fetched back",
                f"dvc checkout{kept}",
            )
        else:
            said = (
                f"outputs of {_stages(own)} are not here, as in a fresh clone; planning "
                f"works without"
            )
            yield "note", said, f"dvc repro {file}" if file else "make repro"


def _changes(entries: Sequence[Any], kind: str) -> dict[str, Any]:
    return {
        path: how
        for entry in entries
        if isinstance(entry, dict)
        for path, how in entry.get(kind, {}).items()
    }


def _touch(path: str, other: str) -> bool:
    """One is the other or lies within it."""
    return f"{path}/".startswith(f"{other}/") or f"{other}/".startswith(f"{path}/")


def _reason(path: str, how: Any) -> str:
    return f"{path}: {few(list(how))}" if isinstance(how, dict) else path


def _by_file(stages: Mapping[str, list[str]]) -> list[tuple[str, dict[str, list[str]]]]:
    """Stages by the file that describes them, blank for dvc.yaml itself, which comes first."""
    files: dict[str, dict[str, list[str]]] = {}
    for name, why in stages.items():
        files.setdefault(name.rpartition(":")[0], {})[name] = why
    return sorted(files.items())


def _stages(counted: Mapping[str, Any]) -> str:
    return "1 stage" if len(counted) == 1 else f"{len(counted)} stages"
