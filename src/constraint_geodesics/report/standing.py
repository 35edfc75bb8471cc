"""Who is ahead in the benchmark at equal time, where the planner loses, and which planners stand
for the rest: in sentences, from its tables.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd

from constraint_geodesics.benchmark.queries import KEEP_OUT, TABLE
from constraint_geodesics.benchmark.statistics import (
    AHEAD,
    all_constraints,
    quantile_with_failures,
    ratio_of,
)
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
        f"{where} it solves {share(own['success_of_solvable'][scene], 1)} of what any planner "
        f"solved, in {milliseconds(own['time_median_s'][scene])} ms at the median and, in 95 % of "
        f"the cases, within {fixed(own['ratio_p95_all'][scene], 3)} times the shortest path known"
        for scene, where in WHERE.items()
        if scene in own.index
    ]
    text = "; ".join(told)
    return f"{text[:1].upper()}{text[1:]}."


def losses(rows: pd.DataFrame, budgets: pd.DataFrame) -> list[Loss]:
    """Where a baseline or a part of the planner is ahead of the whole, for each way to be ahead.

    rows: of the benchmark's table.  budgets: of `ours_against_baselines`.
    """
    pairs = compared(rows, list(dict.fromkeys(map(str, budgets["baseline"]))))
    told = [
        Loss("Within the same time", *_within(budgets)),
        Loss("Sooner at the median", *_sooner(pairs)),
        Loss("Shorter at the 95th percentile, whatever time it takes", *_shorter(pairs)),
    ]
    nothing = (
        "no baseline and no part of the planner is ahead within the same time, sooner at the "
        "median, or shorter"
    )
    return [loss for loss in told if loss.clauses] or [Loss("Nowhere", [nothing])]


def compared(rows: pd.DataFrame, baselines: Sequence[str]) -> pd.DataFrame:
    """The planner and each baseline over the solvable queries that both were asked, all
    constraints together: one row a scene and baseline.

    asked: queries that both were asked, solvable or not.  queries: those of them that are solvable;
    success, time_s (median) and ratio_p95 (of length over the best known, failures infinite), and
    the same of the baseline behind `baseline_`.
    """
    pooled = all_constraints(rows)
    pooled = pooled.assign(ratio=ratio_of(pooled), solvable=pooled["best_known_rad"].notna())
    names = [f"{whose}{name}" for whose in ("", "baseline_") for name in _figures(pooled)]
    table: list[dict[str, Any]] = []
    for scene in WHERE:
        case = pooled[pooled["scene"] == scene]
        mine = case[case["planner"] == PLANNER]
        for baseline in baselines:
            both = case[(case["planner"] == baseline) & case["query"].isin(mine["query"])]
            theirs = both[both["solvable"]]
            same = mine[mine["query"].isin(theirs["query"])]
            if len(theirs):
                figures = (*_figures(same).values(), *_figures(theirs).values())
                about = {"scene": scene, "baseline": baseline, "asked": both["query"].nunique()}
                about["queries"] = same["query"].nunique()
                table.append(about | dict(zip(names, figures, strict=True)))
    return pd.DataFrame(table, columns=["scene", "baseline", "asked", "queries", *names])


def _figures(own: pd.DataFrame) -> dict[str, float]:
    return {
        "success": float(own["valid"].mean()),
        "time_s": float(own["time_s"].median()),
        "ratio_p95": quantile_with_failures(own["ratio"].to_numpy(), 0.95),
    }


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


def _sooner(pairs: pd.DataFrame) -> Told:
    sooner = pairs[pairs["baseline_time_s"] < pairs["time_s"]]
    serving = sooner[sooner["baseline_success"] >= SERVES]
    clauses, details = _by_largest_gap(
        serving,
        "time_s",
        lambda row: (
            f"{milliseconds(row['baseline_time_s'])} ms against {milliseconds(row['time_s'])}"
        ),
        lambda row: (
            f"in {milliseconds(row['baseline_time_s'])} ms against {milliseconds(row['time_s'])} "
            f"(it solves {share(row['baseline_success'], 1)}, the planner "
            f"{share(row['success'], 1)})"
        ),
    )
    rest = len(sooner) - len(serving)
    if rest:
        said = f"{rest}{' more' if clauses else ''} that solve less than half"
        (details if clauses else clauses).append(said)
    return clauses, details


def _shorter(pairs: pd.DataFrame) -> Told:
    shorter = pairs[pairs["baseline_ratio_p95"] * (1.0 + AHEAD) < pairs["ratio_p95"]]
    return _by_largest_gap(
        shorter,
        "ratio_p95",
        lambda row: (
            f"{fixed(row['baseline_ratio_p95'], 3)} times the best known against "
            f"{fixed(row['ratio_p95'], 3)}"
        ),
        lambda row: (
            f"{fixed(row['baseline_ratio_p95'], 3)} times the best known against "
            f"{fixed(row['ratio_p95'], 3)} on {row['queries']} queries, in "
            f"{milliseconds(row['baseline_time_s'])} ms against {milliseconds(row['time_s'])}"
        ),
    )


def _by_largest_gap(
    ahead: pd.DataFrame,
    figure: str,
    gap: Callable[[Mapping[Any, Any]], str],
    detail: Callable[[Mapping[Any, Any]], str],
) -> Told:
    """Of each scene how many are ahead in a figure, and the largest gap; each of them in detail."""
    clauses, details = [], []
    for scene, case in _by_scene(ahead):
        rows = _rows(case)
        widest = min(rows, key=lambda row: row[f"baseline_{figure}"] / row[figure])
        clauses.append(f"{len(rows)} {WHERE[scene]}, the largest gap {gap(widest)}")
        details += [f"“{row['baseline']}” {WHERE[scene]}, {detail(row)}" for row in rows]
    return clauses, details


def _by_scene(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows of each scene that has any, in the order of sentences."""
    for scene in WHERE:
        case = table[table["scene"] == scene]
        if len(case):
            yield scene, case


def _rows(pairs: pd.DataFrame) -> list[Mapping[Any, Any]]:
    return list(pairs.to_dict("records"))


def _duration(seconds: float) -> str:
    return f"{seconds:g} s" if seconds >= 1.0 else f"{1e3 * seconds:g} ms"
