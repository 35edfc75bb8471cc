"""Baselines that learn the set of a demonstration's rows as the zeros of a network: a level-set
network as in ECoMaNN (Sutanto et al., 2020) and a residual network.

Both are trained on the rows and on places beside them, along the directions across the rows that
local models give.  The rank is told.  A network sees joints or the tool's pose, by which local
models are nearer to demonstrations left out; its size, its steps and how far beside the rows it is
trained were chosen by hand on three of the tasks.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from constraint_geodesics.robot.kinematics import SerialRobot
from constraint_geodesics.studies.local_models import (
    Answer,
    LocalModels,
    band_between,
    joints_of,
    moved,
    poses_of,
)

WIDTH, BATCH, RATE = 128, 256, 3e-3
BESIDE = 0.2
"""How far beside the rows places are drawn, at most, in units of what is looked at."""
CHUNK = 250
"""Rows whose directions are computed at once."""
Loss = Callable[[nn.Module, "Beside"], Tensor]


@dataclass(frozen=True)
class Beside:
    """Rows y (b, k), one direction across and one along them each, and distances (b, 1)."""

    y: Tensor
    across: Tensor
    along: Tensor
    away: Tensor


def level_set(net: nn.Module, rows: Beside) -> Tensor:
    """Zero at the rows and the distance beside them; its slope one across the rows, none along
    them.
    """
    count, still = len(rows.y), torch.zeros_like(rows.y)
    places = torch.cat([rows.y, rows.y, rows.y + rows.away * rows.across])
    values, slopes = torch.func.jvp(net, (places,), (torch.cat([rows.along, rows.across, still]),))[
        :2
    ]
    at_rows, beside = values[:count], values[2 * count :]
    along, across = slopes[:count], slopes[count : 2 * count]
    return (
        at_rows.square().sum(-1)
        + (beside.norm(dim=-1) - rows.away[:, 0].abs()).square()
        + along.square().sum(-1)
        + (across.norm(dim=-1) - 1.0).square()
    ).mean()


def residual(net: nn.Module, rows: Beside) -> Tensor:
    """The way back to the rows from beside them; none at them."""
    back = net(rows.y + rows.away * rows.across) + rows.away * rows.across
    return (back.square().sum(-1) + net(rows.y).square().sum(-1)).mean()


class RowNetwork:
    """A network whose zeros are where the rows are, and a band on them."""

    def __init__(
        self,
        robot: SerialRobot,
        rows: Float[np.ndarray, "n D"],
        of: Int[np.ndarray, "n"],
        codim: int,
        loss: Loss,
        steps: int,
        seed: int,
    ) -> None:
        looks = (poses_of(robot), joints_of(robot))
        models = {look: LocalModels(look, rows, of, codim) for look in looks}
        self._look = min(looks, key=lambda look: models[look].left_out_rad)
        self._loss, self._seed = loss, seed
        outputs = codim if loss is level_set else None
        self._fit(models[self._look], rows, outputs, steps)

    def answer(self, start: np.ndarray, goal: np.ndarray) -> Answer:
        """A band on the network's zeros."""
        return band_between(self._projected, start, goal)

    def _fit(self, models: LocalModels, rows: np.ndarray, outputs: int | None, steps: int) -> None:
        seen = [self._look(part) for part in np.array_split(rows, max(len(rows) // CHUNK, 1))]
        across, along = (
            np.concatenate(own) for own in zip(*(models.frames(*own) for own in seen), strict=True)
        )
        y = np.concatenate([own for own, _ in seen])
        self._middle = y.mean(axis=0)
        self._size = max(float((y - self._middle).std()), 1e-3)
        outputs = outputs or y.shape[1]
        torch.manual_seed(self._seed)
        net = nn.Sequential(
            *(nn.Linear(y.shape[1], WIDTH), nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Tanh()),
            nn.Linear(WIDTH, outputs),
        )
        data = [torch.as_tensor(own).float() for own in ((y - self._middle) / self._size,)]
        data += [torch.as_tensor(own).float() for own in (across, along)]
        optimiser = torch.optim.Adam(net.parameters(), RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, 0.01 * RATE)
        order = torch.Generator().manual_seed(self._seed)
        for _ in range(steps):
            optimiser.zero_grad(set_to_none=True)
            self._loss(net, self._beside(data, order)).backward()
            optimiser.step()
            schedule.step()
        self._layers = [
            (own.weight.detach().double().numpy(), own.bias.detach().double().numpy())
            for own in net
            if isinstance(own, nn.Linear)
        ]

    def _beside(self, data: list[Tensor], order: torch.Generator) -> Beside:
        rows = torch.randint(len(data[0]), (BATCH,), generator=order)
        y, across, along = (own[rows] for own in data)
        away = (BESIDE / self._size) * torch.rand(BATCH, 1, generator=order)
        return Beside(y, _any_of(across, order), _any_of(along, order), away)

    def _move(self, q: np.ndarray) -> np.ndarray:
        """The step of the joints towards the zeros."""
        y, slopes = self._look(q)
        (w1, b1), (w2, b2), (w3, b3) = self._layers
        first = np.tanh((y - self._middle) / self._size @ w1.T + b1)
        second = np.tanh(first @ w2.T + b2)
        value = second @ w3.T + b3
        if self._loss is residual:
            return moved(-self._size * value, slopes)
        steep = (w3 * (1.0 - second**2)[:, None]) @ w2 * (1.0 - first**2)[:, None] @ w1
        return moved(value, steep @ slopes / self._size)

    def _projected(self, q: np.ndarray, steps: int) -> np.ndarray:
        q = q.copy()
        for _ in range(steps):
            q += self._move(q)
        return q


def _any_of(directions: Float[Tensor, "b c k"], order: torch.Generator) -> Float[Tensor, "b k"]:
    """A random unit vector of the space that each of some sets of directions spans."""
    weights = torch.randn(len(directions), 1, directions.shape[1], generator=order)
    found = (weights @ directions)[:, 0]
    return found / found.norm(dim=-1, keepdim=True).clamp_min(1e-9)
