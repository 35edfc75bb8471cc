"""Training of a learned manifold with Lightning: the mean, then the variance alone (eq. 4)."""

import logging
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import Callback, EarlyStopping, ModelCheckpoint, RichProgressBar
from sklearn.cluster import MiniBatchKMeans
from torch import Tensor
from torch.utils.data import (
    BatchSampler,
    DataLoader,
    RandomSampler,
    SequentialSampler,
    TensorDataset,
)

from constraint_geodesics.learning.learned_manifold import LearnedManifold
from constraint_geodesics.learning.vae import JointVae, evidence_loss, variance_loss
from constraint_geodesics.params import ManifoldParams
from constraint_geodesics.robot.kinematics import SerialRobot

Report = Callable[[int, dict[str, float]], None]


@dataclass(frozen=True)
class TrainedManifold:
    """The manifold and what held-out configurations say of it."""

    manifold: LearnedManifold
    metrics: dict[str, float]
    history: list[dict[str, float]]


@dataclass(frozen=True)
class TrainingRun:
    """What surrounds a training.

    scratch: where checkpoints go.  report: called with (epoch, figures) after every epoch.
    progress: whether a bar is drawn.
    """

    scratch: Path
    report: Report
    progress: bool = True


class _Phase(lightning.LightningModule):
    """One phase of the training, of so many epochs at most."""

    name: str

    def __init__(self, vae: JointVae, params: ManifoldParams, epochs: int) -> None:
        super().__init__()
        self.vae, self.params, self.epochs = vae, params, epochs


class _MeanPhase(_Phase):
    """Encoder and decoder mean."""

    name = "mean"

    def training_step(self, batch: list[Tensor]) -> Tensor:
        (q,) = batch
        noise = torch.randn(len(q), self.vae.latent_dim)
        loss, _ = evidence_loss(self.vae, q, self.params.beta, noise)
        self.log("loss", loss, on_step=False, on_epoch=True, prog_bar=True)
        return loss

    def validation_step(self, batch: list[Tensor], batch_idx: int) -> None:
        (q,) = batch
        # drawn as in training, so that both are the same loss, and the same in every epoch
        drawn = torch.Generator().manual_seed(batch_idx)
        noise = torch.randn(len(q), self.vae.latent_dim, generator=drawn)
        loss, reconstruction = evidence_loss(self.vae, q, self.params.beta, noise)
        self.log_dict(
            {"held_out_loss": loss, "held_out_reconstruction": reconstruction}, prog_bar=True
        )

    def configure_optimizers(self) -> Any:
        optimiser = torch.optim.Adam(
            [*self.vae.encoder.parameters(), *self.vae.decoder.parameters()],
            self.params.learning_rate,
        )
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            optimiser, self.epochs, 0.01 * self.params.learning_rate
        )
        return {"optimizer": optimiser, "lr_scheduler": schedule}


class _VariancePhase(_Phase):
    """Precision network, everything else frozen."""

    name = "variance"

    def training_step(self, batch: list[Tensor]) -> Tensor:
        loss = variance_loss(self.vae, batch[0])
        self.log("loss", loss, on_step=False, on_epoch=True, prog_bar=True)
        return loss

    def validation_step(self, batch: list[Tensor]) -> None:
        self.log("held_out_loss", variance_loss(self.vae, batch[0]), prog_bar=True)

    def configure_optimizers(self) -> Any:
        return torch.optim.Adam(self.vae.precision.parameters(), 10 * self.params.learning_rate)


class _History(Callback):
    """Keeps each epoch's figures and passes them on."""

    def __init__(self, phase: str, first: int, report: Report) -> None:
        self.phase, self.first, self.report = phase, first, report
        self.rows: list[dict[str, float]] = []

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        if trainer.sanity_checking:
            return
        figures = {
            f"{self.phase}_{name}": float(value) for name, value in trainer.callback_metrics.items()
        }
        step = self.first + len(self.rows)
        self.rows.append({"epoch": float(step), **figures})
        self.report(step, figures)


def train_manifold(
    joints: Float[np.ndarray, "n D"], robot: SerialRobot, params: ManifoldParams, run: TrainingRun
) -> TrainedManifold:
    """Learn the manifold of the given configurations [rad]."""
    torch.manual_seed(params.seed)
    rows = torch.as_tensor(np.random.default_rng(params.seed).permutation(joints)).float()
    count = max(int(len(rows) * params.held_out), 1)
    held_out, rows = rows[:count], rows[count:]
    vae = JointVae(robot.dof, params.latent_dim, params.hidden, params.variance_centres)
    vae.centre.copy_(torch.as_tensor(0.5 * (robot.lower + robot.upper)))
    vae.scale.copy_(torch.as_tensor(0.5 * (robot.upper - robot.lower)))
    history = _fit(_MeanPhase(vae, params, params.epochs), rows, held_out, run, 0)
    _place_variance(vae, rows, params)
    vae.encoder.requires_grad_(False)
    vae.decoder.requires_grad_(False)
    variance = _VariancePhase(vae, params, params.variance_epochs)
    history += _fit(variance, rows, held_out, run, len(history))
    manifold = LearnedManifold(vae.eval().requires_grad_(False))
    return TrainedManifold(manifold, held_out_figures(manifold, robot, held_out.numpy()), history)


