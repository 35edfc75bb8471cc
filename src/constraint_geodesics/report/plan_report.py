"""What the planner that users call reached, as tables of README and of the report's page, from its
stages' JSON.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.benchmark.plan_benchmark import BAND_AFTER, MULTI_START, PARTS, TANGENT
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.report.figures import PLANNERS
from constraint_geodesics.report.page import Links, Recorded, Table, runs_link
from constraint_geodesics.report.results import markdown_table, read_metrics, short
from constraint_geodesics.studies.proposals import (
    DESCENT,
    JOINTS,
    LEARNED,
    ONE_SEED,
    POLICIES,
    RANDOM,
    SEPARATE,
    STRAIGHT,
)

PLAN_COLUMNS = (
    "planner",
    "solved",
    "claimed, not valid",
    "length / best known, median",
    "p95",
    "p95, failures as ∞",
    "time [ms], median",
    "p95",
    "with check, median",
    "p95",
)
POLICY_COLUMNS = (
    "one cubic, not refined",
    "feasible",
    "length / shortest cubic, mean",
    "median",
    "p95",
    "curves looked at",
    "time [ms], beside another process",
)
EXECUTION_COLUMNS = (
    "path",
    "executed",
    "spheres kept, mean",
    "worst",
    "largest tilt [°]",
    "collisions",
    "tracking error [rad]",
    "duration [s]",
)
PEERS = (
    MULTI_START,
    BAND_AFTER,
    PLANNERS["birrt"].label,
    TANGENT,
    PLANNERS["rrt_star"].label,
    PLANNERS["prm"].label,
)
"""The order of rows after the planner and its parts."""
COMPARED = (next(iter(PARTS)), *PEERS[:4])
"""Rows that are shown of constraints that nothing was trained on."""
METHODS = (STRAIGHT, RANDOM, DESCENT, ONE_SEED, POLICIES, SEPARATE)
"""The order of the proposals, each on the learned manifold first."""


def plan_blocks(params: Params, layout: Layout) -> list[Table]:
    """The planner, its parts and its peers under the constraint of the plans, then under the unseen
    ones.
    """
    measured = read_metrics(layout.report("benchmark_plans", "plans"))
    name, plans, batches = params.plans.constraint, measured["plans"], measured["batch"]
    plans = {
        constraint: _ordered(rows, (*params.plans.parts, *PEERS))
        for constraint, rows in plans.items()
    }
    rows = plans[name]
    first, batch = next(iter(rows.values())), batches[name]
    note = (
        f"{first['queries']} queries, {first['solvable']} of which any planner solved; one "
        f"thread of "
        f"{measured['machine']['processor']}. Times without and with PyBullet's check of the "
        f"final path; violation "
        f"bound of the planner's paths at most "
        f"{short(rows['planner']['violation_bound_max'])} rad. In one batch of "
        f"{batch['size']}: {batch['checked_per_second']:.0f} queries a second, "
        f"{batch['per_second']:.0f} without the check. The planner's paths come from "
        f"{_sources(rows['planner'])}; ratios are over each planner's own valid paths, but in "
        f"the column with failures"
    )
    link = Links(runs_link("benchmark_plans", name))
    title, cells = f"{name}, whole and in parts", [_plan_row(*row) for row in rows.items()]
    blocks = [
        Table(title, note, PLAN_COLUMNS, cells, planners=list(rows), links=[link] * len(rows))
    ]
    unseen = [
        (constraint, planner, found)
        for constraint in params.plans.unseen
        for planner, found in plans[constraint].items()
        if planner in COMPARED
    ]
    if unseen:
        counted = ", ".join(f"{c} {_solvable(plans[c])}" for c in params.plans.unseen)
        note = (
            "constraints that nothing was trained on; their graphs, made in about a second "
            "each, are not in the times; "
            f"solved of the queries that any planner solved: {counted}"
        )
        header = ("constraint, planner", *PLAN_COLUMNS[1:])
        cells = [
            _plan_row(f"{constraint}, {planner}", found) for constraint, planner, found in unseen
        ]
        planners = [planner for _, planner, _ in unseen]
        links = [link] * len(unseen)
        blocks.append(
            Table("Unseen constraints", note, header, cells, planners=planners, links=links)
        )
    return blocks


def policy_blocks(params: Params, layout: Layout) -> list[Table]:
    """What the policies propose before any refinement, one block a constraint."""
    found = read_metrics(layout.report("benchmark_policies", params.geodesics.searched[0]))
    names = [name for name in (params.plans.constraint, *params.plans.unseen) if name in found]
    named = [f"{method}, {chart}" for method in METHODS for chart in (LEARNED, JOINTS)]
    link = Links(runs_link("benchmark_policies", params.geodesics.searched[0]))
    return [_policy_block(name, _ordered(found[name], named), link) for name in names]


def execution_block(params: Params, layout: Layout) -> Table:
    """What an open cup keeps of its content on planned paths and on straight joint lines."""
    found = read_metrics(layout.report("execute_paths", params.plans.constraint))
    kinds = {kind: row for kind, row in found.items() if isinstance(row, Mapping)}
    tilt = np.degrees(found["smallest_line_tilt_rad"])
    note = (
        f"{found['queries']} of {found['drawn']} drawn queries of {params.plans.constraint}, "
        f"whose straight joint line "
        f"tilts the cup by {tilt:.0f}° or more; followed by PyBullet's position control with "
        f"gravity, with "
        f"{params.execution.spheres} spheres in an open cup"
    )
    rows = [
        [
            kind,
            str(row["executed"]),
            f"{row['kept_share_mean']:.0%}",
            f"{row['kept_share_worst']:.0%}",
            f"{np.degrees(row['largest_tilt_rad']):.1f}",
            str(row["collisions"]),
            short(row["largest_tracking_error_rad"]),
            f"{row['duration_mean_s']:.2f}",
        ]
        for kind, row in kinds.items()
    ]
    link, recorded = runs_link("execute_paths", params.plans.constraint), _executed(params, layout)
    links = [Links(link, recorded.get(kind, ())) for kind in kinds]
    return Table("Execution", note, EXECUTION_COLUMNS, rows, planners=list(kinds), links=links)


def _executed(params: Params, layout: Layout) -> dict[str, list[Recorded]]:
    """The recorded executions of each kind of path."""
    rows, found = (
        pd.read_csv(layout.report("execute_paths", params.plans.constraint, "csv")),
        dict[str, list[Recorded]](),
    )
    for row in rows[rows["recording"].notna()].to_dict("records"):
        told = (
            f"query {row['query']}: {row['status']}, {row['kept']} of {row['spheres']} spheres kept"
        )
        found.setdefault(str(row["kind"]), []).append(Recorded(in_checkout(row["recording"]), told))
    return found


def plans_markdown(params: Params, layout: Layout) -> str:
    """All of it but the policies, as README shows it."""
    return (
        "\n\n".join(map(_markdown, [*plan_blocks(params, layout), execution_block(params, layout)]))
        + "\n"
    )


def policies_markdown(params: Params, layout: Layout) -> str:
    """The policies' first table, as README shows it."""
    return _markdown(policy_blocks(params, layout)[0]) + "\n"


