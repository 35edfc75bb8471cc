"""What the policies propose and what became of executed paths, as tables of the report's page, from
their stages' JSON.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.report.cells import fixed, markdown_table, share, short
from constraint_geodesics.report.page import Links, Recorded, Table, runs_link
from constraint_geodesics.report.results import read_metrics
from constraint_geodesics.studies.proposals import DESCENT, OWN, POLICY, RANDOM, STRAIGHT

POLICY_COLUMNS = (
    *("one cubic, not refined", "certified, of what anything solves", "95 % interval"),
    *("length / shortest, median", "p95", "curves looked at"),
    *("time with its check [ms]", "chance that the policy solves more", "is shorter"),
)
EXECUTION_COLUMNS = (
    *("path", "executed", "spheres kept, mean", "worst", "largest tilt [°]", "collisions"),
    *("tracking error [rad]", "duration [s]"),
)
METHODS = (POLICY, OWN, RANDOM, DESCENT, STRAIGHT)
"""The order of the proposals."""
SCENES = {"table": "", "keep_out": ", one sphere on the way"}
"""What a block's title says of each scene."""


def policy_blocks(params: Params, layout: Layout) -> list[Table]:
    """What the policies propose before any refinement: the studied constraint, all that they were
    trained on, each that they were not, and the same with a sphere on the way, where there are such
    queries.
    """
    found = read_metrics(layout.report("benchmark_policies", "policies"))
    names = [params.studies.constraint, "trained on", *params.unseen]
    link = Links(runs_link("benchmark_policies", params.policies.chart))
    shown = [(name, "table") for name in names]
    shown += [
        (name, "keep_out") for name in (params.studies.constraint, "trained on", "never seen")
    ]
    return [
        _policy_block(f"{name}{SCENES[scene]}", _ordered(found[name][scene], METHODS), link)
        for name, scene in shown
        if scene in found.get(name, {})
    ]


def execution_block(params: Params, layout: Layout) -> Table:
    """What an open cup keeps of its content on planned paths and on straight joint lines."""
    found = read_metrics(layout.report("execute_paths", params.studies.constraint))
    kinds = {kind: row for kind, row in found.items() if isinstance(row, Mapping)}
    tilt = np.degrees(found["smallest_line_tilt_rad"])
    note = (
        f"{found['queries']} of {found['drawn']} drawn queries of {params.studies.constraint}, "
        f"whose straight joint line tilts the cup by {tilt:.0f}° or more; followed by PyBullet's "
        f"position control with gravity, with {params.execution.spheres} spheres in an open cup"
    )
    rows = [
        [
            kind,
            str(row["executed"]),
            share(row["kept_share_mean"]),
            share(row["kept_share_worst"]),
            f"{np.degrees(row['largest_tilt_rad']):.1f}",
            str(row["collisions"]),
            short(row["largest_tracking_error_rad"]),
            fixed(row["duration_mean_s"]),
        ]
        for kind, row in kinds.items()
    ]
    link, recorded = (
        runs_link("execute_paths", params.studies.constraint),
        _executed(params, layout),
    )
    links = [Links(link, recorded.get(kind, ())) for kind in kinds]
    return Table("Execution", note, EXECUTION_COLUMNS, rows, planners=list(kinds), links=links)


def _executed(params: Params, layout: Layout) -> dict[str, list[Recorded]]:
    """The recorded executions of each kind of path."""
    rows, found = (
        pd.read_csv(layout.report("execute_paths", params.studies.constraint, "csv")),
        dict[str, list[Recorded]](),
    )
    for row in rows[rows["recording"].notna()].to_dict("records"):
        told = (
            f"query {row['query']}: {row['status']}, {row['kept']} of {row['spheres']} spheres kept"
        )
        found.setdefault(str(row["kind"]), []).append(Recorded(in_checkout(row["recording"]), told))
    return found


def execution_markdown(params: Params, layout: Layout) -> str:
    """What became of executed paths, as Markdown."""
    return _markdown(execution_block(params, layout)) + "\n"


def policies_markdown(params: Params, layout: Layout) -> str:
    """The policies' first table, as Markdown."""
    return _markdown(policy_blocks(params, layout)[0]) + "\n"


def _ordered(
    rows: Mapping[str, Mapping[str, Any]], names: Iterable[str]
) -> dict[str, Mapping[str, Any]]:
    """Rows in the order of these names, any others behind them; JSON has them by the alphabet."""
    return {name: rows[name] for name in dict.fromkeys([*names, *rows]) if name in rows}


def _markdown(block: Table) -> str:
    return f"**{block.title}** ({block.note}):\n\n{markdown_table([block.header, *block.rows])}"


def _policy_block(title: str, rows: Mapping[str, Mapping[str, Any]], link: Links) -> Table:
    first = next(iter(rows.values()))
    family = first["optimum_median_iqm"] is not None
    over = "optimum" if family else "ratio"
    note = (
        f"{first['queries']} queries, {first['solvable']} of which anything solves; interquartile "
        f"means over {first['seeds']} seeds of the policy; lengths over "
        + ("the family's shortest curve" if family else "the shortest certified path known")
    )
    cells = [
        [
            method,
            share(row["solved_iqm"], 1),
            f"{share(row['solved_low'], 1)} to {share(row['solved_high'], 1)}",
            *(fixed(row[f"{over}_{what}_iqm"], 4) for what in ("median", "p95")),
            short(row["curves"]),
            short(row["time_ms_iqm"]),
            *(
                share(row[f"beaten_in_{what}"]) if f"beaten_in_{what}" in row else ""
                for what in ("solved", "ratio_p95")
            ),
        ]
        for method, row in rows.items()
    ]
    links = [link] * len(rows)
    return Table(
        f"{title}, proposals", note, POLICY_COLUMNS, cells, planners=list(rows), links=links
    )
