"""A generative adversarial network of joint configurations: its generator as a manifold.

Trained by the Wasserstein distance with a gradient penalty [Gulrajani 2017]; the generator is the
running average of what is trained.  A generator has no encoder: one is fitted to pairs that the
generator makes, and Gauss-Newton steps finish what it starts.
"""

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from constraint_geodesics.learning.latent_manifold import JointDecoder, LatentManifold, frozen
from constraint_geodesics.learning.vae import Perceptron
from constraint_geodesics.params import GanParams
from constraint_geodesics.robot.kinematics import SerialRobot

INVERSIONS = 20
"""Gauss-Newton steps from each latent point that an inversion starts at."""
REACHED = 1e-4
"""Distance of scaled joints up to which no other start is tried."""
BANK, NEIGHBOURS = 4096, 4
"""Latent points kept to start from, and how many are tried: those whose joints are nearest."""
LEAST_STRETCH = 0.01
"""How far a unit of latent space reaches in the embedding at least [rad]."""
DAMPING = 1e-3
"""Of the first of them; a tenth after a step that came nearer, ten times after one that did not."""
WARM_UP = 10
"""Steps over which the running average grows to its full memory."""


class Generator(JointDecoder):
    """The map z → q of a trained network and its approximate inverse.

    A generator knows no deviation.  The embedding is f(z) = (q(z), ε z) [rad] with ε =
    LEAST_STRETCH, so the metric is J_qᵀ J_q + ε² I: it stays positive where the generator folds.
    """

    bank: Tensor

    def __init__(self, dof: int, latent_dim: int, hidden: Sequence[int]) -> None:
        super().__init__(dof, latent_dim)
        self.hidden = list(hidden)
        self.network = Perceptron(latent_dim, hidden, dof)
        self.encoder = Perceptron(dof, hidden, latent_dim)
        self.register_buffer("bank", torch.zeros(BANK, latent_dim))

    @property
    def sizes(self) -> dict[str, Any]:
        """What the constructor was called with."""
        return {"dof": self.dof, "latent_dim": self.latent_dim, "hidden": self.hidden}

    @property
    def ambient_dim(self) -> int:
        """D + N: the joints and the latent point."""
        return self.dof + self.latent_dim

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch A"]:
        """f(z) = (q(z), ε z) [rad]."""
        return torch.cat([self.centre + self.scale * self.network(z), LEAST_STRETCH * z], dim=-1)

    def encode(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch N"]:
        """The latent point whose joints are the nearest that Gauss-Newton finds: from the
        encoder's, and where that does not reach the joints, from those of the bank.
        """
        wanted = ((q - self.centre) / self.scale).reshape(-1, self.dof)
        z = invert(self.network, wanted, self.encoder(wanted))
        miss = (wanted - self.network(z)).norm(dim=-1)
        far = torch.nonzero(miss > REACHED)[:, 0]
        nearest = torch.cdist(wanted[far], self.network(self.bank)).topk(NEIGHBOURS, largest=False)
        for start in nearest.indices.unbind(-1):
            other = invert(self.network, wanted[far], self.bank[start])
            left = (wanted[far] - self.network(other)).norm(dim=-1)
            better = left < miss[far]
            z[far[better]], miss[far[better]] = other[better], left[better]
        return z.reshape(*q.shape[:-1], self.latent_dim)

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count N"]:
        """Standard normal, as in training."""
        return rng.normal(size=(count, self.latent_dim))


def invert(
    network: nn.Module, wanted: Float[Tensor, "B D"], z: Float[Tensor, "B N"]
) -> Float[Tensor, "B N"]:
    """Latent points whose values are nearer to the wanted ones: INVERSIONS damped Gauss-Newton
    steps from z, of which only those that come nearer count.
    """
    damping = torch.full((len(z), 1), DAMPING, dtype=z.dtype)
    jacobians = torch.func.vmap(torch.func.jacfwd(network))
    miss = wanted - network(z)
    for _ in range(INVERSIONS):
        jacobian = jacobians(z)
        normal = jacobian.mT @ jacobian + torch.diag_embed(damping.expand_as(z))
        step = torch.linalg.solve(normal, (jacobian.mT @ miss[..., None]))[..., 0]
        left = wanted - network(z + step)
        nearer = left.square().sum(-1, keepdim=True) < miss.square().sum(-1, keepdim=True)
        z, miss = torch.where(nearer, z + step, z), torch.where(nearer, left, miss)
        damping = torch.where(nearer, damping / 10, damping * 10).clamp(1e-9, 1e6)
    return z


def train_gan(
    joints: Float[np.ndarray, "n D"], robot: SerialRobot, params: GanParams, seed: int
) -> LatentManifold:
    """Learn to generate configurations [rad] like the given ones.

    The same seed gives the same generator, and no other randomness is touched.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        generator = Generator(robot.dof, params.latent_dim, params.hidden)
        generator.scale_to(robot)
        rows = (torch.as_tensor(joints).float() - generator.centre) / generator.scale
        critic = Perceptron(robot.dof, params.hidden, 1)
        generator.network.load_state_dict(_compete(generator, critic, rows, params).state_dict())
        _fit_encoder(generator, params)
        generator.bank.copy_(torch.randn(BANK, params.latent_dim))
    return frozen(generator)


def _compete(
    generator: Generator, critic: nn.Module, rows: Float[Tensor, "n D"], params: GanParams
) -> nn.Module:
    """The running average of the generator's network while it and the critic learn in turn."""
    network = generator.network
    average = copy.deepcopy(network)
    generating, criticising = (_optimiser(one, params) for one in (network, critic))
    schedules = [
        torch.optim.lr_scheduler.LinearLR(one, 1.0, 0.02, params.steps)
        for one in (generating, criticising)
    ]
    for step in range(params.steps):
        for _ in range(params.critic_steps):
            real = rows[torch.randint(len(rows), (params.batch_size,))]
            with torch.no_grad():
                made = network(torch.randn(params.batch_size, generator.latent_dim))
            _descend(criticising, critic_loss(critic, real, made, params.penalty))
        made = network(torch.randn(params.batch_size, generator.latent_dim))
        _descend(generating, -critic(made).mean())
        _follow(average, network, min(params.average, (step + 1) / (step + WARM_UP)))
        for schedule in schedules:
            schedule.step()
    return average


def critic_loss(
    critic: nn.Module, real: Float[Tensor, "b D"], made: Float[Tensor, "b D"], penalty: float
) -> Float[Tensor, ""]:
    """E c(made) − E c(real) + penalty E (‖∇c‖ − 1)², the gradient on lines between the two."""
    share = torch.rand(len(real), 1)
    between = (share * real + (1 - share) * made).requires_grad_()
    (gradient,) = torch.autograd.grad(critic(between).sum(), between, create_graph=True)
    steepness = (gradient.norm(dim=-1) - 1.0).square().mean()
    return critic(made).mean() - critic(real).mean() + penalty * steepness


def _fit_encoder(generator: Generator, params: GanParams) -> None:
    """Learn z from the joints that the generator makes of it."""
    optimiser = torch.optim.Adam(generator.encoder.parameters(), params.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, params.encoder_steps)
    for _ in range(params.encoder_steps):
        z = torch.randn(params.batch_size, generator.latent_dim)
        with torch.no_grad():
            made = generator.network(z)
        _descend(optimiser, (generator.encoder(made) - z).square().sum(-1).mean())
        schedule.step()


def _optimiser(network: nn.Module, params: GanParams) -> torch.optim.Optimizer:
    return torch.optim.Adam(network.parameters(), params.learning_rate, (0.0, 0.9))


def _descend(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()


@torch.no_grad()
def _follow(average: nn.Module, network: nn.Module, memory: float) -> None:
    for old, new in zip(average.parameters(), network.parameters(), strict=True):
        old.lerp_(new, 1.0 - memory)
