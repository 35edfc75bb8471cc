"""What the policies propose and what became of executed paths, as tables of the report's page, from
their stages' JSON.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout, in_checkout
from constraint_geodesics.report.cells import fixed, markdown_table, origin, share, short
from constraint_geodesics.report.page import Links, Recorded, Table, runs_link
from constraint_geodesics.report.results import read_metrics
from constraint_geodesics.studies.proposals import (
    DESCENT,
    OWN,
    PEERS,
    PLANNER,
    POLICY,
    RANDOM,
    STILL,
    STRAIGHT,
)

POLICY_COLUMNS = (
    *("one cubic, not refined", "queries × seeds", "certified, of what anything solves"),
    *("95 % interval", "length / shortest, median", "p95", "p95, failures ∞"),
    *("curves looked at", "time with its check [ms]", "chance that the policy solves more"),
    *("is shorter, failures ∞", "refined: certified", "p95"),
)
EXECUTION_COLUMNS = (
    *("path", "executed", "spheres kept, mean", "worst", "largest tilt [°]", "collisions"),
    *("tracking error [rad]", "duration [s]"),
)
METHODS = (POLICY, STILL, RANDOM, DESCENT, OWN, STRAIGHT, *PEERS[1:], PLANNER)
"""The order of the proposals; the last ones return whole paths."""
COMPARED = (POLICY, STILL, RANDOM, DESCENT)
"""What a sentence compares."""
DIFFUSION = "train_path_diffusion"
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
    """What learning adds, and all tables of it, as Markdown."""
    added = what_learning_adds(params, layout)
    about = read_metrics(layout.report("benchmark_policies", "policies")).get("machine")
    parts = [
        "\n".join(f"- **{footing}.** {sentence}" for footing, sentence in added.items()),
        *([f"{origin(about)}."] if about else []),
        *map(_markdown, policy_blocks(params, layout)),
    ]
    return "\n\n".join(parts) + "\n"


def what_learning_adds(params: Params, layout: Layout) -> dict[str, str]:
    """What is to be said of each footing (one curve, unseen constraints, an obstacle, refined
    paths), and of the training.
    """
    found = read_metrics(layout.report("benchmark_policies", "policies"))
    studied = params.studies.constraint
    unseen = ", ".join(
        f"{name} {share(found[name]['table'][POLICY]['solved_iqm'])}"
        for name in params.unseen
        if POLICY in found.get(name, {}).get("table", {})
    )
    said = {
        "One curve": f"{_against_controls(found[studied]['table'], studied)} "
        f"{_against_controls(found['trained on']['table'], 'All constraints together')}"
    }
    never = found["never seen"].get("table")
    if never:
        said["Constraints never trained on"] = f"The policy solves {unseen}. " + _against_controls(
            never, "Together"
        )
    beset = found["trained on"].get("keep_out")
    if beset:
        said["A sphere on the way"] = _against_controls(beset, "All constraints together")
    rows = found["trained on"]["table"]
    told = [
        f"{name} {share(own['refined_iqm'], 1)} and {fixed(own['refined_p95_iqm'], 4)}"
        for name, own in _ordered(rows, (*COMPARED, PLANNER)).items()
        if name in (*COMPARED, PLANNER)
    ]
    said["Refined paths"] = (
        "The answers relaxed by the planner's band, all constraints together: certified, and 95th "
        f"percentile of the length over the shortest path known, {'; '.join(told)}."
    )
    trained = _trained_for(params, layout)
    return said | ({"Training": trained} if trained else {})


def _against_controls(rows: Mapping[str, Mapping[str, Any]], where: str) -> str:
    """What a policy solves and how long its curves are, and those of its controls."""
    family = rows[POLICY]["optimum_p95_iqm"] is not None
    column = "optimum_p95_iqm" if family else "ratio_p95_iqm"
    over = "the family's shortest curve" if family else "the shortest path known"
    told = [
        f"{name} {share(row['solved_iqm'], 1)} and {fixed(row[column], 3)}"
        for name, row in _ordered(rows, COMPARED).items()
        if name in COMPARED
    ]
    return f"{where}: solved, and 95th percentile of the length over {over}, {'; '.join(told)}."


def _trained_for(params: Params, layout: Layout) -> str:
    """How long the learners were trained, where their stages said so."""
    told = []
    policies = layout.report("train_policies", params.policies.chart)
    if policies.is_file():
        told.append(
            f"a seed of the policy, on one core, {read_metrics(policies)['seconds_mean']:.0f} s"
        )
    times = layout.stage_times
    if times.is_file():
        seconds = pd.read_csv(times).set_index("stage")["seconds"]
        if DIFFUSION in seconds:
            told.append(
                f"path diffusion, the paths it learns from planned, {seconds[DIFFUSION]:.0f} s; "
                "the policies have seen spheres in training, path diffusion has not"
            )
    return f"{', '.join(told)}." if told else ""


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
        f"means and their bootstrap intervals over the seeds, the queries being what they are; "
        f"lengths over "
        + ("the family's shortest curve" if family else "the shortest certified path known")
        + ", p95 of what was solved; with failures infinite, and refined by the planner's band, "
        "over the shortest certified path known"
    )
    cells = [
        [
            method,
            f"{row['asked']} × {row['seeds']}",
            share(row["solved_iqm"], 1),
            ""
            if row["solved_low"] is None
            else f"{share(row['solved_low'], 1)} to {share(row['solved_high'], 1)}",
            *(fixed(row[f"{over}_{what}_iqm"], 4) for what in ("median", "p95")),
            "∞" if row["ratio_p95_all_iqm"] is None else fixed(row["ratio_p95_all_iqm"], 4),
            short(row["curves"]) if row["curves"] else "",
            short(row["time_ms_iqm"]),
            *(
                share(row[f"beaten_in_{what}"]) if f"beaten_in_{what}" in row else ""
                for what in ("solved", "ratio_p95")
            ),
            share(row["refined_iqm"], 1),
            fixed(row["refined_p95_iqm"], 4),
        ]
        for method, row in rows.items()
    ]
    links = [link] * len(rows)
    return Table(
        f"{title}, proposals", note, POLICY_COLUMNS, cells, planners=list(rows), links=links
    )
