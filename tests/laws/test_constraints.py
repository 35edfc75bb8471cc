"""What every constraint must satisfy, over all kinds, all held axes and both robots."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from constraint_geodesics.certification.certificate import Limits
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.both import Both
from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintError,
    ConstraintManifold,
    Pose,
    constraint_from,
    constraint_from_json,
)
from constraint_geodesics.constraints.functions import FunctionsConstraint, RowBound, made_by
from constraint_geodesics.constraints.kernels import curvature, linearise, new_look
from constraint_geodesics.constraints.polynomial import PolynomialConstraint, Relation
from constraint_geodesics.constraints.projection import Retraction, retract
from constraint_geodesics.constraints.spline import Spline, SplineConstraint, SplineRelation, Term
from constraint_geodesics.params import FunctionsConstraintParams
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search.band import PROJECTION

AXES = [
    (0, 0, 0, 0, 0, 0),
    (0, 0, 0, 1, 1, 0),
    (0, 0, 0, 0, 1, 1),
    (0, 0, 0, 1, 0, 1),
    (0, 0, 0, 1, 1, 1),
    (0, 0, 0, 0, 0, 1),
    (0, 0, 1, 1, 1, 0),
    (1, 1, 1, 0, 0, 0),
    (0, 1, 0, 1, 0, 0),
]
REFERENCE = Pose.from_rpy([0.35, 0.1, 0.3], [np.pi / 2, 0.1, 0.4])


@pytest.fixture(scope="module", params=["xarm", "kuka"])
def robot(request: pytest.FixtureRequest):
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("axes", AXES)
def test_the_jacobian_is_the_residuals_derivative(robot, axes) -> None:
    manifold = ConstraintManifold(robot, Constraint(axes, reference=REFERENCE))
    q = robot.sample(40, np.random.default_rng(0))
    # close to a half turn away the derivative grows without bound, and finite differences say
    # nothing
    q = q[np.linalg.norm(manifold.residual(q)[:, 3:], axis=-1) < 2.8]
    assert len(q) > 10
    jacobian, step = manifold.jacobian(q), 1e-6
    for joint in range(robot.dof):
        shift = step * np.eye(robot.dof)[joint]
        difference = (manifold.residual(q + shift) - manifold.residual(q - shift)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., joint], difference, atol=1e-6)


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_retraction_ends_on_the_manifold_and_leaves_its_points_alone(robot, axes, share) -> None:
    tolerance = tuple(share * 0.1 * held for held in axes)
    manifold = ConstraintManifold(robot, Constraint(axes, tolerance, REFERENCE))
    result = retract(manifold, robot.sample(200, np.random.default_rng(1)))
    assert result.converged.mean() > 0.95
    on = result.joints[result.converged]
    assert manifold.violation(on).max() <= 1e-9
    np.testing.assert_array_equal(retract(manifold, on, Retraction(accuracy=1e-8)).joints, on)


def test_retraction_is_first_order(xarm) -> None:
    """Tangent steps stay to second order: halving the step divides the retraction's correction by
    four.
    """
    manifold = ConstraintManifold(xarm, Constraint((0, 0, 0, 1, 1, 0), reference=REFERENCE))
    result = retract(manifold, xarm.sample(50, np.random.default_rng(2)))
    q = result.joints[result.converged]
    jacobian = manifold.jacobian(q)[:, 3:5]
    direction = np.random.default_rng(3).normal(size=q.shape)
    direction -= np.einsum(
        "bji,bj->bi",
        np.linalg.pinv(jacobian).transpose(0, 2, 1),
        np.einsum("bij,bj->bi", jacobian, direction),
    )
    sizes = []
    for step in (0.02, 0.01):
        moved = q + step * direction
        sizes.append(np.linalg.norm(retract(manifold, moved).joints - moved, axis=-1))
    assert 3.0 < np.median(sizes[0] / sizes[1]) < 5.0


@given(st.floats(0.0, np.pi - 0.05), st.floats(-np.pi, np.pi))
@settings(max_examples=30)
def test_a_tilt_is_measured_as_its_angle(xarm, tilt: float, heading: float) -> None:
    """Roll and pitch together give the angle of the tool axis, up to upside down, whatever the
    yaw.
    """
    q = np.array([0.3, -0.4, -0.6, 0.2, 0.5, 0.1])
    position, rotation = xarm.forward(q)
    axis = np.array([np.cos(heading), np.sin(heading), 0.0])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + np.sin(tilt) * cross + (1 - np.cos(tilt)) * cross @ cross
    reference = Pose(position, turn @ rotation)
    residual = ConstraintManifold(
        xarm, Constraint((0, 0, 0, 1, 1, 0), reference=reference)
    ).residual(q)
    # the axis that should be vertical is off by the tilt, wherever that tilt points
    np.testing.assert_allclose(np.linalg.norm(residual[3:5]), tilt, atol=1e-7)
    assert residual[5] == 0.0


SPHERE = "constraint_geodesics.constraints.functions:tip_on_sphere"
KINDS = [
    *("held axes", "cone", "two tolerances", "sphere", "thick sphere", "coupling"),
    *("relations", "loose relations", "surface", "loose surface", "turning", "both", "elbow"),
]


def coupled(q, out) -> None:
    out[0] = np.sin(q[1]) + 0.5 * q[2]
    out[1] = q[3] * q[4]


def coupled_slopes(q, out) -> None:
    out[:] = 0.0
    out[0, 1], out[0, 2] = np.cos(q[1]), 0.5
    out[1, 3], out[1, 4] = q[4], q[3]


# |sin″| ≤ 1; (q₃ q₄)″ = 2 d₃ d₄ ≤ |d|²
COUPLED = FunctionsConstraint(
    coupled, coupled_slopes, (RowBound("first", "rad", 1.0, 0.1), RowBound("second", "m", 1.0))
)


def sphere(robot, tolerance: float = 0.0) -> FunctionsConstraint:
    arguments = {"centre_m": [0.35, 0.0, 0.2], "radius_m": 0.25, "tolerance_m": tolerance}
    return made_by(SPHERE, arguments, robot)


def relations(tolerance: float = 0.0) -> PolynomialConstraint:
    """The tip on a quadric, the tool's z axis towards a point of it, its y axis level."""
    full, towards, level = np.zeros((12, 12)), np.zeros(12), np.zeros(12)
    full[:3, :3], full[0, 9], full[9, 0] = np.diag([2.0, 3.0, 4.0]), 0.1, 0.1
    towards[0], towards[9], level[8] = 1.0, 0.25, 1.0
    return PolynomialConstraint(
        (
            Relation("quadric", "m", -0.25, np.linspace(-0.2, 0.2, 12), full, tolerance),
            Relation("towards", "m", -0.35, towards, None, tolerance),
            Relation("level", "rad", 0.0, level, None, tolerance),
        )
    )


