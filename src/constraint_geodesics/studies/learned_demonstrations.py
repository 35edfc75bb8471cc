"""What is learned of the same demonstrations that constraints are identified from: a level-set
network, a residual network, and the paper's VAE with geodesics by descent and by a policy; judged
by the hidden formula.
"""

import shutil
import time
from collections.abc import Iterator

from constraint_geodesics.params import GeodesicParams, ManifoldParams
from constraint_geodesics.planner import Planner
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.studies.demonstrations import (
    DESCENT,
    FLAT,
    LEVEL_SET,
    POLICY,
    RESIDUAL,
    Answering,
    Cell,
    Columns,
    asked_all,
    flat_rows,
    kept_rows,
    pairs_of,
)
from constraint_geodesics.studies.row_latents import RowLatents
from constraint_geodesics.studies.row_networks import RowNetwork, level_set, residual


def measure(cell: Cell) -> list[Columns]:
    """Rows of one cell; those of an earlier run that was interrupted are taken as they are."""
    return kept_rows(cell, _rows)


def _rows(cell: Cell) -> Iterator[Columns]:
    scene = Scene.from_params(cell.params)
    with Planner.load(cell.layout.planner) as planner:
        pairs = pairs_of(cell, planner, cell.settings.peer_pairs)
    for method, answer, seconds in _trained(cell, scene):
        if pairs:
            answer(*pairs[0][:2])  # what is loaded late is no query's
        for row in asked_all(cell, scene.robot, method, answer, pairs):
            yield row | {"trained_s": seconds}


def _trained(cell: Cell, scene: Scene) -> Iterator[tuple[str, Answering, float]]:
    """Each method, trained on the cell's demonstrations, and the seconds that it took."""
    robot, own, scratch = scene.robot, cell.settings.learned, cell.kept.parent / "training"
    codim = cell.hidden.manifold(robot).codim
    rows, of = flat_rows(cell.shown(scene))
    losses = {LEVEL_SET: (level_set, own.level_set_steps), RESIDUAL: (residual, own.residual_steps)}
    for name, (loss, steps) in losses.items() if codim else ():  # they hold or leave free
        began = time.perf_counter()
        network = RowNetwork(robot, rows, of, codim, loss, steps, cell.seed)
        yield name, network.answer, time.perf_counter() - began
    began = time.perf_counter()
    latents = RowLatents(robot, rows, _vae(cell, len(rows), robot.dof - codim), scratch)
    seconds = time.perf_counter() - began
    yield DESCENT, latents.by_descent(), seconds
    yield FLAT, latents.without_variance(), seconds
    began = time.perf_counter()
    by_policy = latents.by_policy(_policy(cell), cell.seed)
    yield POLICY, by_policy, seconds + time.perf_counter() - began
    shutil.rmtree(scratch, ignore_errors=True)


def _vae(cell: Cell, rows: int, dim: int) -> ManifoldParams:
    own = cell.settings.learned
    changed = {
        "latent_dim": dim,
        "seed": cell.seed,
        "beta": own.beta,
        "epochs": own.epochs,
        "patience": own.epochs,
        "batch_size": max(rows // own.batches, 1),
    }
    return cell.params.manifolds[own.vae].model_copy(update=changed)


def _policy(cell: Cell) -> GeodesicParams:
    return cell.params.geodesics.model_copy(update={"steps": cell.settings.learned.policy_steps})
