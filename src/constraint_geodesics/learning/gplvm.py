"""A Gaussian-process latent variable model of joint configurations, trained with GPyTorch.

The only importer of gpytorch.  One sparse variational Gaussian process a joint [Titsias 2009,
Hensman 2013] over shared inducing points decodes; a perceptron encodes, as in the amortised
variational GPLVM [Lalchand 2022].  What is trained is frozen into plain arrays.
"""

from collections.abc import Sequence
from typing import Any

import gpytorch
import numpy as np
import torch
from jaxtyping import Float
from sklearn.cluster import MiniBatchKMeans
from torch import Tensor

from constraint_geodesics.learning.inference import SPREAD
from constraint_geodesics.learning.latent_manifold import JointDecoder, LatentManifold, frozen
from constraint_geodesics.learning.learned_manifold import PIECE
from constraint_geodesics.learning.vae import Perceptron
from constraint_geodesics.params import GplvmParams
from constraint_geodesics.robot.kinematics import SerialRobot

FIRST_LENGTHSCALE, FIRST_OUTPUT = 2.0, 0.3
"""Of the kernel before training, in standard deviations of the latent points, and in squares of
scaled joints: longer than the data's clusters, and less than the linear mean explains.
"""
FIRST_LOG_VARIANCE = -4.0
"""Of the posterior before training."""
LEAST_NOISE = 1e-6
"""Variance of the likelihood, in squares of scaled joints."""
JITTER = 1e-5
"""On the kernel's diagonal, so that it has a Cholesky factor."""


