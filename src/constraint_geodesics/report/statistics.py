"""Tables of paths → the figures that are compared.  Every row counts, failures too."""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float

Counted = Literal["valid", "found"]
"""Whose lengths count: those of the paths that the judge accepts, or of all that a planner
returned.
"""

STRAIGHT, RANDOM = "straight_latent_line", "random_curves"
BESIDE = (STRAIGHT, RANDOM)
"""Shown beside the planners to tell what policy search adds: what they can't do must not decide
which queries are compared.
"""


def summarise(paths: pd.DataFrame, latent: str, counted: Counted = "valid") -> pd.DataFrame:
    """One row a planner, the counterpart of Table I: shortest, average ± std, time, length,
    violation, success.

    paths: rows of `PathMeasures.row` with planner, query, seed, status and time_s.  latent: the
    manifold whose latent length is compared.  Success, status, violation and time are over all
    rows.  Table I is over one query: here each query's shortest path, average and standard
    deviation over the seeds are taken first, then their mean over the queries (of the variance, for
    the deviation).  Lengths are over the queries that every planner with any counted path has
    solved, because an average over easier queries is a shorter one (those of BESIDE over the ones
    among them that it solves: `compared` counts them); `over_best_*`, the joint length over the
    shortest counted path of the same query, is over all counted rows.
    """
    counts = paths["valid"] if counted == "valid" else paths["length_rad"].notna()
    kept = paths[counts]
    common = common_queries(kept[~kept["planner"].isin(BESIDE)])
    over_best = kept["length_rad"] / kept.groupby("query")["length_rad"].transform("min")
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
                "length_mean_rad": _of(shared.groupby("query")["length_rad"].mean(), np.mean),
                "over_best_median": _of(over_best[mine.index], np.median),
                "over_best_p95": _of(over_best[mine.index], _p95),
                **_violations(group),
                **_times(group),
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
    variances = of_query.var(ddof=1).dropna()  # one seed alone has no spread
    return {
        "latent_shortest": _of(of_query.min(), np.mean),
        "latent_mean": _of(of_query.mean(), np.mean),
        "latent_std": float(np.sqrt(_of(variances, np.mean))),
    }


def _violations(group: pd.DataFrame) -> dict[str, float]:
    degrees = np.degrees(group["max_violation_rad"])
    return {
        "violation_median_deg": _of(degrees, np.median),
        "violation_max_deg": _of(degrees, np.max),
        "violation_max_mm": 1e3 * _of(group["max_violation_m"], np.max),
    }


def _times(group: pd.DataFrame) -> dict[str, float]:
    return {
        "time_mean_s": _of(group["time_s"], np.mean),
        "time_std_s": float(group["time_s"].std(ddof=1)),
        "time_median_s": _of(group["time_s"], np.median),
        "time_p95_s": _of(group["time_s"], _p95),
    }


def _of(values: pd.Series, figure: Callable[[Float[np.ndarray, "n"]], Any]) -> float:
    """A figure of the values that are there; nan if there is none."""
    present = values.dropna().to_numpy(float)
    return float(figure(present)) if len(present) else float("nan")


def _p95(values: Float[np.ndarray, "n"]) -> float:
    return float(np.quantile(values, 0.95))
