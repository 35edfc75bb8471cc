"""Paths of the real planner and straight lines, executed with a few spheres; and the table's
figures by hand.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np
import pandas as pd
import pytest

from constraint_geodesics.bundle import PACKAGED, read_bundle
from constraint_geodesics.constraints.constraint import ConstraintManifold, constraint_manifold
from constraint_geodesics.geometry.braking import Pace
from constraint_geodesics.learning.dataset import Queries, draw_queries
from constraint_geodesics.learning.lift import densify
from constraint_geodesics.params import ExecutionParams, Params
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.cup import CupSettings
from constraint_geodesics.studies.execution import (
    COLUMNS,
    EXECUTED,
    PLANNED,
    ROW_SPACING_RAD,
    STRAIGHT,
    Carrying,
    Executed,
    ExecutionCheckError,
    TippingQueries,
    execute_queries,
    execution_figures,
    line_tilts,
    tipping_queries,
)

LEVEL = "level_cup"
SEED, LEAST, ACCELERATION = 13, 2.0, 10.0
CUP = CupSettings(spheres=3, settle_s=0.25)


def wanted(queries: int, least_tilt_rad: float) -> ExecutionParams:
    return ExecutionParams.model_construct(
        queries=queries, least_tilt_rad=least_tilt_rad, seed=SEED, spheres=3, recorded=1
    )


@pytest.fixture(scope="module")
def manifold(scene: Scene, params: Params) -> ConstraintManifold:
    return constraint_manifold(scene.robot, params.constraints[LEVEL])


@pytest.fixture(scope="module")
def planner() -> Iterator[Planner]:
    with Planner(read_bundle(PACKAGED), "the package") as planner:
        yield planner


@pytest.fixture(scope="module")
def found(scene: Scene, manifold: ConstraintManifold) -> TippingQueries:
    return tipping_queries(scene, manifold, LEVEL, wanted(3, LEAST))


Results = tuple[pd.DataFrame, list[Executed]]


def run(planner: Planner, scene: Scene, manifold: ConstraintManifold, queries: Queries) -> Results:
    plan = partial(planner.plan, constraint=LEVEL)
    return execute_queries(plan, Carrying(LEVEL, scene, manifold, ACCELERATION, CUP), queries)


@pytest.fixture(scope="module")
def checked(
    planner: Planner, scene: Scene, manifold: ConstraintManifold, found: TippingQueries
) -> Results:
    return run(planner, scene, manifold, Queries(found.queries.starts[:1], found.queries.goals[:1]))


def residual_tilts(manifold: ConstraintManifold, queries: Queries) -> np.ndarray:
    """The tilt as the constraint measures it, on rows of their own."""
    lines = [
        densify(np.stack(ends), 0.005) for ends in zip(queries.starts, queries.goals, strict=True)
    ]
    return np.array(
        [np.linalg.norm(manifold.residual(line)[:, 3:5], axis=1).max() for line in lines]
    )


def test_queries_are_the_first_whose_line_tips_the_cup(
    scene: Scene, manifold: ConstraintManifold, found: TippingQueries
) -> None:
    pairs = draw_queries(scene, manifold, LEVEL, 24, SEED)
    tilts = residual_tilts(manifold, pairs)
    kept = np.flatnonzero(tilts >= LEAST)[:3]
    np.testing.assert_array_equal(found.queries.starts, pairs.starts[kept])
    np.testing.assert_array_equal(found.queries.goals, pairs.goals[kept])
    np.testing.assert_allclose(found.tilt_rad, tilts[kept], atol=2e-3)
    assert found.drawn == kept[-1] + 1


def test_more_pairs_are_drawn_while_too_few_tip_the_cup(
    scene: Scene, manifold: ConstraintManifold
) -> None:
    rare = tipping_queries(scene, manifold, LEVEL, wanted(1, 3.1))
    assert rare.drawn > 8
    assert len(rare.queries) == 1
    assert line_tilts(manifold, rare.queries) == rare.tilt_rad >= 3.1


def test_the_planned_path_keeps_the_spheres_and_the_straight_line_loses_them(
    checked: Results, found: TippingQueries
) -> None:
    table, executed = checked
    assert list(table.columns) == list(COLUMNS)
    assert table["kind"].tolist() == [one.kind for one in executed] == [PLANNED, STRAIGHT]
    assert (table["status"] == EXECUTED).all()
    assert table["kept"].tolist() == [3, 0]
    assert table["kept_share"].tolist() == [1.0, 0.0]
    assert table["largest_tilt_rad"][0] < 1e-3
    assert table["largest_tilt_rad"][1] == pytest.approx(found.tilt_rad[0], abs=1e-2)
    assert (table["largest_tracking_error_rad"] < 1e-3).all()
    assert not table["collision"].any()


def test_both_are_executed_at_their_own_times(
    planner: Planner, scene: Scene, checked: Results, found: TippingQueries
) -> None:
    table, executed = checked
    start, goal = found.queries.starts[0], found.queries.goals[0]
    path = planner.plan(start, goal, LEVEL)
    line = densify(np.stack([start, goal]), ROW_SPACING_RAD)
    times = Pace(scene.robot.velocity, np.full(6, ACCELERATION)).times(line, None)
    assert table["duration_s"].tolist() == pytest.approx([path.times[-1], times[-1]])
    assert table["length_rad"].tolist() == pytest.approx(
        [path.length_rad, np.linalg.norm(goal - start)]
    )
    for one in executed:
        assert one.execution is not None
        np.testing.assert_allclose(one.execution.joints[[0, -1]], [start, goal], atol=1e-3)


def test_without_a_path_the_row_stays_and_the_line_is_judged(
    planner: Planner, scene: Scene, manifold: ConstraintManifold, found: TippingQueries
) -> None:
    start = found.queries.starts[0]
    with scene.world() as world:
        drawn = scene.robot.sample(100, np.random.default_rng(0))
        goal = drawn[~world.free(drawn)][:1]
    table, executed = run(planner, scene, manifold, Queries(start[None], goal))
    assert table["status"].tolist() == ["goal_violates", EXECUTED]
    assert executed[0].execution is None
    assert (
        table.loc[0, ["kept", "spheres", "kept_share", "duration_s", "length_rad", "collision"]]
        .isna()
        .all()
    )
    assert table["collision"][1]


def test_constraints_that_let_the_cup_tip_are_refused(
    planner: Planner, scene: Scene, params: Params
) -> None:
    free = constraint_manifold(scene.robot, params.constraints["free"])
    with pytest.raises(ExecutionCheckError, match="no constraint: must hold roll and pitch"):
        run(planner, scene, free, Queries(np.zeros((1, 6)), np.ones((1, 6))))


@pytest.mark.parametrize("least", [0.0, np.pi, float("nan")])
def test_a_tilt_that_means_nothing_is_named(
    scene: Scene, manifold: ConstraintManifold, least: float
) -> None:
    with pytest.raises(
        ExecutionCheckError, match=f"least_tilt_rad = {least}: must lie between 0 and π"
    ):
        tipping_queries(scene, manifold, LEVEL, wanted(1, least))


def test_too_few_lines_that_tip_the_cup_are_named(
    scene: Scene, manifold: ConstraintManifold
) -> None:
    with pytest.raises(
        ExecutionCheckError, match=r"0 of 256 straight lines under 'level_cup' .* 1 are needed"
    ):
        tipping_queries(scene, manifold, LEVEL, wanted(1, 3.14159))


def test_figures_of_a_table_made_by_hand() -> None:
    rows = [
        (0, PLANNED, EXECUTED, 4, 4, 1.0, 0.01, 1e-4, 2.0, 7.0, False),
        (0, STRAIGHT, EXECUTED, 0, 4, 0.0, 3.0, 1e-5, 1.0, 5.0, False),
        (1, PLANNED, "not_connected"),
        (1, STRAIGHT, EXECUTED, 1, 4, 0.25, 2.5, 2e-5, 2.0, 6.0, True),
        (2, PLANNED, EXECUTED, 3, 4, 0.75, 0.03, 2e-4, 3.0, 8.0, False),
        (2, STRAIGHT, EXECUTED, 4, 4, 1.0, 2.1, 3e-5, 3.0, 7.0, False),
    ]
    table = pd.DataFrame(
        [dict(zip(COLUMNS, row, strict=False)) for row in rows], columns=list(COLUMNS)
    )
    ends = np.zeros((3, 6))
    found = TippingQueries(Queries(ends, ends + 1.0), np.array([2.2, 2.0, 3.0]), 11)
    figures = execution_figures(table.astype(COLUMNS), found)
    assert (figures["queries"], figures["drawn"], figures["smallest_line_tilt_rad"]) == (3, 11, 2.0)
    assert figures[PLANNED] == {
        "executed": 2,
        "kept_share_mean": 0.875,
        "kept_share_worst": 0.75,
        "spilled": 1,
        "emptied": 0,
        "collisions": 0,
        "largest_tilt_rad": 0.03,
        "largest_tracking_error_rad": 2e-4,
        "duration_mean_s": 2.5,
    }
    assert figures[STRAIGHT] == {
        "executed": 3,
        "kept_share_mean": pytest.approx(1.25 / 3),
        "kept_share_worst": 0.0,
        "spilled": 2,
        "emptied": 1,
        "collisions": 1,
        "largest_tilt_rad": 3.0,
        "largest_tracking_error_rad": 3e-5,
        "duration_mean_s": 2.0,
    }
