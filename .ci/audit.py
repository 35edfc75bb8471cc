"""Whether advisories are known against a locked version: `make audit`, with pip-audit.

Ends with 1 where there is one.  What the advisory database could not be asked of is counted and
said: behind a proxy that serves packages alone that is all of them, and nothing is known then.
"""

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lock import HASHES, OTHERS

ROOT = Path(__file__).resolve().parents[1]
LOCKS = (HASHES, *OTHERS)
_PIN = re.compile(r"^[A-Za-z0-9._-]+==\S+", re.MULTILINE)


def main() -> int:
    """Print what is known of all locked versions; returns the exit code."""
    pins = sorted({pin for lock in LOCKS for pin in _PIN.findall((ROOT / lock).read_text())})
    with tempfile.TemporaryDirectory() as folder:
        given, out = Path(folder) / "pins", Path(folder) / "answer"
        # a package may be locked in two versions, and a file holds one of each
        answers: list[Mapping[str, Any]] = []
        while pins:
            names = {pin.partition("==")[0]: pin for pin in reversed(pins)}
            given.write_text("\n".join(names.values()) + "\n")
            out.unlink(missing_ok=True)
            command = [sys.argv[1], "-m", "pip_audit", "--disable-pip", "--no-deps", "-r", given]
            command += ["--format", "json", "--output", out, "--progress-spinner", "off"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            try:
                answers += json.loads(out.read_text())["dependencies"]
            except (OSError, ValueError, KeyError):
                said = (done.stderr.strip().splitlines() or ["no answer"])[-1]
                answers += [{"name": name, "skip_reason": said} for name in names]
            pins = [pin for pin in pins if pin not in names.values()]
    lines, code = verdict(answers)
    print("\n".join(lines))
    return code


def verdict(answers: Sequence[Mapping[str, Any]]) -> tuple[list[str], int]:
    """What pip-audit's answers say, in lines, and the exit code: 1 for a finding."""
    unasked = [own for own in answers if "skip_reason" in own]
    found = [(own, fault) for own in answers for fault in own.get("vulns", ())]
    lines = [
        f"{own['name']} {own['version']}: {fault['id']}, mended in "
        f"{', '.join(fault['fix_versions']) or 'no version yet'}"
        for own, fault in found
    ]
    asked = len(answers) - len(unasked)
    lines.append(
        f"{asked} of {len(answers)} locked packages were asked about, {len(found)} findings"
    )
    if unasked:
        first = f"{unasked[0]['name']}: {unasked[0]['skip_reason']}"
        lines.append(f"nothing is known of the other {len(unasked)}: no advisories for {first}")
    return lines, int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
