"""What is learned of the same demonstrations that constraints are identified from: a level-set
network, a residual network, and the paper's VAE with geodesics by descent and by a policy; judged
by the hidden formula.
"""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from constraint_geodesics.params import GeodesicParams, ManifoldParams
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.demonstrations import (
    DESCENT,
    FLAT,
    LEVEL_SET,
    NETWORK_SEEDS,
    POLICY,
    RESIDUAL,
    Answering,
    Cell,
    Columns,
    asked_all,
    flat_rows,
    pairs_of,
)
from constraint_geodesics.studies.row_latents import RowLatents
from constraint_geodesics.studies.row_networks import RowNetwork, level_set, residual

Trained = Iterator[tuple[str, Answering, float]]
"""Methods, each trained on a cell's demonstrations, and the seconds that it took."""


@dataclass(frozen=True)
class Training:
    """What is trained together on one cell's demonstrations; picklable.  scratch: a folder for its
    checkpoints.
    """

    cell: Cell
    trained: Callable[[Cell, Scene, Path], Trained]
    scratch: Path


def trainings_of(cells: Sequence[Cell], scratch: Path) -> list[Training]:
    """All of them."""
    return [
        Training(cell, trained, scratch / f"{number}-{trained.__name__}")
        for number, cell in enumerate(cells)
        for trained in (_networks, _latents)
    ]


def measure(training: Training) -> list[Columns]:
    """Rows of what is trained together."""
    return list(_rows(training))


def _rows(training: Training) -> Iterator[Columns]:
    cell = training.cell
    scene = Scene.from_params(cell.params)
    with Planner.load(cell.layout.planner) as planner:
        pairs = pairs_of(cell, planner, cell.settings.peer_pairs)
    for method, answer, seconds in training.trained(cell, scene, training.scratch):
        if pairs:
            answer(*pairs[0][:2])  # what is loaded late is no query's
        for row in asked_all(cell, scene.robot, method, answer, pairs):
            yield row | {"trained_s": seconds}


def _networks(cell: Cell, scene: Scene, _: Path) -> Trained:
    own, codim = cell.settings.learned, cell.hidden.manifold(scene.robot).codim
    # they hold something or nothing, and no tolerance
    if not codim or cell.seed not in cell.settings.seeds[:NETWORK_SEEDS]:
        return
    rows, of = flat_rows(cell.shown(scene))
    losses = {LEVEL_SET: (level_set, own.level_set_steps), RESIDUAL: (residual, own.residual_steps)}
    for name, (loss, steps) in losses.items():
        began = time.perf_counter()
        network = RowNetwork(scene.robot, rows, of, codim, loss, steps, cell.seed)
        yield name, network.answer, time.perf_counter() - began


def _latents(cell: Cell, scene: Scene, scratch: Path) -> Trained:
    robot = scene.robot
    rows, _ = flat_rows(cell.shown(scene))
    began = time.perf_counter()
    dim = robot.dof - cell.hidden.manifold(robot).codim
    latents = RowLatents(robot, rows, _vae(cell, len(rows), dim), scratch)
    seconds = time.perf_counter() - began
    yield DESCENT, latents.by_descent(), seconds
    yield FLAT, latents.without_variance(), seconds
    began = time.perf_counter()
    by_policy = latents.by_policy(_policy(cell), cell.seed)
    yield POLICY, by_policy, seconds + time.perf_counter() - began
    shutil.rmtree(scratch, ignore_errors=True)


def _vae(cell: Cell, rows: int, dim: int) -> ManifoldParams:
    own = cell.settings.learned
    base = cell.params.manifolds[own.vae]
    changed = {
        "latent_dim": dim,
        "seed": cell.seed,
        "beta": own.beta,
        "epochs": own.epochs,
        "variance_epochs": max(base.variance_epochs * own.epochs // base.epochs, 1),
        "patience": own.epochs,
        "batch_size": max(rows // own.batches, 1),
    }
    return base.model_copy(update=changed)


def _policy(cell: Cell) -> GeodesicParams:
    return cell.params.geodesics.model_copy(update={"steps": cell.settings.learned.policy_steps})
