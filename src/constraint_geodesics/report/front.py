"""What the report's first page opens with: what the project does, the planner's row of the
benchmark beside the best of the rest, and what learning adds to a search and what it does not.
"""

import json
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd

from constraint_geodesics.params import Params
from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.report.cells import fixed, milliseconds, origin, share
from constraint_geodesics.report.page import Links, Table, runs_link
from constraint_geodesics.report.results import read_metrics
from constraint_geodesics.report.standing import (
    CHOICE,
    PLANNER,
    WHERE,
    best_of_families,
    planner_result,
)
from constraint_geodesics.studies.proposals import POLICY, STILL

PURPOSE = (
    "Given a start, a goal and a constraint, such as a cup that stays level, the planner looks for "
    "the shortest robot path that keeps the constraint. Certified, on the whole path and not only "
    "at samples, is that the constraint is kept and nothing touched; not that no path is shorter."
)
BELOW = (
    "Below stand its row beside the best of the rest, what learning adds to a search and what it "
    "does not, and every table and figure of the pipeline, which learns one manifold for all "
    "constraints and trains policies that search in the chart that params.yaml names: "
    "policies.chart."
)
NOT_RUN = "How it stands beside others is measured by make bench, which has left no rows here."
REST = 2
"""Planners that stand beside ours: the one that solves most may be slow."""
SAME = "planner on the queries of {}"
SAME_NOTE = "Where another was asked fewer queries, the planner's row below it is on these. "
COLUMNS = ("queries × seeds", "solved", "length, p95", "median [ms]")
FOOTINGS = {"trained on": "constraints it was trained on", "never seen": "constraints never seen"}
"""Groups of constraints in the figures of the policies, in words."""
QUESTIONS = (
    ("solved", "solved with one curve", 1),
    ("ratio_p95", "length of that curve, p95", -1),
    ("refined", "solved once the planner's band has refined it", 1),
)
"""Columns in which a policy and the same search without one are compared: name, words, and whether
more of it is better or less.
"""


def opening(layout: Layout, measured: bool) -> list[str]:
    """Three sentences: what the planner does, what it reaches, and what stands below.

    measured: whether the benchmark has left its tables.
    """
    return [PURPOSE, planner_result(_overview(layout)) if measured else NOT_RUN, BELOW]


def planner_row(layout: Layout) -> Table:
    """The planner's row of the benchmark in both scenes, and those of the best of the rest; where
    one of these was asked fewer queries, the planner's on them below it.
    """
    overview = _overview(layout)
    about = json.loads((layout.root / "reports" / "benchmark" / "about.json").read_text())
    scenes = {scene: words for scene, words in WHERE.items() if scene in set(overview["scene"])}
    found = {(row["planner"], row["scene"]): row for row in overview.to_dict("records")}
    rows, planners = [], []
    for name in (PLANNER, *best_of_families(overview)[:REST]):
        own = [found[name, scene] for scene in scenes]
        rows.append([name, *(cell for row in own for cell in _row_cells(row))])
        planners.append(name)
        if any(row["queries"] < found[PLANNER, row["scene"]]["queries"] for row in own):
            same = [cell for row in own for cell in _row_cells(row, "reference_")]
            rows.append([SAME.format(name), *same])
            planners.append(PLANNER)
    note = (
        "All constraints together; solved: of what any planner solved; length: over the best "
        f"known, failures infinite. {SAME_NOTE if PLANNER in planners[1:] else ''}The best of the "
        f"rest are the first {REST} by this rule: {CHOICE} {origin(about)}."
    )
    return Table(
        "The planner beside the best of the rest",
        note,
        ("planner", *COLUMNS * len(scenes)),
        rows,
        groups=[(words, len(COLUMNS)) for words in scenes.values()],
        planners=planners,
    )


def _row_cells(row: Mapping[Any, Any], whose: str = "") -> tuple[str, ...]:
    """whose: "reference_" for the planner's figures on the queries that another was asked."""
    return (
        f"{row[f'{whose}queries']} × {row[f'{whose}seeds']}",
        share(row[f"{whose}success_of_solvable"], 1),
        fixed(row[f"{whose}ratio_p95_all"], 3),
        milliseconds(row[f"{whose}time_median_s"]),
    )


