"""The benchmark's tables as texts, from its summary and rows: cells for its page, and Markdown with
the same cells.
"""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import pandas as pd

from constraint_geodesics.benchmark.row import LATENT
from constraint_geodesics.peers.baseline import BaselineSettings
from constraint_geodesics.report.cells import (
    PUBLISHED,
    Cells,
    fixed,
    markdown_table,
    milliseconds,
    share,
)

COLUMNS = (
    *("planner", "queries × seeds", "solved of solvable", "claimed, not valid"),
    "wrongly certified",
    *("length / best known, median", "p95", "IQM [95 % interval]", "p95, failures as ∞"),
    *("time [ms], median", "p95", "to 1 % [ms]", "to 5 %", "to 10 %"),
    *("longer than the planner's", "memory [MB]"),
)
OVERVIEW = (
    *("planner", "queries × seeds", "solved [95 %]", "claimed, not valid"),
    "wrongly certified",
    *("p95 of length / best known, failures ∞ [95 %]", "{}'s on these"),
    *("IQM of solved [95 %]", "{}'s"),
    *("time [ms]: median", "{}'s on these", "p95", "{} shorter"),
)
"""With the name of the planner that each is held against."""
REPEAT = (
    *("planner", "rows", "same validity", "largest relative difference of a length"),
    *("median time [ms]", "second run [ms]", "second time over first, 95 % interval"),
)
BREAK_EVEN = (
    *("planner", "made beforehand [s]", "mean time of a query [ms]", "the planner's [ms]", "valid"),
    "pays from",
)
AHEAD = (
    *("constraint", "scene", "budget [s]", "ahead", "its p95", "the planner's"),
    *("its success", "the planner's"),
)
VERDICTS = (
    *("scene", "time budget [s]", "planner first alone", "tied with another", "another ahead"),
    *("no path of any planner yet", "of"),
)
BEST_FIRST = ("ahead", "tied", "behind", "neither")
"""Verdicts on the others in a case, the one that tells how the planner stands there first."""
TABLE_I = (
    *("method", "paper: shortest", "average ± std", "×", "time [s]"),
    *("here: shortest", "average ± std", "×", "time [s]", "valid", "rows"),
)
FEW = 20
"""Queries below which a 95th percentile is that of the worst one, and not shown."""
PYTHON_NOTE = (
    "† is OMPL's: it asks through Python for every state of its search. Baselines ask the "
    "certifier's compiled check, the planner its own, and the certifier at the end; what draws at "
    "random is asked again while its path is not certified, OMPL's with half the step: one that "
    "takes all its time has one more whole try. Within a time (…, 1 s) the shortest of several "
    "counts, and what is found later does not; a first path may take as long as without it. A "
    "band after one of OMPL's begins with the path as it is found; one without a band "
    "is shortened by OMPL, looked at more closely where that touches something. Where a planner "
    "cannot work under a constraint (OMPL's atlas and tangent bundle have no tangent space for a "
    "tolerance) it has no rows of it here."
)
_LEARNED = "learned"
"""The planner of the benchmark that the paper's learned geodesics stand next to."""
TABLE_I_NOTE = (
    "The paper's lengths have no unit and are of one query, on its own machine with a GPU; ours "
    "are latent lengths (eq. 2, on the `planner` manifold, which does nothing but measure here: "
    "`learned` searches in joint space) of valid paths over all queries and seeds of a method. So "
    "compare the ratios ×: the average over that of the learned geodesics, here of the same "
    "queries. Valid is counted over all queries that were asked, those among them that no planner "
    "solves. `planner` is not learned and has no row in the paper."
)


def asks_in_python(settings: Mapping[str, BaselineSettings]) -> list[str]:
    """Planners whose search asks through Python for every state."""
    return [name for name, own in settings.items() if own.asks_in_python]


def benchmark_markdown(summary: pd.DataFrame) -> str:
    """A block for each constraint and scene, planners in their order."""
    parts = [
        f"`{constraint}`, {scene}: {counted(case)}\n\n{markdown_table(case_cells(case))}"
        for (constraint, scene), case in summary.groupby(["constraint", "scene"], sort=False)
    ]
    return "\n\n".join(parts) + "\n"


def counted(case: pd.DataFrame) -> str:
    """How many queries a case has, and how many of them any planner solved."""
    return f"{int(case['queries'].max())} queries, any planner solved {int(case['solvable'].max())}"


def case_cells(case: pd.DataFrame) -> Cells:
    """The planners under one constraint in one scene, from the summary's rows of these."""
    return [COLUMNS, *(_case_row(row) for row in case.to_dict("records"))]


