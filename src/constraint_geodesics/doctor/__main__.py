"""The same as `geodesics doctor`, where that does not start: `python -m
constraint_geodesics.doctor`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from constraint_geodesics.doctor.report import (
    as_json,
    as_text,
    examine,
    exit_code,
    terminal_colours,
)
from constraint_geodesics.doctor.surroundings import PACKAGE

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Print all findings about the current folder.  Returns the exit code."""
    said = "Look for what is wrong with this checkout and its environment, and say the mend."
    parser = argparse.ArgumentParser(prog=f"python -m {PACKAGE}.doctor", description=said)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(arguments)
    findings = examine(Path())
    print(as_json(findings) if options.json else as_text(findings, terminal_colours()))
    return exit_code(findings)


if __name__ == "__main__":
    sys.exit(main())