class GaussianProcessDecoder(JointDecoder):
    """The predictive distribution of D trained Gaussian processes, and their encoder.

    With the kernel k(z, z') = s² exp(−½ Σ (z_n − z'_n)²/ℓ_n²), inducing points U and
    k_w = L⁻¹ k(U, z), where L Lᵀ = k(U, U):

        μ_d(z) = w_dᵀ z + b_d + k_wᵀ m_d,    σ_d²(z) = s² + noise_d − k_wᵀ (I − S_d) k_w

    m_d and S_d: mean and covariance of the variational distribution in whitened coordinates.  The
    embedding is f(z) = (μ(z), σ(z)) [rad], as the VAE's: σ grows to the prior's away from the data.
    """

    inducing: Tensor
    lengthscale: Tensor
    output: Tensor
    noise: Tensor
    weight: Tensor
    bias: Tensor
    whitening: Tensor
    variational_mean: Tensor
    explained: Tensor
    centres: Tensor
    bandwidth: Tensor

    def __init__(
        self, dof: int, latent_dim: int, hidden: Sequence[int], inducing: int, centres: int
    ) -> None:
        super().__init__(dof, latent_dim)
        self.encoder = Perceptron(dof, hidden, 2 * latent_dim)
        self.hidden = list(hidden)
        shapes: dict[str, tuple[int, ...]] = {
            "inducing": (inducing, latent_dim),
            "lengthscale": (latent_dim,),
            "output": (),
            "noise": (dof,),
            "weight": (dof, latent_dim),
            "bias": (dof,),
            "whitening": (inducing, inducing),
            "variational_mean": (inducing, dof),
            "explained": (dof, inducing, inducing),
            "centres": (centres, latent_dim),
            "bandwidth": (centres,),
        }
        for name, shape in shapes.items():
            self.register_buffer(name, torch.ones(shape))

    @property
    def sizes(self) -> dict[str, Any]:
        """What the constructor was called with."""
        return {
            "dof": self.dof,
            "latent_dim": self.latent_dim,
            "hidden": self.hidden,
            "inducing": len(self.inducing),
            "centres": len(self.centres),
        }

    @property
    def ambient_dim(self) -> int:
        """2D: mean and standard deviation of each joint."""
        return 2 * self.dof

    def posterior(
        self, q: Float[Tensor, "*batch D"]
    ) -> tuple[Float[Tensor, "*batch N"], Float[Tensor, "*batch N"]]:
        """Mean and log variance of the latent coordinates of configurations [rad]."""
        mean, log_variance = self.encoder((q - self.centre) / self.scale).chunk(2, dim=-1)
        return mean, log_variance.clamp(-14.0, 2.0)

    def encode(self, q: Float[Tensor, "*batch D"]) -> Float[Tensor, "*batch N"]:
        """Posterior mean."""
        return self.posterior(q)[0]

    def embed(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch A"]:
        """f(z) = (μ(z), σ(z)) [rad]."""
        whitened = self._kernel(z) @ self.whitening
        mean = z @ self.weight.mT + self.bias + whitened @ self.variational_mean
        explained = torch.einsum("...i,dij,...j->...d", whitened, self.explained, whitened)
        # no less than the noise: rounding could take a variance below it
        variance = torch.maximum(self.output + self.noise - explained, self.noise)
        return torch.cat([self.centre + self.scale * mean, self.scale * variance.sqrt()], dim=-1)

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count N"]:
        """Latent points about centres of the encoded data, as the VAE's are drawn: at a small
        noise the encoded data does not fill the prior.
        """
        centres, width = self.centres.numpy(), self.bandwidth.numpy()
        chosen = rng.integers(len(centres), size=count)
        normal = rng.normal(size=(count, self.latent_dim))
        return centres[chosen] + SPREAD * width[chosen, None] * normal

    def _kernel(self, z: Float[Tensor, "*batch N"]) -> Float[Tensor, "*batch M"]:
        scaled, inducing = z / self.lengthscale, self.inducing / self.lengthscale
        # ‖z − u‖² as a product: differences of all pairs would be N times as many numbers
        square = scaled.square().sum(-1, keepdim=True) + inducing.square().sum(-1)
        return self.output * torch.exp(scaled @ inducing.mT - 0.5 * square)


class SparseProcess(gpytorch.models.ApproximateGP):
    """D sparse variational Gaussian processes with one kernel, a linear mean each, and inducing
    points (M, N) of their own choice.
    """

    def __init__(self, inducing: Float[Tensor, "M N"], outputs: int) -> None:
        batch = torch.Size([outputs])
        family = gpytorch.variational.CholeskyVariationalDistribution(
            len(inducing), batch_shape=batch
        )
        strategy = gpytorch.variational.VariationalStrategy(
            self, inducing, family, learn_inducing_locations=True, jitter_val=JITTER
        )
        super().__init__(strategy)
        dim = inducing.shape[-1]
        self.mean_module = gpytorch.means.LinearMean(dim, batch_shape=batch)
        self.covar_module = gpytorch.kernels.ScaleKernel(
            gpytorch.kernels.RBFKernel(ard_num_dims=dim)
        )
        self.covar_module.base_kernel.lengthscale = FIRST_LENGTHSCALE
        self.covar_module.outputscale = FIRST_OUTPUT

    def forward(self, z: Float[Tensor, "*batch N"]) -> Any:
        """The prior at latent points, in scaled joints."""
        return gpytorch.distributions.MultivariateNormal(self.mean_module(z), self.covar_module(z))


def train_gplvm(
    joints: Float[np.ndarray, "n D"], robot: SerialRobot, params: GplvmParams, seed: int
) -> LatentManifold:
    """Learn the manifold of the given configurations [rad].

    Maximises the evidence bound E log p(q | z) − KL[q(u) ‖ p(u)]/n − KL[q(z | q) ‖ N(0, I)] by
    Adam over batches; then the noise alone is fitted at the encoded means, as the VAE's variance
    is.  The same seed gives the same manifold, and no other randomness is touched.
    Raises ValueError if there are fewer joints than latent dimensions.
    """
    if params.latent_dim > robot.dof:
        raise ValueError(f"latent_dim = {params.latent_dim}: must be at most {robot.dof}, the dof")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        decoder = GaussianProcessDecoder(
            robot.dof, params.latent_dim, params.hidden, params.inducing, params.centres
        )
        decoder.scale_to(robot)
        rows = torch.as_tensor(joints, dtype=torch.float32)
        process = _first_process(decoder, rows, params)
        likelihood = gpytorch.likelihoods.GaussianLikelihood(
            batch_shape=torch.Size([robot.dof]),
            noise_constraint=gpytorch.constraints.GreaterThan(LEAST_NOISE),
        )
        likelihood.noise = params.noise
        _fit(decoder, process, likelihood, rows, params)
    freeze(decoder, process, likelihood)
    _fit_noise(decoder, rows.double())
    _place_centres(decoder, rows.double(), seed)
    return frozen(decoder)


def _first_process(
    decoder: GaussianProcessDecoder, rows: Float[Tensor, "n D"], params: GplvmParams
) -> SparseProcess:
    """Encoder and mean as principal components have them, the inducing points drawn from the
    prior.
    """
    scaled = (rows - decoder.centre) / decoder.scale
    _, size, axes = torch.linalg.svd(scaled - scaled.mean(0), full_matrices=False)
    dim = params.latent_dim
    axes, deviation = axes[:dim], size[:dim] / len(rows) ** 0.5
    process = SparseProcess(torch.randn(params.inducing, dim), decoder.dof)
    with torch.no_grad():
        process.mean_module.weights.copy_((deviation[:, None] * axes).T[..., None])
        process.mean_module.bias.copy_(scaled.mean(0)[:, None])
        last = decoder.encoder.nonlinear[-1]
        assert isinstance(last, torch.nn.Linear)
        last.weight.mul_(0.1)
        last.bias[:dim].copy_(-(axes @ scaled.mean(0)) / deviation)
        last.bias[dim:].fill_(FIRST_LOG_VARIANCE)
        decoder.encoder.linear.weight[:dim].copy_(axes / deviation[:, None])
        decoder.encoder.linear.weight[dim:].zero_()
    return process


def _fit(
    decoder: GaussianProcessDecoder,
    process: SparseProcess,
    likelihood: Any,
    rows: Float[Tensor, "n D"],
    params: GplvmParams,
) -> None:
    """`params.steps` steps of Adam on the evidence bound."""
    bound = gpytorch.mlls.VariationalELBO(likelihood, process, num_data=len(rows))
    learned = [*process.parameters(), *likelihood.parameters(), *decoder.encoder.parameters()]
    optimiser = torch.optim.Adam(learned, params.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimiser, params.steps, 1e-3 * params.learning_rate
    )
    for _ in range(params.steps):
        q = rows[torch.randint(len(rows), (params.batch_size,))]
        mean, log_variance = decoder.posterior(q)
        z = mean + torch.randn_like(mean) * torch.exp(0.5 * log_variance)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).sum(-1).mean()
        scaled = (q - decoder.centre) / decoder.scale
        loss = divergence - bound(process(z), scaled.T).sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


