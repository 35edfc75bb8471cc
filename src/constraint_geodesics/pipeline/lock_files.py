"""DVC's lock files, which it writes in place: killed within, it leaves half of one and then refuses
to run.

Each stage keeps a copy when it starts, which is when DVC has written the stages before it.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from constraint_geodesics.text_files import write_bytes

NAMES = ("dvc.lock", "stages/dvc.lock", "stages/sweep/dvc.lock")


def keep_locks(root: Path) -> None:
    """Copies of those that are whole; nothing where it is not DVC that runs the stage."""
    if "DVC_STAGE" not in os.environ:
        return
    for name in NAMES:
        file, kept = root / name, _kept(root, name)
        if file.is_file() and is_whole(file):
            content = file.read_bytes()
            if not kept.is_file() or kept.read_bytes() != content:
                write_bytes(kept, content)


def recover_locks(root: Path) -> list[str]:
    """Put the kept copy in the place of a lock file that is cut short; returns a line for each."""
    lines = []
    for name in NAMES:
        file, kept = root / name, _kept(root, name)
        if file.is_file() and not is_whole(file):
            if kept.is_file():
                write_bytes(file, kept.read_bytes())
                lines.append(f"{name}: was cut short, is again what the last stage began with")
            else:
                lines.append(f"{name}: cut short, and there is no copy: git checkout -- {name}")
    return lines


def is_whole(file: Path) -> bool:
    """Whether DVC can read all of a lock file."""
    text = file.read_text("utf-8", "replace")
    try:
        stages = _LOADER(text).get_single_data()["stages"]
        return text.endswith("\n") and all(map(_is_entry, _paths(stages)))
    except (yaml.YAMLError, KeyError, TypeError, AttributeError):
        return False


_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _paths(stages: dict[str, Any]) -> Iterator[Any]:
    for stage in stages.values():
        params = stage.get("params", {})
        if not all(isinstance(own, dict) for own in (params, *params.values())):
            raise TypeError
        if not isinstance(stage["cmd"], str):
            raise TypeError
        yield from (entry for kind in ("deps", "outs") for entry in stage.get(kind, ()))


def _is_entry(entry: dict[str, Any]) -> bool:
    return isinstance(entry["path"], str) and entry["hash"] == "md5" and "md5" in entry


def _kept(root: Path, name: str) -> Path:
    return root / ".geodesics" / "locks" / name
