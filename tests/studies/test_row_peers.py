"""What is learned of rows for comparison: networks and a VAE, on a constraint that is known."""

import numpy as np
import pytest
from tests.identification.hidden import HIDDEN, drawn

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.polynomial import PolynomialConstraint
from constraint_geodesics.studies.local_models import LocalModels, joints_of, poses_of
from constraint_geodesics.studies.row_latents import RowLatents
from constraint_geodesics.studies.row_networks import RowNetwork, level_set, residual


@pytest.fixture(scope="module")
def rows(xarm) -> np.ndarray:
    """Of a level cup."""
    return drawn("cup", xarm, 1200)


def lean_deg(robot, path) -> np.ndarray:
    return np.degrees(np.arccos(np.clip(robot.forward(path)[1][:, 2, 1], -1.0, 1.0)))


def pairs(rows: np.ndarray) -> list:
    away = np.linalg.norm(rows - rows[0], axis=1)
    return [(rows[0], rows[k]) for k in np.argsort(away)[40:44]]


@pytest.mark.parametrize(("loss", "most_deg"), [(level_set, 4.0), (residual, 8.0)])
def test_a_network_is_zero_where_the_rows_are(loss, most_deg, xarm, rows) -> None:
    network = RowNetwork(xarm, rows, np.arange(len(rows)), 2, loss, 600, 0)
    start = np.median(
        [lean_deg(xarm, s + np.linspace(0, 1, 50)[:, None] * (g - s)).max() for s, g in pairs(rows)]
    )
    found = [network.answer(*pair) for pair in pairs(rows)]
    paths = [path for status, path, _ in found if status == "solved"]
    assert len(paths) >= 2
    worst = np.median([lean_deg(xarm, path).max() for path in paths])
    assert worst < min(most_deg, start)


def test_the_same_seed_learns_the_same(xarm, rows) -> None:
    ask = pairs(rows)[0]
    one, two, other = (
        RowNetwork(xarm, rows[:400], np.arange(400), 2, residual, 300, seed).answer(*ask)[1]
        for seed in (0, 0, 1)
    )
    assert one is not None
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("looked", [poses_of, joints_of])
def test_frames_tell_what_is_across_the_rows(looked, xarm, rows) -> None:
    look = looked(xarm)
    models = LocalModels(look, rows, np.arange(len(rows)), 2)
    y, slopes = look(rows[:50])
    across, along = models.frames(y, slopes)
    assert across.shape == (50, 2, y.shape[1])
    assert along.shape == (50, 4, y.shape[1])
    both = np.concatenate([across, along], axis=1)
    np.testing.assert_allclose(
        both @ both.transpose(0, 2, 1), np.tile(np.eye(6), (50, 1, 1)), atol=1e-9
    )
    if looked is poses_of:  # R e_y keeps its direction
        assert np.abs(along[:, :, 6:8]).max() < 0.2


def test_frames_of_a_curved_set_follow_it(xarm) -> None:
    """Across a cylinder of the tip is the radius at the place itself, not in the mean around it."""
    q = drawn("cylinder", xarm, 2000)
    look = poses_of(xarm)
    models = LocalModels(look, q, np.arange(len(q)), 1)
    y, slopes = look(q[:200])
    across, _ = models.frames(y, slopes)
    manifold = ConstraintManifold(xarm, PolynomialConstraint(HIDDEN["cylinder"]))
    wanted = manifold.jacobian(q[:200])[:, 0]
    found = (across @ slopes)[:, 0]
    cosine = np.abs((wanted * found).sum(axis=1))
    cosine /= np.linalg.norm(wanted, axis=1) * np.linalg.norm(found, axis=1)
    assert np.degrees(np.arccos(np.clip(np.median(cosine), 0.0, 1.0))) < 4.0


def test_latent_geodesics_join_the_querys_own_ends(params, xarm, rows, tmp_path) -> None:
    changed = {"latent_dim": 4, "epochs": 20, "patience": 20, "batch_size": 128}
    vae = params.manifolds["planner"].model_copy(update=changed)
    latents = RowLatents(xarm, rows, vae, tmp_path)
    policy = params.geodesics.model_copy(update={"steps": 2560})
    start, goal = pairs(rows)[0]
    answers = (latents.by_descent(), latents.without_variance(), latents.by_policy(policy, 0))
    for answer in answers:
        status, path, ms = answer(start, goal)
        assert status == "solved"
        assert ms > 0.0
        np.testing.assert_allclose(path[[0, -1]], [start, goal], atol=1e-12)
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.1
