"""The comparison of learners: exact figures where nothing is learned, and the same rows for all."""

import json

import numpy as np
import pandas as pd
import pytest

from constraint_geodesics.learning.learned_manifold import JointManifold
from constraint_geodesics.robot.kinematics import rotation_about
from constraint_geodesics.studies.manifolds import (
    LEARNERS,
    UNIFORM,
    LearnerTask,
    angles_between,
    measure,
    projection_figures,
    reproduction_figures,
    sample_figures,
    summary,
    table_of,
    tasks_of,
)


@pytest.fixture(scope="module")
def tasks(params, trained, tmp_path_factory) -> list[LearnerTask]:
    own = params.compare_manifolds
    fewer = {"seeds": (0, 1), "held_out": 200, "samples": 300, "checked": 60, "pairs": 3}
    gplvm = own.gplvm.model_copy(update={"inducing": 12, "steps": 10, "batch_size": 32})
    gan = own.gan.model_copy(update={"steps": 4, "batch_size": 32, "encoder_steps": 4})
    small = own.model_copy(update={**fewer, "gplvm": gplvm, "gan": gan})
    vae = params.manifolds["planner"].model_copy(
        update={"epochs": 1, "variance_epochs": 1, "variance_centres": 16}
    )
    changed = params.model_copy(
        update={"compare_manifolds": small, "manifolds": params.manifolds | {"planner": vae}}
    )
    return tasks_of(changed, trained.joints, tmp_path_factory.mktemp("vae"))


def test_every_learner_sees_the_same_rows_and_none_that_it_is_asked_about(tasks, params) -> None:
    assert [(own.learner, own.seed) for own in tasks] == [(k, s) for k in LEARNERS for s in (0, 1)]
    assert set(tasks[0].constraints) == set(params.all_constraints) - {"free"}
    for own in tasks:
        np.testing.assert_array_equal(own.rows, tasks[0].rows)
        np.testing.assert_array_equal(own.held_out, tasks[0].held_out)
    rows, asked = ({tuple(q) for q in own} for own in (tasks[0].rows, tasks[0].held_out))
    assert not rows & asked
    assert len(asked) == 200


@pytest.mark.parametrize("learner", list(LEARNERS))
def test_every_learner_is_measured_alike(tasks, learner) -> None:
    rows = measure(next(own for own in tasks if own.learner == learner))
    assert json.loads(json.dumps(rows)) == rows, "as they are kept"
    table = pd.DataFrame(rows)
    assert set(table["constraint"]) == {"", *tasks[0].constraints}
    assert not table.duplicated(["constraint", "figure"]).any()
    assert np.isfinite(table["value"]).all()
    value = table.set_index(["constraint", "figure"])["value"]
    assert value["", "joint_error_mean_rad"] <= value["", "joint_error_p95_rad"]
    assert value["", "decoded_ratio_mean"] >= 1.0 - 1e-12
    for name in tasks[0].constraints:
        assert value[name, "usable_after"] <= value[name, "kept_after"] == 1.0
        assert value[name, "kept_before"] < 0.3


def test_where_nothing_is_learned_the_figures_are_exact(tasks) -> None:
    uniform = [own for own in tasks if own.learner == UNIFORM]
    table = pd.DataFrame(measure(uniform[0]))
    value = table[table["constraint"] == ""].set_index("figure")["value"]
    assert value["joint_error_p95_rad"] < 1e-12
    assert value["tool_error_p95_mm"] < 1e-9
    assert value["sample_inside"] == 1.0
    assert value["geodesic_ratio_mean"] == pytest.approx(1.0, abs=1e-6)
    assert value["decoded_ratio_mean"] == pytest.approx(1.0, abs=1e-6)


def test_a_seed_is_repeated_and_another_draws_others(tasks) -> None:
    first, other = (own for own in tasks if own.learner == UNIFORM)
    timed = ("train_cpu_s", "drawn_us", "projected_us", "geodesic_ms")

    def figures(task: LearnerTask) -> list[float]:
        return [row["value"] for row in measure(task) if row["figure"] not in timed]

    assert figures(first) == figures(first) != figures(other)


def test_the_angle_between_rotations_is_that_of_the_turn() -> None:
    axis, angles = np.array([0.6, 0.0, 0.8]), np.array([0.0, 1e-7, 0.3, 3.0, np.pi])
    first = rotation_about(np.array([1.0, 2.0, 3.0]), 0.7)
    second = np.array([first @ rotation_about(axis, angle) for angle in angles])
    np.testing.assert_allclose(angles_between(first, second), angles, rtol=1e-6, atol=1e-9)


def test_a_chart_that_is_off_is_off_by_that_much(xarm, trained) -> None:
    class Shifted(JointManifold):
        def decode(self, z):
            return super().decode(z) + np.array([0.01, 0, 0, 0, 0, 0])

    shifted = Shifted(JointManifold.of(trained.joints).vae)
    figures = reproduction_figures(shifted, xarm, trained.joints[:50])
    assert figures["joint_error_mean_rad"] == pytest.approx(0.01 / 6)
    # the first joint turns the whole arm about the base's z axis
    assert figures["orientation_error_median_deg"] == pytest.approx(np.degrees(0.01))
    position, _ = xarm.forward(trained.joints[:50])
    moved = 1e3 * 2 * np.sin(0.005) * np.linalg.norm(position[:, :2], axis=1)
    assert figures["tool_error_median_mm"] == pytest.approx(np.median(moved))


def test_samples_are_counted_by_what_can_be_used_of_them(scene, tasks, trained) -> None:
    inside = trained.joints[:20]
    outside = inside + 2 * (scene.robot.upper - scene.robot.lower)
    with scene.world() as world:
        both = np.concatenate([inside, outside])
        found = sample_figures(both, both, inside, scene.robot, world)
        assert (found["sample_inside"], found["sample_free"]) == (0.5, 0.5)
        assert found["coverage_p95_rad"] == 0.0
        constraint = tasks[0].constraints["level_cup_relaxed"]
        kept = projection_figures(constraint, inside, tasks[0].tolerance, world)
    assert kept["kept_after"] == 1.0
    assert kept["kept_before"] == (constraint.violation(inside) <= tasks[0].tolerance).mean()


def test_the_summary_is_the_mean_and_deviation_over_seeds() -> None:
    rows = [
        {"learner": learner, "seed": seed, "constraint": constraint, "figure": "f", "value": value}
        for constraint in ("", "level")
        for learner, value, seed in ((UNIFORM, 5.0, 0), ("VAE", 1.0, 0), ("VAE", 3.0, 1))
    ]
    table = table_of(rows)
    assert table["learner"].tolist() == ["VAE"] * 4 + [UNIFORM] * 2
    found = summary(table)
    assert found["learners"]["VAE"] == {"f": {"mean": 2.0, "deviation": 1.0}}
    assert found["constraints"]["level"][UNIFORM] == {"f": {"mean": 5.0, "deviation": 0.0}}
