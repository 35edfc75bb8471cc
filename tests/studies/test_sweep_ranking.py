"""A sweep small enough to rank by hand, and the table that is printed of it."""

import numpy as np
import pytest

from constraint_geodesics.studies.sweep_ranking import (
    best_known,
    figures_of,
    ranking,
    seed_figures,
    seed_rows,
)

NAN = float("nan")


def seed(number, cup, slide, optimum=(1.0, 2.0), pace=100.0):
    """A seed's result, as JSON has it: lengths of two queries of each constraint, null where it
    failed.
    """
    constraints = {
        name: {
            "feasible": [length is not None for length in lengths],
            "length_rad": list(lengths),
            "optimum_rad": list(optimum),
            "time_ms": [1.0, 3.0],
        }
        for name, lengths in (("cup", cup), ("slide", slide))
    }
    return {"seed": number, "steps_per_second": pace, "constraints": constraints}


GOOD = [seed(0, (1.0, 2.0), (1.0, 4.0)), seed(1, (2.0, 2.0), (1.0, 2.0))]
POOR = [seed(0, (None, 2.0), (None, None)), seed(1, (2.0, 4.0), (2.0, 4.0), pace=None)]


def test_figures_of_one_seed() -> None:
    found = figures_of(POOR[0], "cup")
    assert found["feasible"] == found["efficiency"] == 0.5
    assert found["ratio_p50"] == found["ratio_p95"] == 1.0
    assert found["time_ms"] == 2.0
    assert np.isnan(figures_of(POOR[0], "slide")["ratio_p50"])
    assert figures_of(GOOD[0], "slide")["efficiency"] == 0.75
    assert seed_figures(POOR[0])["feasible"] == 0.25
    assert seed_figures(POOR[0])["ratio_p50"] == 1.0, "of the constraint that has one"


def test_a_curve_shorter_than_the_family_s_best_is_the_best_known() -> None:
    better = seed(2, (0.5, 2.0), (None, 2.0), optimum=(1.0, None))
    known = best_known([*GOOD, better])
    assert known["cup"].tolist() == [0.5, 2.0]
    rows = seed_rows({"good": GOOD, "better": [better]})
    scores = {(r["configuration"], r["seed"], r["constraint"]): r["score"] for r in rows}
    assert scores["better", 2, "cup"] == 1.0
    assert scores["good", 0, "cup"] == 0.75
    assert scores["better", 2, "slide"] == 0.5, "a failure is worth nothing"
    assert figures_of(better, "cup")["efficiency"] == 1.0, "held against itself"


def test_the_ranking_by_hand() -> None:
    rows = seed_rows({"poor": POOR, "good": GOOD})
    first, second = ranking(rows, "poor")
    assert (first["rank"], first["configuration"], first["seeds"]) == (1, "good", 2)
    # scores a seed and constraint: good 1, 0.75, 0.75, 1; poor 0.5, 0, 0.5, 0.5
    assert first["score"] == 0.875
    assert second["score"] == 0.5, "of four scores the middle two"
    assert first["above_reference"] == 1.0
    assert np.isnan(second["above_reference"])
    # its seeds drawn again: 0.25 with the first alone, 0.5 in the three other ways
    assert second["score_low"] == pytest.approx(np.quantile([0.25, 0.5, 0.5, 0.5], 0.025))
    assert second["score_high"] == 0.5
    assert second["steps_per_second"] == 100.0, "of the seeds that have one"


def test_no_order_of_rows_or_configurations_changes_the_ranking() -> None:
    rows = seed_rows({"poor": POOR, "good": GOOD})
    again = seed_rows({"good": GOOD[::-1], "poor": POOR})[::-1]
    shown = ("rank", "configuration", "score", "score_low", "score_high")
    assert [[row[name] for name in shown] for row in ranking(rows, "good")] == [
        [row[name] for name in shown] for row in ranking(again, "good")
    ]


def test_a_query_that_nobody_solved_counts_for_none() -> None:
    lost = [seed(0, (1.0, None), (1.0, 2.0), optimum=(1.0, None))]
    (row, _) = seed_rows({"lost": lost})
    assert row["score"] == 1.0
    assert row["feasible"] == 0.5


def test_a_constraint_that_nobody_solved_leaves_the_others_scores() -> None:
    lost = [seed(0, (None, None), (1.0, 2.0), optimum=(None, None))]
    rows = seed_rows({"lost": lost})
    assert ranking(rows, "lost")[0]["score"] == pytest.approx(1.0)
