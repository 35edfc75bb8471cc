"""The sub-manifold of a learned manifold on which a constraint holds: {z : ι_C(z) = 0} and its
components, eq. 8.

In two latent dimensions it is drawn on a grid; in more, configurations on the constraint are
encoded and joined by a nearest-neighbour graph whose edges were checked.  The learned manifold is
used as it is, never retrained.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from constraint_geodesics.constraints.constraint import ConstraintManifold
from constraint_geodesics.constraints.projection import Retraction
from constraint_geodesics.geometry.graph import (
    components,
    components_on_grid,
    nearest_neighbour_edges,
)
from constraint_geodesics.learning.lift import Chart, jump_excess, lift
from constraint_geodesics.params import SubmanifoldParams

Free = Callable[[Float[np.ndarray, "m D"]], Bool[np.ndarray, "m"]]
"""Which configurations touch neither the arm itself nor the workcell."""
UNKNOWN = -1

ARRAYS, CARD = "submanifold.npz", "submanifold.json"


@dataclass(frozen=True)
class GridSubmanifold:
    """In a latent plane: grid lines (G,) along both axes, ι_C (G, G) [rad or m], components (G, G),
    −1 outside.
    """

    first_axis: Float[np.ndarray, "G"]
    second_axis: Float[np.ndarray, "G"]
    inclusion: Float[np.ndarray, "G G"]
    labels: Int[np.ndarray, "G G"]


@dataclass(frozen=True)
class GraphSubmanifold:
    """In more dimensions: nodes as latent points (n, N) and joints (n, D) [rad], checked edges,
    their lengths [rad], and the component of each node, 0 the largest.
    """

    latent: Float[np.ndarray, "n N"]
    joints: Float[np.ndarray, "n D"]
    edges: Int[np.ndarray, "m 2"]
    lengths: Float[np.ndarray, "m"]
    labels: Int[np.ndarray, "n"]


Submanifold = GridSubmanifold | GraphSubmanifold


def extract(
    chart: Chart,
    manifold: ConstraintManifold,
    free_joints: Float[np.ndarray, "n D"],
    constrained: Float[np.ndarray, "m D"],
    free: Free,
    params: SubmanifoldParams,
) -> Submanifold:
    """The sub-manifold in the form that the latent dimension allows.

    free_joints: what the manifold was trained on; constrained: configurations that satisfy the
    constraint.
    """
    if chart.dim == 2:
        return on_grid(chart, manifold, chart.encode(free_joints), params)
    return on_graph(chart, manifold, constrained[: params.nodes], free, params)


def on_grid(
    chart: Chart,
    manifold: ConstraintManifold,
    data: Float[np.ndarray, "n N"],
    params: SubmanifoldParams,
) -> GridSubmanifold:
    """Inclusion map of the decoded poses over the part of the latent plane that the data reaches
    (Fig. 4b).

    An axis held exactly leaves a set too thin for any grid: it counts as kept within the grid's
    resolution.
    """
    low, high = data.min(axis=0), data.max(axis=0)
    first, second = (np.linspace(low[k], high[k], params.grid) for k in range(2))
    decoded = chart.decode(np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1))
    inside = within_resolution(manifold, params).violation(decoded) <= 0
    return GridSubmanifold(
        first, second, manifold.violation(decoded), components_on_grid(inside, (False, False))
    )


def on_graph(
    chart: Chart,
    manifold: ConstraintManifold,
    joints: Float[np.ndarray, "n D"],
    free: Free,
    params: SubmanifoldParams,
) -> GraphSubmanifold:
    """Graph over configurations of the constraint manifold, joined to their nearest neighbours
    where an edge holds.
    """
    edges = nearest_neighbour_edges(joints, params.neighbours)
    checked = check_edges(
        chart, manifold, joints[edges[:, 0]], joints[edges[:, 1]], free, params.edge_points
    )
    edges, lengths = edges[np.isfinite(checked)], checked[np.isfinite(checked)]
    return GraphSubmanifold(
        chart.encode(joints), joints, edges, lengths, components(len(joints), edges)
    )


def check_edges(
    chart: Chart,
    manifold: ConstraintManifold,
    starts: Float[np.ndarray, "m D"],
    goals: Float[np.ndarray, "m D"],
    free: Free,
    points: int,
) -> Float[np.ndarray, "m"]:
    """Length [rad] of each edge, or inf where it does not hold.

    It holds if the straight latent line between its ends, retracted, has no jump, keeps the joint
    limits and touches nothing.
    """
    t = np.linspace(0.0, 1.0, points)
    first, last = chart.encode(starts)[:, None], chart.encode(goals)[:, None]
    lifted = lift(
        chart,
        manifold,
        (1 - t[:, None]) * first + t[:, None] * last,
        t,
        starts,
        goals,
        Retraction(),
    )
    holds = (jump_excess(lifted.joints, t) == 0) & (
        lifted.violation.max(axis=-1) <= Retraction().accuracy
    )
    holds &= manifold.robot.limit_distance(lifted.joints).min(axis=-1) >= 0
    inner = lifted.joints[holds, 1:-1]
    holds[holds] = free(inner.reshape(-1, starts.shape[1])).reshape(inner.shape[:2]).all(axis=1)
    return np.where(
        holds, np.linalg.norm(np.diff(lifted.joints, axis=1), axis=-1).sum(axis=1), np.inf
    )


def component_of(
    submanifold: GraphSubmanifold,
    chart: Chart,
    manifold: ConstraintManifold,
    q: Float[np.ndarray, "D"],
    free: Free,
    params: SubmanifoldParams,
) -> int:
    """Component of a configuration: that of the nearest node an edge reaches, or UNKNOWN if none of
    them can be.
    """
    order = np.argsort(np.linalg.norm(submanifold.joints - q, axis=-1))[: 4 * params.neighbours]
    nodes = submanifold.joints[order]
    lengths = check_edges(
        chart, manifold, np.broadcast_to(q, nodes.shape), nodes, free, params.edge_points
    )
    if not np.isfinite(lengths).any():
        return UNKNOWN
    return int(submanifold.labels[order[np.argmin(lengths)]])


def within_resolution(
    manifold: ConstraintManifold, params: SubmanifoldParams
) -> ConstraintManifold:
    """The same constraint with every held axis loosened to the grid's resolution at least."""
    least = {"m": params.resolution_m, "rad": params.resolution_rad}
    return ConstraintManifold(manifold.robot, manifold.constraint.loosened(least))


