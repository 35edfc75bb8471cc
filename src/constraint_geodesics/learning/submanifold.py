"""The sub-manifold on which a constraint holds, {z : ι_C(z) = 0}, and its components, eq. 8.

In two latent dimensions on a grid; in more as a graph of configurations on the constraint whose
edges were checked.  The learned manifold is used as it is, never retrained.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from constraint_geodesics.array_files import read_npz
from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.geometry.graph import (
    components,
    components_on_grid,
    nearest_neighbour_edges,
)
from constraint_geodesics.learning.lift import Chart, corrected, jump_excess, retracted
from constraint_geodesics.params import SubmanifoldParams
from constraint_geodesics.text_files import read_json, reading, write_text, written

Free = Callable[[Float[np.ndarray, "m D"]], Bool[np.ndarray, "m"]]
"""Which configurations touch neither the arm itself nor the workcell."""

ARRAYS, CARD = "submanifold.npz", "submanifold.json"


@dataclass(frozen=True)
class GridSubmanifold:
    """In a latent plane: grid lines along both axes, ι_C [rad or m], components, −1 outside."""

    first_axis: Float[np.ndarray, "G"]
    second_axis: Float[np.ndarray, "G"]
    inclusion: Float[np.ndarray, "G G"]
    labels: Int[np.ndarray, "G G"]


@dataclass(frozen=True)
class GraphSubmanifold:
    """In more dimensions: nodes, checked edges [rad], and each node's component, 0 the largest."""

    latent: Float[np.ndarray, "n N"]
    joints: Float[np.ndarray, "n D"]
    edges: Int[np.ndarray, "m 2"]
    lengths: Float[np.ndarray, "m"]
    labels: Int[np.ndarray, "n"]


Submanifold = GridSubmanifold | GraphSubmanifold


@dataclass(frozen=True)
class Surface:
    """A constraint on a learned manifold, and which configurations are free."""

    learned: Chart
    manifold: ConstraintManifold
    free: Free


def extract(
    surface: Surface,
    free_joints: Float[np.ndarray, "n D"],
    constrained: Float[np.ndarray, "m D"],
    params: SubmanifoldParams,
) -> Submanifold:
    """The sub-manifold in the form that the latent dimension allows.

    free_joints: what the manifold was trained on.  constrained: satisfy the constraint.
    """
    if surface.learned.dim == 2:
        data = surface.learned.encode(free_joints)
        return on_grid(surface.learned, surface.manifold, data, params)
    return on_graph(surface, constrained[: params.nodes], params)


def on_grid(
    learned: Chart,
    manifold: ConstraintManifold,
    data: Float[np.ndarray, "n N"],
    params: SubmanifoldParams,
) -> GridSubmanifold:
    """Inclusion map of the decoded poses over the data's bounding box in the plane, Fig. 4b; limits
    and collisions are not looked at.

    An axis held exactly leaves a set too thin for any grid: it counts as kept within the grid's
    resolution.
    """
    low, high = data.min(axis=0), data.max(axis=0)
    first, second = (np.linspace(low[k], high[k], params.grid) for k in range(2))
    decoded = learned.decode(np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1))
    inside = within_resolution(manifold, params).violation(decoded) <= 0
    labels = components_on_grid(inside, (False, False))
    return GridSubmanifold(first, second, manifold.violation(decoded), labels)


def on_graph(
    surface: Surface, joints: Float[np.ndarray, "n D"], params: SubmanifoldParams
) -> GraphSubmanifold:
    """Configurations on the constraint, joined to nearest neighbours where an edge holds."""
    edges = nearest_neighbour_edges(joints, params.neighbours)
    lengths = check_edges(surface, joints[edges[:, 0]], joints[edges[:, 1]], params.edge_points)
    holds = np.isfinite(lengths)
    edges, latent = edges[holds], surface.learned.encode(joints)
    labels = components(len(joints), edges)
    return GraphSubmanifold(latent, joints, edges, lengths[holds], labels)


