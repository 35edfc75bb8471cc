"""Demonstrations of what has no formula: surfaces, axes that turn, an elbow, and regions."""

import numpy as np
import pytest

from constraint_geodesics import bundle
from constraint_geodesics.certification.certificate import CertificationError
from constraint_geodesics.certification.certifier import Certifier
from constraint_geodesics.constraints.both import Both
from constraint_geodesics.constraints.constraint import (
    ConstraintError,
    ConstraintManifold,
    constraint_from_json,
)
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.identification import identify, load_constraint
from constraint_geodesics.planner import Planner
from constraint_geodesics.studies.hidden_tasks import HOLE, HOLE_M, TASKS


def missed(task: str, found, scene) -> tuple[float, float]:
    """Medians of how far the identified set is from the hidden one near it, in degrees and mm."""
    own, robot = TASKS[task], scene.robot
    near = own.draw(scene, 200, 8)
    moved = near + np.random.default_rng(2).normal(scale=0.05, size=near.shape)
    on = retract(ConstraintManifold(robot, found.constraint), moved)
    assert on.converged.mean() > 0.95
    q = on.joints[on.converged]
    degrees, mm = own.missed(robot, q[own.shown(*robot.forward(q))])
    return float(np.median(degrees)), float(np.median(mm))


@pytest.fixture(scope="module")
def rows(scene) -> np.ndarray:
    return TASKS["wavy surface"].draw(scene, 2000, 1)


def test_a_surface_and_the_axis_along_its_normal(rows, scene) -> None:
    found = identify(rows, scene.robot)
    assert found.codim == 3, found.explanation
    assert "freeform surface, and the tool's" in found.explanation
    degrees, mm = missed("wavy surface", found, scene)
    assert degrees < 0.002
    assert mm < 0.002


def test_noise_and_wrong_rows_on_a_surface(rows, scene) -> None:
    rng = np.random.default_rng(3)
    noisy = rows + np.radians(0.5) * rng.normal(size=rows.shape)
    noisy[rng.choice(len(rows), 60, replace=False)] = scene.robot.sample(60, rng)
    found = identify(noisy, scene.robot)
    assert found.codim == 3, found.explanation
    assert 55 <= found.dropped <= 80
    assert found.noise_rad == pytest.approx(np.radians(0.5), rel=0.1)
    degrees, mm = missed("wavy surface", found, scene)
    assert degrees < 0.25
    assert mm < 0.9


def test_a_persons_error_on_a_surface(scene) -> None:
    shown = TASKS["wavy surface"].demonstrate(scene, 40, 0.3, 0)
    found = identify(shown, scene.robot)
    assert found.codim == 3, found.explanation
    degrees, mm = missed("wavy surface", found, scene)
    assert degrees < 0.4
    assert mm < 1.6


def test_two_demonstrations_do_not_make_a_surface(scene) -> None:
    shown = TASKS["wavy surface"].demonstrate(scene, 2, 0.0, 0)
    found = identify(shown, scene.robot)
    assert found.codim < 3
    assert "show more demonstrations" in found.missing


def test_paths_on_a_surface_are_certified_and_say_what_is_left_open(rows, scene, tmp_path) -> None:
    found = identify(rows, scene.robot)
    found.save(tmp_path / "waves.yaml", where_shown=True)
    loaded = load_constraint(tmp_path / "waves.yaml", scene.robot)
    assert isinstance(loaded, Both)
    assert loaded.key == found.supported.key
    degrees = mm = solved = 0.0
    with Planner.load(bundle.PACKAGED) as planner:
        first = rows[0]
        order = np.argsort(np.linalg.norm(rows - first, axis=1))
        for other in rows[order[20:200:30]]:
            ends = [planner.project(q, loaded).configuration for q in (first, other)]
            path = planner.plan(*ends, constraint=loaded)
            if path.status != "solved":
                assert path.status in ("not_found", "not_connected", "in_collision")
                continue
            solved += 1
            assert "which demonstrations left out miss by" in path.explanation
            off = TASKS["wavy surface"].missed(scene.robot, path.joints)
            degrees, mm = max(degrees, off[0].max()), max(mm, off[1].max())
    assert solved >= 4
    assert degrees < 0.02
    assert mm < 0.2


def test_nothing_is_proven_beyond_where_a_surface_was_shown(rows, scene) -> None:
    found = identify(rows, scene.robot)
    manifold = ConstraintManifold(scene.robot, found.constraint)
    spline = found.constraint.splines[0]
    on = retract(manifold, scene.robot.sample(4000, np.random.default_rng(0)))
    q = on.joints[on.converged]
    x = spline.coordinates(scene.robot.forward(q)[0])[:, :2]
    outside = ((x < spline.lower[:2]) | (x > spline.upper[:2])).any(axis=1)
    beyond = q[outside][0]
    with Certifier(scene) as certifier:
        for place, proven in ((beyond, False), (rows[0], True)):
            path = np.stack([place, place + 1e-6])
            certificate = certifier.certify(path, found.constraint, collisions=False)
            assert (certificate.violation is None) == proven


