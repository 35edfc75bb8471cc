"""README's tables and numbers from the reports: `python tests/readme.py` writes them, tests/test_readme.py compares."""

import json
import re
from pathlib import Path
from urllib.parse import unquote

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = {
    "results": "table.md",
    "geometry": "geometry.md",
    "plans": "plans.md",
    "policies": "policies.md",
    "benchmark": "benchmark/drawn.md",
    "budgets": "benchmark/budgets.md",
    "table_i": "benchmark/table_i.md",
    "growth": "growth/growth.md",
}
"""What stands between <!-- name --> and <!-- /name -->: a file of reports/."""
SHORTENED = ("budgets",)
"""Blocks that are their file's first paragraph."""
QUOTED = re.compile(r"([\d.]+)([^\d<]{0,12})<!-- from (\S+) (\S+) ([\d.e-]+) (\d) -->")
"""A number with its source behind it: file, key (a blank is written %20), scale, digits."""


def filled(text: str) -> str:
    """README's text with every block and every quoted number as the reports have it now."""
    for name, file in BLOCKS.items():
        begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        head, rest = text.split(begin)
        content = (ROOT / "reports" / file).read_text().strip()
        shown = content.split("\n\n")[0] if name in SHORTENED else content
        text = f"{head}{begin}\n{shown}\n{end}{rest.split(end)[1]}"
    return QUOTED.sub(_requoted, text)


def _requoted(found: re.Match[str]) -> str:
    _, between, file, key, scale, digits = found.groups()
    value = json.loads((ROOT / file).read_text())
    for part in unquote(key).split("/"):
        value = value[int(part) if isinstance(value, list) else part]
    shown = f"{value * float(scale):.{digits}f}"
    return f"{shown}{between}<!-- from {file} {key} {scale} {digits} -->"


if __name__ == "__main__":
    (ROOT / "README.md").write_text(filled((ROOT / "README.md").read_text()))