def _overview(layout: Layout) -> pd.DataFrame:
    return pd.read_csv(layout.root / "reports" / "benchmark" / "overview.csv")


class Learning(NamedTuple):
    """What a policy adds to the same search without one, what it does not, and the figures."""

    adds: Sequence[str]
    lacks: Sequence[str]
    table: Table


def learning(params: Params, layout: Layout) -> Learning | None:
    """A policy against the same search without one, on constraints it was trained on and on others,
    in both scenes; None where the study has none of these.

    One is better than the other where their 95 % intervals over the seeds are apart.
    """
    found = read_metrics(layout.report("benchmark_policies", "policies"))
    compared = {
        f"{words}, {where}": found[group][scene]
        for group, words in FOOTINGS.items()
        for scene, where in WHERE.items()
        if {POLICY, STILL} <= set(found.get(group, {}).get(scene, ()))
    }
    if not compared:
        return None
    adds, lacks = [], []
    for column, words, sign in QUESTIONS:
        places: dict[int, list[str]] = {1: [], 0: [], -1: []}
        for footing, rows in compared.items():
            told = f"{footing} ({_number(rows[POLICY], column)} against "
            told += f"{_number(rows[STILL], column)})"
            places[sign * _apart(rows[POLICY], rows[STILL], column)].append(told)
        said = words[:1].upper() + words[1:]
        adds += [f"{said}: better on {'; '.join(places[1])}."] if places[1] else []
        for verdict, judged in ((0, "no difference that the intervals show"), (-1, "worse")):
            lacks += [f"{said}: {judged} on {'; '.join(places[verdict])}."] * bool(places[verdict])
    footing, rows = next(iter(compared.items()))
    if PLANNER in rows:
        said = (
            f"The planner, in which nothing is learned, solves {_number(rows[PLANNER], 'solved')} "
            f"on {footing}, in {rows[PLANNER]['time_ms_iqm']:.3g} ms; the policy "
            f"{_number(rows[POLICY], 'solved')} in {rows[POLICY]['time_ms_iqm']:.3g} ms."
        )
        is_ahead = _apart(rows[POLICY], rows[PLANNER], "solved") > 0
        (adds if is_ahead else lacks).append(said)
    nothing = "Nothing that the intervals over the seeds show."
    return Learning(adds or [nothing], lacks, _learning_table(params, compared))


def _learning_table(params: Params, compared: Mapping[str, Mapping[str, Any]]) -> Table:
    cells = [
        [
            f"{footing}: {method}",
            str(rows[method]["solvable"]),
            str(rows[method]["seeds"]),
            *(_with_interval(rows[method], column) for column, _, _ in QUESTIONS),
        ]
        for footing, rows in compared.items()
        for method in (POLICY, STILL)
    ]
    note = (
        "One cubic a query, found in the same rounds; interquartile means over the seeds and "
        "their 95 % intervals; solved: of what anything solves; length: over the shortest "
        "certified path known, of what was solved. From "
        "reports/benchmark_policies/policies.json; all methods stand below."
    )
    return Table(
        "A policy, and the same search without one",
        note,
        ("on", "queries", "seeds", *(words for _, words, _ in QUESTIONS)),
        cells,
        planners=[method for _ in compared for method in (POLICY, STILL)],
        links=[Links(runs_link("benchmark_policies", params.policies.chart))] * len(cells),
    )


def _apart(one: Mapping[str, Any], other: Mapping[str, Any], column: str) -> int:
    """1 where the interval of one lies above the other's, -1 below, 0 where they meet or one of
    them is not known.
    """
    low, high, other_low, other_high = (
        own[f"{column}_{end}"] for own in (one, other) for end in ("low", "high")
    )
    if None in (low, high, other_low, other_high):
        return 0
    return int(low > other_high) - int(high < other_low)


def _number(row: Mapping[str, Any], column: str, end: str = "iqm") -> str:
    value = row[f"{column}_{end}"]
    return fixed(value, 3) if column.startswith("ratio") else share(value, 1)


def _with_interval(row: Mapping[str, Any], column: str) -> str:
    middle, known = _number(row, column), row[f"{column}_low"] is not None
    low, high = _number(row, column, "low"), _number(row, column, "high")
    return f"{middle} [{low}, {high}]" if known else middle
