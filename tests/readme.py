"""Tables and numbers of README and docs from the reports: `python tests/readme.py` writes them,
tests compare.
"""

import csv
import gzip
import json
import re
from collections import defaultdict
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from constraint_geodesics.params import load_params
from constraint_geodesics.peers.registry import all_settings
from constraint_geodesics.report.benchmark_tables import FEW, asked, asks_in_python
from constraint_geodesics.report.cells import fixed, milliseconds

ROOT = Path(__file__).resolve().parents[1]
README, RESULTS, POLICIES, EXPERIMENTS = (
    ROOT / name
    for name in ("README.md", "docs/results.md", "docs/policies.md", "docs/experiments.md")
)
BLOCKS = {
    "results": "table.md",
    "geometry": "geometry.md",
    "policies": "policies.md",
    "benchmark": "benchmark/drawn.md",
    "budgets": "benchmark/budgets.md",
    "table_i": "benchmark/table_i.md",
    "growth": "growth/growth.md",
}
"""What stands between <!-- name --> and <!-- /name --> of a page: a file of reports/."""
HEADED = ("results", "geometry", "policies")
"""Blocks whose files have a title and a sentence first."""
SHORTENED = {"budgets": 2}
"""Blocks that are only the first paragraphs of their file."""
ORIGINS = {
    "the benchmark": "benchmark.csv",
    "MotionBenchMaker's problems": "problems.csv.gz",
    "random clutter": "clutter.csv.gz",
    "changing scenes": "scenes.csv.gz",
    "episodes": "episodes.csv.gz",
    "the proof of the certificate": "collision_proof.json",
    "charts": "compare_charts.csv.gz",
    "manifolds": "compare_manifolds.csv",
    "arms and goals": "arms.csv",
    "growth": "growth/growth.csv",
    "demonstrations": "demonstrations.csv.gz",
    "policies' proposals": "benchmark_policies/free-table.csv.gz",
}
"""Studies whose rows say where they are from, and these rows."""
ORIGIN = (r"commit\W+([0-9a-f]{7})", r"date\W+([0-9-]{10})", r"processor\W+([^\"\n]+)")
"""Commit, date and processor in what opens such a file."""
SHOWN = (
    *("planner", "learned + band", "learned"),
    *("BiRRT + band", "BiRRT, steps of 1 rad + band", "BiRRT + band, 1 s", "BiRRT"),
)
"""Rows of README's table."""
QUOTED = re.compile(r"([\d.]+)([^\d<]{0,12})<!-- from (\S+) (\S+) ([\d.e-]+) (\d) -->")
"""A number with its source behind it: file, key (a blank is written %20, a sum over a list +),
scale, digits."""


def with_planners(text: str) -> str:
    """README's text with its table of planners, from the benchmark's overview, and its numbers."""
    with (ROOT / "reports" / "benchmark" / "overview.csv").open() as file:
        found = {(row["planner"], row["scene"]): row for row in csv.DictReader(file)}
    columns = ("solved", "length, p95", "median [ms]")
    head = ("planner", "queries × seeds", *columns, *(f"sphere: {column}" for column in columns))
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * 7}"]
    slow = asks_in_python(all_settings(load_params(ROOT / "params.yaml")))
    for planner in SHOWN:
        rows = [found[planner, scene] for scene in ("table", "keep_out")]
        cells = [cell for row in rows for cell in _cells(row)]
        lines.append(f"| {' | '.join((*asked(rows[0], slow), *cells))} |")
    return QUOTED.sub(_requoted, replaced(text, "planners", "\n".join(lines)))


def _cells(row: dict[str, str]) -> tuple[str, str, str]:
    """Share solved of the solvable, p95 of the length over the best known with failures as
    infinite, and the median time of one figure of the benchmark's overview; behind the last two
    those of the planner on the same queries.
    """
    few, whose = int(row["queries"]) < FEW, ("", "reference_")
    lengths = ["–" if few else fixed(float(row[f"{of}ratio_p95_all"]), 3) for of in whose]
    times = [milliseconds(float(row[f"{of}time_median_s"])) for of in whose]
    own, beside = zip(lengths, times, strict=True)
    if row["planner"] != SHOWN[0]:
        own = tuple(f"{first} ({second})" for first, second in zip(own, beside, strict=True))
    return f"{float(row['success_of_solvable']):.0%}", own[0], own[1]


def replaced(text: str, name: str, content: str) -> str:
    """The text with other content between a block's marks."""
    begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    head, rest = text.split(begin)
    return f"{head}{begin}\n{content}\n{end}{rest.split(end)[1]}"


