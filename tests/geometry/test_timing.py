import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from constraint_geodesics.geometry.errors import StartVelocityError
from constraint_geodesics.geometry.manifold import GeometryError, NonFiniteError
from constraint_geodesics.geometry.timing import COINCIDENT, time_parametrisation

VELOCITY = np.array([3.1, 2.0, 1.5, 3.0, 2.5, 4.0])
ACCELERATION = np.array([4.0, 2.0, 8.0, 5.0, 3.0, 10.0])


def law(test):
    """Cases are drawn, yet the same on every run, so that a red run can be repeated."""
    return settings(max_examples=60)(given(st.data())(test))


def differences(joints: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities of the steps (T-1, D) and accelerations at the rows (T, D), at rest outside."""
    still = np.zeros((1, joints.shape[1]))
    dt = np.diff(times)
    velocities = np.diff(joints, axis=0) / dt[:, None]
    around = np.concatenate([[0.0], dt, [0.0]])
    changes = np.diff(np.concatenate([still, velocities, still]), axis=0)
    return velocities, changes / (0.5 * (around[1:] + around[:-1]))[:, None]


def draw_limits(data: st.DataObject, dim: int) -> tuple[np.ndarray, np.ndarray]:
    limit = arrays(np.float64, dim, elements=st.floats(0.1, 20.0))
    return data.draw(limit), data.draw(limit)


def draw_broken_line(data: st.DataObject) -> np.ndarray:
    """Rows in any order of any distance, with corners, turns back and joints that stand still."""
    rows, dim = data.draw(st.integers(2, 30)), data.draw(st.integers(1, 7))
    steps = data.draw(
        arrays(np.float64, (rows - 1, dim), elements=st.floats(-0.125, 0.125, width=32))
    )
    flat = np.abs(steps).max(axis=1) < 1e-3
    steps[flat, 0] += 0.01
    return np.cumsum(
        np.concatenate([data.draw(arrays(np.float64, (1, dim), elements=st.floats(-3, 3))), steps]),
        axis=0,
    )


def smooth_curve(seed: int, rows: int = 300, dim: int = 6) -> np.ndarray:
    """A curve of a few sines, its rows unevenly spaced by up to a third."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, rows)
    t[1:-1] += rng.uniform(-0.15, 0.15, rows - 2) / (rows - 1)
    waves = [
        rng.normal(size=dim) * np.sin(np.pi * k * t[:, None] + rng.uniform(0, 6, dim)) / k
        for k in (1, 2, 3)
    ]
    return np.sum(waves, axis=0)


def fastest_on_a_line(
    direction: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> float:
    """Duration of a straight move from rest to rest: speed up, hold the limit if it is reached,
    slow down.
    """
    largest = (velocity / np.abs(direction)).min()
    gain = (acceleration / np.abs(direction)).min()
    if largest**2 / gain >= 1.0:
        return float(2.0 / np.sqrt(gain))
    return float(1.0 / largest + largest / gain)


# Limits


@law
def test_any_broken_line_keeps_its_limits(data):
    joints = draw_broken_line(data)
    velocity, acceleration = draw_limits(data, joints.shape[1])
    times = time_parametrisation(joints, velocity, acceleration)
    assert times[0] == 0.0
    assert (np.diff(times) > 0).all()
    velocities, accelerations = differences(joints, times)
    assert (np.abs(velocities) <= velocity).all()
    assert (np.abs(accelerations) <= acceleration).all()


def test_rows_of_any_spacing_keep_their_limits():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        rows, dim = rng.integers(3, 60), rng.integers(1, 4)
        steps = rng.normal(size=(rows - 1, dim)) * 10 ** rng.uniform(-4, 0, (rows - 1, 1))
        joints = np.cumsum(np.r_[np.zeros((1, dim)), steps], axis=0)
        velocity, acceleration = 10 ** rng.uniform(-2, 2, (2, dim))
        velocities, accelerations = differences(
            joints, time_parametrisation(joints, velocity, acceleration)
        )
        assert (np.abs(velocities) <= velocity).all()
        assert (np.abs(accelerations) <= acceleration).all()


@pytest.mark.parametrize("rows", [3, 10, 100, 500])
def test_a_smooth_curve_keeps_its_limits(rows):
    for seed in range(5):
        joints = smooth_curve(seed, rows)
        velocities, accelerations = differences(
            joints, time_parametrisation(joints, VELOCITY, ACCELERATION)
        )
        assert (np.abs(velocities) <= VELOCITY).all()
        assert (np.abs(accelerations) <= ACCELERATION).all()


@law
def test_it_starts_and_ends_at_rest(data):
    joints = draw_broken_line(data)
    velocity, acceleration = draw_limits(data, joints.shape[1])
    times = time_parametrisation(joints, velocity, acceleration)
    for step, dt in (
        (joints[1] - joints[0], times[1]),
        (joints[-1] - joints[-2], times[-1] - times[-2]),
    ):
        # a joint at rest that keeps its acceleration for the whole of the step gets at most this
        # far
        assert (np.abs(step) <= 0.5 * acceleration * dt**2 * (1 + 1e-9)).all()


def test_an_infinite_velocity_limit_is_none():
    joints = smooth_curve(0)
    free = time_parametrisation(joints, np.full(6, np.inf), ACCELERATION)
    np.testing.assert_allclose(
        free, time_parametrisation(joints, np.full(6, 1e6), ACCELERATION), rtol=1e-12
    )


# Optimality


@law
def test_two_rows_take_the_least_possible(data):
    joints = draw_broken_line(data)[:2]
    velocity, acceleration = draw_limits(data, joints.shape[1])
    step = np.abs(joints[1] - joints[0])
    expected = max((step / velocity).max(), np.sqrt(2 * step / acceleration).max())
    times = time_parametrisation(joints, velocity, acceleration)
    np.testing.assert_allclose(times, [0.0, expected], rtol=1e-8)


@law
def test_a_straight_line_takes_the_known_time(data):
    dim = data.draw(st.integers(1, 7))
    direction = data.draw(arrays(np.float64, dim, elements=st.floats(0.1, 3.0)))
    velocity, acceleration = draw_limits(data, dim)
    shares = np.cumsum(data.draw(arrays(np.float64, 200, elements=st.floats(0.5, 1.0))))
    joints = (shares - shares[0])[:, None] / (shares[-1] - shares[0]) * direction
    duration = time_parametrisation(joints, velocity, acceleration)[-1]
    # at its corners the differences see a little less acceleration than there is
    assert 0.995 < duration / fastest_on_a_line(direction, velocity, acceleration) < 1 + 1e-6


@pytest.mark.parametrize("rows", [41, 201])
def test_turning_back_is_a_stop(rows):
    there = np.linspace(0.0, 1.0, rows)
    joints = np.concatenate([there, there[-2::-1]])[:, None]
    duration = time_parametrisation(joints, np.array([9.0]), np.array([1.0]))[-1]
    assert 0.98 < duration / (2 * 2.0) < 1.05


@pytest.mark.parametrize("seed", range(5))
def test_at_almost_every_row_some_limit_is_reached(seed):
    """What a time-optimal motion does everywhere: its speed is bounded by something at every
    place.
    """
    joints = smooth_curve(seed)
    velocities, accelerations = differences(
        joints, time_parametrisation(joints, VELOCITY, ACCELERATION)
    )
    used = (np.abs(velocities) / VELOCITY).max(axis=1)
    used = np.maximum(
        (np.abs(accelerations) / ACCELERATION).max(axis=1)[1:-1], np.maximum(used[1:], used[:-1])
    )
    assert (used > 0.999).mean() > 0.96


@pytest.mark.parametrize("seed", range(5))
def test_no_single_step_can_be_faster_by_a_percent(seed):
    joints = smooth_curve(seed, 60)
    times = time_parametrisation(joints, VELOCITY, ACCELERATION)
    faster = 0
    for step in range(len(times) - 1):
        shorter = times.copy()
        shorter[step + 1 :] -= 0.01 * (times[step + 1] - times[step])
        velocities, accelerations = differences(joints, shorter)
        faster += (np.abs(velocities) <= VELOCITY).all() and (
            np.abs(accelerations) <= ACCELERATION
        ).all()
    assert faster <= 1


@pytest.mark.parametrize("seed", range(5))
def test_the_duration_hardly_depends_on_the_rows_or_on_the_direction(seed):
    joints = smooth_curve(seed, 501)
    duration = time_parametrisation(joints, VELOCITY, ACCELERATION)[-1]
    coarse = time_parametrisation(joints[::2], VELOCITY, ACCELERATION)[-1]
    backwards = time_parametrisation(joints[::-1], VELOCITY, ACCELERATION)[-1]
    assert coarse == pytest.approx(duration, rel=0.01)
    assert backwards == pytest.approx(duration, rel=0.01)


# Moving at the first row


def moving_differences(
    joints: np.ndarray, times: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As `differences`, with a velocity before the first row."""
    velocities, accelerations = differences(joints, times)
    accelerations[0] = (velocities[0] - start) / (0.5 * (times[1] - times[0]))
    return velocities, accelerations


def assert_continues(joints, times, start, velocity, acceleration):
    velocities, accelerations = moving_differences(joints, times, start)
    assert times[0] == 0.0
    assert (np.diff(times) > 0).all()
    assert (np.abs(velocities) <= velocity).all()
    assert (np.abs(accelerations) <= acceleration).all()
    assert 2.0 * np.linalg.norm(velocities[0]) >= np.linalg.norm(start)


def test_any_start_that_can_go_on_keeps_the_limits():
    """And of starts along the path at a pace that the path is passed at from rest, most can."""
    rng, done = np.random.default_rng(1), 0
    for _ in range(2000):
        rows, dim = rng.integers(2, 60), rng.integers(1, 7)
        steps = rng.normal(size=(rows - 1, dim)) * 10 ** rng.uniform(-3, 0, (rows - 1, 1))
        joints = np.cumsum(np.r_[np.zeros((1, dim)), steps], axis=0)
        velocity, acceleration = 10 ** rng.uniform(-2, 2, (2, dim))
        rested = time_parametrisation(joints, velocity, acceleration)
        start = steps[0] / rested[1] * rng.uniform(0.0, 2.0, dim)
        try:
            times = time_parametrisation(joints, velocity, acceleration, start)
        except StartVelocityError:
            continue
        done += 1
        assert_continues(joints, times, start, velocity, acceleration)
    assert done > 1500


@law
def test_a_start_at_rest_is_none_at_all(data):
    joints = draw_broken_line(data)
    limits = draw_limits(data, joints.shape[1])
    times = time_parametrisation(joints, *limits)
    resting = time_parametrisation(joints, *limits, np.zeros(joints.shape[1]))
    np.testing.assert_array_equal(resting, times)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("share", [0.1, 0.37, 0.5, 0.81])
def test_the_rest_of_a_motion_takes_the_rest_of_its_time(seed, share):
    """From any row, with the velocity between those of the lines before and after, it goes on."""
    joints = smooth_curve(seed, 301)
    times = time_parametrisation(joints, VELOCITY, ACCELERATION)
    row = int(share * 300)
    before, after = np.diff(times)[row - 1 : row + 1]
    lines = np.diff(joints, axis=0)[row - 1 : row + 1] / np.array([[before], [after]])
    start = (lines[0] * after + lines[1] * before) / (before + after)
    most = ACCELERATION * (1 + 1e-5)  # the motion uses its limits up: rounding needs some room
    rest = time_parametrisation(joints[row:], VELOCITY, most, start)
    assert_continues(joints[row:], rest, start, VELOCITY, most)
    assert rest[-1] == pytest.approx(times[-1] - times[row], rel=0.01)


@law
def test_a_straight_line_from_a_velocity_takes_the_known_time(data):
    """Up to the velocity's limit, or as far as there is time for, and down to rest."""
    dim = data.draw(st.integers(1, 7))
    direction = data.draw(arrays(np.float64, dim, elements=st.floats(0.1, 3.0)))
    velocity, acceleration = draw_limits(data, dim)
    most, gain = (velocity / direction).min(), (acceleration / direction).min()
    top = min(most, np.sqrt(2.0 * gain))  # what stops within the line's length, 1
    speed = data.draw(st.floats(0.0, 0.98)) * top
    joints = np.linspace(0.0, 1.0, 400)[:, None] * direction
    times = time_parametrisation(joints, velocity, acceleration, speed * direction)
    assert_continues(joints, times, speed * direction, velocity, acceleration)
    peak = min(most, np.sqrt(gain + 0.5 * speed**2))
    held = 1.0 - (2.0 * peak**2 - speed**2) / (2.0 * gain)
    expected = (peak - speed) / gain + held / peak + peak / gain
    assert 0.99 < times[-1] / expected < 1.005


@pytest.mark.parametrize("rows", [2, 3, 50, 400])
def test_a_line_too_short_to_stop_on_is_refused(rows):
    """A speed of 1 needs ½ / A = 0.25 to stop."""
    for length, stops in ((0.2501, True), (0.2499, False)):
        joints = np.linspace(0.0, length, rows)[:, None]
        if stops:
            times = time_parametrisation(joints, np.ones(1), 2.0 * np.ones(1), np.ones(1))
            assert times[-1] == pytest.approx(0.5, rel=0.05)
        else:
            with pytest.raises(StartVelocityError, match=r"at most, 0.5 rad/s are needed"):
                time_parametrisation(joints, np.ones(1), 2.0 * np.ones(1), np.ones(1))


def test_a_line_that_turns_away_is_refused():
    joints = np.linspace([0.0, 0.0], [0.0, 1.0], 20)
    for start in ([1.0, 0.0], [1.0, 1.0], [0.0, -1.0]):
        with pytest.raises(StartVelocityError, match="start_velocity = "):
            time_parametrisation(joints, 2 * np.ones(2), 4 * np.ones(2), np.array(start))


# Invariance


@law
def test_limits_k_times_faster_take_the_k_th_part(data):
    joints = draw_broken_line(data)
    velocity, acceleration = draw_limits(data, joints.shape[1])
    k = data.draw(st.sampled_from([0.25, 0.5, 2.0, 4.0]))
    times = time_parametrisation(joints, velocity, acceleration)
    faster = time_parametrisation(joints, k * velocity, k**2 * acceleration)
    np.testing.assert_allclose(k * faster, times, rtol=1e-8)


@law
def test_the_unit_of_the_joints_does_not_matter(data):
    joints = draw_broken_line(data)
    velocity, acceleration = draw_limits(data, joints.shape[1])
    k = data.draw(st.sampled_from([2.0**-10, 0.5, 2.0**10]))
    times = time_parametrisation(joints, velocity, acceleration)
    np.testing.assert_allclose(
        time_parametrisation(k * joints, k * velocity, k * acceleration), times, rtol=1e-8
    )


@law
def test_order_sign_and_idle_joints_do_not_matter(data):
    joints = smooth_curve(data.draw(st.integers(0, 100)), 50)
    signs = data.draw(arrays(np.float64, 6, elements=st.sampled_from([-1.0, 1.0])))
    order = data.draw(st.permutations(range(6)))
    times = time_parametrisation(joints, VELOCITY, ACCELERATION)
    other = time_parametrisation((signs * joints)[:, order], VELOCITY[order], ACCELERATION[order])
    idle = time_parametrisation(
        np.c_[joints, np.ones(50)], np.r_[VELOCITY, 0.1], np.r_[ACCELERATION, 0.1]
    )
    np.testing.assert_allclose(other, times, rtol=1e-6)
    np.testing.assert_allclose(idle, times, rtol=1e-6)


def test_the_input_stays_as_it_is():
    joints = smooth_curve(0)
    before, velocity, acceleration = joints.copy(), VELOCITY.copy(), ACCELERATION.copy()
    time_parametrisation(joints, velocity, acceleration)
    assert (joints == before).all()
    assert (velocity == VELOCITY).all()
    assert (acceleration == ACCELERATION).all()


# Misuse


ROWS = np.array([[0.0, 0.0], [0.1, 0.2], [0.3, 0.3]])


@pytest.mark.parametrize(
    ("joints", "velocity", "acceleration", "message"),
    [
        (ROWS[:1], [1, 1], [1, 1], r"shape \(1, 2\).*at least two rows"),
        (ROWS[0], [1, 1], [1, 1], r"shape \(2,\)"),
        (ROWS[:, :0], [], [], "one joint"),
        (ROWS, [1, 1, 1], [1, 1], r"velocity has shape \(3,\): must be \(2,\)"),
        (ROWS, [1, 1], 1.0, r"acceleration has shape \(\)"),
        (ROWS, [1, 0], [1, 1], r"velocity = \[1.0, 0.0\]: must be positive"),
        (ROWS, [1, 1], [1, -1], r"acceleration = \[1.0, -1.0\]: must be positive"),
        (ROWS, [1, 1], [1, np.nan], r"acceleration = \[1.0, nan\]: must be positive"),
        (ROWS, [1, 1], [1, np.inf], r"acceleration = \[1.0, inf\]: must be finite"),
        (ROWS[[0, 1, 1, 2]], [1, 1], [1, 1], r"joints\[1\] and joints\[2\] coincide"),
        (ROWS[[0, 0]], [1, 1], [1, 1], r"joints\[0\] and joints\[1\] coincide"),
        (
            np.r_[ROWS, ROWS[2:] + 0.1 * COINCIDENT],
            [1, 1],
            [1, 1],
            r"joints\[2\] and joints\[3\] coincide",
        ),
    ],
)
def test_misuse_is_named(joints, velocity, acceleration, message):
    with pytest.raises(GeometryError, match=message):
        time_parametrisation(joints, np.array(velocity), np.array(acceleration))


def test_a_start_velocity_that_is_none_is_named():
    for start, message in (
        (np.ones(3), r"shape \(3,\): must be \(2,\)"),
        (np.array([0.0, np.nan]), r"\[1\] = nan"),
    ):
        with pytest.raises(GeometryError, match="start_velocity.*" + message):
            time_parametrisation(ROWS, np.ones(2), np.ones(2), start)


def test_a_row_that_is_not_finite_is_named():
    joints = ROWS.copy()
    joints[1, 1] = np.inf
    with pytest.raises(NonFiniteError, match=r"joints\[1, 1\] = inf"):
        time_parametrisation(joints, np.ones(2), np.ones(2))
