"""The benchmark's tables as texts, from its summary and rows: cells for its page, and Markdown with
the same cells.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.params import PeerParams
from constraint_geodesics.report.results import markdown_table

COLUMNS = (
    "planner",
    "queries × seeds",
    "solved of solvable",
    "claimed, not valid",
    "length / best known, median",
    "p95",
    "IQM [95 % interval]",
    "p95, failures as ∞",
    "time [ms], median",
    "p95",
    "to 1 % [ms]",
    "to 5 %",
    "to 10 %",
    "longer than the planner's",
    "memory [MB]",
)
OVERVIEW = (
    "planner",
    "queries × seeds",
    "solved [95 %]",
    "claimed, not valid",
    "p95 of length / best known, failures ∞",
    "IQM of solved [95 %]",
    "the planner's on these",
    "time [ms]: median",
    "p95",
    "planner shorter",
)
FEW = 40
"""Rows below which a 95th percentile says nothing and is not shown."""
PYTHON_NOTE = (
    "† asks PyBullet through Python for every state of its search; the others check with "
    "compiled clearances and ask "
    "PyBullet about the finished path. Where a planner cannot work under a constraint (OMPL's "
    "atlas and tangent bundle "
    "have no tangent space for a tolerance) it has no rows of it here."
)
REPEAT = (
    "planner",
    "rows",
    "same validity",
    "largest relative difference of a length",
    "median time [ms], 95 % interval",
    "second run",
    "overlap",
)
BREAK_EVEN = (
    "planner",
    "its training [s]",
    "mean time of a query [ms]",
    "the planner's [ms]",
    "valid",
    "pays from",
)
PUBLISHED = {
    "PRM": (499.42, 530.89, 24.43, 9.75),
    "RRT* 10 s": (134.80, 155.28, 17.84, 5.21),
    "BiRRT": (53.00, 84.65, 25.52, 2.903),
    "planner": (70.56, 79.81, 7.64, 3.8),
}
"""Table I of the paper: shortest path, average, its ±, planning time [s]; its learned geodesic
beside our planner.
"""
TABLE_I_NOTE = (
    "The paper's lengths have no unit and are of one query, on its own machine with a GPU; "
    "ours are latent lengths "
    "(eq. 2, on the `planner` manifold) of valid paths over all queries and seeds of a "
    "method. So compare the ratios "
    "×: the average over that of the geodesic, here over that of the planner's paths of the "
    "same queries."
)


Cells = list[Sequence[str]]
"""A table's header and its rows."""


def asks_in_python(planners: Mapping[str, PeerParams]) -> list[str]:
    """Planners whose search asks PyBullet through Python for every state."""
    return [name for name, peer in planners.items() if peer.kind in ("ompl", "decoder_sampling")]


def benchmark_markdown(summary: pd.DataFrame) -> str:
    """A block for each constraint and scene, planners in their order."""
    parts = []
    for (constraint, scene), case in summary.groupby(["constraint", "scene"], sort=False):
        parts.append(
            f"`{constraint}`, {scene}: {counted(case)}\n\n{markdown_table(case_cells(case))}"
        )
    return "\n\n".join(parts) + "\n"


def case_cells(case: pd.DataFrame) -> Cells:
    """The planners under one constraint in one scene, from the summary's rows of these."""
    return [COLUMNS, *(_cells(row) for row in case.to_dict("records"))]


def counted(case: pd.DataFrame) -> str:
    """How many queries a case has, and how many of them any planner solved."""
    return f"{int(case['queries'].max())} queries, any planner solved {int(case['solvable'].max())}"


def overview_markdown(summary: pd.DataFrame, in_python: Collection[str] = ()) -> str:
    """One block a scene with the queries of all constraints together, for README.

    in_python: planners whose search asks for every state through Python.
    """
    parts = []
    for scene, case in summary.groupby("scene", sort=False):
        rows = overview_cells(case, in_python)
        queries, solvable = int(case["queries"].max()), int(case["solvable"].max())
        head = (
            f"Scene `{scene}`, all constraints: {queries} queries, of which any planner "
            f"solved {solvable}."
        )
        parts.append(f"{head}\n\n{markdown_table(rows)}")
    return "\n\n".join([*parts, *([PYTHON_NOTE] if in_python else [])]) + "\n"


