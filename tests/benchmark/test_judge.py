"""The judge on real paths of the real robot: one case for every rule, and lengths that are
known.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from constraint_geodesics.benchmark.judge import (
    densify,
    judge_limits,
    measure_path,
    polyline_length,
)
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.constraint import constraint_manifold
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.vae import JointVae
from constraint_geodesics.params import load_params
from constraint_geodesics.scene.scene import Scene

PARAMS = load_params(Path(__file__).parents[2] / "params.yaml")
STEPS = np.linspace(0.0, 1.0, 21)[:, None]
paths = arrays(float, st.tuples(st.integers(2, 6), st.just(3)), elements=st.floats(-3, 3, width=32))


@pytest.fixture(scope="module")
def scene():
    return Scene.from_params(PARAMS)


@pytest.fixture(scope="module")
def cup(scene):
    return constraint_manifold(scene.robot, PARAMS.constraints["level_cup"])


@pytest.fixture(scope="module")
def world(scene):
    with scene.world() as world:
        yield world


@pytest.fixture(scope="module")
def start(scene, cup, world):
    """A level cup, free of collision however the base turns, and far from every limit."""
    found = retract(cup, scene.robot.sample(200, np.random.default_rng(0)))
    good = found.joints[found.converged & (scene.robot.limit_distance(found.joints) > 0.1)]
    for q in good:
        q[0] = 0.0
        if world.free(around(q)).all():
            return q
    raise AssertionError("no start found")


def around(q, angle=1.0):
    """The base turns by `angle`: the cup stays level, and the joint length is known."""
    return q + angle * STEPS * np.eye(6)[0]


@pytest.fixture(scope="module")
def identity_chart(scene):
    """A manifold whose latent point is the configuration itself and whose deviation is constant."""
    robot = scene.robot
    vae = JointVae(robot.dof, robot.dof, (4,), 2)
    with torch.no_grad():
        for parameter in vae.parameters():
            parameter.zero_()
        vae.encoder.linear.weight[: robot.dof] = torch.eye(robot.dof)
        vae.decoder.linear.weight.copy_(torch.eye(robot.dof))
        vae.precision.spread.fill_(1e12)
        vae.precision.log_weights.fill_(-30.0)
    return LearnedManifold(vae.eval().requires_grad_(False))


@pytest.fixture(scope="module")
def certifier(scene):
    with Certifier(scene, judge_limits(PARAMS.judge)) as certifier:
        yield certifier


def judged(path, cup, certifier, charts=None, ends=None):
    first, last = (path[0], path[-1]) if ends is None else ends
    return measure_path(path, first, last, cup, charts or {}, certifier, PARAMS.judge.spacing_rad)


def test_a_level_turn_is_valid_and_its_lengths_are_known(
    scene, cup, certifier, start, identity_chart
):
    found = judged(around(start), cup, certifier, {"identity": identity_chart})
    assert (found.valid, found.reason) == (True, "")
    assert found.length_rad == pytest.approx(1.0)
    assert found.max_step_rad == pytest.approx(0.05)
    assert found.latent_length["identity"] == pytest.approx(1.0, rel=1e-5)
    radius = np.hypot(*scene.robot.forward(start)[0][:2])
    assert found.tool_length_m == pytest.approx(radius, rel=1e-3)
    assert found.max_violation_rad < 1e-8
    assert found.max_violation_m == 0.0


def test_the_row_has_one_latent_length_a_manifold(cup, certifier, start, identity_chart):
    charts = {"one": identity_chart, "two": identity_chart}
    row = judged(around(start), cup, certifier, charts).row()
    assert row["latent_length_one"] == row["latent_length_two"]
    assert "latent_length" not in row
    nothing = judged(np.zeros((0, 6)), cup, certifier, charts, (start, start))
    assert set(row) == set(nothing.row())


def test_no_path_and_no_numbers_are_failures_that_have_no_length(
    cup, certifier, start, identity_chart
):
    nothing = judged(np.zeros((0, 6)), cup, certifier, {"identity": identity_chart}, (start, start))
    broken = around(start)
    broken[3, 2] = np.inf
    infinite = judged(broken, cup, certifier, {"identity": identity_chart}, (start, start))
    for found, reason in ((nothing, "no path"), (infinite, "not finite")):
        assert (found.valid, found.reason) == (False, reason)
        lengths = [found.length_rad, found.tool_length_m, *found.latent_length.values()]
        assert np.isnan([*lengths, found.max_violation_rad]).all()


def test_every_rule_refuses_what_it_is_for(scene, cup, certifier, start):
    level = around(start)
    ends = (level[0], level[-1])
    assert judged(level[1:], cup, certifier, ends=ends).reason == "start missed"
    assert judged(level, cup, certifier, ends=(ends[0], ends[1] + 2e-6)).reason == "goal missed"
    assert judged(level[::3], cup, certifier, ends=(level[0], level[::3][-1])).reason == "step"
    upper = scene.robot.upper[0]
    beyond = start + (upper - 0.5) * np.eye(6)[0] + STEPS * np.eye(6)[0]
    assert judged(beyond, cup, certifier).reason == "joint limits"
    # the shoulder turns about a horizontal axis: all of it is tilt
    tilted = start + 0.3 * STEPS * np.eye(6)[1]
    found = judged(tilted, cup, certifier)
    assert found.reason == "constraint"
    assert found.max_violation_rad == pytest.approx(0.3, abs=1e-6)
    assert found.length_rad == pytest.approx(0.3)


def test_a_path_into_the_table_collides(scene, world, certifier):
    free = constraint_manifold(scene.robot, PARAMS.constraints["free"])
    poses = scene.robot.sample(200, np.random.default_rng(1))
    poses = poses[scene.robot.limit_distance(poses) > 0.1]
    touching = poses[~world.free(poses)][0]
    path = touching + 0.01 * STEPS * np.eye(6)[5]
    assert judged(path, free, certifier).reason in ("self collision", "workcell collision")


def test_violation_between_two_points_is_seen(cup, certifier, start):
    # both ends level, the straight joint line between them far from it: it counts although no given
    # point shows it
    other = start.copy()
    other[[3, 5]] += [0.9, 0.9]
    other = retract(cup, other[None]).joints[0]
    found = judged(np.stack([start, other]), cup, certifier)
    assert cup.violation(np.stack([start, other])).max() < 1e-8
    assert found.max_violation_rad > 0.01


def test_the_angle_of_a_cone_is_measured_as_a_whole(scene, cup, certifier):
    relaxed = constraint_manifold(scene.robot, PARAMS.constraints["level_cup_relaxed"])
    q = scene.robot.sample(50, np.random.default_rng(2))
    tilt = np.linalg.norm(cup.residual(q)[:, 3:], axis=-1)
    tolerance = PARAMS.constraints["level_cup_relaxed"].tolerance[3]
    for k in range(len(q)):
        still = np.stack([q[k], q[k] + 1e-9])
        assert judged(still, cup, certifier).max_violation_rad == pytest.approx(tilt[k], abs=1e-6)
        excess = pytest.approx(max(tilt[k] - tolerance, 0.0), abs=1e-6)
        assert judged(still, relaxed, certifier).max_violation_rad == excess
    free = constraint_manifold(scene.robot, PARAMS.constraints["free"])
    assert judged(q[:2], free, certifier).max_violation_rad == 0.0


@given(paths, st.floats(0.05, 2.0))
def test_densified_paths_keep_their_points_and_length_and_the_spacing(path, spacing):
    dense = densify(path, spacing)
    assert np.linalg.norm(np.diff(dense, axis=0), axis=-1).max() <= spacing * (1 + 1e-9)
    assert polyline_length(dense) == pytest.approx(polyline_length(path), abs=1e-9)
    for point in path:
        assert np.abs(dense - point).max(axis=-1).min() == 0.0


def test_polyline_length():
    assert polyline_length(np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 4.0], [3.0, 5.0]])) == 6.0
    assert polyline_length(np.zeros((1, 2))) == 0.0