def filled(text: str) -> str:
    """A page's text with its blocks and every quoted number as the reports have them now."""
    for name, file in BLOCKS.items():
        if f"<!-- {name} -->" not in text:
            continue
        content = (ROOT / "reports" / file).read_text().strip()
        if name in HEADED:
            _, _, content = content.split("\n\n", 2)
        paragraphs = content.split("\n\n")[: SHORTENED.get(name)]
        text = replaced(text, name, "\n\n".join(paragraphs))
    return with_numbers(text)


def with_origins(text: str) -> str:
    """A page's text with the commit, date and processor of each study's rows."""
    lines = ["| rows | of commit | date | processor |", "|---|---|---|---|"]
    for study, name in ORIGINS.items():
        file = ROOT / "reports" / name
        opened = gzip.open if file.suffix == ".gz" else open
        with opened(file, "rt") as report:
            head = report.read(1000)
        commit, date, processor = (re.findall(one, head)[0] for one in ORIGIN)
        lines.append(f"| {study} | `{commit}` | {date} | {processor} |")
    return filled(replaced(text, "origins", "\n".join(lines)))


def _requoted(found: re.Match[str]) -> str:
    _, between, file, key, scale, digits = found.groups()
    value = _at(json.loads((ROOT / file).read_text()), unquote(key).split("/"))
    shown = f"{value * float(scale):.{digits}f}"
    return f"{shown}{between}<!-- from {file} {key} {scale} {digits} -->"


def _at(value: Any, parts: list[str]) -> float:
    """A report's number; of a list the place in it, or the sum over all of it (+)."""
    for place, part in enumerate(parts):
        if part == "+":
            assert isinstance(value, list), parts
            return sum(_at(own, parts[place + 1 :]) for own in value)
        value = value[int(part) if isinstance(value, list) else part]
    return value


TIMES = re.compile(r"<!-- stage_times -->.*?<!-- /stage_times -->", re.S)
CONTINUED = "run_benchmark"
"""Its last run may have made few of its rows, so its time says nothing."""


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


def with_pipeline(text: str) -> str:
    """A page's text with the drawing of `make dag`."""
    from constraint_geodesics.pipeline.dag import drawing, pipeline

    return replaced(text, "dag", f"```text\n{drawing(*pipeline(ROOT))}\n```")


def with_numbers(text: str) -> str:
    """A page's text with every quoted number as the reports have it now."""
    return QUOTED.sub(_requoted, text)


def with_efforts(text: str) -> str:
    """A page's text with the effort, the commit and the processor of each row of
    reports/reliability.json, and its numbers.
    """
    rows = json.loads((ROOT / "reports" / "reliability.json").read_text())
    alike: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for name, row in sorted(rows.items()):
        effort, processor = f"`make {COMMANDS[row['effort']]}`", row.get("processor", "not kept")
        alike[effort, f"`{row['commit']}`", processor].append(name)
    head = "| effort | commit | processor | took [s] | rows |\n|---|---|---|---:|---|"
    lines = [f"| {' | '.join((*own, _together(rows, alike[own])))} |" for own in sorted(alike)]
    return with_numbers(replaced(text, "efforts", "\n".join([head, *lines])))


def with_outcome(text: str) -> str:
    """A page's text with the sentences that open the report on demonstrations, and its numbers."""
    said = (ROOT / "reports" / "demonstrations.md").read_text().split("\n\n")[1]
    return with_numbers(replaced(text, "outcome", said))


COMMANDS = {"faults": "test-faults", "soak": "soak"}
"""What runs tests/faults with each effort."""


def _together(rows: dict[str, dict[str, float]], names: list[str]) -> str:
    """Cells of rows of one effort, commit and processor: how long their tests ran, their names."""
    took = sum(rows[name]["seconds"] for name in names)
    return f"{took:.0f} | {', '.join(f'`{name}`' for name in names)}"


PAGES = {
    README: with_planners,
    RESULTS: with_origins,
    POLICIES: filled,
    EXPERIMENTS: lambda text: with_pipeline(with_stage_times(text)),
}
NUMBERED = ("scenes.md", "problems.md", "scaling.md", "method.md")
PAGES |= {ROOT / "docs" / page: with_numbers for page in NUMBERED}
PAGES[ROOT / "docs" / "reliability.md"] = with_efforts
PAGES[ROOT / "docs" / "demonstrations.md"] = with_outcome
"""What brings each page up to date."""

if __name__ == "__main__":
    for page, written in PAGES.items():
        page.write_text(written(page.read_text()))
