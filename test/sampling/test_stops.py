# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib_ros.kinematics import se3
from calib_ros.sampling.stops import FEW, MOST_SPREAD, RestlessError, average

SIGMA = 5e-5
PLACE = np.array([1.2, -0.3, 0.8])


def noisy(rng, count=60, sigma=SIGMA):
    return PLACE + rng.normal(scale=sigma, size=(count, 3))


@pytest.mark.parametrize('width', [1, 3])
def test_the_error_of_the_mean_falls_as_the_root_of_the_number(width, rng):
    """Over 400 stops the RMS error of the mean is known to 2 to 4 %."""
    ratios = {}
    for count in (1, 4, 16, 64):
        errors = [
            average(rng.normal(scale=SIGMA, size=(count, width)), None, SIGMA).value
            for _ in range(400)
        ]
        ratios[count] = np.sqrt(np.mean(np.square(errors))) / (SIGMA / np.sqrt(count))
    assert max(ratios.values()) < 1.1
    assert min(ratios.values()) > 0.9


def test_the_spread_is_that_of_one_coordinate(rng):
    found = [average(noisy(rng, 200), None, SIGMA).spread for _ in range(20)]
    assert np.mean(found) == pytest.approx(SIGMA, rel=0.05)


def test_measurements_at_rest_are_all_used(rng):
    """One in twenty thousand lies beyond the limit of a spike."""
    left_out = sum((~average(noisy(rng), None, SIGMA).used).sum() for _ in range(200))
    assert left_out == 0


def with_spikes(rng, share, count=60):
    values = noisy(rng, count)
    hit = rng.choice(count, round(share * count), replace=False)
    size = rng.uniform(2e-3, 0.5, (len(hit), 3))
    values[hit] += rng.choice([-1.0, 1.0], size.shape) * size
    return values, hit


@pytest.mark.parametrize('sigma_given', [SIGMA, SIGMA / 100.0])
@pytest.mark.parametrize('share', [0.0, 0.05])
def test_spikes_are_left_out_and_no_others(rng, share, sigma_given):
    """Even where the noise is larger than it was said to be."""
    values, hit = with_spikes(rng, share)
    found = average(values, None, sigma_given)
    assert set(np.flatnonzero(~found.used)) == set(hit)


@pytest.mark.parametrize('share', [0.1, 0.2])
def test_of_many_spikes_none_is_used(share):
    """Others may go with them, as spikes close together look like vibration; few are refused."""
    refused = 0
    for seed in range(200):
        values, hit = with_spikes(np.random.default_rng(seed), share)
        try:
            found = average(values, None, SIGMA)
        except RestlessError:
            refused += 1
            continue
        assert not found.used[hit].any()
        limit = 5.0 * SIGMA * np.sqrt(3.0 / found.used.sum())
        assert np.linalg.norm(found.value - PLACE) < limit
    assert refused < 10


@pytest.mark.parametrize('at', range(1, 60))
def test_two_places_are_never_averaged(rng, at):
    """A few at another place are left out; where the larger part is not clear it is refused."""
    values = noisy(rng, 60)
    values[at:] += [2e-3, 0.0, 0.0]
    try:
        used = average(values, None, SIGMA).used
    except RestlessError:
        refused = True
    else:
        refused = False
        assert not used[:at].any() or not used[at:].any()
    assert refused == (40 <= at <= 45)


def test_the_refusal_says_by_how_much(rng):
    values = noisy(rng, 60)
    values[42:] += [2e-3, 0.0, 0.0]
    with pytest.raises(RestlessError, match=r'spread by 0\.\d+ mm, their noise is 0\.0\d+ mm'):
        average(values, None, SIGMA)


@pytest.mark.parametrize('count', [20, 100])
@pytest.mark.parametrize('sigma_given', [SIGMA, SIGMA / 10.0])
def test_a_slow_drift_is_refused(rng, count, sigma_given):
    """A target that slips or an arm that sags: hardly seen from one measurement to the next."""
    drift = np.linspace(0.0, 1.0, count)[:, np.newaxis] * [0.0, 0.0, 20.0 * SIGMA]
    with pytest.raises(RestlessError):
        average(noisy(rng, count) + drift, None, sigma_given)