def _ordered(
    rows: Mapping[str, Mapping[str, Any]], names: Iterable[str]
) -> dict[str, Mapping[str, Any]]:
    """Rows in the order of these names, any others behind them; JSON has them by the alphabet."""
    return {name: rows[name] for name in dict.fromkeys([*names, *rows]) if name in rows}


def _markdown(block: Table) -> str:
    return f"**{block.title}** ({block.note}):\n\n{markdown_table([block.header, *block.rows])}"


def _plan_row(name: str, row: Mapping[str, Any]) -> Sequence[str]:
    times = (
        row[key] for key in ("time_median_ms", "time_p95_ms", "checked_median_ms", "checked_p95_ms")
    )
    return [
        name,
        _number(row["success_of_solvable"], "{:.1%}"),
        str(row["claimed_but_invalid"]),
        _number(row["ratio_median"], "{:.4f}"),
        _number(row["ratio_p95"], "{:.4f}"),
        _number(row["ratio_p95_all"], "{:.4f}"),
        *(_number(value, "{:.3g}") for value in times),
    ]


def _sources(row: Mapping[str, Any]) -> str:
    told = {"straight": "the straight start", "graph": "the graph", "policy": "the policies"}
    return ", ".join(f"{told[name]} ({row[f'from_{name}']:.0%})" for name in told)


def _solvable(rows: Mapping[str, Mapping[str, Any]]) -> str:
    first = next(iter(rows.values()))
    return f"{first['solvable']} of {first['queries']}"


def _policy_block(constraint: str, rows: Mapping[str, Mapping[str, Any]], link: Links) -> Table:
    first = next(iter(rows.values()))
    note = (
        f"{first['queries']} queries, {first['solvable']} of which have a curve of the "
        f"family; ratios over the "
        f"{first['shared']} that every method solves"
    )
    cells = [
        [
            method,
            _number(row["feasible"], "{:.1%}"),
            *(_number(row[f"shared_ratio_{what}"], "{:.4f}") for what in ("mean", "median", "p95")),
            str(row["curves"]),
            _number(row["time_median_ms"], "{:.3g}"),
        ]
        for method, row in rows.items()
    ]
    links = [link] * len(rows)
    return Table(
        f"{constraint}, proposals", note, POLICY_COLUMNS, cells, planners=list(rows), links=links
    )


def _number(value: float | None, form: str) -> str:
    return "–" if value is None or np.isnan(value) else form.format(value)