def overview_cells(case: pd.DataFrame, in_python: Collection[str] = ()) -> Cells:
    """The planners in one scene, the queries of all constraints together."""
    return [OVERVIEW, *(_overview_cells(row, in_python) for row in case.to_dict("records"))]


def table_i_markdown(rows: pd.DataFrame) -> str:
    """The paper's Table I beside the same planners' rows of one constraint and scene."""
    return f"{markdown_table(table_i_cells(rows))}\n\n{TABLE_I_NOTE}\n"


def table_i_cells(rows: pd.DataFrame) -> Cells:
    """The same, its header first."""
    head = (
        "method",
        "paper: shortest",
        "average ± std",
        "×",
        "time [s]",
        "here: shortest",
        "average ± std",
        "×",
        "time [s]",
        "valid",
        "rows",
    )
    valid = rows[rows["valid"]]
    lengths = {name: valid[valid["planner"] == name]["latent_length"] for name in PUBLISHED}
    planner = valid[valid["planner"] == "planner"]
    cells: Cells = [head]
    for name, (shortest, average, spread, seconds) in PUBLISHED.items():
        own, found = rows[rows["planner"] == name], lengths[name]
        if own.empty:
            continue
        base = planner[planner["query"].isin(own["query"])]["latent_length"].mean()
        cells.append(
            (
                f"learned geodesic; here `{name}`" if name == "planner" else name,
                f"{shortest:.2f}",
                f"{average:.2f} ± {spread:.2f}",
                f"{average / PUBLISHED['planner'][1]:.2f}",
                f"{seconds:.2f}",
                _fixed(found.min(), 2),
                f"{_fixed(found.mean(), 2)} ± {_fixed(found.std(), 2)}",
                _fixed(found.mean() / base, 2),
                f"{own['time_s'].mean():.3g}",
                _share(own["valid"].mean()),
                str(len(own)),
            )
        )
    return cells


def ahead_markdown(table: pd.DataFrame) -> str:
    """Every case and budget in which a peer is ahead of the planner, or that there is none."""
    rows = ahead_cells(table)
    return f"{ahead_told(table)}\n" + (f"\n{markdown_table(rows)}\n" if len(rows) > 1 else "")


def ahead_told(table: pd.DataFrame) -> str:
    """In how many cases of constraint, scene and budget the planner is first, and in how many a
    peer.
    """
    worst = _verdicts(table)
    neither = int((worst == {"neither"}).sum())
    lost = int(worst.map(lambda verdicts: "ahead" in verdicts).sum())
    return (
        "Within a time budget the planner is first or tied on p95 of the length (failures "
        "infinite; where both are, on "
        f"success) in {len(worst) - neither - lost} of {len(worst)} cases of constraint, "
        f"scene and budget; in {lost} a "
        f"peer is ahead, in {neither} no planner has any path yet."
    )


def verdict_cells(table: pd.DataFrame) -> Cells:
    """The same for each budget: how many cases of constraint and scene have which verdict."""
    rows: Cells = [
        (
            "time budget [s]",
            "planner first or tied",
            "a peer ahead",
            "no path of any planner yet",
            "of",
        )
    ]
    for budget, found in _verdicts(table).groupby("budget_s", sort=True):
        lost, neither = (
            int(found.map(is_so).sum())
            for is_so in (lambda v: "ahead" in v, lambda v: v == {"neither"})
        )
        rows.append(
            (f"{budget:g}", *map(str, (len(found) - lost - neither, lost, neither, len(found))))
        )
    return rows


def _verdicts(table: pd.DataFrame) -> "pd.Series[Any]":
    """What is said of any peer in each case and budget."""
    return table.groupby(["constraint", "scene", "budget_s"], sort=False)["verdict"].agg(set)


def ahead_cells(table: pd.DataFrame) -> Cells:
    """Every peer that is ahead of the planner in a case, within a budget."""
    rows: Cells = [
        (
            "constraint",
            "scene",
            "budget [s]",
            "peer ahead",
            "its p95",
            "the planner's",
            "its success",
            "the planner's",
        )
    ]
    rows += [
        (
            f"`{row['constraint']}`",
            str(row["scene"]),
            f"{row['budget_s']:g}",
            f"{row['peer']} ({row['queries']} queries)",
            _fixed(row["peer_ratio_p95"], 3),
            _fixed(row["ratio_p95"], 3),
            _share(row["peer_success"]),
            _share(row["success"]),
        )
        for row in table[table["verdict"] == "ahead"].to_dict("records")
    ]
    return rows