def check_edges(
    surface: Surface, starts: Float[np.ndarray, "m D"], goals: Float[np.ndarray, "m D"], points: int
) -> Float[np.ndarray, "m"]:
    """Length [rad] of each edge, or inf where it does not hold.

    It holds if the straight latent line between its ends, retracted, has no jump, keeps the joint
    limits and touches nothing.
    """
    learned, manifold = surface.learned, surface.manifold
    t = np.linspace(0.0, 1.0, points)
    first, last = learned.encode(starts)[:, None], learned.encode(goals)[:, None]
    line = learned.decode((1 - t[:, None]) * first + t[:, None] * last)
    lifted = retracted(manifold, corrected(line, t, starts, goals), Retraction())
    joints = lifted.joints
    holds = jump_excess(joints, t) == 0
    holds &= lifted.violation.max(axis=-1) <= Retraction().accuracy
    holds &= manifold.robot.limit_distance(joints).min(axis=-1) >= 0
    inner = joints[holds, 1:-1]
    untouched = surface.free(inner.reshape(-1, starts.shape[1]))
    holds[holds] = untouched.reshape(inner.shape[:2]).all(axis=1)
    lengths = np.linalg.norm(np.diff(joints, axis=1), axis=-1).sum(axis=1)
    return np.where(holds, lengths, np.inf)


def components_of(
    submanifold: GraphSubmanifold,
    surface: Surface,
    q: Float[np.ndarray, "D"],
    params: SubmanifoldParams,
) -> set[int]:
    """Components of the nodes near q that an edge from it reaches; none if there is none."""
    near = np.argsort(np.linalg.norm(submanifold.joints - q, axis=-1))
    near = near[: 4 * params.neighbours]
    nodes = submanifold.joints[near]
    lengths = check_edges(surface, np.broadcast_to(q, nodes.shape), nodes, params.edge_points)
    return set(submanifold.labels[near[np.isfinite(lengths)]].tolist())


def within_resolution(
    manifold: ConstraintManifold, params: SubmanifoldParams
) -> ConstraintManifold:
    """The same constraint with every held axis loosened to the grid's resolution at least."""
    least = {"m": params.resolution_m, "rad": params.resolution_rad}
    return ConstraintManifold(manifold.robot, manifold.constraint.loosened(least))


def submanifold_figures(
    submanifold: Submanifold,
    surface: Surface,
    free_joints: Float[np.ndarray, "n D"],
    constrained: Float[np.ndarray, "m D"],
    params: SubmanifoldParams,
) -> dict[str, float]:
    """Number and sizes of the components, and how well the decoder keeps the constraint.

    share_inside: decoded poses of the free data that satisfy the constraint within the resolution.
    decoded_violation_*: excess at the decoded poses of configurations that satisfy it exactly.
    """
    labels = submanifold.labels[submanifold.labels >= 0]
    sizes = np.bincount(labels) if len(labels) else np.zeros(0, dtype=int)
    learned, manifold = surface.learned, surface.manifold
    violation = manifold.violation(learned.decode(learned.encode(constrained)))
    loose = within_resolution(manifold, params)
    inside = loose.violation(learned.decode(learned.encode(free_joints))) <= 0
    return {
        "components": float(len(sizes)),
        "components_of_ten_or_more": float((sizes >= 10).sum()),
        "largest_component_share": float(sizes.max() / sizes.sum()) if len(sizes) else 0.0,
        "share_inside": float(inside.mean()),
        "decoded_violation_median": float(np.median(violation)),
        "decoded_violation_p95": float(np.quantile(violation, 0.95)),
    }


def save_submanifold(submanifold: Submanifold, folder: Path) -> None:
    """Write the arrays (npz) and which form they have (JSON)."""
    with written(folder / ARRAYS) as part:
        np.savez_compressed(part, **vars(submanifold))
    form = "grid" if isinstance(submanifold, GridSubmanifold) else "graph"
    write_text(folder / CARD, json.dumps({"form": form}) + "\n")


def load_submanifold(folder: Path) -> Submanifold:
    """Read what `save_submanifold` wrote.  Raises DamagedFileError."""
    with reading(folder / CARD):
        form = read_json(folder / CARD)["form"]
        kind = {"grid": GridSubmanifold, "graph": GraphSubmanifold}[form]
    with reading(folder / ARRAYS):
        return kind(**read_npz(folder / ARRAYS))