def _case_row(row: Mapping[Any, Any]) -> tuple[str, ...]:
    size = f"{row['queries']} × {row['seeds']}"
    if row["not_applicable"] == row["rows"]:
        return (str(row["planner"]), size, "not applicable", *("–",) * (len(COLUMNS) - 3))
    return (
        *(str(row["planner"]), size, share(row["success_of_solvable"])),
        *(str(row["claimed_but_invalid"]), fixed(row["wrongly_certified"], 0)),
        fixed(row["ratio_median"], 4),
        *(_p95(row, "ratio_p95"), _iqm(row, 4), _p95(row, "ratio_p95_all")),
        *(milliseconds(row[f"time_{which}_s"]) for which in ("median", "p95")),
        *(milliseconds(row[f"within_{within}_s"]) for within in (1, 5, 10)),
        *(share(row["beaten"]), fixed(row["peak_memory_median_mb"], 1)),
    )


def overview_markdown(
    summary: pd.DataFrame, in_python: Collection[str] = (), against: str = "planner"
) -> str:
    """One block a scene with the queries of all constraints together, for README.

    in_python: planners whose search asks for every state through Python.  against: the one that
    the summary holds each against.
    """
    parts = []
    for scene, case in summary.groupby("scene", sort=False):
        queries, solvable = int(case["queries"].max()), int(case["solvable"].max())
        head = (
            f"Scene `{scene}`, all constraints: {queries} queries, of which any planner "
            f"solved {solvable}."
        )
        parts.append(f"{head}\n\n{markdown_table(overview_cells(case, in_python, against))}")
    return "\n\n".join([*parts, *([PYTHON_NOTE] if in_python else [])]) + "\n"


def overview_cells(
    case: pd.DataFrame, in_python: Collection[str] = (), against: str = "planner"
) -> Cells:
    """The planners in one scene, the queries of all constraints together."""
    head = tuple(word.format(against) for word in OVERVIEW)
    return [head, *(_overview_row(row, in_python) for row in case.to_dict("records"))]


def _overview_row(row: Mapping[Any, Any], in_python: Collection[str]) -> tuple[str, ...]:
    low, high = share(row["success_low"]), share(row["success_high"])
    return (
        *asked(row, in_python),
        f"{share(row['success_of_solvable'])} [{low}, {high}]",
        *(str(row["claimed_but_invalid"]), fixed(row["wrongly_certified"], 0)),
        *(_p95_with_interval(row), _p95(row, "reference_ratio_p95_all")),
        *(_iqm(row, 3), fixed(row["reference_iqm"], 3)),
        *(milliseconds(row["time_median_s"]), milliseconds(row["reference_time_median_s"])),
        *(milliseconds(row["time_p95_s"]), share(row["beaten"])),
    )


def asked(row: Mapping[Any, Any], in_python: Collection[str]) -> tuple[str, str]:
    """The planner, marked where its search asks through Python, and what it was asked."""
    mark = " †" if row["planner"] in in_python else ""
    return f"{row['planner']}{mark}", f"{row['queries']} × {row['seeds']}"


def table_i_cells(rows: pd.DataFrame) -> Cells:
    """The paper's Table I next to the same planners' rows of one constraint and scene, and the
    planner's, which the paper has not.
    """
    valid, column = rows[rows["valid"]], f"{LATENT}planner"
    learned = valid[valid["planner"] == _LEARNED].set_index("query")[column]
    cells: Cells = [TABLE_I]
    for name in (*PUBLISHED, "planner"):
        own, found = rows[rows["planner"] == name], valid[valid["planner"] == name]
        if own.empty:
            continue
        base = found["query"].map(learned)
        ratio = found[column][base.notna()].mean() / base.mean()
        row = (
            *(f"`{name}`" if name in (_LEARNED, "planner") else name, *_published(name)),
            fixed(found[column].min(), 2),
            f"{fixed(found[column].mean(), 2)} ± {fixed(found[column].std(), 2)}",
            *(fixed(ratio, 2), f"{own['time_s'].mean():.3g}"),
            *(share(own["valid"].mean()), str(len(own))),
        )
        cells.append(row)
    return cells


def _published(name: str) -> tuple[str, str, str, str]:
    """The paper's figures of a planner: shortest, average, ratio and time."""
    if name not in PUBLISHED:
        return ("–",) * 4
    shortest, average, spread, seconds, _ = PUBLISHED[name]
    ratio = average / PUBLISHED[_LEARNED][1]
    return f"{shortest:.2f}", f"{average:.2f} ± {spread:.2f}", f"{ratio:.2f}", f"{seconds:.2f}"


