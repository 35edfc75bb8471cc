"""Stage: the benchmark's summary, tables, figures and the database for Planner Arena."""

import json
import sys
from collections.abc import Mapping
from typing import Any

import pandas as pd

from constraint_geodesics.benchmark.planner_arena import export_arena
from constraint_geodesics.benchmark.queries import KEEP_OUT, TABLE
from constraint_geodesics.benchmark.row import read_table
from constraint_geodesics.benchmark.statistics import (
    all_constraints,
    benchmark_summary,
    break_even_table,
    ours_against_baselines,
)
from constraint_geodesics.params import Params
from constraint_geodesics.peers.baseline import BaselineSettings
from constraint_geodesics.peers.planner import PlannerSettings
from constraint_geodesics.peers.registry import all_settings, colours
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.pipeline.stage import run_stage
from constraint_geodesics.recording.png import save_png
from constraint_geodesics.report import benchmark_figures as figures
from constraint_geodesics.report import benchmark_tables as tables
from constraint_geodesics.report.cells import markdown_table
from constraint_geodesics.report.standing import WHERE, shown_at_first
from constraint_geodesics.text_files import write_text, written
from constraint_geodesics.tracking.comparison import BENCHMARK, cells_of
from constraint_geodesics.tracking.experiment import StageRun, Work, tracked_stage

STAGE = "report_benchmark"
BUDGETS = (0.01, 0.03, 0.1, 0.3, 1.0, 20.0)
"""Time budgets at which the planner is held against its baselines [s]: it is given no more than a
second, they have ended at the last.
"""
MADE_OTHERWISE = ("without graph", "trees + band", "learned", "learned + band")
"""Planners that need less beforehand than the planner, or training: drawn where that pays, with
those that the overview shows.
"""
SERVES = 0.5
"""Valid rows of all that a planner must have to be drawn among those that serve queries."""

Settings = Mapping[str, BaselineSettings]


def main(params: Params, layout: Layout) -> None:
    """Write reports/benchmark/ and data/benchmark.db."""
    drawn = {"drawn": params.benchmark.drawn}
    work = Work(STAGE, STAGE, drawn, [layout.benchmark_table, layout.training_times])
    with tracked_stage(work, params.tracking.experiment, layout.root) as run:
        write(params, layout, run)


def write(params: Params, layout: Layout, run: StageRun) -> None:
    """Write all of it; MLflow gets a run for each planner that is drawn, and for the first one's
    constraints.
    """
    folder, settings = layout.root / "reports" / "benchmark", all_settings(params)
    rows, about = read_table(layout.benchmark_table)
    orders = {
        "planner": list(settings),
        "constraint": list(params.all_constraints),
        "scene": [TABLE, KEEP_OUT],
    }
    rows = rows.sort_values(
        list(orders),
        key=lambda names: names.map({name: k for k, name in enumerate(orders[str(names.name)])}),
        kind="stable",
    )
    folder.mkdir(parents=True, exist_ok=True)
    found = write_tables(params, layout, settings, rows)
    costs = found["break_even"]
    drawn = [name for name in params.benchmark.drawn if name in settings]
    first = shown_at_first(found["overview"])
    told_apart, styles = (
        figures.styles_of(names, colours(settings))
        for names in (first, (*first, *(name for name in MADE_OTHERWISE if name in settings)))
    )
    for name, figure in (
        ("overview", figures.overview(all_constraints(rows), told_apart, WHERE)),
        ("break_even", figures.break_even(costs[costs["success"] >= SERVES], styles)),
    ):
        save_png(figure, folder / f"{name}.png")
        run.figure(folder / f"{name}.png")
    told = {name: json.dumps(own.model_dump(mode="json")) for name, own in settings.items()}
    export_arena(rows, layout.root / "data" / "benchmark.db", about, told)
    write_text(folder / "about.json", json.dumps(about, indent=2) + "\n")
    summary, overview = found["summary"], found["overview"]
    shown: list[Any] = [
        *overview[overview["planner"].isin(drawn)].to_dict("records"),
        *summary[summary["planner"] == next(iter(settings))].to_dict("records"),
    ]
    run.cells(cells_of(shown, ("planner", "constraint", "scene"), BENCHMARK))


def write_tables(
    params: Params, layout: Layout, settings: Settings, rows: pd.DataFrame
) -> dict[str, pd.DataFrame]:
    """Write every table as CSV and Markdown; returns them by name."""
    folder, reference = layout.root / "reports" / "benchmark", next(iter(settings))
    in_python = tables.asks_in_python(settings)
    summary = benchmark_summary(rows, reference)
    overview = benchmark_summary(all_constraints(rows), reference)
    shown = overview[overview["planner"].isin(params.benchmark.drawn)]
    illustrated = params.geodesics.illustrated_constraints[0]
    case = rows[(rows["constraint"] == illustrated) & (rows["scene"] == TABLE)]
    ahead = ours_against_baselines(rows, whole_planner(settings), BUDGETS)
    costs = break_even_table(rows, json.loads(layout.training_times.read_text()), reference)
    written_tables = (
        ("summary", summary, tables.benchmark_markdown(summary)),
        ("overview", overview, tables.overview_markdown(overview, in_python)),
        ("drawn", None, tables.overview_markdown(shown, in_python)),
        (
            "table_i",
            None,
            f"{markdown_table(tables.table_i_cells(case))}\n\n{tables.TABLE_I_NOTE}\n",
        ),
        ("budgets", ahead, tables.ahead_markdown(ahead)),
        ("break_even", costs, f"{markdown_table(tables.break_even_cells(costs))}\n"),
    )
    for name, table, text in written_tables:
        write_text(folder / f"{name}.md", text)
        if table is not None:
            with written(folder / f"{name}.csv") as part:
                table.to_csv(part, index=False, float_format="%.6g")
    return {name: table for name, table, _ in written_tables if table is not None}


def whole_planner(settings: Settings) -> dict[str, float]:
    """The planner's names with the budget [s] of each, 0 for the first answer.  Without some part
    it is a baseline, as are the learned methods.
    """
    return {
        name: one.given_s
        for name, one in settings.items()
        if isinstance(one, PlannerSettings) and one.method == "planner" and not one.switched_off
    }


if __name__ == "__main__":
    run_stage(main, sys.argv[1:])
