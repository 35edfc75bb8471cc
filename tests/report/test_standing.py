"""Who wins and where the planner loses is read from the rows: other rows, other sentences."""

import numpy as np
import pandas as pd
import pytest

from constraint_geodesics.benchmark.statistics import all_constraints, benchmark_summary
from constraint_geodesics.report.benchmark_tables import FEW
from constraint_geodesics.report.standing import (
    ASKED,
    best_of_families,
    equal_time,
    losses,
    planner_result,
    winner,
)

CASE = {"constraint": "level_cup", "scene": "table", "budget_s": 0.01, "queries": FEW}


def verdicts(**by_baseline):
    """A row of the budgets for each verdict of a baseline."""
    return pd.DataFrame(
        [
            CASE | {"baseline": name, "verdict": verdict, "budget_s": 0.01 * 10**k}
            for name, found in by_baseline.items()
            for k, verdict in enumerate(found)
        ]
    )


def overview_of(*rows):
    return benchmark_summary(all_constraints(pd.DataFrame(rows)), "planner")


def answers(planner, time_s, length, *, scene="table", queries=FEW, constraint="level_cup"):
    """A planner's rows; the best known length is 2 rad, and a length of nan is a failure."""
    return [
        {
            "planner": planner,
            "constraint": constraint,
            "scene": scene,
            "query": query,
            "seed": 0,
            "status": "solved" if np.isfinite(length) else "not_found",
            "valid": bool(np.isfinite(length)),
            "time_s": time_s,
            "length_rad": length,
            "best_known_rad": 2.0,
            "touches": 0.0,
            "peak_memory_mb": 1.0,
        }
        for query in range(queries)
    ]


def summary(planner, solved, length, queries=ASKED):
    """The rows of the overview of one planner, a scene each; solved and length: of both."""
    return [
        {
            "planner": planner,
            "scene": scene,
            "queries": queries,
            "solvable": queries - 1,
            "success_of_solvable": share,
            "ratio_p95_all": ratio,
            "time_median_s": 0.002,
        }
        for scene, share, ratio in zip(("table", "keep_out"), solved, length, strict=True)
    ]


def test_the_winner_is_who_is_ahead_in_more_cases_than_behind():
    assert winner(verdicts(BiRRT=["behind", "ahead"], PRM=["tied", "behind"])) == "planner"
    budgets = verdicts(BiRRT=["ahead", "ahead", "behind"], PRM=["ahead", "behind", "behind"])
    assert winner(budgets) == "BiRRT"
    assert equal_time(budgets).startswith(
        "It is ahead of the planner in 2 cases of constraint, scene and budget, and behind in 1. "
    )
    assert equal_time(verdicts(PRM=["behind"])).startswith("Within a time budget the planner is")


def test_a_planner_that_nobody_beats_loses_nowhere():
    overview = overview_of(*answers("planner", 0.001, 2.0), *answers("BiRRT", 0.1, 2.1))
    (loss,) = losses(overview, verdicts(BiRRT=["behind"]))
    assert loss.title == "Nowhere"


def test_what_is_sooner_or_shorter_is_named_with_both_figures():
    overview = overview_of(
        *answers("planner", 0.010, 2.1),
        *answers("BiRRT", 0.005, 2.4),
        *answers("PRM", 0.001, np.nan),
        *answers("SLSQP", 2.0, 2.0),
        *answers("planner", 0.020, 2.2, scene="keep_out"),
        *answers("SLSQP", 2.0, 2.3, scene="keep_out"),
    )
    sooner, shorter = losses(overview, verdicts(BiRRT=["behind"], PRM=["behind"], SLSQP=["behind"]))
    assert sooner.title == "Sooner at the median"
    assert sooner.sentence == "1 in the workcell, the largest gap 5 ms against 10."
    assert sooner.details == [
        "“BiRRT” in the workcell, in 5 ms against 10 (it solves 100.0%, the planner 100.0%)",
        "1 more that solve less than half",
    ]
    assert (
        shorter.sentence
        == "1 in the workcell, the largest gap 1.000 times the best known against 1.050."
    )
    assert shorter.details == [
        "“SLSQP” in the workcell, 1.000 times the best known against 1.050 on 20 queries, in "
        "2,000 ms against 10"
    ]


