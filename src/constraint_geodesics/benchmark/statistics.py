"""Figures of tables of paths: success, lengths with intervals, times, and who beats whom.  Every
row counts, failures too.

Interquartile means with bootstrap intervals and the probability of improvement after Agarwal et
al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021), with queries in
the place of tasks.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

CASE = ["constraint", "scene"]
Counted = Literal["valid", "found"]
"""Whose lengths count: those of the paths that the judge accepts, or of all that a planner
returned.
"""

STRAIGHT, RANDOM = "straight_latent_line", "random_curves"
APART = (STRAIGHT, RANDOM)
"""Shown next to the planners to say what policy search adds: what they can't do must not decide
which queries are compared.
"""
WITHIN = (0.01, 0.05, 0.10)
"""Excess over the best known length for which the time to reach it is given."""
TIED = 1e-4
"""Relative difference below which two lengths count as one."""
RESAMPLES = 1000
LATE = 0.05
"""Share of a budget by which an answer may come after it: who is given a second ends shortly after.
The planner is held to less: within a budget it is one that was given a shorter one.
"""
AHEAD = 1e-3
"""Relative difference of two p95 below which neither planner is ahead."""


def benchmark_summary(rows: pd.DataFrame, reference: str) -> pd.DataFrame:
    """One row a constraint, scene and planner, from the rows of benchmark.csv.

    queries, rows; solvable: queries that any planner solved.  success: valid rows of all;
    success_of_solvable: of those whose query any planner solved, with its 95 % interval of Clopper
    and Pearson over queries.  claimed_but_invalid: rows called solved that the certifier refuses.
    wrongly_certified: rows that the certifier takes and PyBullet does not, nan where it was not
    asked.
    not_applicable: rows of problems that the planner cannot work on.
    ratio_*: length over best known of valid rows: median, 95th percentile, and the interquartile
    mean over queries (of each query's mean over its seeds) with its 95 % bootstrap interval;
    ratio_p95_all: the 95th percentile with every row that is not valid counted as infinite, of the
    solvable queries, with its 95 % bootstrap interval over queries.
    time_*: of the rows of solvable queries [s], or a planner's own limit would be its time where
    there is no path.  within_1, _5, _10: median time [s] to a valid path within so many per
    cent of the best known, infinite where fewer than half of the rows get there.
    reference_iqm: the interquartile mean of `reference` over the queries that the planner has a
    valid path of.  reference_queries, _seeds, _success_of_solvable, _ratio_p95_all,
    _time_median_s: its figures over the queries that the planner was asked.
    beaten: the probability that a run of `reference` is shorter than one of the planner on a query,
    ties counted half, failures as infinitely long.
    """
    rows = rows.assign(ratio=ratio_of(rows))
    table = []
    for (constraint, scene), case in rows.groupby(CASE, sort=False):
        theirs = case[case["planner"] == reference]
        wanted = _lengths_by_query(theirs)
        mine = theirs[theirs["valid"]].groupby("query")["ratio"].mean()
        for planner, own in case.groupby("planner", sort=False):
            about = {"constraint": constraint, "scene": scene, "planner": planner}
            same = mine[mine.index.isin(own[own["valid"]]["query"])].to_numpy()
            theirs_on_these = _chief(theirs[theirs["query"].isin(own["query"])])
            compared = {
                "reference_iqm": interquartile_mean(same)[1],
                "beaten": _beaten(wanted, _lengths_by_query(own)),
                **{f"reference_{name}": figure for name, figure in theirs_on_these.items()},
            }
            table.append(about | _figures(own) | compared)
    return pd.DataFrame(table)


def _chief(own: pd.DataFrame) -> dict[str, Any]:
    """The figures that are also given of the reference on a planner's queries."""
    solvable = own[own["best_known_rad"].notna()]
    return {
        "queries": own["query"].nunique(),
        "seeds": own["seed"].nunique(),
        "success_of_solvable": float(solvable["valid"].mean()),
        "ratio_p95_all": quantile_with_failures(solvable["ratio"].to_numpy(), 0.95),
        "time_median_s": solvable["time_s"].quantile(0.5),
    }


def _figures(own: pd.DataFrame) -> dict[str, Any]:
    solvable = own[own["best_known_rad"].notna()]
    ratio, time = own["ratio"].dropna(), solvable["time_s"]
    low, middle, high = interquartile_mean(own.groupby("query")["ratio"].mean().dropna().to_numpy())
    p95_low, p95_high = _p95_interval(
        [each.to_numpy() for _, each in solvable.groupby("query")["ratio"]]
    )
    success_low, success_high = _of_a_share(solvable.groupby("query")["valid"].mean())
    reached = {
        f"within_{100 * share:.0f}_s": _median_time(solvable, 1.0 + share) for share in WITHIN
    }
    return {
        "rows": len(own),
        **_chief(own),
        "solvable": solvable["query"].nunique(),
        "success": float(own["valid"].mean()),
        "success_low": success_low,
        "success_high": success_high,
        "claimed_but_invalid": int(((own["status"] == "solved") & ~own["valid"]).sum()),
        "wrongly_certified": _wrongly_certified(own),
        "not_applicable": int((own["status"] == "not_applicable").sum()),
        "ratio_median": ratio.quantile(0.5),
        "ratio_p95": ratio.quantile(0.95),
        "ratio_iqm": middle,
        "ratio_iqm_low": low,
        "ratio_iqm_high": high,
        "ratio_p95_all_low": p95_low,
        "ratio_p95_all_high": p95_high,
        "time_p95_s": time.quantile(0.95),
        **reached,
        "peak_memory_median_mb": own["peak_memory_mb"].quantile(0.5),
    }


def _wrongly_certified(own: pd.DataFrame) -> float:
    certified = own[own["valid"]]
    asked = certified["touches"].notna().all()
    return float((certified["touches"] == 1.0).sum()) if asked else float("nan")


def _of_a_share(solved: "pd.Series[float]") -> tuple[float, float]:
    """The 95 % interval of Clopper and Pearson of a share of queries, each counted by the share of
    its runs: none is ever of no width; nan without queries.
    """
    count, known = len(solved), float(solved.sum())
    if not count:
        return float("nan"), float("nan")
    low = stats.beta.ppf(0.025, known, count - known + 1.0) if known > 0.0 else 0.0
    high = stats.beta.ppf(0.975, known + 1.0, count - known) if known < count else 1.0
    return float(low), float(high)


def interquartile_mean(values: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Mean of the middle half, and its 95 % percentile bootstrap interval: low, mean, high; nan
    without values.
    """
    return _interval(values, partial(stats.trim_mean, proportiontocut=0.25))


def _interval(
    values: Float[np.ndarray, "n"], statistic: Callable[..., Any]
) -> tuple[float, float, float]:
    """A statistic and its 95 % percentile bootstrap interval: low, the statistic, high; nan without
    values.
    """
    if not len(values):
        return (float("nan"),) * 3
    middle = float(statistic(values))
    if len(values) < 2:
        return middle, middle, middle
    drawn = stats.bootstrap(
        (values,),
        statistic,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return float(drawn.confidence_interval.low), middle, float(drawn.confidence_interval.high)


def quantile_with_failures(ratio: Float[np.ndarray, "n"], share: float) -> float:
    """A quantile in which nan counts as infinite: the smallest value that the share of all rows
    does not pass.
    """
    if not len(ratio):
        return float("nan")
    filled = np.sort(np.where(np.isnan(ratio), np.inf, ratio))
    return float(filled[min(int(np.ceil(share * len(filled))) - 1, len(filled) - 1)])


def _p95_interval(by_query: Sequence[Float[np.ndarray, "seeds"]]) -> tuple[float, float]:
    """The 95 % percentile bootstrap interval of `quantile_with_failures` over queries, each with
    all of its runs; nan without queries.
    """
    if not by_query:
        return float("nan"), float("nan")
    rng = np.random.default_rng(0)
    drawn = [
        quantile_with_failures(np.concatenate([by_query[k] for k in chosen]), 0.95)
        for chosen in rng.integers(len(by_query), size=(RESAMPLES, len(by_query)))
    ]
    ordered = np.sort(drawn)  # no mean of a number and infinity
    return float(ordered[int(0.025 * RESAMPLES)]), float(ordered[int(0.975 * RESAMPLES) - 1])


def over_budget(rows: pd.DataFrame, budgets: Sequence[float]) -> pd.DataFrame:
    """What a planner has within a time budget: success and p95 of length over best known, one row a
    case and budget.

    A row counts from its time_s on; before, and where it is not valid, its length is infinite.
    """
    keys, table = [*CASE, "planner"], []
    for key, own in _solvable(rows).groupby(keys, sort=False):
        for budget in budgets:
            success, ratio = _within(own, budget)
            figures = {"budget_s": budget, "success": success, "ratio_p95": ratio}
            table.append(dict(zip(keys, key, strict=True)) | figures)
    return pd.DataFrame(table)


def all_constraints(rows: pd.DataFrame) -> pd.DataFrame:
    """The same rows as one case a scene, the queries of all constraints together; a planner that
    cannot work under a constraint has no rows of it.
    """
    rows = rows[rows["status"] != "not_applicable"]
    return rows.assign(query=rows["constraint"] + " " + rows["query"].astype(str), constraint="all")


def ours_against_baselines(
    rows: pd.DataFrame, ours: Mapping[str, float], budgets: Sequence[float]
) -> pd.DataFrame:
    """Where a baseline is ahead of the planner on p95 of length over best known within a time
    budget, or LATE after it, failures infinite.

    ours: the planner's names with the budget [s] that each is given, 0 for the first answer; within
    a budget the one with the longest that is shorter counts, of those that were asked a query which
    somebody solves.
    One row a case, budget and baseline: success and p95 of both within the budget, over the queries
    that the baseline was asked, and `verdict`: of the baseline, "ahead" or "behind" if its p95 is
    shorter or longer by more than AHEAD, else "tied"; where both are infinite, success decides in
    the same way, and two without any are "neither".
    """
    table = []
    for case, found in _solvable(rows).groupby(CASE, sort=False):
        groups = dict(list(found.groupby("planner", sort=False)))
        for budget in budgets:
            given = [name for name in ours if ours[name] < budget and name in groups]
            chosen, in_time = max(given, key=ours.__getitem__), (1.0 + LATE) * budget
            for name, theirs in groups.items():
                if name in ours:
                    continue
                mine = groups[chosen][groups[chosen]["query"].isin(theirs["query"])]
                both = (
                    _within(mine, in_time),
                    _within(theirs[theirs["query"].isin(mine["query"])], in_time),
                )
                about = dict(zip(CASE, case, strict=True)) | {"budget_s": budget}
                figures = {
                    f"{whose}{figure}": value
                    for whose, values in zip(("", "baseline_"), both, strict=True)
                    for figure, value in zip(("success", "ratio_p95"), values, strict=True)
                }
                asked = {"baseline": name, "asked": chosen, "queries": mine["query"].nunique()}
                table.append(about | asked | figures | {"verdict": _verdict(*both)})
    return pd.DataFrame(table)


def ratio_of(rows: pd.DataFrame) -> "pd.Series[float]":
    """Length over best known; nan where not valid."""
    return rows["length_rad"].where(rows["valid"]) / rows["best_known_rad"]


def _solvable(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of solvable queries with their `ratio`."""
    return rows.assign(ratio=ratio_of(rows))[rows["best_known_rad"].notna()]


def _within(rows: pd.DataFrame, budget_s: float) -> tuple[float, float]:
    """Success and p95 of the ratio, failures infinite, of what is there within a budget."""
    reached = rows["ratio"].where(rows["time_s"] <= budget_s).to_numpy()
    return float(np.isfinite(reached).mean()), quantile_with_failures(reached, 0.95)


def _verdict(mine: tuple[float, float], theirs: tuple[float, float]) -> str:
    """Of the other, from success and p95 of both."""
    (success, ratio), (other_success, other_ratio) = mine, theirs
    if np.isfinite(ratio) or np.isfinite(other_ratio):
        own, other = ratio, other_ratio
    elif success == other_success == 0.0:
        return "neither"
    else:  # the shorter figure is the better one: shares of failures
        own, other = 1.0 - success, 1.0 - other_success
    if other * (1.0 + AHEAD) < own:
        return "ahead"
    return "behind" if own * (1.0 + AHEAD) < other else "tied"


def break_even_table(
    rows: pd.DataFrame, training_s: Mapping[str, float], reference: str
) -> pd.DataFrame:
    """From how many queries on the reference's training pays: its cost over what it saves a query.

    training_s: of each planner, 0 where it is not named.  One row a planner, the reference first:
    training_s, query_s (mean over its rows of the solvable queries that both were asked),
    reference_s, success (valid rows), and break_even, infinite where the other is no slower.
    """
    rows = _solvable(rows)
    mine, spent = rows[rows["planner"] == reference], training_s.get(reference, 0.0)
    keys, table = [*CASE, "query"], list[dict[str, Any]]()
    means = mine[[*keys, "time_s"]].groupby(keys, as_index=False).mean()
    others = rows[(rows["status"] != "not_applicable") & (rows["planner"] != reference)]
    for planner, own in [(reference, mine), *others.groupby("planner", sort=False)]:
        both = own.merge(means, on=keys, suffixes=("", "_mine"))
        if both.empty:
            continue
        trained, own_s = training_s.get(str(planner), 0.0), float(both["time_s"].mean())
        reference_s = float(both["time_s_mine"].mean())
        extra, saved = max(spent - trained, 0.0), own_s - reference_s
        pays = np.nan if planner == reference else extra / saved if saved > 0.0 else np.inf
        row = {"planner": planner, "training_s": trained, "query_s": own_s}
        success = float(both["valid"].mean())
        table.append(row | {"reference_s": reference_s, "success": success, "break_even": pays})
    return pd.DataFrame(table)


def repeated(first: pd.DataFrame, again: pd.DataFrame) -> pd.DataFrame:
    """Two runs of the same rows compared: one row a planner.

    rows: that both have.  same_validity; length_difference: the largest relative one of rows valid
    in both.  time_s, time_again_s: medians of the first and of the second run.  ratio_*: the median
    over queries of the second time over the first of the same row, of a query's seeds the median,
    with its 95 % bootstrap interval; rows that took no time or do not apply have no part in it.
    """
    keys, table = [*CASE, "planner", "query", "seed"], []
    both = first.merge(again, on=keys, suffixes=("", "_again"))
    for planner, own in both.groupby("planner", sort=False):
        lengths = own[own["valid"] & own["valid_again"]]
        relative = (lengths["length_rad_again"] / lengths["length_rad"] - 1.0).abs()
        row: dict[str, Any] = {
            "planner": planner,
            "rows": len(own),
            "same_validity": bool((own["valid"] == own["valid_again"]).all()),
            "length_difference": float(relative.max()) if len(relative) else 0.0,
        }
        times = {"time_s": own["time_s"].median(), "time_again_s": own["time_s_again"].median()}
        timed = own[(own["time_s"] > 0.0) & (own["status"] != "not_applicable")]
        ratios = (timed["time_s_again"] / timed["time_s"]).groupby(
            [timed[k] for k in (*CASE, "query")]
        )
        low, middle, high = _interval(ratios.median().to_numpy(), np.median)
        table.append(row | times | {"ratio": middle, "ratio_low": low, "ratio_high": high})
    return pd.DataFrame(table)


def _median_time(solvable: pd.DataFrame, ratio: float) -> float:
    times = solvable["time_s"].where(solvable["ratio"] <= ratio)
    return quantile_with_failures(times.to_numpy(), 0.5)


def _lengths_by_query(rows: pd.DataFrame) -> dict[Any, np.ndarray]:
    """Each query's lengths, one a seed, infinite where it failed."""
    lengths = rows["length_rad"].where(rows["valid"], np.inf)
    return {query: own.to_numpy() for query, own in lengths.groupby(rows["query"])}


def _beaten(wanted: Mapping[Any, np.ndarray], other: Mapping[Any, np.ndarray]) -> float:
    """The mean over queries of the share of pairs of runs in which the other is longer, ties
    half.
    """
    shares = []
    for query in [query for query in wanted if query in other]:  # a set's order changes by the run
        mine, others = np.meshgrid(wanted[query], other[query])
        known = np.isfinite(mine) | np.isfinite(others)
        if known.any():
            tied = np.isclose(mine, others, rtol=TIED)
            shares.append(np.where(tied, 0.5, mine < others)[known].mean())
    return float(np.mean(shares)) if shares else float("nan")


def comparison_figures(rows: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Success, length and what was claimed but is not valid, of each planner; times stand in the
    table alone.
    """
    return {
        str(planner): {
            "rows": len(own),
            "success": float(own["valid"].mean()),
            "claimed_but_invalid": int(((own["status"] == "solved") & ~own["valid"]).sum()),
            "length_median_rad": float(own["length_rad"].where(own["valid"]).median()),
        }
        for planner, own in rows.groupby("planner", sort=False)
    }


def summarise(paths: pd.DataFrame, latent: str, counted: Counted = "valid") -> pd.DataFrame:
    """One row a planner, the counterpart of Table I: shortest, average ± std, time, length,
    violation, success.

    paths: rows of `PathMeasures.row` with planner, query, seed, status and time_s.  latent: the
    manifold whose latent length is compared. Success, status and violation are over all rows, times
    over those of queries that any planner solves: a planner's own limit is no time of it. Table I
    is over one query: here each query's shortest path, average and standard deviation over the
    seeds are taken first, then their mean over the queries (of the variance, for the deviation).
    Lengths are over the queries that every planner with any counted path has solved, because an
    average over easier queries is a shorter one (those of APART over the ones among them that it
    solves: `compared` counts them); `over_best_*`, the joint length over the shortest counted path
    of the same query, is over all counted rows.
    """
    counts = paths["valid"] if counted == "valid" else paths["length_rad"].notna()
    kept = paths[counts]
    common = common_queries(kept[~kept["planner"].isin(APART)])
    over_best = kept["length_rad"] / kept.groupby("query")["length_rad"].transform("min")
    solvable = set(kept["query"])
    rows = []
    for planner, group in paths.groupby("planner", sort=False):
        mine = kept[kept["planner"] == planner]
        shared = mine[mine["query"].isin(common)]
        rows.append(
            {
                "planner": planner,
                **_answers(group),
                "compared": shared["query"].nunique(),
                **_over_seeds(shared, f"latent_length_{latent}"),
                "length_mean_rad": _mean(shared.groupby("query")["length_rad"].mean()),
                "over_best_median": over_best[mine.index].median(),
                "over_best_p95": over_best[mine.index].quantile(0.95),
                **_violations(group),
                **_times(group[group["query"].isin(solvable)]),
            }
        )
    return pd.DataFrame(rows)


def common_queries(counted: pd.DataFrame) -> set[int]:
    """Queries for which every planner of the table has a path; a planner with no row at all does
    not take part.
    """
    solved = [set(group["query"]) for _, group in counted.groupby("planner")]
    return set.intersection(*solved) if solved else set()


def _answers(group: pd.DataFrame) -> dict[str, Any]:
    return {
        "rows": len(group),
        "queries": group["query"].nunique(),
        "success": float(group["valid"].mean()),
        "found": float(group["length_rad"].notna().mean()),
        "not_connected": float((group["status"] == "not_connected").mean()),
        "refused": float((group["length_rad"].notna() & ~group["valid"]).mean()),
    }


def _over_seeds(shared: pd.DataFrame, column: str) -> dict[str, float]:
    of_query = shared.groupby("query")[column]
    return {
        "latent_shortest": _mean(of_query.min()),
        "latent_mean": _mean(of_query.mean()),
        "latent_std": float(np.sqrt(_mean(of_query.var(ddof=1)))),  # one seed alone has no spread
    }


def _violations(group: pd.DataFrame) -> dict[str, float]:
    degrees = np.degrees(group["max_violation_rad"])
    return {
        "violation_median_deg": degrees.median(),
        "violation_max_deg": degrees.max(),
        "violation_max_mm": 1e3 * group["max_violation_m"].max(),
    }


def _times(group: pd.DataFrame) -> dict[str, float]:
    return {
        "time_mean_s": _mean(group["time_s"]),
        "time_std_s": group["time_s"].std(ddof=1),
        "time_median_s": group["time_s"].median(),
        "time_p95_s": float(group["time_s"].quantile(0.95)),
    }


def _mean(values: "pd.Series[float]") -> float:
    """Of the values that are there, added up as if there were no others; nan if there is none."""
    return float(values.dropna().mean())
