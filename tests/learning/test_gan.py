"""The generative network: its loss on critics that are known, its inverse, and what it draws."""

import numpy as np
import pytest
import torch
from torch import nn

from constraint_geodesics.learning.gan import LEAST_STRETCH, critic_loss, invert, train_gan


def linear(weight: torch.Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], bias=False, dtype=weight.dtype)
    layer.weight.data.copy_(weight)
    return layer


@pytest.mark.parametrize(("slope", "charged"), [(1.0, 0.0), (2.0, 0.7), (0.0, 0.7)])
def test_a_critic_pays_for_a_slope_that_is_not_one(slope, charged) -> None:
    torch.manual_seed(0)
    critic = linear(slope * torch.tensor([[0.6, 0.8]]))
    real, made = torch.randn(5, 2), torch.randn(5, 2) + 3.0
    loss = critic_loss(critic, real, made, penalty=0.7)
    apart = critic(made).mean() - critic(real).mean()
    torch.testing.assert_close(loss, apart + charged, rtol=1e-5, atol=1e-5)


def test_a_linear_map_is_inverted_and_what_is_out_of_reach_is_come_near_to() -> None:
    torch.manual_seed(0)
    square = linear(torch.randn(4, 4, dtype=torch.float64))
    z = torch.randn(7, 4, dtype=torch.float64)
    found = invert(square, square(z), torch.zeros_like(z))
    torch.testing.assert_close(square(found), square(z), rtol=0, atol=1e-8)
    tall = linear(torch.randn(4, 2, dtype=torch.float64))
    wanted = torch.randn(7, 4, dtype=torch.float64)
    found = invert(tall, wanted, torch.zeros(7, 2, dtype=torch.float64))
    best = torch.linalg.lstsq(tall.weight, wanted.mT).solution.mT
    torch.testing.assert_close(found, best, rtol=0, atol=1e-5)


def test_training_draws_nearer_to_the_data(xarm, params) -> None:
    small = {"hidden": (16,), "batch_size": 64, "encoder_steps": 1, "average": 0.9}
    own = params.compare_manifolds.gan.model_copy(update=small)
    wanted = xarm.lower + np.array([0.2, 0.8, 0.3, 0.7, 0.4, 0.6]) * (xarm.upper - xarm.lower)
    joints = wanted + np.random.default_rng(0).normal(scale=0.2, size=(500, 6))
    off = []
    for steps in (1, 250):
        manifold = train_gan(joints, xarm, own.model_copy(update={"steps": steps}), 0)
        drawn = manifold.decode(manifold.sample(500, np.random.default_rng(0)))
        off.append(np.linalg.norm(drawn - wanted, axis=1).mean())
    assert off[1] < 0.5 * off[0]


def test_the_metric_stays_positive_where_the_generator_folds(trained, xarm, params) -> None:
    small = {"hidden": (8,), "steps": 2, "batch_size": 32, "encoder_steps": 2}
    own = params.compare_manifolds.gan.model_copy(update=small)
    manifold = train_gan(trained.joints, xarm, own, 0)
    for weight in manifold.decoder.network.parameters():
        weight.zero_()  # every latent point decodes to one configuration
    z = torch.zeros(2, 6, dtype=torch.float64)
    flat = LEAST_STRETCH**2 * torch.eye(6, dtype=torch.float64)
    torch.testing.assert_close(manifold.metric(z), flat.expand(2, 6, 6))
