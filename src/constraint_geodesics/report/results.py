"""The result table of a run: the paths of all planners read, checked, compared, and printed.

Everything comes from the tables of the other stages; names come from params.yaml, never from what
lies in a folder.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pandera.pandas as pandera

from constraint_geodesics.benchmark.statistics import APART, RANDOM, STRAIGHT, Counted, summarise
from constraint_geodesics.learning.learned_manifold import JOINT_SPACE
from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.cells import (
    Cells,
    fixed,
    markdown_table,
    plus_minus,
    records,
    short,
)
from constraint_geodesics.report.figures import PLANNERS

LEARNED = "learned_geodesic"
TEXTS = ("reason", "recording")

CHORDS = "chords_batched_per_second"
LENGTH_RATES, CHORD_RATES = ("per_second", "naive_per_second"), ("per_second", CHORDS)
STEP_RATES = ("steps_per_second", "dummy_vec_env_steps_per_second")
"""Keys of a rate and of that of the usual way in reports/geometry.json."""

COUNTED = {"valid": "valid paths", "found": "all paths found, valid or not"}
COLUMNS = (
    *("constraint", "planner", "valid", "queries", "shortest", "average ± std"),
    *("joint length [rad]", "time [s]", "violation, median [°]", "worst [°]"),
)


class ReportError(ValueError):
    """A file that the report needs is missing or can't be used; the message is one line with its
    name.
    """


def compare_planners(params: Params, layout: Layout) -> pd.DataFrame:
    """One row a manifold, constraint and planner: the figures of `summarise`, sampled and learned
    paths side by side.

    Where curves are retracted the lengths are those of valid paths; where they are only decoded, as
    in the paper, of all paths found (column `counted`), since hardly any of those keeps the
    constraint.
    """
    items = params.searched_items
    if not items:
        none = "geodesics.searched and geodesics.illustrated name no manifold"
        raise ReportError(f"{none}: there is nothing to compare")
    tables = []
    for manifold, constraint in items:
        settings = params.manifolds[manifold]
        counted: Counted = "valid" if settings.retract else "found"
        rows = read_comparison(params, layout, manifold, constraint)
        about = {"manifold": manifold, "latent_dim": settings.latent_dim, "constraint": constraint}
        summary = summarise(rows, manifold, counted)
        tables.append(pd.DataFrame([about | {"counted": counted}] * len(summary)).join(summary))
    return pd.concat(tables, ignore_index=True)


def read_comparison(params: Params, layout: Layout, manifold: str, constraint: str) -> pd.DataFrame:
    """The rows of all planners under one constraint, sampled first, in the order they are shown."""
    sampled = read_paths(layout.report("benchmark_planners", constraint, "csv"), manifold)
    sampled = sampled[sampled["planner"].isin(params.benchmark.compared_kinds)]
    file = layout.report("train_geodesics", f"{manifold}-{constraint}", "csv")
    rows = pd.concat([sampled, read_paths(file, manifold)], ignore_index=True)
    order = list(PLANNERS)
    return rows.sort_values("planner", key=lambda names: names.map(order.index), kind="stable")


def read_paths(file: Path, manifold: str) -> pd.DataFrame:
    """Read and check a table of measured paths that has the latent length on `manifold`.

    Raises ReportError naming the file and the column if a row can't be used.
    """
    columns = ["length_rad", f"latent_length_{manifold}", "time_s"]
    columns += ["max_violation_rad", "max_violation_m"]
    schema = pandera.DataFrameSchema(
        {
            "planner": pandera.Column(str, pandera.Check.isin(list(PLANNERS))),
            **{name: pandera.Column(int) for name in ("query", "seed")},
            **{name: pandera.Column(str) for name in ("status", *TEXTS)},
            "valid": pandera.Column(bool),
            **{name: pandera.Column(float, nullable=True) for name in columns},
        }
    )
    frame = pd.read_csv(file, float_precision="round_trip", dtype=dict.fromkeys(TEXTS, str))
    # CSV does not tell an empty text from a missing one
    frame = frame.fillna(dict.fromkeys(TEXTS, ""))
    try:
        return schema.validate(frame)
    except pandera.errors.SchemaError as error:
        raise ReportError(f"{file}: {' '.join(str(error).split())[:300]}") from None


def read_metrics(file: Path) -> dict[str, Any]:
    """A stage's metrics.  Raises ReportError naming the file if it is not JSON."""
    try:
        content: dict[str, Any] = json.loads(file.read_text())
    except json.JSONDecodeError as error:
        raise ReportError(f"{file}: not JSON: {error}") from None
    return content


