"""The benchmark's page (reports/benchmark.html), from the tables and figures of its stages."""

from collections.abc import Mapping, Sequence

import pandas as pd

from constraint_geodesics.benchmark.queries import TABLE
from constraint_geodesics.benchmark.row import read_table
from constraint_geodesics.params import Params
from constraint_geodesics.peers.planner import PlannerSettings
from constraint_geodesics.peers.registry import all_settings
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.report.benchmark_tables import (
    PYTHON_NOTE,
    TABLE_I_NOTE,
    ahead_cells,
    asks_in_python,
    break_even_cells,
    case_cells,
    counted,
    overview_cells,
    repeated_cells,
    table_i_cells,
    verdict_cells,
)
from constraint_geodesics.report.cells import Cells, fixed
from constraint_geodesics.report.chooser import chooser
from constraint_geodesics.report.page import Links, Picture, Recorded, Section, Table, write_page
from constraint_geodesics.report.results import ReportError
from constraint_geodesics.report.standing import equal_time, losses, planner_result, winner

Case = tuple[str, str, str]
"""Constraint, scene and planner."""
GROWTH = ("what grows with what", "exponent", "± standard error", "points")


def write_benchmark_page(params: Params, layout: Layout) -> None:
    """Write reports/benchmark.html from reports/benchmark.csv, benchmark/, growth/ and
    benchmark_repeat/.

    Raises ReportError naming the first file that is missing.
    """
    try:
        rows, about = read_table(layout.benchmark_table)
        overview, budgets = (_table(layout, name) for name in ("overview", "budgets"))
        sections = benchmark_sections(params, layout, rows)
    except FileNotFoundError as error:
        raise ReportError(f"{error.filename or error}: missing; `make bench` makes it") from None
    write_page(
        layout,
        "benchmark",
        winner=winner(budgets),
        standing=equal_time(budgets),
        result=planner_result(overview),
        losses=losses(overview, budgets),
        chooser=chooser(rows, overview, list(params.benchmark.planners)),
        about=about,
        planners=rows["planner"].nunique(),
        rows=len(rows),
        sections=sections,
    )


def benchmark_sections(params: Params, layout: Layout, rows: pd.DataFrame) -> list[Section]:
    """The page's parts in their order.  rows: of reports/benchmark.csv."""
    summary, overview, budgets, costs = (
        _table(layout, name) for name in ("summary", "overview", "budgets", "break_even")
    )
    return [
        *_overview_sections(params, overview),
        _budget_section(budgets),
        _published_section(params, rows),
        _break_even_section(layout, costs),
        _growth_section(layout),
        _repeat_section(layout),
        _case_section(summary, benchmark_recordings(rows)),
    ]


def _table(layout: Layout, name: str) -> pd.DataFrame:
    return pd.read_csv(layout.root / "reports" / "benchmark" / f"{name}.csv")


def _overview_sections(params: Params, overview: pd.DataFrame) -> list[Section]:
    settings = all_settings(params)
    in_python = asks_in_python(settings)
    parts = [name for name, one in settings.items() if isinstance(one, PlannerSettings)]
    drawn, own = (
        overview[overview["planner"].isin(names)] for names in (params.benchmark.drawn, parts)
    )
    return [
        Section(
            "overview",
            "Overview",
            f"All constraints together, a table for each scene. {PYTHON_NOTE}",
            tables=_overview_blocks(drawn, in_python, "planners that are drawn"),
            folded=_overview_blocks(overview, in_python, "all planners"),
        ),
        Section(
            "parts",
            "The planner without its parts",
            "The same queries with a part left out, or with a longer budget.",
            tables=_overview_blocks(own, (), "the planner and its parts"),
        ),
    ]


def _budget_section(budgets: pd.DataFrame) -> Section:
    note = "a case is a constraint in a scene; from reports/benchmark/budgets.csv"
    cases = Table("Cases by budget", note, *_parted(verdict_cells(budgets)))
    behind = Table("Baselines and parts that are ahead", note, *_parted(ahead_cells(budgets)))
    told = (
        "How often the planner is first within the same time, over the queries that it and a "
        "baseline, or a part of it, were both asked."
    )
    return Section("budgets", "Within a time budget", told, tables=[cases], folded=[behind])


def _published_section(params: Params, rows: pd.DataFrame) -> Section:
    constraint = params.geodesics.illustrated_constraints[0]
    cells = table_i_cells(rows[(rows["constraint"] == constraint) & (rows["scene"] == TABLE)])
    block = _of_planners(
        f"Table I and {constraint}, scene {TABLE}", "from reports/benchmark.csv", cells
    )
    return Section(
        "published", "Next to the paper: Table I", TABLE_I_NOTE.replace("`", ""), tables=[block]
    )


