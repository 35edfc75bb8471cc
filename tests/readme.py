"""README's and docs' tables and numbers from the reports: `python tests/readme.py` writes them,
tests compare.
"""

import csv
import json
import re
from collections import defaultdict
from pathlib import Path
from urllib.parse import unquote

ROOT = Path(__file__).resolve().parents[1]
BLOCKS = {
    "results": "table.md",
    "geometry": "geometry.md",
    "execution": "execution.md",
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


TIMES = re.compile(r"<!-- stage_times -->.*?<!-- /stage_times -->", re.S)
CONTINUED = "run_benchmark"
"""Its last run may have made few of its rows, so its time says nothing."""
TIMES_PAGE = ROOT / "docs" / "experiments.md"


def with_stage_times(text: str) -> str:
    """A page's text with how long each stage took when it last ran, items of a stage together."""
    seconds: dict[str, list[float]] = defaultdict(list)
    with (ROOT / "reports" / "stage_times.csv").open() as file:
        for row in csv.DictReader(file):
            stage = row["stage"].split()[0]
            if stage != CONTINUED:
                seconds[stage].append(float(row["seconds"]))
    head = "| stage | items | an item [s] | together [s] |\n|---|---:|---:|---:|"
    lines = [
        f"| `{name}` | {len(own)} | {_range(own)} | {sum(own):.0f} |"
        for name, own in sorted(seconds.items())
    ]
    table = "\n".join([head, *lines])
    return TIMES.sub(lambda _: f"<!-- stage_times -->\n{table}\n<!-- /stage_times -->", text)


def _range(values: list[float]) -> str:
    low, high = (f"{value:.0f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


if __name__ == "__main__":
    TIMES_PAGE.write_text(with_stage_times(TIMES_PAGE.read_text()))
    (ROOT / "README.md").write_text(filled((ROOT / "README.md").read_text()))
