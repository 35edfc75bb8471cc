"""Few runs compared: interquartile means, bootstrap intervals over runs, who improves on whom.

After Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021).
Scores are arrays whose first axis is the run (a seed); others, if any, are tasks.
"""

from collections.abc import Callable
from itertools import product

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
"""Drawn at most.  Where there are no more ways to draw the runs, each of these counts once: with
four runs and fewer the interval is exact."""

Scores = Float[np.ndarray, "n *tasks"]
Statistic = Callable[[np.ndarray], float]


def interquartile_mean(values: Float[np.ndarray, "..."]) -> float:
    """Mean of the middle half of all values: a quarter of them, rounded down, is left out at each
    end; nan without values.
    """
    ordered = np.sort(np.asarray(values, float).ravel())
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean()) if len(ordered) else float("nan")


def bootstrap_interval(
    scores: Scores, statistic: Statistic, level: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic over the runs: low, high; nan without runs.

    A run keeps its scores of all tasks together: one policy earned them.  level: of confidence, in
    (0, 1).  seed: of the resamples, where not all of them are looked at.
    """
    if not 0 < level < 1:
        raise ValueError(f"level={level}: must lie between 0 and 1")
    runs = len(scores)
    if not runs:
        return float("nan"), float("nan")
    if runs**runs <= RESAMPLES:
        drawn = np.array(list(product(range(runs), repeat=runs)))
    else:
        drawn = np.random.default_rng(seed).integers(runs, size=(RESAMPLES, runs))
    found = [statistic(scores[rows]) for rows in drawn]
    low, high = np.quantile(found, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def probability_of_improvement(mine: Scores, others: Scores) -> float:
    """The share of pairs of runs in which mine has the higher score, ties half, averaged over the
    tasks; nan where one of them has no run.
    """
    if not len(mine) or not len(others):
        return float("nan")
    better = mine[:, None] > others[None]
    return float((better + 0.5 * (mine[:, None] == others[None])).mean())