def repeated_markdown(table: pd.DataFrame) -> str:
    """Two runs of the same rows, planner by planner."""
    return f"{markdown_table(repeated_cells(table))}\n"


def repeated_cells(table: pd.DataFrame) -> Cells:
    """The same, its header first."""
    rows: Cells = [REPEAT]
    for row in table.to_dict("records"):
        times = [
            f"{_milli(row[f'{run}_s'])} [{_milli(row[f'{run}_low_s'])}, "
            f"{_milli(row[f'{run}_high_s'])}]"
            for run in ("time", "time_again")
        ]
        rows.append(
            (
                str(row["planner"]),
                str(row["rows"]),
                "yes" if row["same_validity"] else "no",
                f"{row['length_difference']:.1e}",
                *times,
                "yes" if row["overlap"] else "no",
            )
        )
    return rows


def break_even_markdown(table: pd.DataFrame) -> str:
    """From how many queries on training pays against each planner."""
    return f"{markdown_table(break_even_cells(table))}\n"


def break_even_cells(table: pd.DataFrame) -> Cells:
    """The same, its header first."""
    rows: Cells = [BREAK_EVEN]
    for row in table.to_dict("records"):
        pays = row["break_even"]
        rows.append(
            (
                str(row["planner"]),
                f"{row['training_s']:.0f}",
                _milli(row["query_s"]),
                _milli(row["reference_s"]),
                _share(row["success"]),
                "–" if pd.isna(pays) else "never" if pays == np.inf else f"{pays:,.0f} queries",
            )
        )
    return rows


def _overview_cells(row: Mapping[Any, Any], in_python: Collection[str]) -> tuple[str, ...]:
    solved = (
        f"{_share(row['success_of_solvable'])} [{_share(row['success_low'])}, "
        f"{_share(row['success_high'])}]"
    )
    return (
        f"{row['planner']}{' †' if row['planner'] in in_python else ''}",
        f"{row['queries']} × {row['seeds']}",
        solved,
        str(row["claimed_but_invalid"]),
        _p95(row, "ratio_p95_all"),
        _iqm(row, 3),
        _fixed(row["reference_iqm"], 3),
        _milli(row["time_median_s"]),
        _milli(row["time_p95_s"]),
        _share(row["beaten"]),
    )


def _p95(row: Mapping[Any, Any], name: str) -> str:
    return "–" if row["rows"] < FEW else _fixed(row[name], 3)


def _cells(row: Mapping[Any, Any]) -> tuple[str, ...]:
    size = f"{row['queries']} × {row['seeds']}"
    if row["not_applicable"] == row["rows"]:
        return (str(row["planner"]), size, "not applicable", *("–",) * (len(COLUMNS) - 3))
    return (
        str(row["planner"]),
        size,
        _share(row["success_of_solvable"]),
        str(row["claimed_but_invalid"]),
        _fixed(row["ratio_median"], 4),
        _p95(row, "ratio_p95"),
        _iqm(row, 4),
        _p95(row, "ratio_p95_all"),
        _milli(row["time_median_s"]),
        _milli(row["time_p95_s"]),
        _milli(row["within_1_s"]),
        _milli(row["within_5_s"]),
        _milli(row["within_10_s"]),
        _share(row["beaten"]),
        _fixed(row["peak_memory_median_mb"], 1),
    )


def _iqm(row: Mapping[Any, Any], digits: int) -> str:
    low, middle, high = (_fixed(row[f"ratio_iqm{end}"], digits) for end in ("_low", "", "_high"))
    return f"{middle} [{low}, {high}]"


def _fixed(value: float, digits: int) -> str:
    return "–" if pd.isna(value) else ("∞" if value == float("inf") else f"{value:.{digits}f}")


def _milli(value: float) -> str:
    """Seconds in milliseconds: three digits, or all of a larger number's."""
    if pd.isna(value):
        return "–"
    if value == float("inf"):
        return "∞"
    return f"{1e3 * value:,.0f}" if value >= 0.1 else f"{1e3 * value:.3g}"


def _share(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.0%}"