def test_a_length_over_few_queries_is_only_counted():
    few = {"queries": FEW - 1}
    planner, other = answers("planner", 0.01, 2.1, **few), answers("SLSQP", 2.0, 2.0, **few)
    (loss,) = losses(overview_of(*planner, *other), verdicts(SLSQP=["behind"]))
    assert loss.sentence == f"1 over fewer than {FEW} queries."


def test_within_the_same_time_few_queries_are_only_counted():
    overview = overview_of(*answers("planner", 0.001, 2.0), *answers("BiRRT", 0.1, 2.1))
    budgets = verdicts(BiRRT=["ahead", "behind", "ahead"], PRM=["ahead"])
    (loss,) = losses(overview, budgets)
    assert loss.sentence == (
        "in 10 ms under 1 constraint in the workcell; in 1 s under 1 constraint in the workcell."
    )
    assert loss.details == [
        "in 10 ms in the workcell, “BiRRT” under level_cup and “PRM” under level_cup",
        "in 1 s in the workcell, “BiRRT” under level_cup",
    ]
    (loss,) = losses(overview, budgets.assign(queries=FEW - 1))
    assert loss.sentence == f"3 comparisons over fewer than {FEW} queries stand in a table below."


def test_the_planner_is_compared_over_the_queries_that_the_other_was_asked():
    rows = [
        *answers("planner", 0.001, 2.0, queries=2),
        *answers("planner", 0.009, 2.0, constraint="slide"),
        *answers("PRM", 0.005, 2.0, queries=2),
    ]
    assert [loss.title for loss in losses(overview_of(*rows), verdicts(PRM=["behind"]))] == [
        "Nowhere"
    ]
    rows += answers("PRM", 0.005, 2.0, constraint="slide")
    (loss,) = losses(overview_of(*rows), verdicts(PRM=["behind"]))
    assert loss.sentence == "1 in the workcell, the largest gap 5 ms against 9."


def test_each_family_is_represented_by_the_best_in_its_worse_scene():
    overview = pd.DataFrame(
        [
            *summary("planner", (1.0, 1.0), (1.0, 1.0)),
            *summary("trees + band", (1.0, 1.0), (1.0, 1.0)),
            *summary("BiRRT", (1.0, 0.8), (1.2, np.inf)),
            *summary("BiRRT + band", (0.9, 0.9), (1.1, np.inf)),
            *summary("PRM", (1.0, 0.9), (1.0, 1.5)),
            *summary("SLSQP", (1.0, 1.0), (1.0, 1.0), queries=ASKED - 1),
            *summary("latent graph", (1.0, 1.0), (1.0, 1.0))[:1],
        ]
    )
    assert best_of_families(overview) == ["PRM", "BiRRT + band"]
    fewer = overview.assign(queries=ASKED - 1)
    assert best_of_families(fewer) == ["SLSQP", "PRM", "BiRRT + band"], "as many as the planner"


def test_the_planners_result_is_said_of_both_scenes():
    told = planner_result(pd.DataFrame(summary("planner", (1.0, 0.875), (1.25, np.inf))))
    asked = f"the {ASKED - 1} of {ASKED} queries that any planner solved"
    assert told.startswith(f"In the workcell it solves 100.0% of {asked}, in 2 ms")
    assert "1.250 times the shortest path known; with a sphere on the way it solves 87.5%" in told
    assert told.endswith("∞ times the shortest path known.")


@pytest.mark.parametrize("verdict", ["tied", "neither"])
def test_a_tie_is_no_loss(verdict):
    overview = overview_of(*answers("planner", 0.001, 2.0), *answers("BiRRT", 0.001, 2.0))
    assert [loss.title for loss in losses(overview, verdicts(BiRRT=[verdict]))] == ["Nowhere"]
