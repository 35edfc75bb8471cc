"""Training of the diffusion model of paths, on certified paths of the project's own planner."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from constraint_geodesics.bundle import Bundle
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.learning.dataset import draw_queries
from constraint_geodesics.learning.path_diffusion import (
    FREQUENCIES,
    PathDiffusion,
    coefficients,
    conditions,
    seen_times,
)
from constraint_geodesics.params import PathDiffusionParams
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search.candidates import ALL_PARTS
from constraint_geodesics.search.roadmap import resample

Report = Callable[[int, dict[str, float]], None]

POINTS = 33
"""Even points of a path that its coefficients are taken from."""
REPORTED = 500
"""Steps between two figures of the held-out paths."""
WARM_UP = 100
"""Steps in which the learning rate rises."""
AVERAGED = 0.999
"""Share of the averaged weights that a step keeps."""
CHECKED_TIMES = 8
"""Times at which each held-out path is looked at."""
LEAST_SCALE = 1e-3
"""Of a number that the network sees, so that one which is always the same is not blown up."""


@dataclass(frozen=True)
class PathTask:
    """Paths of one constraint to plan in its scene, by its name in the bundle; picklable."""

    bundle: Bundle
    scene: Scene
    constraint: str
    settings: PathDiffusionParams


@dataclass(frozen=True)
class Examples:
    """What a model learns: `conditions` and `coefficients` [rad] of n paths, there and back."""

    seen: Float[np.ndarray, "2 n c"]
    paths: Float[np.ndarray, "2 n k D"]

    @classmethod
    def joined(cls, parts: "list[Examples]") -> "Examples":
        """Of several constraints."""
        seen, paths = zip(*((part.seen, part.paths) for part in parts), strict=True)
        return cls(np.concatenate(seen, axis=1), np.concatenate(paths, axis=1))


@dataclass(frozen=True)
class TrainedDiffusion:
    """The model, and its held-out loss while it was trained."""

    model: PathDiffusion
    history: list[dict[str, float]]


def planned_examples(task: PathTask) -> Examples:
    """Certified paths between random ends, each in both directions.

    The ends are drawn as the benchmark's are, with a seed of their own.  Trees are not asked: they
    take most of the time, and find a path hardly more often.
    Raises DatasetError if hardly anything satisfies the constraint.
    """
    settings, name = task.settings, task.constraint
    with Planner(task.bundle, "for training") as planner:
        manifold = ConstraintManifold(planner.robot, planner.constraints[name])
        planner.scene.become(task.scene)
        ends = draw_queries(task.scene, manifold, name, settings.queries, settings.query_seed)
        parts, found = replace(ALL_PARTS, tree=False), []
        for start, goal in zip(ends.starts, ends.goals, strict=True):
            path = planner.plan(start, goal, name, parts=parts)
            if path.status == "solved":
                found.append(resample(path.joints, POINTS))
    return examples_of(manifold, np.array(found), settings.modes)


def examples_of(
    manifold: ConstraintManifold, paths: Float[np.ndarray, "n t D"], modes: int
) -> Examples:
    """Of paths of one constraint at even times [rad]."""
    ways = (paths, paths[:, ::-1])
    return Examples(
        np.stack([conditions(manifold, way[:, 0], way[:, -1]) for way in ways]),
        np.stack([coefficients(way, modes) for way in ways]),
    )


class _Block(nn.Module):
    """Two layers beside a path that leaves everything as it is."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, h: Float[Tensor, "b w"]) -> Float[Tensor, "b w"]:
        return h + self.outer(nn.functional.silu(self.inner(nn.functional.silu(h))))


class Denoiser(nn.Module):
    """The network that `PathDiffusion.estimate` evaluates: x, the time and the conditions in, v
    out; v = 0 before it is trained.
    """

    def __init__(self, drawn: int, seen: int, width: int, blocks: int) -> None:
        super().__init__()
        self.first = nn.Linear(drawn + 2 * FREQUENCIES + seen, width)
        self.blocks = nn.ModuleList(_Block(width) for _ in range(blocks))
        self.last = nn.Linear(width, drawn)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(
        self, x: Float[Tensor, "b x"], s: Float[Tensor, "b 1"], known: Float[Tensor, "b c"]
    ) -> Float[Tensor, "b x"]:
        """Estimates v of x at the times s."""
        h = self.first(torch.cat([x, _seen_times(s), known], dim=1))
        for block in self.blocks:
            h = block(h)
        found: Tensor = self.last(nn.functional.silu(h))
        return found