def held_out_figures(
    manifold: LearnedManifold, robot: SerialRobot, joints: Float[np.ndarray, "n D"]
) -> dict[str, float]:
    """Reconstruction error [°, mm], deviation, and condition of the metric (eq. 5)."""
    joints = np.asarray(joints, np.float64)
    z = manifold.encode(joints)
    decoded = manifold.decode(z)
    error_deg = np.degrees(np.abs(decoded - joints))
    tool_mm = 1e3 * np.linalg.norm(robot.forward(decoded)[0] - robot.forward(joints)[0], axis=-1)
    metric = manifold.metric(manifold.tensor(z[:1000])).double()
    eigenvalues = torch.linalg.eigvalsh(metric)
    condition = (eigenvalues[:, -1] / eigenvalues[:, 0].clamp_min(1e-12)).numpy()
    with torch.no_grad():
        deviation = np.degrees(manifold.vae.deviation(manifold.tensor(z)).numpy())
    figures = {
        "joint_error_mean_deg": error_deg.mean(),
        "joint_error_p95_deg": np.quantile(error_deg, 0.95),
        "tool_error_median_mm": np.median(tool_mm),
        "tool_error_p95_mm": np.quantile(tool_mm, 0.95),
        "deviation_median_deg": np.median(deviation),
        "metric_condition_median": np.median(condition),
        "metric_condition_p95": np.quantile(condition, 0.95),
        "metric_volume_median": np.median(eigenvalues.prod(-1).clamp_min(0).sqrt().numpy()),
    }
    return {name: float(value) for name, value in figures.items()}


def _fit(
    phase: _Phase, rows: Tensor, held_out: Tensor, run: TrainingRun, first: int
) -> list[dict[str, float]]:
    """Figures of every epoch, the first of which has number `first`; the best weights stay."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    params, folder = phase.params, run.scratch / phase.name
    history = _History(phase.name, first, run.report)
    best = ModelCheckpoint(folder, "best", monitor="held_out_loss", enable_version_counter=False)
    bar = [RichProgressBar(leave=True)] if run.progress else []
    trainer = lightning.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=phase.epochs,
        logger=False,
        enable_model_summary=False,
        enable_progress_bar=run.progress,
        num_sanity_val_steps=0,
        default_root_dir=run.scratch,
        callbacks=[history, best, EarlyStopping("held_out_loss", patience=params.patience), *bar],
    )
    order = torch.Generator().manual_seed(params.seed)
    shuffled, fixed = _batches(rows, params.batch_size, order), _batches(held_out, 8192, None)
    trainer.fit(phase, shuffled, fixed)
    phase.load_state_dict(torch.load(best.best_model_path, weights_only=True)["state_dict"])
    return history.rows


def _batches(rows: Tensor, size: int, generator: torch.Generator | None) -> DataLoader:
    dataset = TensorDataset(rows)
    shuffled = generator is not None
    order = RandomSampler(dataset, generator=generator) if shuffled else SequentialSampler(dataset)
    # a batch of indices at once: collating row by row costs more than a training step here
    sampler = BatchSampler(order, min(size, len(rows)), drop_last=shuffled)
    return DataLoader(dataset, sampler=sampler, batch_size=None)


def _place_variance(vae: JointVae, rows: Tensor, params: ManifoldParams) -> None:
    """k-means centres on the encoded data; each centre's bandwidth reaches its neighbours."""
    with torch.no_grad():
        z = vae.encode(rows)[0]
    count = min(params.variance_centres, len(z))
    means = MiniBatchKMeans(count, random_state=params.seed, n_init=1, batch_size=4096).fit(
        z.numpy()
    )
    centres = torch.as_tensor(means.cluster_centers_).float()
    centres = centres[torch.arange(params.variance_centres) % count]
    neighbours = torch.cdist(centres, centres).topk(min(4, count), largest=False).values[:, 1:]
    bandwidth = neighbours.mean(-1).clamp_min(1e-3)
    with torch.no_grad():
        error = (vae.mean(z) - rows).square().mean()
        spread = z.square().sum(-1).quantile(0.95).sqrt()
        floor = params.sigma_max_rad**-2
        vae.precision.place(centres, bandwidth, floor, float(spread), float(1.0 / error))
