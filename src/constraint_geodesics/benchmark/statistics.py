"""The benchmark's figures, all from its rows: success, lengths with intervals, times, and who beats
whom.

Interquartile means with bootstrap intervals and the probability of improvement after Agarwal et
al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021), with queries in
the place of tasks.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

CASE = ["constraint", "scene"]
WITHIN = (0.01, 0.05, 0.10)
"""Excess over the best known length that the time to reach is told of."""
TIED = 1e-4
"""Relative difference below which two lengths count as one."""
RESAMPLES = 1000
AHEAD = 1e-3
"""Relative difference of two p95 below which neither planner is ahead."""


def benchmark_summary(rows: pd.DataFrame, reference: str) -> pd.DataFrame:
    """One row a constraint, scene and planner, from the rows of benchmark.csv.

    queries, rows; solvable: queries that any planner solved.  success: valid rows of all;
    success_of_solvable: of those whose query any planner solved, with its 95 % bootstrap interval
    over queries.  claimed_but_invalid: rows called solved that the certifier refuses.
    not_applicable: rows of problems that the planner cannot work on.
    ratio_*: length over best known of valid rows: median, 95th percentile, and the interquartile
    mean over queries (of each query's mean over its seeds) with its 95 % bootstrap interval;
    ratio_p95_all: the 95th percentile with every row that is not valid counted as infinite, of the
    solvable queries.
    time_*: of all rows [s].  within_1, _5, _10: median time [s] to a valid path within so many per
    cent of the best known, infinite where fewer than half of the rows get there.
    reference_iqm: the interquartile mean of `reference` over the queries that the planner has a
    valid path of.
    beaten: the probability that a run of `reference` is shorter than one of the planner on a query,
    ties counted half, failures as infinitely long.
    """
    rows = rows.assign(ratio=rows["length_rad"].where(rows["valid"]) / rows["best_known_rad"])
    table = []
    for (constraint, scene), case in rows.groupby(CASE, sort=False):
        wanted = _lengths_by_query(case[case["planner"] == reference])
        mine = case[(case["planner"] == reference) & case["valid"]].groupby("query")["ratio"].mean()
        for planner, own in case.groupby("planner", sort=False):
            about = {"constraint": constraint, "scene": scene, "planner": planner}
            same = mine[mine.index.isin(own[own["valid"]]["query"])].to_numpy()
            beside = {
                "reference_iqm": interquartile_mean(same)[1],
                "beaten": _beaten(wanted, _lengths_by_query(own)),
            }
            table.append(about | _figures(own) | beside)
    return pd.DataFrame(table)


def _figures(own: pd.DataFrame) -> dict[str, Any]:
    solvable = own[own["best_known_rad"].notna()]
    ratio, time = own["ratio"].dropna(), own["time_s"]
    low, middle, high = interquartile_mean(own.groupby("query")["ratio"].mean().dropna().to_numpy())
    solved = solvable.groupby("query")["valid"].mean().to_numpy()
    success_low, _, success_high = _interval(solved, np.mean)
    reached = {
        f"within_{100 * share:.0f}_s": _median_time(solvable, 1.0 + share) for share in WITHIN
    }
    return {
        "rows": len(own),
        "queries": own["query"].nunique(),
        "seeds": own["seed"].nunique(),
        "solvable": solvable["query"].nunique(),
        "success": float(own["valid"].mean()),
        "success_of_solvable": float(solvable["valid"].mean()) if len(solvable) else np.nan,
        "success_low": success_low,
        "success_high": success_high,
        "claimed_but_invalid": int(((own["status"] == "solved") & ~own["valid"]).sum()),
        "not_applicable": int((own["status"] == "not_applicable").sum()),
        "ratio_median": _quantile(ratio, 0.5),
        "ratio_p95": _quantile(ratio, 0.95),
        "ratio_iqm": middle,
        "ratio_iqm_low": low,
        "ratio_iqm_high": high,
        "ratio_p95_all": quantile_with_failures(solvable["ratio"].to_numpy(), 0.95),
        "time_median_s": _quantile(time, 0.5),
        "time_p95_s": _quantile(time, 0.95),
        **reached,
        "peak_memory_median_mb": _quantile(own["peak_memory_mb"], 0.5),
    }


def interquartile_mean(values: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Mean of the middle half, and its 95 % percentile bootstrap interval: low, mean, high; nan
    without values.
    """
    return _interval(values, _trimmed)


def _trimmed(values: np.ndarray, axis: int = 0) -> Any:
    return stats.trim_mean(values, 0.25, axis=axis)


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


def over_budget(rows: pd.DataFrame, budgets: Sequence[float]) -> pd.DataFrame:
    """What a planner has within a time budget: success and p95 of length over best known, one row a
    case and budget.

    A row counts from its time_s on; before, and where it is not valid, its length is infinite.
    """
    rows = rows[rows["best_known_rad"].notna()]
    ratio = (rows["length_rad"].where(rows["valid"]) / rows["best_known_rad"]).to_numpy()
    table = []
    for (constraint, scene, planner), own in rows.assign(ratio=ratio).groupby(
        [*CASE, "planner"], sort=False
    ):
        about: Mapping[str, Any] = {"constraint": constraint, "scene": scene, "planner": planner}
        for budget in budgets:
            reached = own["ratio"].where(own["time_s"] <= budget).to_numpy()
            figures = {
                f"ratio_p{share:.0f}": quantile_with_failures(reached, share / 100)
                for share in (50.0, 95.0)
            }
            table.append(
                {
                    **about,
                    "budget_s": budget,
                    "success": float(np.isfinite(reached).mean()),
                    **figures,
                }
            )
    return pd.DataFrame(table)


def all_constraints(rows: pd.DataFrame) -> pd.DataFrame:
    """The same rows as one case a scene, the queries of all constraints together; a planner that
    cannot work under a constraint has no rows of it.
    """
    rows = rows[rows["status"] != "not_applicable"]
    return rows.assign(query=rows["constraint"] + " " + rows["query"].astype(str), constraint="all")


def ours_against_peers(
    rows: pd.DataFrame, ours: Mapping[str, float], own: Sequence[str], budgets: Sequence[float]
) -> pd.DataFrame:
    """Where a peer is ahead of the planner on p95 of length over best known within a time budget,
    failures infinite.

    ours: the planner's names with the budget [s] that each is given, 0 for the first answer; within
    a budget the one with the longest that is shorter counts.  own: names that are no peers, such as
    the planner without a part.
    One row a case, budget and peer: success and p95 of both within the budget, over the queries
    that the peer was asked, and `verdict`: of the peer, "ahead" or "behind" if its p95 is shorter
    or longer by more than AHEAD, else "tied"; where both are infinite, success decides in the same
    way, and two without any are "neither".
    """
    rows = rows[rows["best_known_rad"].notna()]
    rows = rows.assign(ratio=rows["length_rad"].where(rows["valid"]) / rows["best_known_rad"])
    table = []
    for (constraint, scene), case in rows.groupby(CASE, sort=False):
        groups = dict(list(case.groupby("planner", sort=False)))
        for budget in budgets:
            chosen = max(
                (name for name in ours if ours[name] < budget), key=lambda name: ours[name]
            )
            for peer, asked in groups.items():
                if peer in ours or peer in own:
                    continue
                mine = groups[chosen][groups[chosen]["query"].isin(asked["query"])]
                asked = asked[asked["query"].isin(mine["query"])]
                success, ratio = _within(mine, budget)
                peer_success, peer_ratio = _within(asked, budget)
                table.append(
                    {
                        "constraint": constraint,
                        "scene": scene,
                        "budget_s": budget,
                        "peer": peer,
                        "asked": chosen,
                        "queries": mine["query"].nunique(),
                        "success": success,
                        "peer_success": peer_success,
                        "ratio_p95": ratio,
                        "peer_ratio_p95": peer_ratio,
                        "verdict": _verdict(success, ratio, peer_success, peer_ratio),
                    }
                )
    return pd.DataFrame(table)


def _within(rows: pd.DataFrame, budget_s: float) -> tuple[float, float]:
    """Success and p95 of the ratio, failures infinite, of what is there within a budget."""
    reached = rows["ratio"].where(rows["time_s"] <= budget_s).to_numpy()
    return float(np.isfinite(reached).mean()), quantile_with_failures(reached, 0.95)


def _verdict(success: float, ratio: float, peer_success: float, peer_ratio: float) -> str:
    if np.isfinite(ratio) or np.isfinite(peer_ratio):
        mine, other = ratio, peer_ratio
    elif success == peer_success == 0.0:
        return "neither"
    else:  # the shorter figure is the better one: shares of failures
        mine, other = 1.0 - success, 1.0 - peer_success
    if other * (1.0 + AHEAD) < mine:
        return "ahead"
    return "behind" if mine * (1.0 + AHEAD) < other else "tied"


def break_even_table(
    rows: pd.DataFrame, training_s: Mapping[str, float], reference: str
) -> pd.DataFrame:
    """From how many queries on the reference's training pays: its cost over what it saves a query.

    training_s: of each planner, 0 where it is not named.  One row a planner, the reference first:
    training_s, query_s (mean over all of its rows of the queries that both were asked),
    reference_s, success (valid rows), and break_even, infinite where the other is no slower.
    """
    mine = rows[rows["planner"] == reference]
    own_time, spent = float(mine["time_s"].mean()), training_s.get(reference, 0.0)
    first = {
        "planner": reference,
        "training_s": spent,
        "query_s": own_time,
        "reference_s": own_time,
        "success": float(mine["valid"].mean()),
        "break_even": np.nan,
    }
    table = [first]
    keys = ["constraint", "scene", "query"]
    for planner, own in rows[rows["status"] != "not_applicable"].groupby("planner", sort=False):
        both = own.merge(
            mine[[*keys, "time_s"]].groupby(keys, as_index=False).mean(),
            on=keys,
            suffixes=("", "_mine"),
        )
        if planner == reference or both.empty:
            continue
        saved = both["time_s"].mean() - both["time_s_mine"].mean()
        extra = max(spent - training_s.get(str(planner), 0.0), 0.0)
        table.append(
            {
                "planner": planner,
                "training_s": training_s.get(str(planner), 0.0),
                "query_s": both["time_s"].mean(),
                "reference_s": both["time_s_mine"].mean(),
                "success": float(both["valid"].mean()),
                "break_even": extra / saved if saved > 0.0 else np.inf,
            }
        )
    return pd.DataFrame(table)


def repeated(first: pd.DataFrame, again: pd.DataFrame) -> pd.DataFrame:
    """Two runs of the same rows compared: one row a planner.

    rows: that both have.  same_validity; length_difference: the largest relative one of rows valid
    in both.  time_*: median of the first and of the second run [s] with 95 % bootstrap intervals,
    and whether these overlap.
    """
    keys, table = [*CASE, "planner", "query", "seed"], []
    both = first.merge(again, on=keys, suffixes=("", "_again"))
    for planner, own in both.groupby("planner", sort=False):
        lengths = own[own["valid"] & own["valid_again"]]
        relative = (lengths["length_rad_again"] / lengths["length_rad"] - 1.0).abs()
        low, middle, high = _interval(own["time_s"].to_numpy(), np.median)
        low_again, middle_again, high_again = _interval(own["time_s_again"].to_numpy(), np.median)
        table.append(
            {
                "planner": planner,
                "rows": len(own),
                "same_validity": bool((own["valid"] == own["valid_again"]).all()),
                "length_difference": float(relative.max()) if len(relative) else 0.0,
                "time_s": middle,
                "time_low_s": low,
                "time_high_s": high,
                "time_again_s": middle_again,
                "time_again_low_s": low_again,
                "time_again_high_s": high_again,
                "overlap": bool(low <= high_again and low_again <= high),
            }
        )
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
    for query in wanted.keys() & other.keys():
        mine, others = np.meshgrid(wanted[query], other[query])
        known = np.isfinite(mine) | np.isfinite(others)
        if known.any():
            tied = np.isclose(mine, others, rtol=TIED)
            shares.append(np.where(tied, 0.5, mine < others)[known].mean())
    return float(np.mean(shares)) if shares else float("nan")


def _quantile(values: "pd.Series[float]", share: float) -> float:
    known = values.dropna()
    return float(known.quantile(share)) if len(known) else float("nan")