def train_path_diffusion(
    examples: Examples, settings: PathDiffusionParams, report: Report
) -> TrainedDiffusion:
    """Learn to draw the paths of the examples.

    report: called with the step and the held-out loss, the mean square error of v on paths that
    are held out in both directions.
    """
    torch.manual_seed(settings.seed)
    scales = _scales(examples)
    x, known = _scaled(examples, scales)
    held = _held(examples.paths.shape[1], settings)
    network = Denoiser(x.shape[1], known.shape[1], settings.width, settings.blocks)
    optimiser = torch.optim.AdamW(network.parameters(), settings.learning_rate)
    averaged = {name: value.clone() for name, value in network.state_dict().items()}
    history: list[dict[str, float]] = []
    rows = torch.from_numpy(np.flatnonzero(~held))
    for step in range(1, settings.steps + 1):
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * _rate(step, settings.steps)
        batch = rows[torch.randint(len(rows), (settings.batch_size,))]
        loss = _loss(network, x[batch], known[batch], torch.rand(len(batch), 1))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        _average(averaged, network, step)
        if step % REPORTED == 0 or step == settings.steps:
            figures = {"held_out_loss": _held_out(network, averaged, x[held], known[held])}
            history.append({"step": float(step), **figures})
            report(step, figures)
    weights = {name: value.numpy() for name, value in averaged.items()}
    return TrainedDiffusion(PathDiffusion({**weights, **scales}), history)


def _held(paths: int, settings: PathDiffusionParams) -> Bool[np.ndarray, "rows"]:
    """Which rows are held out: at least one path, there and back."""
    held = np.random.default_rng(settings.seed).random(paths) < settings.held_out
    held[0] = True
    return np.tile(held, 2)


def _scales(examples: Examples) -> dict[str, np.ndarray]:
    scales = {
        "scale": examples.paths.std(axis=(0, 1)),
        "seen_mean": examples.seen.mean(axis=(0, 1)),
        "seen_scale": examples.seen.std(axis=(0, 1)) + LEAST_SCALE,
    }
    return {name: values.astype(np.float32) for name, values in scales.items()}


def _scaled(examples: Examples, scales: Mapping[str, np.ndarray]) -> tuple[Tensor, Tensor]:
    modes, dof = scales["scale"].shape
    x = (examples.paths / scales["scale"]).reshape(-1, modes * dof)
    known = (examples.seen - scales["seen_mean"]) / scales["seen_scale"]
    return torch.from_numpy(x).float(), torch.from_numpy(known).flatten(0, 1).float()


def _rate(step: int, steps: int) -> float:
    """Share of the learning rate: a rise, then half a cosine down to a hundredth."""
    return float(max(0.5 + 0.5 * np.cos(np.pi * step / steps), 0.01) * min(step / WARM_UP, 1.0))


def _loss(network: Denoiser, x: Tensor, known: Tensor, s: Tensor) -> Tensor:
    """Mean square error of v at the times s."""
    noise, angle = torch.randn_like(x), 0.5 * torch.pi * s
    cos, sin = torch.cos(angle), torch.sin(angle)
    wrong = network(cos * x + sin * noise, s, known) - (cos * noise - sin * x)
    return wrong.square().mean()


def _seen_times(s: Tensor) -> Tensor:
    return torch.from_numpy(seen_times(s.numpy())).to(s.dtype)


@torch.no_grad()
def _average(averaged: Mapping[str, Tensor], network: Denoiser, step: int) -> None:
    """Move averaged weights towards the network's, faster while there were few steps."""
    kept = min(AVERAGED, (1 + step) / (10 + step))
    for name, value in network.state_dict().items():
        averaged[name].lerp_(value, 1.0 - kept)


@torch.no_grad()
def _held_out(network: Denoiser, averaged: Mapping[str, Tensor], x: Tensor, known: Tensor) -> float:
    """Loss of the averaged weights, at even times and the same noise every time."""
    own = {name: value.clone() for name, value in network.state_dict().items()}
    network.load_state_dict(dict(averaged))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        times = (torch.arange(CHECKED_TIMES) + 0.5) / CHECKED_TIMES
        losses = [float(_loss(network, x, known, s.expand(len(x), 1))) for s in times]
    network.load_state_dict(own)
    return float(np.mean(losses))