def metrics_of(layout: Layout, stage: str, names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The metrics of some items of a stage, by their names."""
    return {str(name): read_metrics(layout.report(stage, name)) for name in names}


def result_table(layout: Layout) -> str:
    """The result table as Markdown, from reports/table.csv; columns are aligned, so that it reads
    in a terminal too.
    """
    table = pd.read_csv(layout.root / "reports" / "table.csv")
    parts, named = [], ["manifold", "latent_dim", "counted"]
    for (manifold, latent_dim, counted), rows in table.groupby(named, sort=False):
        cells: Cells = [COLUMNS]
        for constraint, group in rows.groupby("constraint", sort=False):
            for k, row in enumerate(records(group)):
                cells.append((str(constraint) if k == 0 else "", *table_cells(row)))
        lengths = f"lengths are those of {COUNTED[str(counted)]}"
        heading = f"`{manifold}`, {latent_dim} latent dimensions; {lengths}"
        parts.append(f"{heading}:\n\n{markdown_table(cells)}")
    return "\n\n".join(parts) + "\n"


def studies_at_hand(params: Params, layout: Layout) -> frozenset[str]:
    """Which studies of `make bench` have left all of their reports: the pipeline runs without."""
    analytic = map(str, params.geodesics.analytic)
    files = {
        "geometry": [
            layout.root / "reports" / "geometry.json",
            layout.report("benchmark_geometry", "quadrature", "csv"),
        ],
        "ablations": [
            *(layout.report("ablate_analytic", name) for name in analytic),
            *(layout.report("ablate_manifold", name) for name in params.manifolds),
        ],
        "policies": [layout.report("benchmark_policies", "policies")],
        "benchmark": [
            layout.root / "reports" / "benchmark" / name for name in ("overview.csv", "about.json")
        ],
        "arms": [layout.root / "reports" / "arms.json"],
        "manifolds": [layout.root / "reports" / "compare_manifolds.json"],
        "charts": [layout.root / "reports" / "compare_charts.json"],
        "demonstrations": [layout.root / "reports" / "demonstrations.json"],
    }
    return frozenset(n for n, own in files.items() if all(file.is_file() for file in own))


def geometry_table(layout: Layout) -> str:
    """What the geometry core reaches, as Markdown, from reports/geometry.json."""
    geometry = read_metrics(layout.root / "reports" / "geometry.json")
    constraint = geometry["constraint"]
    rates: Cells = [(f"on `{geometry['manifold']}`, a second", "here", "the usual way", "ratio")]
    for suffix, how in (("", ""), ("_retracted", f", retracted onto {constraint}")):
        lengths, steps = geometry[f"curve_length{suffix}"], geometry[f"environment{suffix}"]
        measured = [
            (f"curve lengths, batches of {lengths['batch']}", lengths, LENGTH_RATES),
            ("environment steps, PPO included", steps, STEP_RATES),
        ]
        if CHORDS in lengths:
            measured.insert(
                1, ("the same against 101 chords, batched, no Jacobian", lengths, CHORD_RATES)
            )
        for what, found, (own, usual) in measured:
            ratio = found[own] / found[usual]
            shown = (
                f"{found[own]:,.0f}",
                f"{found[usual]:,.0f}",
                fixed(ratio, 0 if ratio >= 10 else 1),
            )
            rates.append((f"{what}{how}", *shown))
    ratios: Cells = [
        (
            *("length over exact distance, mean", "random curve", "descent alone"),
            *("policy (worst seed)", "its p95", "gradient", "domain of the pairs"),
        )
    ]
    for name, searched in geometry["policy_search"].items():
        random, policy = np.mean(searched["first_mean_ratio"]), max(searched["mean_ratio"])
        descent, p95 = np.mean(searched["descent_mean_ratio"]), max(searched["p95_ratio"])
        gradient = geometry["solvers"][name]["gradient"]["mean_ratio"]
        domain = searched["domain"].replace("|", "\\|")
        control = f"{random:.3f}", f"{descent:.4f}"
        ratios.append((name, *control, f"{policy:.4f}", f"{p95:.4f}", f"{gradient:.5f}", domain))
    tables = [rates, ratios, _walls(geometry["grids_with_walls"])]
    return "\n\n".join(map(markdown_table, tables)) + "\n"


def _walls(figures: Mapping[str, Mapping[str, Any]]) -> Cells:
    """What the solvers reach on grids with walls, a row for each metric and solver."""
    title = "150 × 150 nodes with walls"
    rows: Cells = [
        (
            *(title, "queries", "curve found", "crosses no wall"),
            *("over 8-connected Dijkstra: mean", "p95", "max"),
            *("over a converged reference: mean", "max", "ms"),
        )
    ]
    for name, by_solver in figures.items():
        for solver, found in by_solver.items():
            dijkstra, reference = found["over_dijkstra"], found["over_reference"]
            rows.append(
                (
                    *(f"{name}, {solver}", str(found["queries"]), f"{100 * found['found']:.0f} %"),
                    "–" if found["inside"] is None else f"{100 * found['inside']:.0f} %",
                    *(_or_dash(dijkstra[key], ".3f") for key in ("mean", "p95", "max")),
                    *(_or_dash(reference[key], ".4f") for key in ("mean", "max")),
                    f"{found['milliseconds']:.0f}",
                )
            )
    return rows


def _or_dash(value: float | None, form: str) -> str:
    return "–" if value is None or np.isnan(value) else format(value, form)


class Finding(NamedTuple):
    """What the table says of one thing, good and bad, in sentences."""

    about: str
    sentences: Sequence[str]


def findings(
    params: Params, table: pd.DataFrame, manifolds: Mapping[str, Mapping[str, float]]
) -> list[Finding]:
    """What was found on each manifold, and what to keep in mind.

    table: what `compare_planners` returns.  manifolds: each learned manifold's held-out metrics.
    """
    found = [
        _found_on(params, str(name), rows, manifolds[str(name)])
        for name, rows in table.groupby("manifold", sort=False)
    ]
    sampled = table[~table["planner"].isin([LEARNED, *APART])]
    refused = _by_planner(sampled.drop_duplicates(["constraint", "planner"]), "refused")
    seeds, queries = len(params.geodesics.seeds), params.labels.queries
    cautions = [
        f"This is {queries} queries a constraint and {seeds} policies each: enough to see large "
        "differences, not small ones.",
        "Training the manifolds and policies is not in the planning times.",
        "No planner's own word counts: of all rows, the share in which a sampling planner returned "
        f"a path that the judge refused is {refused}.",
    ]
    return [*found, Finding("To keep in mind", cautions)]


def _found_on(
    params: Params, manifold: str, rows: pd.DataFrame, held_out: Mapping[str, float]
) -> Finding:
    settings = params.manifolds[manifold]
    learned, straight, random = (
        rows[rows["planner"] == name].set_index("constraint")
        for name in (LEARNED, STRAIGHT, RANDOM)
    )
    others = _by_planner(rows[~rows["planner"].isin([LEARNED, *APART])], "success")
    decoded = "curves decoded and their ends corrected, nothing retracted"
    chart = "joint space" if params.policies.chart == JOINT_SPACE else "its latent space"
    retracted = f"curves of {chart} retracted onto the constraint"
    how = retracted if settings.retract else decoded
    shares = ", ".join(f"{name} {share:.0%}" for name, share in learned["success"].items())
    worst, median = (short(learned[f"violation_{which}_deg"].max()) for which in ("max", "median"))
    sentences = [
        f"The learned search finds a valid path for {_share(learned, 'success')} of the queries "
        f"({shares}).",
        f"Under the same constraints the straight line of the chart is valid for "
        f"{_share(straight, 'success')}, and the sampling planners find a valid path for so many: "
        f"{others}.",
        f"The learned geodesics returned violate the constraint by {worst}° at worst; the median "
        f"path of the worst constraint by {median}°.",
        _shortest_under(rows),
        f"The decoder reproduces unseen poses to {short(held_out['joint_error_mean_deg'])}° a "
        f"joint (mean) and {short(held_out['tool_error_median_mm'])} mm at the tool (median).",
        "Without a policy, no fewer random curves than a first round, chosen by the same rule, "
        f"give {_share(random, 'success')}.",
        "No connection in the sampled graph, and so no search: "
        f"{_share(learned, 'not_connected')} of the queries.",
    ]
    return Finding(f"{manifold}: {settings.latent_dim} latent dimensions, {how}", sentences)


def _by_planner(rows: pd.DataFrame, column: str) -> str:
    return ", ".join(
        f"{PLANNERS[str(name)].label} {_share(group, column)}"
        for name, group in rows.groupby("planner", sort=False)
    )


def _shortest_under(rows: pd.DataFrame) -> str:
    """Where the learned geodesic is the shortest, in the mean over the common queries."""
    comparable = rows[~rows["planner"].isin(APART)].dropna(subset=["latent_mean"])
    shortest = comparable.loc[comparable.groupby("constraint", sort=False)["latent_mean"].idxmin()]
    won = shortest.loc[shortest["planner"] == LEARNED, "constraint"].tolist()
    others = records(shortest[shortest["planner"] != LEARNED])
    lost = [f"{row['constraint']} ({PLANNERS[row['planner']].label})" for row in others]
    mine = (
        "On the queries that all planners solved, their mean latent length is the shortest under "
        + (", ".join(won) or "no constraint")
    )
    return f"{mine}; another planner's is under {', '.join(lost)}." if lost else f"{mine}."


def _share(rows: pd.DataFrame, column: str) -> str:
    return f"{float(np.average(rows[column], weights=rows['rows'])):.0%}" if len(rows) else "–"


def table_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    """One row of the result table after its constraint."""
    return (
        PLANNERS[row["planner"]].label,
        f"{row['success']:.0%}",
        f"{row['compared']}/{row['queries']}",
        fixed(row["latent_shortest"]),
        plus_minus(row["latent_mean"], row["latent_std"], fixed),
        fixed(row["length_mean_rad"]),
        plus_minus(row["time_mean_s"], row["time_std_s"], short),
        short(row["violation_median_deg"]),
        short(row["violation_max_deg"]),
    )
