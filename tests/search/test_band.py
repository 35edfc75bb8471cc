"""Laws of the elastic band over constraints, its optimum against SLSQP, its Hessian against
differences.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import minimize
from tests.planner_fixtures import length

from constraint_geodesics.constraints.constraint import (
    Constraint,
    ConstraintManifold,
    Pose,
    constraint_manifold,
)
from constraint_geodesics.constraints.kernels import linearise
from constraint_geodesics.constraints.projection import retract
from constraint_geodesics.params import Params
from constraint_geodesics.scene.box import Box
from constraint_geodesics.scene.clearance import (
    ClearanceModel,
    clearance_model,
    new_contacts,
    path_stays_clear,
)
from constraint_geodesics.scene.scene import Scene
from constraint_geodesics.search import band_kernels
from constraint_geodesics.search.band import PROJECTION, BandSettings, project
from constraint_geodesics.search.curve_kernels import (
    LONGEST_ROW_STEP,
    curve_points,
    relaxed_curve,
    rows_along,
    spline_through,
)
from constraint_geodesics.search.push_kernels import new_push, new_samples, penalise
from constraint_geodesics.search.space import Space, space_of

MARGIN = 0.006
HOME = np.array([-1.35, -0.47, -0.87, -2.28, 0.34, 0.74])
OWN = {
    "held angle": Constraint((0, 0, 0, 1, 0, 0)),
    "held angle with tolerance": Constraint((0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 0.2)),
    "height with tolerance": Constraint((0, 0, 1, 0, 0, 0), (0, 0, 0.05, 0, 0, 0)),
    "angles with two tolerances": Constraint((0, 0, 0, 1, 1, 0), (0, 0, 0, 0.05, 0.2, 0)),
}
NAMED = ("free", "level_cup", "level_cup_relaxed", "slide", "fixed_orientation", "tool_down")
EXACT = ("level_cup", "slide", "fixed_orientation", "tool_down", "held angle")
EVERY = (*NAMED, *OWN)
SETTINGS = BandSettings(iterations=60, accuracy=1e-9)


@dataclass(frozen=True)
class Spaces:
    """Constraint manifolds of one robot by name, and its clearance to the table."""

    manifolds: dict[str, ConstraintManifold]
    model: ClearanceModel

    def clear(self, name: str) -> Space:
        return space_of(self.manifolds[name], self.model, MARGIN)

    def open(self, name: str) -> Space:
        return space_of(self.manifolds[name])

    def lines(
        self, name: str, segments: int, count: int, seed: int, spread: float = 1.0
    ) -> Iterator[np.ndarray]:
        """Straight joint lines between configurations of the space that are not too far apart."""
        manifold, rng = self.manifolds[name], np.random.default_rng(seed)
        robot = manifold.robot
        found = 0
        while found < count:
            start = retract(manifold, robot.sample(1, rng))
            goal = retract(
                manifold, start.joints + rng.uniform(-spread, spread, start.joints.shape)
            )
            ends = np.concatenate([start.joints, goal.joints])
            if (
                not (start.converged[0] and goal.converged[0])
                or np.linalg.norm(ends[1] - ends[0]) < 0.3
            ):
                continue
            if (
                robot.limit_distance(ends).min() > 0.0
                and self.model.clearance(robot, ends).min() > MARGIN
            ):
                found += 1
                yield straight(ends[0], ends[1], segments)


@pytest.fixture(scope="module")
def spaces(scene: Scene, params: Params) -> Spaces:
    robot = scene.robot
    reference = Pose(*robot.forward(HOME))
    manifolds = {name: constraint_manifold(scene.robot, params.constraints[name]) for name in NAMED}
    manifolds |= {
        name: ConstraintManifold(robot, constraint.relative_to(reference))
        for name, constraint in OWN.items()
    }
    return Spaces(manifolds, clearance_model(Scene(robot, scene.workcell)))


def straight(start: np.ndarray, goal: np.ndarray, segments: int) -> np.ndarray:
    share = np.linspace(0.0, 1.0, segments + 1)[:, None]
    return (1.0 - share) * start + share * goal


def bent(nodes: np.ndarray, size: float) -> np.ndarray:
    """The same ends with a bow between them, of `size` [rad] in every joint."""
    bow = (
        np.sin(np.linspace(0.0, np.pi, len(nodes)))[:, None]
        * size
        * np.array([1.0, -1.0] * 4)[: nodes.shape[1]]
    )
    bow[[0, -1]] = 0.0
    return nodes + bow


def energy(nodes: np.ndarray) -> float:
    return 0.5 * float(np.square(np.diff(nodes, axis=0)).sum())


def pulls(nodes: np.ndarray) -> np.ndarray:
    """e_i = 2 q_i − q_{i−1} − q_{i+1} of the inner nodes."""
    return 2.0 * nodes[1:-1] - nodes[:-2] - nodes[2:]


class Band(NamedTuple):
    """A relaxed band: nodes (n + 1, D) [rad], what is left of the violation, iterations, and
    whether it converged.
    """

    nodes: np.ndarray
    violation: float
    iterations: int
    converged: bool


def relax(
    space: Space,
    nodes: np.ndarray,
    settings: BandSettings,
    around: Space | None = None,
    guarded: bool = False,
) -> Band:
    """The shortest band near the given one, its ends fixed; pushed clear of what is around."""
    moved, steps = np.array(nodes, np.float64), settings.steps(guarded)
    return Band(moved, *band_kernels.relax_band(space, around or space, moved, steps))


def projected(space: Space, nodes: np.ndarray) -> tuple[np.ndarray, float]:
    """The band before any step is taken, and what its nodes leave of the violation."""
    band = relax(space, nodes, BandSettings(iterations=0))
    return band.nodes, band.violation


@pytest.mark.parametrize("name", EVERY)
def test_a_relaxed_band_keeps_its_space_and_is_never_longer(spaces, name) -> None:
    manifold, space = spaces.manifolds[name], spaces.open(name)
    robot, used = manifold.robot, 0
    for nodes in spaces.lines(name, 16, 40, seed=0):
        given = nodes.copy()
        before, left = projected(space, nodes)
        band = relax(space, nodes, BandSettings())
        np.testing.assert_array_equal(nodes, given)
        assert band.nodes[0].tobytes() == given[0].tobytes()
        assert band.nodes[-1].tobytes() == given[-1].tobytes()
        if left > 1e-6:
            continue
        used += 1
        assert band.violation <= 1e-6
        assert 0 < band.iterations <= BandSettings().iterations
        assert manifold.violation(band.nodes).max() <= 1e-6
        assert robot.limit_distance(band.nodes).min() >= -1e-6
        assert energy(band.nodes) <= energy(before) * (1.0 + 1e-12)
        # what falls is the energy; where unequal steps become equal, chords round a bend gain a
        # little
        assert length(band.nodes) <= length(before) * 1.01
    assert used >= 35


@pytest.mark.parametrize("segments", [12, 64])
@pytest.mark.parametrize("name", EXACT)
def test_no_tangential_pull_is_left(spaces, name, segments) -> None:
    """The reduced problem's gradient Nᵀe vanishes."""
    manifold, used = spaces.manifolds[name], 0
    for nodes in spaces.lines(name, segments, 25, seed=1):
        band = relax(spaces.open(name), nodes, SETTINGS)
        # near a limit the pull across it remains
        if not band.converged or manifold.robot.limit_distance(band.nodes[1:-1]).min() < 0.06:
            continue
        used += 1
        pull = pulls(band.nodes)
        rows = manifold.jacobian(band.nodes[1:-1])[:, manifold.rows.held]
        across = np.linalg.pinv(rows) @ rows @ pull[..., None]
        assert np.abs(pull - across[..., 0]).max() < 1e-4 * np.linalg.norm(nodes[-1] - nodes[0])
    assert used >= 15