def ahead_markdown(table: pd.DataFrame) -> str:
    """How often the planner is first within each budget, then every case in which a baseline or a
    part of it is ahead.
    """
    rows = ahead_cells(table)
    told = f"{ahead_text(table)}\n\n{markdown_table(verdict_cells(table))}\n"
    return told + (f"\n{markdown_table(rows)}\n" if len(rows) > 1 else "")


def ahead_text(table: pd.DataFrame) -> str:
    """In how many cases of constraint, scene and budget the planner is first, tied, or behind a
    baseline or a part of it.
    """
    first, tied, lost, neither = (counts := _counts(_verdicts(table)))
    return (
        "Within a time budget the planner is ahead of every baseline and every part of it on p95 "
        "of the length (failures infinite; where both are, on success) in "
        f"{first} of {sum(counts)} cases of constraint, scene and budget, and tied with the best "
        f"of them in {tied}; in {lost} one is ahead, in {neither} no planner has any path yet."
    )


def verdict_cells(table: pd.DataFrame) -> Cells:
    """The same for each scene and budget: under how many constraints there is which verdict."""
    cases = _verdicts(table).groupby(["scene", "budget_s"], sort=True)
    return [
        VERDICTS,
        *(
            (str(scene), f"{budget:g}", *map(str, _counts(own)), str(len(own)))
            for (scene, budget), own in cases
        ),
    ]


def _verdicts(table: pd.DataFrame) -> "pd.Series[Any]":
    """In each case and budget, what is said of the best of the others."""
    by_case = table.groupby(["constraint", "scene", "budget_s"], sort=False)["verdict"]
    return by_case.agg(lambda found: min(found, key=BEST_FIRST.index))


def _counts(verdicts: "pd.Series[Any]") -> tuple[int, int, int, int]:
    """Cases in which the planner is first alone, tied with the best of the others, behind one, and
    in which none has a path.
    """
    first, tied, lost, neither = (
        int((verdicts == said).sum()) for said in ("behind", "tied", "ahead", "neither")
    )
    return first, tied, lost, neither


def ahead_cells(table: pd.DataFrame) -> Cells:
    """Every baseline and part that is ahead of the planner in a case, within a budget."""
    rows: Cells = [
        (
            *(f"`{row['constraint']}`", str(row["scene"]), f"{row['budget_s']:g}"),
            f"{row['baseline']} ({row['queries']} queries)",
            *(fixed(row["baseline_ratio_p95"], 3), fixed(row["ratio_p95"], 3)),
            *(share(row["baseline_success"]), share(row["success"])),
        )
        for row in table[table["verdict"] == "ahead"].to_dict("records")
    ]
    return [AHEAD, *rows]


def repeated_cells(table: pd.DataFrame) -> Cells:
    """Two runs of the same rows, planner by planner."""
    rows: Cells = [REPEAT]
    for row in table.to_dict("records"):
        times = (milliseconds(row["time_s"]), milliseconds(row["time_again_s"]))
        low, ratio, high = (fixed(row[name], 2) for name in ("ratio_low", "ratio", "ratio_high"))
        same, difference = (
            "yes" if row["same_validity"] else "no",
            f"{row['length_difference']:.1e}",
        )
        about = str(row["planner"]), str(row["rows"]), same, difference
        rows.append((*about, *times, f"{ratio} [{low}, {high}]"))
    return rows


def break_even_cells(table: pd.DataFrame) -> Cells:
    """From how many queries on training pays against each planner."""
    rows: Cells = [BREAK_EVEN]
    for row in table.to_dict("records"):
        pays = row["break_even"]
        known = "never" if pays == np.inf else f"{pays:,.0f} queries"
        times = (
            milliseconds(row["query_s"]),
            milliseconds(row["reference_s"]),
            share(row["success"]),
        )
        shown = "–" if pd.isna(pays) else known
        rows.append((str(row["planner"]), f"{row['training_s']:.0f}", *times, shown))
    return rows


def _p95(row: Mapping[Any, Any], name: str) -> str:
    return "–" if row["queries"] < FEW else fixed(row[name], 3)


def _p95_with_interval(row: Mapping[Any, Any]) -> str:
    if row["queries"] < FEW:
        return "–"
    low, high = (fixed(row[f"ratio_p95_all_{end}"], 3) for end in ("low", "high"))
    return f"{fixed(row['ratio_p95_all'], 3)} [{low}, {high}]"


def _iqm(row: Mapping[Any, Any], digits: int) -> str:
    low, middle, high = (fixed(row[f"ratio_iqm{end}"], digits) for end in ("_low", "", "_high"))
    return f"{middle} [{low}, {high}]"
