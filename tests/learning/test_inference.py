"""A trained manifold without the training library is the same manifold."""

import subprocess
import sys

import numpy as np
import pytest
from tests.planner_fixtures import packaged_learned

from constraint_geodesics.learning.inference import SPREAD, FrozenManifold, perceptron


@pytest.fixture(scope="module")
def frozen(trained, tmp_path_factory) -> FrozenManifold:
    folder = tmp_path_factory.mktemp("manifold")
    trained.manifold.save(folder)
    return FrozenManifold.load(folder)


def test_it_encodes_and_decodes_as_the_trained_network_does(trained, frozen) -> None:
    manifold = trained.manifold
    assert frozen.dim == manifold.dim
    for q in (trained.joints[:500], 3.0 * trained.joints[:50]):
        z = manifold.encode(q)
        np.testing.assert_allclose(frozen.encode(q), z, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(frozen.decode(z), manifold.decode(z), rtol=1e-5, atol=1e-5)
    spread = 5.0 * np.random.default_rng(0).normal(size=(500, frozen.dim))
    np.testing.assert_allclose(frozen.decode(spread), manifold.decode(spread), rtol=1e-5, atol=1e-5)
    assert np.ptp(frozen.decode(spread), axis=0).min() > 0.1


def test_any_batch_shape_is_answered_in_double_precision(trained, frozen) -> None:
    q = trained.joints[:12]
    z = frozen.encode(q)
    assert z.dtype == frozen.decode(z).dtype == np.float64
    np.testing.assert_allclose(frozen.encode(q.reshape(3, 4, -1)), z.reshape(3, 4, -1), atol=1e-5)
    np.testing.assert_allclose(
        frozen.decode(z.reshape(2, 6, -1)).reshape(q.shape), frozen.decode(z), atol=1e-5
    )
    np.testing.assert_allclose(frozen.decode(z[0]), frozen.decode(z)[0], atol=1e-5)
    assert frozen.encode(q[0]).shape == (frozen.dim,)
    assert frozen.decode(z[:0]).shape == (0, q.shape[1])


def test_far_points_are_decoded_to_numbers(frozen) -> None:
    with np.errstate(over="raise", invalid="raise"):
        for size in (1e3, -1e6):
            assert np.isfinite(frozen.decode(np.full((2, frozen.dim), size))).all()


def test_samples_lie_around_the_centres(frozen) -> None:
    first, again = (frozen.sample(4000, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert first.shape == (4000, frozen.dim)
    centres, width = frozen.arrays["precision.centres"], frozen.arrays["precision.bandwidth"]
    np.testing.assert_allclose(
        first.mean(axis=0), centres.mean(axis=0), atol=0.2 * centres.std(axis=0).max()
    )
    nearest = np.linalg.norm(first[:, None] - centres, axis=-1) / width
    assert np.median(nearest.min(axis=1)) < SPREAD * np.sqrt(frozen.dim)


def test_samples_of_the_packaged_manifold_are_configurations_of_the_arm(scene) -> None:
    chart = FrozenManifold(packaged_learned().manifold)
    decoded = chart.decode(chart.sample(1000, np.random.default_rng(2)))
    assert (scene.robot.limit_distance(decoded) > -0.2).mean() > 0.75
    with scene.world() as world:
        drawn = scene.robot.sample(1000, np.random.default_rng(3))
        assert world.free(decoded).mean() > world.free(drawn).mean() + 0.05, (
            "freer than what is drawn blindly"
        )
    back = chart.decode(chart.encode(decoded))
    assert np.median(np.linalg.norm(back - decoded, axis=1)) < 0.5


def test_a_perceptron_of_one_layer_is_its_two_linear_paths() -> None:
    rng = np.random.default_rng(3)
    hidden, bias, out, last, direct = (
        rng.normal(size=s) for s in ((5, 3), (5,), (2, 5), (2,), (2, 3))
    )
    arrays = {
        "net.nonlinear.0.weight": hidden,
        "net.nonlinear.0.bias": bias,
        "net.nonlinear.2.weight": out,
        "net.nonlinear.2.bias": last,
        "net.linear.weight": direct,
    }
    x = rng.normal(size=(4, 3))
    y = x @ hidden.T + bias
    expected = (y / (1.0 + np.exp(-y))) @ out.T + last + x @ direct.T
    np.testing.assert_allclose(perceptron(arrays, "net", x), expected, rtol=1e-12)


def test_the_training_library_is_not_imported() -> None:
    code = "import sys, constraint_geodesics.learning.inference; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