def _break_even_section(layout: Layout, costs: pd.DataFrame) -> Section:
    note = "never: the other is no slower; from reports/benchmark/break_even.csv"
    block = _of_planners("From how many queries on", note, break_even_cells(costs))
    told = (
        "What training and roadmaps take once, from data to files, against what they save in each "
        "query."
    )
    return Section(
        "break_even", "When training pays", told, [_picture(layout, "break_even")], [block]
    )


def _growth_section(layout: Layout) -> Section:
    slopes = pd.read_csv(layout.root / "reports" / "growth" / "slopes.csv", comment="#")
    slopes = slopes[slopes["points"] > 2]  # any two points lie on a line
    told = (
        "Seconds against joints, held task axes, obstacles, queries, latent dimensions and "
        "rows, on one thread."
    )
    note = "of seconds over size, in log-log; from reports/growth/slopes.csv"
    block = Table("Exponents", note, GROWTH, growth_cells(slopes), planners=list(slopes["what"]))
    return Section("growth", "How cost grows", told, [_picture(layout, "growth")], [block])


def _repeat_section(layout: Layout) -> Section:
    table = pd.read_csv(layout.root / "reports" / "benchmark_repeat" / "repeat.csv")
    block = _of_planners(
        "Two runs", "from reports/benchmark_repeat/repeat.csv", repeated_cells(table)
    )
    told = "Part of the queries answered a second time, by the planners whose search no clock ends."
    return Section("repeat", "The same again", told, tables=[block])


def _case_section(summary: pd.DataFrame, recorded: Mapping[Case, Sequence[Recorded]]) -> Section:
    blocks = []
    for (constraint, scene), case in summary.groupby(["constraint", "scene"], sort=False):
        links = [
            Links("", recorded.get((str(constraint), str(scene), str(name)), ()))
            for name in case["planner"]
        ]
        note = f"{counted(case)}; from reports/benchmark/summary.csv"
        blocks.append(_of_planners(f"{constraint}, scene {scene}", note, case_cells(case), links))
    told = (
        "Recorded paths stand below the table that they belong to. All rows are in "
        "reports/benchmark.csv, and in data/benchmark.db for Planner Arena; MLflow has a run for "
        "each planner that is drawn (its view Planners)."
    )
    return Section("cases", "Every constraint and scene", told, folded=blocks)


def benchmark_recordings(rows: pd.DataFrame) -> dict[Case, list[Recorded]]:
    """The recorded paths of each constraint, scene and planner."""
    found: dict[Case, list[Recorded]] = {}
    for row in rows[rows["recording"] != ""].to_dict("records"):
        key = (str(row["constraint"]), str(row["scene"]), str(row["planner"]))
        verdict = "valid" if row["valid"] else "not valid"
        told = (
            f"query {row['query']}, seed {row['seed']}: {verdict}, {fixed(row['length_rad'])} rad"
        )
        found.setdefault(key, []).append(Recorded(in_checkout(row["recording"]), told))
    return found


def growth_cells(slopes: pd.DataFrame) -> Cells:
    """Exponents of time over size, one row an axis and what grows."""
    return [
        (
            f"{row['what']}: {row['axis']}",
            *(fixed(row[name]) for name in ("slope", "standard_error")),
            str(row["points"]),
        )
        for row in slopes.to_dict("records")
    ]


def _overview_blocks(summary: pd.DataFrame, in_python: Sequence[str], which: str) -> list[Table]:
    source = "from reports/benchmark/overview.csv"
    return [
        _of_planners(
            f"Scene {scene}, {which}", f"{counted(case)}; {source}", overview_cells(case, in_python)
        )
        for scene, case in summary.groupby("scene", sort=False)
    ]


def _of_planners(title: str, note: str, cells: Cells, links: Sequence[Links] = ()) -> Table:
    """A block whose rows begin with their planner's name."""
    header, rows = _parted(cells)
    return Table(title, note, header, rows, planners=[row[0] for row in rows], links=links)


def _parted(cells: Cells) -> tuple[Sequence[str], Cells]:
    """A table's header, and its rows; the page needs no marks around names."""
    header, *rows = ([cell.replace("`", "") for cell in row] for row in cells)
    return header, list(rows)


CAPTIONS: Mapping[str, tuple[str, str, str]] = {
    "break_even": (
        "benchmark",
        "Training, roadmaps and planning, in all",
        "Time from the first query on, over the planner's on the same queries, of planners with a "
        "valid path in half of their rows or more. Above 1 the planner has taken less; a dot says "
        "from how many queries on.",
    ),
    "growth": (
        "growth",
        "Seconds over size",
        "A panel for each axis, in log-log; slopes with their standard errors stand in the "
        "legends.",
    ),
}
"""Folder, title and caption of each figure."""


def _picture(layout: Layout, name: str) -> Picture:
    folder, title, caption = CAPTIONS[name]
    return Picture(name, title, caption, title, layout.root / "reports" / folder / f"{name}.png")