@torch.no_grad()
def freeze(decoder: GaussianProcessDecoder, process: SparseProcess, likelihood: Any) -> None:
    """Write a process's predictive distribution into the decoder's arrays, in double precision.

    The jitter that GPyTorch adds to the kernel's diagonal is part of that distribution.
    """
    decoder.double()
    process.double()
    strategy, kernel = process.variational_strategy, process.covar_module
    inducing, count = strategy.inducing_points, len(strategy.inducing_points)
    jitter = strategy.jitter_val * torch.eye(count, dtype=torch.float64)
    factor = torch.linalg.cholesky(kernel(inducing).to_dense() + jitter)
    unit = torch.eye(count, dtype=torch.float64)
    whitening = torch.linalg.solve_triangular(factor, unit, upper=False).mT
    distribution = strategy.variational_distribution
    for name, values in {
        "inducing": inducing,
        "lengthscale": kernel.base_kernel.lengthscale.reshape(-1),
        "output": kernel.outputscale,
        "noise": likelihood.noise.reshape(-1) + strategy.jitter_val,
        "weight": process.mean_module.weights[..., 0],
        "bias": process.mean_module.bias[..., 0],
        "whitening": whitening,
        "variational_mean": distribution.mean.mT,
        "explained": unit - distribution.covariance_matrix,
    }.items():
        getattr(decoder, name).copy_(values)


@torch.no_grad()
def _fit_noise(decoder: GaussianProcessDecoder, rows: Float[Tensor, "n D"]) -> None:
    """What the processes' own variance does not explain of the squared errors.

    While training, the noise also holds what the spread of the latent points moves the joints by.
    """
    left = torch.zeros(decoder.dof, dtype=torch.float64)
    for q in rows.split(PIECE):
        mean, deviation = (decoder.embed(decoder.encode(q)) / decoder.scale.repeat(2)).split(
            decoder.dof, dim=-1
        )
        own = deviation.square() - decoder.noise
        left += ((mean - q / decoder.scale).square() - own).sum(0)
    decoder.noise.copy_((left / len(rows)).clamp_min(LEAST_NOISE))


@torch.no_grad()
def _place_centres(decoder: GaussianProcessDecoder, rows: Tensor, seed: int) -> None:
    """k-means centres of the encoded data; each centre's bandwidth reaches its neighbours."""
    z = decoder.encode(rows)
    count = min(len(decoder.centres), len(z))
    found = MiniBatchKMeans(count, random_state=seed, n_init=1, batch_size=4096).fit(z.numpy())
    centres = torch.as_tensor(found.cluster_centers_)[torch.arange(len(decoder.centres)) % count]
    neighbours = torch.cdist(centres, centres).topk(min(4, count), largest=False).values[:, 1:]
    decoder.centres.copy_(centres)
    decoder.bandwidth.copy_(neighbours.mean(-1))