def blocks(jacobians: np.ndarray) -> np.ndarray:
    """Rows (n, k, D) of each node as one matrix (n k, n D)."""
    n, k, dof = jacobians.shape
    matrix = np.zeros((n, k, n, dof))
    matrix[np.arange(n), :, np.arange(n)] = jacobians
    return matrix.reshape(n * k, n * dof)


def reference(manifold: ConstraintManifold, nodes: np.ndarray) -> np.ndarray:
    """The band of least energy by SLSQP on all nodes at once, from the same start."""
    dof, held, tolerance = manifold.robot.dof, manifold.rows.held, manifold.rows.tolerance
    exact, loose = held & (tolerance == 0.0), held & (tolerance > 0.0)
    is_cone = loose[3:].any() and len(set(tolerance[3:][held[3:]])) == 1
    entries = loose & ~np.array([False] * 3 + [is_cone] * 3)

    def band(x: np.ndarray) -> np.ndarray:
        return np.concatenate([nodes[:1], x.reshape(-1, dof), nodes[-1:]])

    def residual(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return manifold.linearise(x.reshape(-1, dof))

    constraints = []
    if exact.any():
        constraints.append(
            {
                "type": "eq",
                "fun": lambda x: residual(x)[0][:, exact].ravel(),
                "jac": lambda x: blocks(residual(x)[1][:, exact]),
            }
        )
    if is_cone:
        radius = tolerance[3:].max()
        constraints.append(
            {
                "type": "ineq",
                "fun": lambda x: radius**2 - np.square(residual(x)[0][:, 3:]).sum(axis=1),
                "jac": lambda x: blocks(-2.0 * residual(x)[0][:, None, 3:] @ residual(x)[1][:, 3:]),
            }
        )
    if entries.any():
        constraints.extend(
            {
                "type": "ineq",
                "fun": lambda x, sign=sign: (tolerance - sign * residual(x)[0])[:, entries].ravel(),
                "jac": lambda x, sign=sign: blocks(-sign * residual(x)[1][:, entries]),
            }
            for sign in (1.0, -1.0)
        )
    found = minimize(
        lambda x: energy(band(x)),
        nodes[1:-1].ravel(),
        jac=lambda x: pulls(band(x)).ravel(),
        constraints=constraints,
        bounds=[*zip(manifold.robot.lower, manifold.robot.upper, strict=True)] * (len(nodes) - 2),
        method="SLSQP",
        options={"maxiter": 300, "ftol": 1e-13},
    )
    assert found.success, found.message
    assert manifold.violation(band(found.x)).max() < 1e-6
    return band(found.x)


@pytest.mark.parametrize(
    "name",
    [
        *(name for name in NAMED if name != "free"),
        "held angle",
        "held angle with tolerance",
        "height with tolerance",
        "angles with two tolerances",
    ],
)
def test_the_energy_is_that_of_a_general_optimiser(spaces, name) -> None:
    manifold, space = spaces.manifolds[name], spaces.open(name)
    gained = []
    for nodes in spaces.lines(name, 8, 6, seed=3):
        start, left = projected(space, bent(nodes, 0.1))
        if left > 1e-6:
            continue
        best, band = reference(manifold, start), relax(space, start, SETTINGS)
        assert energy(band.nodes) == pytest.approx(energy(best), rel=1e-4)
        gained.append(1.0 - energy(best) / energy(start))
    assert len(gained) >= 5
    assert min(gained) > 0.02, "there was something to gain"


@pytest.mark.parametrize("name", ["level_cup_relaxed", "height with tolerance"])
def test_bands_within_a_tolerance_converge(spaces, name) -> None:
    space = spaces.open(name)
    bands = [relax(space, nodes, BandSettings()) for nodes in spaces.lines(name, 16, 40, seed=2)]
    assert np.mean([band.converged for band in bands]) > 0.9


@pytest.mark.parametrize("name", [name for name in EVERY if name != "free"])
def test_the_reduced_hessian_is_that_of_the_lagrangian(spaces, name) -> None:
    """H = Nᵀ (2 + Σ λ ∇²c) N against differences of Cᵀλ, with λ = −(C Cᵀ)⁻¹ C e of the rows that
    hold.
    """
    manifold = spaces.manifolds[name]
    robot, rng = manifold.robot, np.random.default_rng(4)
    far_away = np.stack([robot.lower - 100.0, robot.upper + 100.0])
    space = spaces.open(name)._replace(limits=far_away)
    work = band_kernels.new_work(space)
    curved = 0
    for start in retract(manifold, robot.sample(20, rng)).joints:
        rows_at, active = active_rows(manifold, start)
        rows = rows_at(start)
        # a pull outward keeps the rows of a tolerance active; one along the rows alone would leave
        # nothing to bend
        pull = rng.normal(size=robot.dof) - rows.T @ rng.uniform(0.5, 1.0, len(rows))
        weights = -np.linalg.solve(rows @ rows.T, rows @ pull)
        if not (weights[active] > 1e-3).all():
            continue
        basis, hessian, onto = (
            np.zeros((robot.dof,) * 2),
            np.zeros((robot.dof,) * 2),
            np.zeros(robot.dof),
        )
        linearise(space, start[None], work.looked)
        count = band_kernels.reduced(space, start, 0, pull, basis, hessian, onto, work)
        assert count == robot.dof - len(rows)
        basis, hessian = basis[:, :count], hessian[:count, :count]
        np.testing.assert_allclose(basis.T @ basis, np.eye(count), atol=1e-9)
        np.testing.assert_allclose(rows @ basis, 0.0, atol=1e-7)
        step = 1e-5
        moved = [
            (rows_at(start + step * direction) - rows_at(start - step * direction)).T
            @ weights
            / (2.0 * step)
            for direction in basis.T
        ]
        expected = np.array(moved) @ basis
        expected = 2.0 * np.eye(count) + 0.5 * (expected + expected.T)
        np.testing.assert_allclose(hessian, expected, atol=1e-3 * max(1.0, np.abs(expected).max()))
        curved += np.abs(expected - 2.0 * np.eye(count)).max() > 0.05
    assert curved >= 5 or name == "tool_down", "what its wrist leaves is flat"


def active_rows(manifold: ConstraintManifold, q: np.ndarray):
    """Rows ∂c/∂q that hold at q as a function of the joints, and which of them are inequalities."""
    residual, held, tolerance = manifold.residual(q), manifold.rows.held, manifold.rows.tolerance
    is_cone = (
        held[3:].any()
        and len(set(tolerance[3:][held[3:]])) == 1
        and tolerance[3:][held[3:]].max() > 0.0
    )
    near = np.abs(residual) >= tolerance - 0.05
    kept = held & near & ~(np.array([False] * 3 + [is_cone] * 3))
    signs = np.where((tolerance > 0.0) & (residual < 0.0), -1.0, 1.0)
    cone = is_cone and np.linalg.norm(residual[3:]) >= tolerance[3:].max() - 0.05

    def rows_at(joints: np.ndarray) -> np.ndarray:
        value, jacobian = manifold.linearise(joints)
        rows = [signs[kept, None] * jacobian[kept]]
        if cone:
            rows.append((value[3:] / np.linalg.norm(value[3:]) @ jacobian[3:])[None])
        return np.concatenate(rows)

    return rows_at, np.concatenate([tolerance[kept] > 0.0, np.ones(int(cone), bool)])


def test_null_spaces_are_orthonormal_and_complete() -> None:
    """Of rows in general position, of rows that depend on each other, and of none."""
    rng = np.random.default_rng(8)
    for size, rank in ((0, 0), (1, 1), (3, 3), (4, 2), (6, 5), (7, 7)):
        rows = rng.normal(size=(size, rank)) @ rng.normal(size=(rank, 7))
        basis, filled = np.empty((7, 7)), np.zeros((7, 7))
        filled[:size] = rows
        count = band_kernels.null_space(filled, size, basis)
        assert count == 7 - rank
        np.testing.assert_allclose(rows @ basis[:, :count], 0.0, atol=1e-12)
        np.testing.assert_allclose(basis[:, :count].T @ basis[:, :count], np.eye(count), atol=1e-14)


def test_without_a_constraint_a_bent_band_becomes_the_straight_line(spaces) -> None:
    robot, rng = spaces.manifolds["free"].robot, np.random.default_rng(5)
    for _ in range(10):
        start, goal = rng.uniform(robot.lower + 1.0, robot.upper - 1.0, (2, robot.dof))
        line = straight(start, goal, 16)
        band = relax(spaces.open("free"), bent(line, 0.3), SETTINGS)
        assert band.converged
        np.testing.assert_allclose(band.nodes, line, atol=1e-12)


def test_a_line_through_a_wall_is_lifted_out_of_it(spaces) -> None:
    manifold, rng = spaces.manifolds["free"], np.random.default_rng(6)
    robot = manifold.robot
    model = clearance_model(Scene(robot, (Box("wall", (0.5, 0.0, 0.15), (0.2, 2.0, 0.3)),)))
    space = space_of(manifold, model, MARGIN)
    lifted = 0
    for _ in range(800):
        ends = robot.sample(2, rng)
        line = straight(ends[0], ends[1], 16)
        depth = model.clearance(robot, line)
        if depth[[0, -1]].min() < 0.02 or not -0.15 < depth.min() < 0.0:
            continue
        band = relax(space, line, BandSettings())
        if band.violation > 1e-6:
            continue
        lifted += 1
        assert model.clearance(robot, band.nodes).min() >= MARGIN - 1e-6
        assert robot.limit_distance(band.nodes).min() >= -1e-6
        assert length(line) < length(band.nodes) < 2.0 * length(line)
    assert lifted >= 5


def test_another_robot_is_relaxed_as_well(kuka_scene) -> None:
    robot = kuka_scene.robot
    home = np.full(robot.dof, 0.6)
    manifold = ConstraintManifold(
        robot, Constraint((0, 0, 1, 1, 1, 0), reference=Pose(*robot.forward(home)))
    )
    spaces = Spaces({"slide": manifold}, clearance_model(Scene(robot, kuka_scene.workcell)))
    for nodes in spaces.lines("slide", 8, 5, seed=7, spread=0.7):
        start, left = projected(spaces.open("slide"), nodes)
        assert left <= 1e-6
        band = relax(spaces.open("slide"), nodes, SETTINGS)
        assert energy(band.nodes) == pytest.approx(energy(reference(manifold, start)), rel=1e-4)


def test_bands_of_one_segment_or_of_no_numbers_end(spaces) -> None:
    space, around = spaces.open("level_cup"), spaces.clear("level_cup")
    ends = next(spaces.lines("level_cup", 1, 1, seed=8))
    np.testing.assert_array_equal(relax(space, ends, BandSettings(), around).nodes, ends)
    for bad in (np.nan, np.inf):
        nodes = next(spaces.lines("level_cup", 8, 1, seed=8))
        nodes[3, 2] = bad
        band = relax(space, nodes, BandSettings(), around)
        assert not band.converged
        assert not spline_through(band.nodes)[1]


@pytest.mark.parametrize("name", EVERY)
def test_a_curve_runs_through_its_ends_and_on_the_constraint(spaces, name) -> None:
    manifold, space = spaces.manifolds[name], spaces.clear(name)
    robot, shares, judged = manifold.robot, np.linspace(0.0, 1.0, 200), 0
    for nodes in spaces.lines(name, 16, 5, seed=9):
        band = relax(spaces.open(name), nodes, BandSettings())
        curve, sound = spline_through(band.nodes)
        if band.violation > 1e-6 or not sound:
            continue
        judged += 1
        points, left = curve_points(space, curve, shares, PROJECTION)
        assert points[0].tobytes() == nodes[0].tobytes()
        assert points[-1].tobytes() == nodes[-1].tobytes()
        assert left <= 1e-6
        assert manifold.violation(points).max() <= 1e-6
        assert robot.limit_distance(points).min() >= -1e-6
        assert spaces.model.clearance(robot, points).min() >= MARGIN - 1e-6
        whole = curve.knots[-1]
        assert whole == pytest.approx(length(band.nodes), rel=1e-12)
        at_nodes = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(band.nodes, axis=0), axis=1))]
        )
        on_it = np.minimum(at_nodes / whole, 1.0)
        again, _ = curve_points(spaces.open(name), curve, on_it, PROJECTION)
        np.testing.assert_allclose(again, band.nodes, atol=1e-6)
        assert length(points) == pytest.approx(whole, rel=0.05)
    assert judged >= 3