def elbow() -> Relation:
    """The origin of a joint on a sphere."""
    full = np.zeros((12, 12))
    full[:3, :3] = np.eye(3) / 0.4
    linear = np.append(-np.array([0.1, 0.1, 0.5]) / 0.4, np.zeros(9))
    return Relation("on a sphere", "m", 0.27 / 0.8 - 0.2, linear, full, 0.02)


def surface(tolerance: float = 0.0, normal: bool = True) -> SplineConstraint:
    """The tip on a freeform surface, and a tool axis along its normal or loosely turned."""
    rng = np.random.default_rng(4)
    frame, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    lower, spacing = np.full(3, -2.0), np.full(3, 0.4)
    # twice as coarse as the tests' steps would be needed to see every wave of it
    height = Spline(
        frame, np.zeros(3), lower, spacing, (5, 5, 0), 0.05 * rng.normal(size=(15, 15, 1))
    )
    turn = Spline(
        np.eye(3), np.zeros(3), lower, spacing, (3, 3, 3), 0.2 * rng.normal(size=(13,) * 3)
    )
    up, nothing = np.concatenate([frame[2], np.zeros(9)]), np.zeros(12)
    axis = [np.concatenate([np.zeros(9), row]) for row in frame]
    rows = [SplineRelation("height", "m", -0.3, up, Term(height, -1, -1.0, nothing), tolerance)]
    rows += [
        SplineRelation("normal", "rad", 0.0, axis[k], Term(height, k, 0.0, axis[2]), tolerance)
        for k in range(2)
    ]
    level = np.eye(12)[8]
    rows.append(SplineRelation("turn", "rad", 0.0, level, Term(turn, -1, 1.0, nothing), 0.3))
    rows.append(SplineRelation("side", "rad", 1.0, -axis[2], None, 2.1))
    own = rows[:3] + rows[4:] if normal else [rows[0], rows[3]]
    return SplineConstraint(tuple(own), (1e-3,) * len(own))


