"""Problems in scenes of their own, all planners side by side, as Markdown: reports/problems.md and
reports/clutter.md.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from constraint_geodesics.benchmark.problem_files import Problem
from constraint_geodesics.benchmark.row import write_table
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.machine import run_header
from constraint_geodesics.report.cells import fixed, markdown_table, origin
from constraint_geodesics.studies.problem_runs import UNDISTURBED, Asked, answered, figures
from constraint_geodesics.text_files import write_text
from constraint_geodesics.tracking.comparison import problem_cells

if TYPE_CHECKING:  # `geodesics bench` writes the same tables, and tracks nothing
    from constraint_geodesics.tracking.experiment import StageRun

Figures = Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]]
"""By constraint, scene or "all", and planner."""
HEADER = (
    *("scene", "planner", "asked", "solved of what any solves", "time [ms], median", "p95"),
    *("failures too, p95", "length / best known, median", "p95", "wrongly certified"),
    "ready for the scene [ms]",
)
NOTE = (
    "asked: problems whose ends are free and within limits. Solved: a certified path that PyBullet "
    "finds free at configurations 5 mrad apart, within the limit; of those problems that any "
    "planner here solves: where one is asked alone, of its own. Times end with the first "
    "certified path, projection, simplification, band and failed attempts in them; for the limit "
    'where there is none in "failures too". Best known: the shortest such path that any planner '
    "here found. Wrongly certified: paths that the certificate takes and PyBullet does not. Ready "
    "for the scene: what comes once a scene and is in no time of a query, in the median: the "
    "planner follows a change with its certifier, search and PyBullet's world; the others are lent "
    "the judge's certifier, whose making is not counted. The planner's roadmap, one a constraint, "
    "is made before the first query, in no time here. OMPL's planners ask through Python for "
    "every state, and PRM makes its roadmap anew for each query"
)


def report_answers(
    run: "StageRun",
    layout: Layout,
    name: str,
    title: str,
    about: Sequence[str],
    problems: Sequence[Problem],
    asked: Asked,
) -> None:
    """Ask the planners what they have not answered yet, and write the report of a stage, in
    reports/ and in its run.
    """
    table, folder = answered(problems, asked, name), layout.root / "reports"
    found = write_problem_report(folder, name, title, about, table, run_header(layout.root))
    run.cells(problem_cells(found))
    run.mirror({"rows": len(table)}, folder / f"{name}.json")


def write_problem_report(
    folder: Path,
    name: str,
    title: str,
    about: Sequence[str],
    table: pd.DataFrame,
    run: Mapping[str, str],
) -> Figures:
    """Write the rows, gzipped, their figures and the tables: name.csv.gz, name.json, name.md.
    Returns the figures.

    about: sentences to know before the tables.  run: where the rows are from.
    """
    found = figures(table)
    write_table(table, folder / f"{name}.csv.gz", run)
    about = [*about, origin(run)]
    told = {"about": about, "figures": found}
    write_text(folder / f"{name}.json", json.dumps(told, indent=1) + "\n")
    write_text(folder / f"{name}.md", problems_markdown(title, about, found))
    return found


def problems_markdown(title: str, about: Sequence[str], found: Figures) -> str:
    """All tables, those of all scenes together first.  about: sentences to know before."""
    parts = [f"# {title}", " ".join(f"{line[0].upper()}{line[1:]}." for line in (*about, NOTE))]
    parts += ["## All scenes", totals_markdown(found)]
    for constraint, scenes in found.items():
        rows = [row for scene, own in scenes.items() if scene != "all" for row in _rows(scene, own)]
        parts += [f"## Scene by scene: {constraint}", markdown_table([HEADER, *rows])]
    return "\n\n".join(parts) + "\n"


def totals_markdown(found: Figures) -> str:
    """One table of all scenes together, a part for each constraint."""
    header = ("constraint", *HEADER[1:])
    rows = [row for name, scenes in found.items() for row in _rows(name, scenes["all"])]
    text = markdown_table([header, *rows])
    apart = [
        f"{name}: {own['apart']} of {own['problems']} problems have ends that touch something or "
        "are out of limits, and count nowhere."
        for name, scenes in found.items()
        if (own := next(iter(scenes["all"].values())))["apart"]
    ]
    shares = [own["disturbed"] for scenes in found.values() for own in scenes["all"].values()]
    parts, had = [text, *apart], [share for share in shares if share is not None]
    if had:
        parts.append(
            f"Of a planner's answers {min(had):.0%} to {max(had):.0%} had less than "
            f"{UNDISTURBED:.0%} of a core: these took longer by as much."
        )
    return "\n\n".join(parts)


def _rows(first: str, planners: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    return [
        [
            first,
            name,
            str(own["asked"]),
            f"{own['solved']} of {own['solvable']}",
            fixed(own["time_ms_median"], 1),
            fixed(own["time_ms_p95"], 1),
            fixed(own["time_all_ms_p95"], 1),
            fixed(own["ratio_median"], 3),
            fixed(own["ratio_p95"], 3),
            str(own["wrongly_certified"]),
            fixed(own["ready_ms"], 1),
        ]
        for name, own in planners.items()
    ]