@pytest.mark.parametrize("name", EVERY)
def test_rows_lie_on_the_space_and_lines_between_them_keep_the_constraint(spaces, name) -> None:
    manifold, space = spaces.manifolds[name], spaces.open(name)
    used = []
    for nodes in spaces.lines(name, 16, 5, seed=11):
        sound, _, points, total, _ = relaxed_curve(
            space, space, nodes, BandSettings().steps(), PROJECTION
        )
        if not sound:
            continue
        rows = rows_along(space, points, 1e-4, PROJECTION)
        assert rows[[0, -1]].tobytes() == points[[0, -1]].tobytes()
        assert manifold.violation(rows).max() <= 1e-6
        assert manifold.robot.limit_distance(rows).min() >= -1e-6
        assert length(rows) == pytest.approx(total, rel=0.01)
        steps = np.linalg.norm(np.diff(rows, axis=0), axis=1)
        assert steps.max() <= 1.1 * LONGEST_ROW_STEP
        between = np.linspace(0.0, 1.0, 9)[:, None, None] * np.diff(rows, axis=0) + rows[:-1]
        off = manifold.violation(between).max(axis=0)
        assert off.max() <= 1.3e-4
        used.append(np.maximum(off / 1e-4, np.square(steps / LONGEST_ROW_STEP)))
    assert np.median(np.concatenate(used)) > 0.7, "rows lie closer than they need to"