def of_kind(name: str, robot) -> Constraint:
    return {
        "held axes": Constraint((0, 0, 1, 1, 1, 0), reference=REFERENCE),
        "cone": Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, 0.2, 0.2, 0), REFERENCE),
        "two tolerances": Constraint((0, 1, 0, 1, 0, 1), (0, 0.1, 0, 0.2, 0, 0.1), REFERENCE),
        "sphere": sphere(robot),
        "thick sphere": sphere(robot, 0.05),
        "coupling": COUPLED,
        "relations": relations(),
        "loose relations": relations(0.05),
        "surface": surface(),
        "loose surface": surface(0.05),
        "elbow": PolynomialConstraint((elbow(),), joint=3),
        "turning": surface(normal=False),
        "both": Both(PolynomialConstraint(relations().relations[2:]), surface(0.0, normal=False)),
    }[name]


@pytest.fixture(scope="module", params=KINDS)
def manifold(request: pytest.FixtureRequest, robot) -> ConstraintManifold:
    return ConstraintManifold(robot, of_kind(request.param, robot))


def test_shapes_units_and_words(manifold) -> None:
    constraint, robot = manifold.constraint, manifold.robot
    count = len(constraint.rows.held)
    q = robot.sample(6, np.random.default_rng(0)).reshape(2, 3, -1)
    residual, jacobian = manifold.linearise(q)
    assert residual.shape == (2, 3, count)
    assert jacobian.shape == (2, 3, count, robot.dof)
    assert len(constraint.units) == count
    assert set(constraint.units) <= {"m", "rad"}
    assert constraint.codim == len(constraint.rows.exact)
    assert isinstance(constraint, Constraint)
    assert not constraint.is_free
    assert constraint.is_placed
    assert constraint.context.shape == (12,)
    assert "constraint on" in constraint.label
    drawn = constraint.series(residual.reshape(-1, count))
    assert all(line.values.shape == (6,) and (line.values >= 0).all() for line in drawn)


def test_the_slopes_are_the_residuals_of_every_kind(manifold) -> None:
    q, step = manifold.robot.sample(40, np.random.default_rng(0)), 1e-6
    q = q[np.abs(manifold.residual(q)).max(axis=-1) < 2.0]
    assert len(q) >= 10
    jacobian = manifold.jacobian(q)
    for joint in range(manifold.robot.dof):
        shift = step * np.eye(manifold.robot.dof)[joint]
        difference = (manifold.residual(q + shift) - manifold.residual(q - shift)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., joint], difference, atol=1e-6)


def test_projection_ends_where_nothing_is_violated(manifold) -> None:
    rows = manifold.constraint.rows
    result = retract(manifold, manifold.robot.sample(200, np.random.default_rng(1)))
    assert result.converged.mean() > 0.9
    on = result.joints[result.converged]
    residual, violation = manifold.residual(on), manifold.violation(on)
    assert violation.max() <= 1e-9
    np.testing.assert_array_equal(violation == 0.0, (manifold.inclusion(on) == 0.0).all(axis=1))
    np.testing.assert_allclose(residual[:, rows.exact], 0.0, atol=1e-9)
    for group in rows.loose_groups:
        size = np.linalg.norm(residual[:, group], axis=1)
        assert size.max() <= rows.tolerance[group[0]] + 1e-9
    np.testing.assert_array_equal(retract(manifold, on, Retraction(accuracy=1e-8)).joints, on)


def test_many_configurations_are_projected_each_as_if_it_were_alone(manifold) -> None:
    q = manifold.robot.sample(70, np.random.default_rng(6))
    settings = Retraction(iterations=12, last_step=1e-5)
    together, shares = retract(manifold, q, settings), np.linspace(0.2, 1.0, len(q))
    narrow = retract(manifold, q, settings, shares)
    residual, jacobian = manifold.linearise(q)
    for n in range(len(q)):
        alone = retract(manifold, q[n], settings)
        np.testing.assert_array_equal(alone.joints, together.joints[n])
        assert alone.violation == together.violation[n]
        np.testing.assert_array_equal(
            retract(manifold, q[n], settings, shares[n]).joints, narrow.joints[n]
        )
        np.testing.assert_array_equal(manifold.residual(q[n]), residual[n])
        np.testing.assert_array_equal(manifold.jacobian(q[n]), jacobian[n])


@pytest.mark.parametrize("size", [1e-7, 1e-5, 1e-3])
def test_a_last_step_that_is_not_measured_leaves_no_more_than_it_says(manifold, size) -> None:
    rng = np.random.default_rng(7)
    on = retract(manifold, manifold.robot.sample(200, rng))
    beside = on.joints[on.converged] + size * rng.normal(size=on.joints[on.converged].shape)
    for asked in (Retraction(last_step=1e-5), PROJECTION):
        found = retract(manifold, beside, asked)
        assert found.converged.mean() > 0.97
        # about the square of the last step, times half a second derivative
        measured = manifold.violation(found.joints)[found.converged]
        assert (measured <= 10.0 * found.violation[found.converged] + 1e-12).all()