def test_a_drift_within_the_noise_is_not_refused(rng):
    drift = np.linspace(0.0, 1.0, 60)[:, np.newaxis] * [0.0, 0.0, SIGMA]
    for _ in range(50):
        assert average(noisy(rng) + drift, None, SIGMA).used.all()


def vibrating(rng, count, rate, amplitude, frequency, decay):
    """Return measurements after a stop, and how far the vibration still was at each [m]."""
    times = np.arange(count) / rate
    size = amplitude * np.exp(-times / decay)
    swing = size * np.cos(2.0 * np.pi * frequency * times + rng.uniform(0.0, 2.0 * np.pi))
    axis = rng.normal(size=3)
    return noisy(rng, count) + swing[:, np.newaxis] * axis / np.linalg.norm(axis), size


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([30.0, 100.0, 300.0]),
    st.sampled_from([2e-4, 1e-3, 5e-3]),
    st.sampled_from([5.0, 8.0, 15.0]),
    st.sampled_from([0.05, 0.1, 0.2]),
)
def test_nothing_that_vibrates_is_in_the_mean(seed, rate, amplitude, frequency, decay):
    """The mean is off by the noise alone, and none is used while the swing is beyond its limit."""
    rng = np.random.default_rng(seed)
    values, size = vibrating(rng, round(2.0 * rate), rate, amplitude, frequency, decay)
    found = average(values, None, SIGMA)
    used = int(found.used.sum())
    assert used > rate  # half of the stop at least
    assert np.linalg.norm(found.value - PLACE) < 5.0 * SIGMA * np.sqrt(3.0 / used)
    first = int(np.argmax(found.used))
    period = int(np.ceil(rate / frequency))
    assert size[min(first + period, len(size) - 1)] < 10.0 * SIGMA


def test_a_stop_that_vibrates_all_the_time_is_refused(rng):
    values, _ = vibrating(rng, 200, 100.0, 2e-3, 3.0, 100.0)
    with pytest.raises(RestlessError):
        average(values, None, SIGMA)


@pytest.mark.parametrize('count', range(1, FEW))
def test_few_measurements_are_taken_as_they_are(count):
    values = np.arange(count)[:, np.newaxis] * np.ones(3)
    found = average(values, None, SIGMA)
    assert found.used.all()
    np.testing.assert_allclose(found.value, values.mean(axis=0))


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 3.0, np.pi - 1e-6, np.pi]))
def test_rotations_are_averaged_as_rotations(seed, angle):
    """Also near half a turn, where rotation vectors jump from one sign to the other."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    true = se3.exp_rotation(angle * axis[np.newaxis] / np.linalg.norm(axis))[0]
    count, sigma = 100, 1e-3
    turned = se3.exp_rotation(rng.normal(scale=sigma, size=(count, 3))) @ true
    found = average(noisy(rng, count), turned, SIGMA).rotation
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    error = se3.log_rotation((found @ true.T)[np.newaxis])[0]
    assert np.linalg.norm(error) < 5.0 * sigma * np.sqrt(3.0 / count)


def test_the_rotation_of_a_spike_does_not_count(rng):
    values, rotations = noisy(rng, 20), np.tile(np.eye(3), (20, 1, 1))
    values[7] += 0.1
    rotations[7] = se3.exp_rotation(np.array([[0.5, 0.0, 0.0]]))[0]
    np.testing.assert_allclose(average(values, rotations, SIGMA).rotation, np.eye(3), atol=1e-12)


def test_the_limit_of_the_spread_is_beyond_chance(rng):
    """A stop of a few measurements passes, however they fall."""
    for _ in range(2000):
        assert average(noisy(rng, FEW), None, SIGMA).spread < MOST_SPREAD * 2.0 * SIGMA
