"""All checks, what they find, and how it is told."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from constraint_geodesics.doctor.checkout import check_disk, check_git, check_robot
from constraint_geodesics.doctor.environment import (
    check_install,
    check_packages,
    check_python,
    check_torch,
)
from constraint_geodesics.doctor.runs import check_mlflow, check_pipeline
from constraint_geodesics.doctor.surroundings import Surroundings
from constraint_geodesics.doctor.viewer import check_display, check_recordings

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from constraint_geodesics.doctor.surroundings import Check, Said, Status

COLOURS = {"ok": "\033[32m", "note": "\033[33m", "problem": "\033[31m"}


@dataclass(frozen=True)
class Finding:
    """What one check says.  A note is worth knowing and breaks nothing; only a problem makes the
    exit code 1.
    """

    check: str
    status: Status
    message: str
    mend: str
    """A command, or what to do; blank where there is nothing to mend."""


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


def examine(
    root: Path, here: Surroundings | None = None, checks: Mapping[str, Check] | None = None
) -> list[Finding]:
    """All findings about one checkout, by default of this process; a check that fails is a problem
    itself.
    """
    here = here or Surroundings.here()
    looked = [
        _look(name, check, root, here)
        for name, check in (CHECKS if checks is None else checks).items()
    ]
    return [finding for findings in looked for finding in findings]


def _look(name: str, check: Check, root: Path, here: Surroundings) -> list[Finding]:
    said: list[Said] = []

    def listen() -> Iterator[Said]:
        well = yield from check(root, here)
        if well and not said:
            yield "ok", well, ""

    try:
        for one in listen():
            said.append(one)  # noqa: PERF402
    except Exception as error:
        message = f"could not be looked at: {type(error).__name__}: {' '.join(str(error).split())}"
        said.append(("problem", message, "mend what the message names, then look again"))
    return [Finding(name, *one) for one in said]


def exit_code(findings: Sequence[Finding]) -> int:
    """1 if there is a problem, else 0."""
    return int(any(finding.status == "problem" for finding in findings))


def as_json(findings: Sequence[Finding]) -> str:
    """One object: whether all is well, and the findings."""
    return json.dumps(
        {"ok": not exit_code(findings), "findings": [asdict(finding) for finding in findings]}
    )


def as_text(findings: Sequence[Finding], colours: Mapping[str, str] | None = None) -> str:
    """One line a finding, the mend below it.  colours: how a terminal is told of each status; by
    default not at all.
    """
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


def terminal_colours() -> Mapping[str, str] | None:
    """None where standard output is no terminal, or colours are not wanted."""
    return COLOURS if sys.stdout.isatty() and not os.environ.get("NO_COLOR") else None
