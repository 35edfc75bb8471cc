import numpy as np
import pandas as pd
import pytest

from constraint_geodesics.pipeline.layout import Layout
from constraint_geodesics.studies.charts import (
    HOLE,
    JOINTS,
    TASK,
    WORKCELL,
    summary,
    table_of,
    tasks_of,
)
from constraint_geodesics.studies.proposals import DESCENT, POLICY


def rows(data: str, dim: int, seed: int, lengths: dict[str, list[float]]) -> list[dict]:
    named = {"data": data, "dim": dim, "seed": seed}
    return [
        named | {"method": method, "query": query, "figure": figure, "value": value}
        for method, own in lengths.items()
        for query, length in enumerate(own)
        for figure, value in (("length_rad", length), ("ms", 10.0 + query))
    ]


def test_lengths_are_held_against_the_shortest_of_all_charts() -> None:
    nan = np.nan
    table = table_of(
        [
            *rows(TASK, 2, 0, {POLICY: [2.2, nan, nan], DESCENT: [nan, nan, nan]}),
            *rows(TASK, 2, 1, {POLICY: [2.0, nan, nan], DESCENT: [nan, nan, nan]}),
            *rows(JOINTS, 6, 0, {POLICY: [4.0, 3.0, nan], DESCENT: [2.0, 3.3, nan]}),
        ]
    )
    found = summary(table)
    assert (found["queries"], found["solvable"]) == (3, 2), "nothing solves the last"
    charts = found["charts"]
    assert charts[TASK]["2"][POLICY]["solved"] == {"mean": 0.5, "least": 0.5, "largest": 0.5}
    median = charts[TASK]["2"][POLICY]["ratio_median"]
    assert median == pytest.approx({"mean": 1.05, "least": 1.0, "largest": 1.1})
    assert charts[TASK]["2"][DESCENT]["ratio_median"]["mean"] is None
    assert charts[JOINTS]["6"][POLICY]["ratio_median"]["mean"] == pytest.approx(1.5)
    assert charts[JOINTS]["6"][DESCENT]["solved"]["mean"] == 1.0


def test_every_chart_has_every_seed_and_joint_space_its_joints(params, tmp_path) -> None:
    own, tasks = params.compare_charts, tasks_of(params, Layout(tmp_path))
    cases = pd.DataFrame([vars(task) for task in tasks]).groupby(["data", "dim"])["seed"].apply(set)
    assert set(cases.map(frozenset)) == {frozenset(own.seeds)}
    assert list(cases[JOINTS].index) == [6]
    assert list(cases[WORKCELL].index) == list(cases[TASK].index) == list(own.dims)
    assert list(cases[HOLE].index) == list(own.hole.dims)
    assert len({task.scratch for task in tasks}) == len(tasks)
    assert tasks[0].vae.latent_dim == tasks[0].dim