def untouched(q, out) -> None:
    out[0] = 1e-6


def no_slope(q, out) -> None:
    out[:] = 0.0


def test_a_row_that_no_joint_moves_is_not_said_to_be_kept(xarm) -> None:
    assert not retract(
        ConstraintManifold(xarm, Constraint((0, 0, 0, 1, 1, 0), reference=REFERENCE)),
        np.full((2, 6), np.nan),
    ).converged.any()
    stuck = FunctionsConstraint(untouched, no_slope, (RowBound("stuck", "rad", 0.0),))
    found = retract(ConstraintManifold(xarm, stuck), np.zeros((3, 6)), Retraction(last_step=1e-5))
    np.testing.assert_allclose(found.violation, 1e-6)
    assert not found.converged.any()


@njit
def closed_form(arrays, weights, q, which):
    looked = new_look(arrays.constraint, q.shape[1])
    full = np.zeros((q.shape[1], q.shape[1]))
    linearise(arrays, q, looked)
    return curvature(arrays, weights, looked, which, full), full


def test_the_closed_curvature_is_that_of_finite_differences(manifold, request) -> None:
    """Where a kind knows Σ λ ∇²r in closed form: on the constraint, along its tangent space."""
    rng, step, rows = np.random.default_rng(5), 1e-5, manifold.constraint.rows
    result = retract(manifold, manifold.robot.sample(20, rng))
    on, judged = result.joints[result.converged], 0
    for which, q in enumerate(on):
        weights = rng.normal(size=len(rows.held)) * rows.held
        known, full = closed_form(manifold.arrays, weights, on, which)
        if not known:
            continue
        judged += 1
        slopes = manifold.jacobian(q)
        basis = np.linalg.svd(slopes)[2][np.linalg.matrix_rank(slopes, 1e-6) :].T
        moved = [
            (manifold.jacobian(q + step * b) - manifold.jacobian(q - step * b)).T @ weights
            for b in basis.T
        ]
        expected = np.array(moved) @ basis / (2.0 * step)
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(
            basis.T @ full @ basis, 0.5 * (expected + expected.T), atol=1e-4 * scale
        )
    closed = request.node.callspec.params["manifold"] == "held axes"
    assert judged == closed * len(on)
    assert len(on) >= 10


@pytest.fixture(scope="module")
def certifier(kuka_scene: Scene):
    with Certifier(kuka_scene, Limits(max_step_rad=1.0)) as own:
        yield own


@pytest.fixture(scope="module", params=KINDS)
def held(request: pytest.FixtureRequest, kuka_scene: Scene) -> tuple[str, ConstraintManifold]:
    """Made once: functions are compiled."""
    robot = kuka_scene.robot
    return request.param, ConstraintManifold(robot, of_kind(request.param, robot))


@settings(max_examples=25)
@given(seed=st.integers(0, 2**31 - 1), step=st.floats(0.001, 0.3))
def test_the_bound_between_waypoints_holds_at_every_sample(certifier, held, seed, step) -> None:
    (kind, manifold), rng = held, np.random.default_rng(seed)
    robot = manifold.robot
    first = robot.sample(1, rng)[0]
    steps = rng.normal(size=(3, robot.dof))
    steps *= step / np.linalg.norm(steps, axis=1, keepdims=True)
    path = np.concatenate([first[None], first + np.cumsum(steps, axis=0)])
    found = certifier.certify(path, manifold.constraint, collisions=False)
    t = np.linspace(0.0, 1.0, 50)[:, None, None]
    between = (path[:-1] + t * (path[1:] - path[:-1])).reshape(-1, robot.dof)
    sampled = manifold.violation(between).max()
    assert found.violation_bound >= sampled - 1e-11
    assert found.max_violation <= found.violation_bound + 1e-11
    # The bound is sharp enough to be of use.  Angles that have a tolerance each are bounded one by
    # one, and by π alone where the tool is turned by nearly a half turn.
    sharp = sampled + 0.05 * max(sampled, 1e-4) + 2e-4
    turned = np.linalg.norm(manifold.residual(between)[:, 3:], axis=1).max()
    if kind == "two tolerances" and turned > 2.9:
        sharp = max(sharp, np.pi)
    assert found.violation_bound <= sharp


