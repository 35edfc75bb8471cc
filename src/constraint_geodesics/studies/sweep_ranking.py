"""What a sweep's configurations are worth: one score a seed and constraint, and their ranking.

The score is success weighted by path length (Anderson et al., "On Evaluation of Embodied Navigation
Agents", 2018): the mean over queries of the best known length over the one found, 0 where no
feasible curve was found.  1 is perfect.  Best known is the shortest curve that any configuration
found, or that any family was shown to have: curves of different degrees are held against the same.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from constraint_geodesics.studies.statistics import (
    bootstrap_interval,
    interquartile_mean,
    probability_of_improvement,
)

Record = dict[str, Any]
FIGURES = ("efficiency", "feasible", "ratio_p50", "ratio_p95", "time_ms", "steps_per_second")


def figures_of(seed: Mapping[str, Any], constraint: str) -> dict[str, float]:
    """Of one seed's policy under one constraint, from what `train_and_judge` returned.

    efficiency: the score, held against the best of its own family and itself alone.  feasible:
    share of the queries.  ratio_p50, ratio_p95: length over the family's best, of the
    feasible ones; nan where there is none.  time_ms: median of a query.
    """
    own = seed["constraints"][constraint]
    length, optimum = _array(own["length_rad"]), _array(own["optimum_rad"])
    ratio = length / optimum
    known = ratio[np.isfinite(ratio)]
    p50, p95 = np.quantile(known, [0.5, 0.95]) if len(known) else (np.nan, np.nan)
    return {
        "efficiency": _score(length, np.fmin(length, optimum)),
        "feasible": float(np.mean(own["feasible"])),
        "ratio_p50": float(p50),
        "ratio_p95": float(p95),
        "time_ms": float(np.median(own["time_ms"])),
        "steps_per_second": float(_array([seed["steps_per_second"]])[0]),
    }


def seed_figures(seed: Mapping[str, Any]) -> dict[str, float]:
    """The same over all constraints: their means."""
    rows = [figures_of(seed, constraint) for constraint in seed["constraints"]]
    return {name: _mean([row[name] for row in rows]) for name in FIGURES}


def best_known(seeds: Sequence[Mapping[str, Any]]) -> dict[str, Float[np.ndarray, "Q"]]:
    """The shortest length of each query that any of them found or was compared with [rad]; nan
    where there is none.
    """
    found = {}
    for constraint in seeds[0]["constraints"] if seeds else ():
        own = [seed["constraints"][constraint] for seed in seeds]
        lengths = [_array(row[name]) for row in own for name in ("length_rad", "optimum_rad")]
        found[constraint] = np.fmin.reduce(lengths)
    return found


def seed_rows(configurations: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Record]:
    """One row a configuration, seed and constraint: its score and figures.

    configurations: what the seeds of each returned, by its name.  A query that nobody solved counts
    for none.
    """
    known, rows = best_known([seed for own in configurations.values() for seed in own]), []
    for name, seeds in configurations.items():
        for seed in seeds:
            for constraint, best in known.items():
                length = _array(seed["constraints"][constraint]["length_rad"])
                about = {"configuration": name, "seed": seed["seed"], "constraint": constraint}
                about["score"] = _score(length, best)
                rows.append(about | figures_of(seed, constraint))
    return rows


def ranking(rows: Sequence[Mapping[str, Any]], reference: str) -> list[Record]:
    """One row a configuration, the best first.

    score: the interquartile mean over its seeds and all constraints, with its 95 % bootstrap
    interval over the seeds.  above_reference: the probability that one of its seeds has a higher
    score than one of `reference`, averaged over the constraints.  The rest are means of `rows`.
    """
    names = list(dict.fromkeys(row["configuration"] for row in rows))
    scores = {name: _scores([r for r in rows if r["configuration"] == name]) for name in names}
    against = scores.get(reference, np.empty((0, 0)))
    table = []
    for name, own in scores.items():
        low, high = bootstrap_interval(own, interquartile_mean)
        improved = probability_of_improvement(own, against) if name != reference else float("nan")
        score = {"score": interquartile_mean(own), "score_low": low, "score_high": high}
        mine = [row for row in rows if row["configuration"] == name]
        means = {figure: _mean([row[figure] for row in mine]) for figure in FIGURES}
        about = {"configuration": name, "seeds": len(own)}
        table.append(about | score | {"above_reference": improved} | means)
    ordered = sorted(table, key=lambda row: (-row["score"], row["configuration"]))
    return [{"rank": place} | row for place, row in enumerate(ordered, start=1)]


def _scores(rows: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, "n T"]:
    """A row a seed, a column a constraint; those that nobody solved a query of are left out."""
    seeds = list(dict.fromkeys(row["seed"] for row in rows))
    of = {(row["seed"], row["constraint"]): row["score"] for row in rows}
    tasks = list(dict.fromkeys(c for (_, c), score in of.items() if np.isfinite(score)))
    return np.array([[of[seed, constraint] for constraint in tasks] for seed in seeds])


def _score(length: Float[np.ndarray, "Q"], best: Float[np.ndarray, "Q"]) -> float:
    """Over the queries that somebody solved; nan if there is none."""
    share = np.nan_to_num(best / length)[np.isfinite(best)]
    return float(share.mean()) if len(share) else float("nan")


def _array(values: Sequence[float | None]) -> Float[np.ndarray, "n"]:
    """JSON's null is nan."""
    return np.array([np.nan if value is None else value for value in values], float)


def _mean(values: Sequence[float]) -> float:
    """Of the values that are there; nan if there is none."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")
