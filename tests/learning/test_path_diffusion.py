"""The diffusion model of paths: its series, its sampler against known answers, its training."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.planner_fixtures import manifold_of, packaged_bundle, packaged_planner, pairs_of

from constraint_geodesics.bundle import BundleError
from constraint_geodesics.learning.path_diffusion import (
    CARD,
    WEIGHTS,
    PathDiffusion,
    coefficients,
    conditions,
    seen_times,
    sines,
    straight,
)
from constraint_geodesics.learning.path_diffusion_training import (
    Denoiser,
    Examples,
    PathTask,
    examples_of,
    planned_examples,
    train_path_diffusion,
)
from constraint_geodesics.params import PathDiffusionParams
from constraint_geodesics.problem import SATISFIED

SMALL = PathDiffusionParams(
    queries=20,
    query_seed=3,
    modes=4,
    width=32,
    blocks=1,
    steps=400,
    batch_size=64,
    learning_rate=0.005,
    held_out=0.1,
    seed=0,
)
MODES, DOF, SEEN = 4, 6, 120


def model_of(network: Denoiser, scale: float = 1.0) -> PathDiffusion:
    weights = {name: value.numpy() for name, value in network.state_dict().items()}
    scales = {
        "scale": np.full((MODES, DOF), scale, np.float32),
        "seen_mean": np.zeros(SEEN, np.float32),
        "seen_scale": np.ones(SEEN, np.float32),
    }
    return PathDiffusion({**weights, **scales})


def untrained(scale: float = 1.0) -> PathDiffusion:
    """Its network is 0 everywhere."""
    return model_of(Denoiser(MODES * DOF, SEEN, 8, 1), scale)


@settings(max_examples=30)
@given(seed=st.integers(0, 1000), modes=st.integers(1, 12), points=st.integers(14, 40))
def test_a_sine_series_has_its_own_coefficients(seed: int, modes: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    a, (start, goal) = rng.normal(size=(3, modes, DOF)), rng.normal(size=(2, 3, DOF))
    curves = straight(start, goal, points) + sines(points, modes) @ a
    np.testing.assert_array_equal(curves[:, [0, -1]], np.stack([start, goal], axis=1))
    np.testing.assert_allclose(coefficients(curves, modes), a, atol=1e-12)


def test_the_network_is_the_one_that_was_trained() -> None:
    torch.manual_seed(0)
    network = Denoiser(MODES * DOF, SEEN, 16, 2)
    for value in network.parameters():
        torch.nn.init.normal_(value, std=0.2)
    x, s, known = torch.randn(5, MODES * DOF), torch.rand(5, 1), torch.randn(5, SEEN)
    with torch.no_grad():
        expected = network(x, s, known).numpy()
    found = model_of(network).estimate(x.numpy(), s.numpy(), known.numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)
    assert seen_times(s.numpy()).shape == (5, 16)


@pytest.mark.parametrize("steps", [4, 32, 256])
def test_normal_coefficients_are_drawn_as_they_are(steps: int) -> None:
    """Of normal x the best estimate is v = 0, and DDIM then turns the noise by cos(π/2n) n times,
    which is the identity for many steps.
    """
    model, rng = untrained(0.3), np.random.default_rng(0)
    noise, line = model.noise(5, rng), straight(np.zeros(DOF), np.ones(DOF), 17)
    drawn = model.curves(np.zeros(SEEN), line, noise, [None] * steps)
    expected = 0.3 * np.cos(0.5 * np.pi / steps) ** steps * noise
    np.testing.assert_allclose(coefficients(drawn, MODES), expected, atol=1e-5)
    assert np.abs(noise[0]).max() == 0.0 < np.abs(noise[1:]).min()


@dataclass(frozen=True)
class OnePath(PathDiffusion):
    """The exact estimate where every path has the same coefficients `only`."""

    only: np.ndarray

    def estimate(self, x: np.ndarray, s: np.ndarray, known: np.ndarray) -> np.ndarray:
        cos, sin = np.cos(0.5 * np.pi * s), np.sin(0.5 * np.pi * s)
        return (cos * x - self.only) / sin


def test_of_paths_that_are_all_the_same_that_one_is_drawn() -> None:
    rng = np.random.default_rng(1)
    only = rng.normal(size=(1, MODES * DOF))
    model, line = OnePath(untrained().arrays, only), straight(np.zeros(DOF), np.ones(DOF), 17)
    drawn = model.curves(np.zeros(SEEN), line, model.noise(4, rng), [None] * 8)
    there = np.broadcast_to(only.reshape(MODES, DOF), (4, MODES, DOF))
    np.testing.assert_allclose(coefficients(drawn, MODES), there, atol=1e-5)


def test_a_correction_in_the_last_step_is_what_comes_out() -> None:
    model, line = untrained(), straight(np.zeros(DOF), np.ones(DOF), 17)
    bent = line + sines(17, MODES) @ np.full((MODES, DOF), 0.1)
    noise = model.noise(3, np.random.default_rng(0))
    drawn = model.curves(np.zeros(SEEN), line, noise, [None, lambda q: np.repeat(bent[None], 3, 0)])
    np.testing.assert_allclose(drawn, np.repeat(bent[None], 3, axis=0), atol=1e-6)


def test_the_network_sees_what_is_held_at_which_pose() -> None:
    """The straight line retracted onto the constraint is among what it sees, and a query back is
    seen as another.
    """
    start, goal = (end[None] for end in pairs_of("level_cup", 1, seed=2)[0])
    planner = packaged_planner()
    cup, down = manifold_of(planner, "level_cup"), manifold_of(planner, "tool_down")
    assert conditions(cup, start, goal).shape == (1, SEEN)
    np.testing.assert_array_equal(cup.constraint.context, down.constraint.context)
    assert np.abs(conditions(cup, start, goal) - conditions(down, start, goal)).max() > 0.1
    bent = conditions(cup, start, goal)[0, -7 * DOF :].reshape(7, DOF)
    line = straight(start[0], goal[0], 9)[1:-1]
    assert cup.violation(line + bent).max() < 1e-3 < cup.violation(line).max()


def test_planned_examples_are_there_and_back() -> None:
    scene = packaged_planner().scene.now
    found = planned_examples(PathTask(packaged_bundle(), scene, "level_cup", SMALL))
    assert found.seen.shape == (2, found.paths.shape[1], SEEN)
    assert 1 <= found.paths.shape[1] <= SMALL.queries
    odd = np.array([1.0, -1.0, 1.0, -1.0])[:, None]  # of sin(kπ(1 − t))
    np.testing.assert_allclose(found.paths[1], odd * found.paths[0], atol=1e-9)
    ends = np.pi * found.seen[0, :, : 2 * DOF].reshape(-1, 2, DOF)
    assert manifold_of(packaged_planner(), "level_cup").violation(ends).max() < SATISFIED
    joined = Examples.joined([found, found])
    assert joined.paths.shape[1] == 2 * found.paths.shape[1]


def toy(count: int) -> np.ndarray:
    """Paths whose first sine is half the start."""
    rng = np.random.default_rng(0)
    start, goal = rng.uniform(-1.0, 1.0, size=(2, count, DOF))
    a = np.zeros((count, MODES, DOF))
    a[:, 0], a[:, 1] = 0.5 * (start + goal), 0.1 * rng.normal(size=(count, DOF))
    return straight(start, goal, 17) + sines(17, MODES) @ a


def test_training_learns_what_the_ends_say_and_is_fixed_by_its_seed() -> None:
    manifold, paths = manifold_of(packaged_planner(), "free"), toy(300)
    examples, losses = examples_of(manifold, paths, MODES), []
    trained = train_path_diffusion(examples, SMALL, lambda _, figures: losses.append(figures))
    again = train_path_diffusion(examples, SMALL, lambda *_: None)
    for name, values in trained.model.arrays.items():
        np.testing.assert_array_equal(values, again.model.arrays[name])
    assert [{"step": 400.0, **losses[-1]}] == trained.history
    unseen = toy(320)[300:]
    for path in unseen:
        line = straight(path[0], path[-1], 17)
        seen = conditions(manifold, path[:1], path[-1:])[0]
        noise = np.zeros((1, MODES, DOF))
        drawn = trained.model.curves(seen, line, noise, [None] * 8)
        assert np.linalg.norm(drawn[0] - path) < 0.5 * np.linalg.norm(line - path)


def test_a_saved_model_is_the_same_and_an_altered_one_is_refused(tmp_path: Path) -> None:
    model = untrained(0.2)
    model.save(tmp_path)
    again = PathDiffusion.load(tmp_path)
    assert (again.dof, again.modes) == (DOF, MODES)
    for name, values in model.arrays.items():
        np.testing.assert_array_equal(again.arrays[name], values)
    assert sorted(file.name for file in tmp_path.iterdir()) == [CARD, WEIGHTS]
    content = bytearray((tmp_path / WEIGHTS).read_bytes())
    content[-1] ^= 1
    (tmp_path / WEIGHTS).write_bytes(content)
    with pytest.raises(BundleError, match="path_diffusion"):
        PathDiffusion.load(tmp_path)