def test_a_sphere_s_bound_holds_the_second_derivative(robot) -> None:
    constraint, rng, h = sphere(robot), np.random.default_rng(7), 1e-4
    q, d = robot.sample(500, rng), rng.normal(size=(500, robot.dof))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    values = [constraint.values(q + k * h * d)[:, 0] for k in (-1, 0, 1)]
    second = np.abs(values[0] - 2.0 * values[1] + values[2]) / h**2
    bound = constraint.bounds[0].second_derivative
    assert second.max() <= bound
    assert second.max() > 0.02 * bound


def test_json_pickle_and_key_keep_a_constraint(manifold) -> None:
    constraint, robot = manifold.constraint, manifold.robot
    again = pickle.loads(pickle.dumps(constraint))
    assert again.key == constraint.key
    hash(constraint.key)
    if constraint is COUPLED:
        with pytest.raises(ConstraintError, match="was not made by a factory"):
            constraint.to_json()
        return
    read = constraint_from_json(json.loads(json.dumps(constraint.to_json())), robot)
    assert read.key == constraint.key
    q = robot.sample(5, np.random.default_rng(3))
    np.testing.assert_array_equal(ConstraintManifold(robot, read).residual(q), manifold.residual(q))


def test_looser_is_another_constraint(manifold) -> None:
    loose = manifold.constraint.loosened({"m": 0.3, "rad": 0.3})
    assert loose.key != manifold.constraint.key
    held = loose.rows.held
    assert (loose.rows.tolerance[held] >= manifold.constraint.rows.tolerance[held]).all()
    assert (loose.rows.tolerance[held] >= 0.3).all()


def test_only_marked_factories_are_called(kuka) -> None:
    for factory in ("os:system", "nowhere.at_all:thing", "json:dumps", "no_colon"):
        with pytest.raises(ConstraintError, match="factory"):
            made_by(factory, {}, kuka)
    with pytest.raises(ConstraintError, match="unexpected"):
        made_by(SPHERE, {"centre": 1}, kuka)
    with pytest.raises(ConstraintError, match="radius_m"):
        made_by(SPHERE, {"centre_m": [0, 0, 0], "radius_m": -1.0}, kuka)
    with pytest.raises(ConstraintError, match="no such kind"):
        constraint_from_json({"kind": "kernels"}, kuka)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ((), "one is needed"),
        ((RowBound("", "m", 0.0),), "a name"),
        ((RowBound("x", "mm", 0.0),), "m or rad"),
        ((RowBound("x", "m", -1.0),), "second_derivative"),
        ((RowBound("x", "m", 0.0, float("nan")),), "tolerance"),
    ],
)
def test_a_row_that_makes_no_sense_is_refused(bounds, words) -> None:
    with pytest.raises(ConstraintError, match=words):
        FunctionsConstraint(coupled, coupled_slopes, bounds)


def test_params_name_a_factory(kuka) -> None:
    entry = FunctionsConstraintParams(
        kind="functions",
        description="wiping a bowl",
        factory=SPHERE,
        arguments={"centre_m": [0.35, 0.0, 0.2], "radius_m": 0.25, "tolerance_m": 0.0},
    )
    assert constraint_from(entry, kuka).key == sphere(kuka).key


FILES = {
    "Pose": {"params.py", "constraints/constraint.py", "constraints/pose.py"},
    "Functions": {
        "params.py",
        "constraints/functions.py",
        "kernel_jobs.py",
        "studies/hidden_tasks.py",
    },
    "Polynomial": {
        "constraints/polynomial.py",
        *(f"identification/{name}.py" for name in ("bounds", "forms", "identify", "vanishing")),
        "studies/hidden_tasks.py",
    },
    "Spline": {
        "constraints/spline.py",
        *(f"identification/{name}.py" for name in ("freeform", "identify", "kernels")),
        *(f"identification/{name}.py" for name in ("support", "vanishing")),
        "studies/demonstrations.py",
        "report/demonstrations_figure.py",
    },
}
"""Where the class of a kind, its arrays and its record may be named; the warm-up compiles what
calls functions.
"""


@pytest.mark.parametrize("kind", FILES)
def test_a_kind_is_named_in_its_own_files_alone(kind) -> None:
    package = Path(__file__).parents[2] / "src" / "constraint_geodesics"
    words = [f"{kind}Constraint", f"{kind.removesuffix('s')}Arrays", f"constraints.{kind.lower()} "]
    named = {
        str(file.relative_to(package))
        for file in package.rglob("*.py")
        if any(word in file.read_text() for word in words)
    }
    assert named <= FILES[kind] | {f"certification/{kind.lower()}.py"}


def test_another_process_gets_no_address(manifold) -> None:
    assert manifold.arrays.constraint.linearise
    assert set(vars(pickle.loads(pickle.dumps(manifold)))) == {"robot", "constraint"}
