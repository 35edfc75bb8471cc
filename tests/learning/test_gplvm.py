"""The Gaussian processes as plain arrays, against GPyTorch's own predictions."""

import gpytorch
import numpy as np
import pytest
import torch

from constraint_geodesics.learning.gplvm import (
    GaussianProcessDecoder,
    SparseProcess,
    freeze,
    train_gplvm,
)


@pytest.fixture(scope="module")
def settings(params):
    small = {"hidden": (32,), "inducing": 32, "steps": 120, "batch_size": 64, "centres": 64}
    return params.compare_manifolds.gplvm.model_copy(update=small)


@pytest.fixture(scope="module")
def manifold(trained, xarm, settings):
    return train_gplvm(trained.joints, xarm, settings, 0)


def test_the_arrays_predict_what_gpytorch_predicts() -> None:
    torch.manual_seed(5)
    process = SparseProcess(torch.randn(12, 2), 3)
    with torch.no_grad():
        for values in process.parameters():
            values.add_(0.3 * torch.randn_like(values))
    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=torch.Size([3]))
    process.variational_strategy.variational_params_initialized.fill_(1)
    decoder = GaussianProcessDecoder(3, 2, (4,), 12, 2)
    freeze(decoder, process, likelihood)
    z = torch.randn(20, 2, dtype=torch.float64)
    process.eval()
    likelihood.double().eval()
    with torch.no_grad():
        predicted = likelihood(process(z))
        mean, deviation = decoder.embed(z).split(3, dim=-1)
    torch.testing.assert_close(mean, predicted.mean.mT, rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(deviation, predicted.stddev.mT, rtol=1e-5, atol=1e-6)


def test_it_reproduces_its_data_and_does_not_think_too_well_of_itself(manifold, trained) -> None:
    mean, deviation = np.split(manifold.embed_joints(trained.joints), 2, axis=-1)
    error = mean - trained.joints
    assert np.abs(error).mean() < 0.1
    expected, found = (np.sqrt((own**2).mean(axis=0)) for own in (deviation, error))
    assert (expected > 0.9 * found).all()


def test_the_deviation_grows_away_from_the_data(manifold, trained) -> None:
    z = manifold.encode(trained.joints[:200])
    near, far = (manifold.embed_points(share * z)[:, 6:].mean(axis=0) for share in (1.0, 20.0))
    assert (far > 3 * near).all()


def test_samples_lie_among_the_data(manifold, trained, xarm) -> None:
    drawn = manifold.decode(manifold.sample(2000, np.random.default_rng(0)))
    assert (xarm.limit_distance(drawn) >= 0).mean() > 0.5
    np.testing.assert_allclose(drawn.mean(axis=0), trained.joints.mean(axis=0), atol=0.3)
    np.testing.assert_allclose(drawn.std(axis=0), trained.joints.std(axis=0), rtol=0.15)


def test_more_latent_dimensions_than_joints_are_refused(trained, xarm, settings) -> None:
    with pytest.raises(ValueError, match=r"latent_dim = 7: must be at most 6"):
        train_gplvm(trained.joints, xarm, settings.model_copy(update={"latent_dim": 7}), 0)