def submanifold_figures(
    submanifold: Submanifold,
    chart: Chart,
    manifold: ConstraintManifold,
    free: Float[np.ndarray, "n D"],
    constrained: Float[np.ndarray, "m D"],
    params: SubmanifoldParams,
) -> dict[str, float]:
    """Number and sizes of the components, share of the free data inside, and how well the decoder
    keeps the constraint.

    share_inside: decoded poses of the free data that satisfy the constraint within the resolution.
    decoded_violation_*: excess at the decoded poses of configurations that satisfy the constraint
    exactly.
    """
    labels = submanifold.labels[submanifold.labels >= 0]
    sizes = np.bincount(labels) if len(labels) else np.zeros(0, dtype=int)
    violation = manifold.violation(chart.decode(chart.encode(constrained)))
    inside = within_resolution(manifold, params).violation(chart.decode(chart.encode(free))) <= 0
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
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ARRAYS).open("wb") as file:
        np.savez_compressed(file, **vars(submanifold))
    form = "grid" if isinstance(submanifold, GridSubmanifold) else "graph"
    (folder / CARD).write_text(json.dumps({"form": form}) + "\n")


def load_submanifold(folder: Path) -> Submanifold:
    """Read what `save_submanifold` wrote."""
    form = json.loads((folder / CARD).read_text())["form"]
    with np.load(folder / ARRAYS, allow_pickle=False) as arrays:
        return (GridSubmanifold if form == "grid" else GraphSubmanifold)(**arrays)
