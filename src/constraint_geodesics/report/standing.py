"""Who is ahead in the benchmark at equal time, where the planner loses, and which planners stand
for the rest: in sentences, from its tables.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd

from constraint_geodesics.benchmark.queries import KEEP_OUT, TABLE
from constraint_geodesics.benchmark.statistics import AHEAD
from constraint_geodesics.palette import planner_family
from constraint_geodesics.report.benchmark_tables import FEW, ahead_text
from constraint_geodesics.report.cells import fixed, milliseconds, share

PLANNER = "planner"
"""Its name in params.yaml, to which every baseline is compared."""
WHERE = {TABLE: "in the workcell", KEEP_OUT: "with a sphere on the way"}
"""What a sentence says of each scene."""
ASKED = 30
"""Queries in each scene below which a planner does not stand for others."""
SERVES = 0.5
"""Of the queries, a planner that solves less is no loss where it is sooner."""
CHOICE = (
    "Of each family but the planner's own the one that solves most in its worse scene, at a tie "
    f"the one with the shorter 95th percentile of length, among those asked {ASKED} queries or "
    "more in every scene."
)
"""Who stands for the rest, and in which order: `best_of_families`."""
SHOWN = 4
"""Planners that a chart shows at first beside ours: their curves can be told apart."""


class Loss(NamedTuple):
    """One way to be ahead of the planner: a title, a clause for each budget or scene, and who it
    is.
    """

    title: str
    clauses: Sequence[str]
    details: Sequence[str] = ()

    @property
    def sentence(self) -> str:
        """The clauses as one."""
        return f"{'; '.join(self.clauses)}."


def best_of_families(overview: pd.DataFrame) -> list[str]:
    """The planners that CHOICE names, the best first; where the planner itself was asked fewer
    queries, so many are enough.

    overview: the benchmark's summary with all constraints together.
    """
    least = min(ASKED, int(overview.loc[overview["planner"] == PLANNER, "queries"].min()))
    figures = overview.groupby("planner", sort=False).agg(
        scenes=("scene", "nunique"),
        queries=("queries", "min"),
        solved=("success_of_solvable", "min"),
        length=("ratio_p95_all", "max"),
    )
    families = figures.index.map(lambda name: planner_family(str(name)) or "")
    asked = (figures["queries"] >= least) & (figures["scenes"] == overview["scene"].nunique())
    rest = figures.assign(family=families)[asked & (families != planner_family(PLANNER))]
    ordered = rest.sort_values(["solved", "length"], ascending=[False, True], kind="stable")
    return [str(name) for name in ordered.drop_duplicates("family").index]


def shown_at_first(overview: pd.DataFrame) -> list[str]:
    """The planner and the first of `best_of_families`: what a chart of the benchmark begins with.

    overview: the benchmark's summary with all constraints together.
    """
    return [PLANNER, *best_of_families(overview)[:SHOWN]]


def winner(budgets: pd.DataFrame) -> str:
    """Who is ahead at equal time: the planner, unless a baseline or a part of it is ahead in more
    cases of constraint, scene and time than behind; then the one with the largest surplus.

    budgets: of `ours_against_baselines`.
    """
    surplus = (
        budgets["verdict"]
        .map({"ahead": 1, "behind": -1})
        .fillna(0)
        .groupby(budgets["baseline"], sort=False)
        .sum()
    )
    return str(surplus.idxmax()) if len(surplus) and surplus.max() > 0 else PLANNER


def equal_time(budgets: pd.DataFrame) -> str:
    """How the planner and its baselines stand within the same time."""
    first = winner(budgets)
    if first == PLANNER:
        return ahead_text(budgets)
    own = budgets.loc[budgets["baseline"] == first, "verdict"].value_counts()
    return (
        f"It is ahead of the planner in {own.get('ahead', 0)} cases of constraint, scene and "
        f"budget, and behind in {own.get('behind', 0)}. {ahead_text(budgets)}"
    )


def planner_result(overview: pd.DataFrame) -> str:
    """What the planner reaches in each scene, all constraints together."""
    own = overview[overview["planner"] == PLANNER].set_index("scene")
    told = [
        f"{where} it solves {share(own['success_of_solvable'][scene], 1)} of the "
        f"{own['solvable'][scene]} of {own['queries'][scene]} queries that any planner solved, in "
        f"{milliseconds(own['time_median_s'][scene])} ms at the median and, in 95 % of the cases, "
        f"within {fixed(own['ratio_p95_all'][scene], 3)} times the shortest path known"
        for scene, where in WHERE.items()
        if scene in own.index
    ]
    text = "; ".join(told)
    return f"{text[:1].upper()}{text[1:]}."


def losses(overview: pd.DataFrame, budgets: pd.DataFrame) -> list[Loss]:
    """Where a baseline or a part of the planner is ahead of the whole, for each way to be ahead:
    the planner's figures are of the queries that the other was asked.

    overview: the benchmark's summary with all constraints together.  budgets: of
    `ours_against_baselines`.
    """
    others = overview[overview["planner"].isin(budgets["baseline"])]
    told = [
        Loss("Within the same time", *_within(budgets)),
        Loss("Sooner at the median", *_sooner(others)),
        Loss("Shorter at the 95th percentile, whatever time it takes", *_shorter(others)),
    ]
    nothing = (
        "no baseline and no part of the planner is ahead within the same time, sooner at the "
        "median, or shorter"
    )
    return [loss for loss in told if loss.clauses] or [Loss("Nowhere", [nothing])]


Told = tuple[list[str], list[str]]
"""Clauses and details of a loss."""


def _within(budgets: pd.DataFrame) -> Told:
    ahead = budgets[budgets["verdict"] == "ahead"]
    sure = ahead[ahead["queries"] >= FEW]
    clauses, details = [], []
    for budget, own in sure.groupby("budget_s"):
        within = f"in {_duration(float(str(budget)))}"
        counts: list[str] = []
        for scene, case in _by_scene(own):
            names = " and ".join(
                f"“{baseline}” under {', '.join(found['constraint'])}"
                for baseline, found in case.groupby("baseline", sort=False)
            )
            number = case["constraint"].nunique()
            noun = "" if counts else " constraint" if number == 1 else " constraints"
            counts.append(f"{number}{noun} {WHERE[scene]}")
            details.append(f"{within} {WHERE[scene]}, {names}")
        clauses.append(f"{within} under {' and '.join(counts)}")
    few = len(ahead) - len(sure)
    if few:
        said = f"{few} comparisons over fewer than {FEW} queries stand in a table below"
        (details if clauses else clauses).append(said)
    return clauses, details


def _sooner(others: pd.DataFrame) -> Told:
    sooner = others[others["time_median_s"] < others["reference_time_median_s"]]
    serving = sooner[sooner["success_of_solvable"] >= SERVES]
    told = _by_largest_gap(
        serving,
        "time_median_s",
        _times,
        lambda row: (
            f"in {_times(row)} (it solves {share(row['success_of_solvable'], 1)}, the planner "
            f"{share(row['reference_success_of_solvable'], 1)})"
        ),
    )
    return _with_rest(told, len(sooner) - len(serving), "that solve less than half")


def _shorter(others: pd.DataFrame) -> Told:
    shorter = others[others["ratio_p95_all"] * (1.0 + AHEAD) < others["reference_ratio_p95_all"]]
    sure = shorter[shorter["queries"] >= FEW]
    told = _by_largest_gap(
        sure,
        "ratio_p95_all",
        _lengths,
        lambda row: f"{_lengths(row)} on {row['solvable']} queries, in {_times(row)}",
    )
    return _with_rest(told, len(shorter) - len(sure), f"over fewer than {FEW} queries")


def _with_rest(told: Told, rest: int, said: str) -> Told:
    """And how many more there are that are not named, if any."""
    clauses, details = told
    if rest:
        (details if clauses else clauses).append(f"{rest}{' more' if clauses else ''} {said}")
    return told


def _times(row: Mapping[Any, Any]) -> str:
    theirs, ours = (milliseconds(row[f"{whose}time_median_s"]) for whose in ("", "reference_"))
    return f"{theirs} ms against {ours}"


def _lengths(row: Mapping[Any, Any]) -> str:
    theirs, ours = (fixed(row[f"{whose}ratio_p95_all"], 3) for whose in ("", "reference_"))
    return f"{theirs} times the best known against {ours}"


def _by_largest_gap(
    ahead: pd.DataFrame,
    figure: str,
    gap: Callable[[Mapping[Any, Any]], str],
    detail: Callable[[Mapping[Any, Any]], str],
) -> Told:
    """Of each scene how many are ahead in a figure, and the largest gap; each of them in detail."""
    clauses, details = [], []
    for scene, case in _by_scene(ahead):
        rows = list(case.to_dict("records"))
        widest = min(rows, key=lambda row: row[figure] / row[f"reference_{figure}"])
        clauses.append(f"{len(rows)} {WHERE[scene]}, the largest gap {gap(widest)}")
        details += [f"“{row['planner']}” {WHERE[scene]}, {detail(row)}" for row in rows]
    return clauses, details


def _by_scene(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows of each scene that has any, in the order of sentences."""
    for scene in WHERE:
        case = table[table["scene"] == scene]
        if len(case):
            yield scene, case


def _duration(seconds: float) -> str:
    return f"{seconds:g} s" if seconds >= 1.0 else f"{1e3 * seconds:g} ms"