def test_there_is_no_curve_through_nodes_that_coincide_or_are_no_numbers(spaces) -> None:
    space = spaces.open("free")
    nodes = straight(HOME, HOME + 0.5, 8)
    assert spline_through(nodes)[1]
    for row, value in ((0, HOME + 0.5 / 8), (4, nodes[3]), (8, nodes[7]), (5, np.nan), (5, np.inf)):
        broken = nodes.copy()
        broken[row] = value
        assert not spline_through(broken)[1]
        np.testing.assert_array_equal(rows_along(space, broken, 1e-4, PROJECTION), broken)
    assert not spline_through(np.tile(HOME, (9, 1)))[1]


def test_points_are_projected_from_beside_the_space(spaces) -> None:
    """Limits, boxes and the constraint are kept together."""
    for name in ("level_cup", "slide", "height with tolerance"):
        manifold, space = spaces.manifolds[name], spaces.clear(name)
        robot, rng = manifold.robot, np.random.default_rng(10)
        points = np.concatenate(list(spaces.lines(name, 1, 30, seed=10)))
        moved = points + rng.uniform(-0.05, 0.05, points.shape)
        left = project(space, moved)
        assert left <= 1e-6
        assert manifold.violation(moved).max() <= 1e-6
        assert robot.limit_distance(moved).min() >= -1e-6
        assert spaces.model.clearance(robot, moved).min() >= MARGIN - 1e-6
        assert np.linalg.norm(moved - points, axis=1).max() < 0.5
        again = moved.copy()
        project(space, again)
        np.testing.assert_allclose(again, moved, atol=1e-7)


