"""DVC experiments that are run in a clone of the checkout, which itself stays as it is.

`dvc exp run --temp` would copy the whole history for each experiment, which takes longer than all
the rest, and the workers of `dvc queue` do the same and outlive the command that started them.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LAST_WORDS = 300
"""Characters of what a command said last that an error repeats."""
DVC = (sys.executable, "-m", "dvc")


class ExperimentError(RuntimeError):
    """An experiment was not run; the message is one line with the command and what it said."""


@dataclass(frozen=True)
class ExperimentClone:
    """A clone of a checkout's last commit with what differs from it there, and its DVC cache.

    environment: variables of the experiments besides those of this process.
    """

    root: Path
    folder: Path
    environment: Mapping[str, str]

    def make(self) -> None:
        """Clone anew, whatever an interrupted run has left.

        Raises ExperimentError, as the other methods do.
        """
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        git = ["git", "clone", "--quiet", "--shared", str(self.root), str(self.folder)]
        _said(git, self.root)
        cache = _said([*DVC, "cache", "dir"], self.root).strip()
        cache = str((self.root / cache).resolve())
        _said([*DVC, "cache", "dir", "--local", cache], self.folder)

    def run(self, name: str, changes: Mapping[str, Any], target: str) -> None:
        """Run one stage as an experiment, and bring the experiment to the checkout.

        changes: entries of params.yaml by their paths.  target: the stage; those before it are not
        looked at.
        """
        if not self.folder.is_dir():
            self.make()
        _said(["git", "reset", "--quiet", "--hard"], self.folder)
        if changed := _said(["git", "diff", "--binary", "HEAD"], self.root):
            _said(["git", "apply", "-"], self.folder, given=changed)
        set_to = [w for key, value in changes.items() for w in ("-S", f"{key}={json.dumps(value)}")]
        command = ["exp", "run", "--single-item", "--force", "--name", name, *set_to, target]
        _said([*DVC, *command], self.folder, self.environment)
        for ref in experiments(self.folder, name):
            _said(["git", "fetch", "--quiet", str(self.folder), f"+{ref}:{ref}"], self.root)


def experiments(root: Path, name: str = "*") -> list[str]:
    """Refs of a checkout's experiments, or of those of one name, whatever commit they started
    from.
    """
    command = ["git", "for-each-ref", "--format=%(refname)", f"refs/exps/??/*/{name}"]
    return _said(command, root).split()


def experiment_names(root: Path) -> set[str]:
    """Names of all experiments of a checkout."""
    return {ref.rpartition("/")[2] for ref in experiments(root)}


def _said(
    command: Sequence[str],
    folder: Path,
    environment: Mapping[str, str] | None = None,
    given: str | None = None,
) -> str:
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **(environment or {})},
        input=given,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())[-LAST_WORDS:]
        shown = shlex.join(command).removeprefix(f"{sys.executable} -m ")
        raise ExperimentError(f"{shown}: {said}")
    return done.stdout