def test_an_axis_that_turns_with_the_place(scene) -> None:
    """The tool's z axis over a plane leans further the further out the tip is."""
    robot, rng = scene.robot, np.random.default_rng(0)
    q = robot.sample(20_000, rng)

    def residual(q: np.ndarray) -> np.ndarray:
        p, turned = robot.forward(q)
        lean = 3.0 * (p[:, 0] - 0.4)
        axis = turned[:, :, 2]
        across = axis[:, 0] * np.cos(lean) + axis[:, 2] * np.sin(lean)
        return np.stack([p[:, 2] - 0.2, across, axis[:, 1]], axis=1)

    for _ in range(25):
        c, step = residual(q), 1e-6
        slopes = [
            (residual(q + d) - residual(q - d)) / (2 * step) for d in step * np.eye(robot.dof)
        ]
        moved = np.einsum("ndk,nk->nd", np.linalg.pinv(np.stack(slopes, axis=2)), c)
        q = (
            q
            - moved
            * np.minimum(1.0, 0.3 / np.maximum(np.linalg.norm(moved, axis=1), 1e-9))[:, None]
        )
    p, turned = robot.forward(q)
    on = np.abs(residual(q)).max(axis=1) < 1e-9
    on &= (robot.limit_distance(q) > 0.0) & (turned[:, 2, 2] < -0.2)
    on &= (np.abs(p[:, 0] - 0.4) < 0.15) & (np.abs(p[:, 1]) < 0.3)
    shown = q[on]
    assert len(shown) > 300
    found = identify(shown, robot)
    assert found.codim == 3, found.explanation
    assert "z axis is a smooth function of the place" in found.explanation
    assert found.left_out_error["rad"] < 1e-3


def test_an_elbow_on_a_hose(scene, tmp_path) -> None:
    found = identify(TASKS["hose at the elbow"].demonstrate(scene, 10, 0.0, 0), scene.robot)
    assert found.codim == 1
    assert "the origin of joint4 lies on a sphere, r = 400.0 mm" in found.explanation
    degrees, mm = missed("hose at the elbow", found, scene)
    assert degrees == 0.0
    assert mm < 1e-3
    assert found.support is None
    found.save(tmp_path / "hose.yaml")
    assert load_constraint(tmp_path / "hose.yaml", scene.robot).key == found.constraint.key
    about = found.constraint.to_json()
    with pytest.raises(ConstraintError, match="the arm has 6 joints"):
        constraint_from_json({**about, "joint": 11}, scene.robot)
    with Certifier(scene) as certifier, pytest.raises(CertificationError, match="no such joint"):
        path = np.zeros((2, 6)) + np.array([[0.0], [1e-3]])
        certifier.certify(path, constraint_from_json({**about, "joint": 11}), collisions=False)
    with pytest.raises(ConstraintError, match="has no region"):
        found.save(tmp_path / "hose.yaml", where_shown=True)


def test_a_path_goes_around_a_hole_in_what_was_shown(scene) -> None:
    task = TASKS["hole"]
    rows = task.draw(scene, 6000, 0)
    found = identify(rows, scene.robot)
    assert found.codim == 3
    assert "within" in found.support.words
    manifold = ConstraintManifold(scene.robot, found.supported)
    assert manifold.violation(rows).max() < 1e-6
    again = constraint_from_json(found.supported.to_json(), scene.robot)
    assert again.key == found.supported.key

    def depth(q: np.ndarray) -> float:
        away = np.linalg.norm(scene.robot.forward(q)[0] - HOLE, axis=1)
        return float(HOLE_M - away.min())

    through = 0
    with Planner.load(bundle.PACKAGED) as planner:
        tip = scene.robot.forward(rows)[0]
        beside = np.flatnonzero(np.linalg.norm(tip - HOLE, axis=1) < 0.06)
        for one in beside[:60]:
            opposite = np.linalg.norm(tip[beside] - (2 * HOLE - tip[one]), axis=1) < 0.03
            others = beside[opposite]
            if not len(others):
                continue
            other = others[np.argmin(np.linalg.norm(rows[others] - rows[one], axis=1))]
            ends = rows[one], rows[other]
            straight = planner.plan(*ends, constraint=found.constraint)
            around = planner.plan(*ends, constraint=found.supported)
            if straight.status == around.status == "solved" and depth(straight.joints) > 0.015:
                assert depth(around.joints) < 0.006
                through += 1
            if through == 3:
                break
    assert through == 3
