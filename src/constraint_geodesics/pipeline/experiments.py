"""DVC experiments: which there are, and how one is run in a copy of the checkout.

`dvc queue` is not used: its workers outlive the command that started them, each run of theirs takes
longer than one of `dvc exp run --temp`, and an experiment that was killed within them stays
"running".
"""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LAST_WORDS = 300
"""Characters of what DVC said last that an error repeats."""


class ExperimentError(RuntimeError):
    """DVC did not run an experiment; the message is one line with its name."""


def experiment_names(root: Path) -> set[str]:
    """Names of all experiments of a checkout, whatever commit they started from."""
    command = ["git", "for-each-ref", "--format=%(refname)", "refs/exps"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    parts = [line.split("/") for line in done.stdout.splitlines()]
    return {own[4] for own in parts if len(own) == 5 and len(own[2]) == 2}


def run_experiment(
    root: Path, name: str, changes: Mapping[str, Any], target: str, environment: Mapping[str, str]
) -> None:
    """Run one stage as an experiment in a copy of the checkout, which stays as it is.

    changes: entries of params.yaml by their paths.  target: the stage; those before it are not
    looked at.  environment: variables besides those of this process.
    Raises ExperimentError.
    """
    changed = [w for key, value in changes.items() for w in ("-S", f"{key}={json.dumps(value)}")]
    command = ["exp", "run", "--temp", "--single-item", "--name", name, *changed, target]
    done = subprocess.run(
        [sys.executable, "-m", "dvc", *command],
        cwd=root,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())[-LAST_WORDS:]
        raise ExperimentError(f"{name}: dvc {shlex.join(command)}: {said}")