@pytest.fixture(scope="module")
def walled(spaces) -> Space:
    """The space of free motion round a wall."""
    manifold = spaces.manifolds["free"]
    wall = Box("wall", (0.5, 0.0, 0.15), (0.2, 2.0, 0.3))
    return space_of(manifold, clearance_model(Scene(manifold.robot, (wall,))), MARGIN)


def blocked_lines(spaces, walled: Space, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Straight lines of 8 segments, and which of these touch nothing."""
    rng, found = np.random.default_rng(7), 0
    while found < count:
        line = straight(*spaces.manifolds["free"].robot.sample(2, rng), 8)
        free = clear_segments(walled, line)
        if free.sum() <= 6:
            found += 1
            yield line, free


def clear_segments(space: Space, nodes: np.ndarray) -> np.ndarray:
    pairs = (np.stack(pair) for pair in itertools.pairwise(nodes))
    return np.array([path_stays_clear(space.chain, space.clearance, pair) for pair in pairs])


def test_no_line_of_a_guarded_band_is_moved_into_something(spaces, walled) -> None:
    """Those that touch something from the start are pushed out."""
    before = after = 0
    for line, free in blocked_lines(spaces, walled, 12):
        space = spaces.open("free")
        band = relax(space, line, BandSettings(iterations=8), walled, guarded=True)
        clear = clear_segments(walled, band.nodes)
        assert clear[free].all()
        before, after = before + free.sum(), after + clear.sum()
    assert after > before


def test_the_penalty_is_none_of_what_is_far_and_its_slopes_are_those_of_differences(
    spaces, walled
) -> None:
    robot, rng, margin = spaces.manifolds["free"].robot, np.random.default_rng(5), 0.03
    room, model = new_contacts(walled.clearance, HOME.size), ClearanceModel(walled.clearance)
    far = steep = 0
    while steep < 4 or far < 2:
        line = straight(*(robot.sample(1, rng) + rng.uniform(-0.3, 0.3, (2, HOME.size))), 4)
        samples = np.concatenate([line[1:-1], 0.5 * (line[1:] + line[:-1])])
        apart = model.clearance(robot, samples, 0.1)
        if far >= 2 and apart.min() >= margin:
            continue
        if apart.min() < 0.005:  # of what overlaps the direction is one of a few
            continue
        push = new_push(line)
        asked = push, room, new_samples(walled, line)
        value = penalise(walled, margin, line, *asked, 0.0, np.inf)
        if value > 0.0:  # no more is told of what is too much
            enough = penalise(walled, margin, line, *asked, 1.0, 1.0 + 0.5 * value)
            assert 1.0 + 0.5 * value <= enough <= 1.0 + value
            penalise(walled, margin, line, *asked, 0.0, np.inf)
        assert (value > 0.0) == (apart.min() < margin)
        far += value == 0.0
        slopes = push.slopes[1:-1].copy()
        # a distance is known to 1e-7 m
        allowed = 0.01 * np.linalg.norm(slopes) + 0.05
        steep += np.linalg.norm(slopes) > 1.0
        for node, joint in itertools.product(range(1, 4), range(HOME.size)):
            there, back = line.copy(), line.copy()
            there[node, joint] += 1e-4
            back[node, joint] -= 1e-4
            values = [penalise(walled, margin, at, *asked, 0.0, np.inf) for at in (there, back)]
            ahead, behind = (values[0] - value) / 1e-4, (value - values[1]) / 1e-4
            # where other corners come nearest there are two slopes
            assert min(ahead, behind) - allowed <= slopes[node - 1, joint]
            assert slopes[node - 1, joint] <= max(ahead, behind) + allowed


def test_what_pushes_a_band_curves_it_upwards(spaces, walled) -> None:
    """The blocks that two neighbours share are one matrix that is nowhere negative."""
    room, seen = new_contacts(walled.clearance, HOME.size), 0
    for line, _ in blocked_lines(spaces, walled, 6):
        push, dof = new_push(line), HOME.size
        penalise(walled, 0.02, line, push, room, new_samples(walled, line), 0.0, np.inf)
        whole = np.zeros((len(line), dof, len(line), dof))
        for i in range(len(line)):
            whole[i, :, i] = push.curvatures[i]
        for i in range(len(line) - 1):
            whole[i, :, i + 1], whole[i + 1, :, i] = push.crosses[i], push.crosses[i].T
        eigenvalues = np.linalg.eigvalsh(whole.reshape(len(line) * dof, -1))
        assert eigenvalues.min() >= -1e-9 * max(eigenvalues.max(), 1.0)
        seen += eigenvalues.max() > 1.0
    assert seen >= 4
