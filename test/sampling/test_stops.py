# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, strategies as st

from calib_ros.estimation.levels import FEW
from calib_ros.sampling.means import MOST_SPREAD, averages

SIGMA = 5e-5
PLACE = np.array([1.2, -0.3, 0.8])


def noisy(rng, count=60, sigma=SIGMA):
    return PLACE + rng.normal(scale=sigma, size=(count, 3))


def average(values, sigma=SIGMA):
    """Return what is used of the measurements of one stop, their mean and spread; else None."""
    found = averages(values, np.array([0]), np.array([sigma]))
    return (found.used, found.values[0], found.spreads[0]) if found.rests[0] else None


@pytest.mark.parametrize('width', [1, 3])
def test_the_error_of_the_mean_falls_as_the_root_of_the_number(width, rng):
    """Over 400 stops the RMS error of the mean is known to 2 to 4 %."""
    ratios = {}
    for count in (1, 4, 16, 64):
        errors = [average(rng.normal(scale=SIGMA, size=(count, width)))[1] for _ in range(400)]
        ratios[count] = np.sqrt(np.mean(np.square(errors))) / (SIGMA / np.sqrt(count))
    assert max(ratios.values()) < 1.1
    assert min(ratios.values()) > 0.9


def test_the_spread_is_that_of_one_coordinate(rng):
    found = [average(noisy(rng, 200))[2] for _ in range(20)]
    assert np.mean(found) == pytest.approx(SIGMA, rel=0.05)


@pytest.mark.parametrize('moved', [0.0, SIGMA])
def test_measurements_at_rest_are_all_used(rng, moved):
    """One in twenty thousand lies beyond the limit of a spike; a drift may be within the noise."""
    drift = np.linspace(0.0, 1.0, 60)[:, np.newaxis] * [0.0, 0.0, moved]
    left_out = sum((~average(noisy(rng) + drift)[0]).sum() for _ in range(200))
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
    used, *_ = average(values, sigma_given)
    assert set(np.flatnonzero(~used)) == set(hit)


@pytest.mark.parametrize('share', [0.1, 0.2])
def test_of_many_spikes_none_is_used(share):
    """Others may go with them, as spikes close together look like vibration; few are refused."""
    refused = 0
    for seed in range(200):
        values, hit = with_spikes(np.random.default_rng(seed), share)
        found = average(values)
        if found is None:
            refused += 1
            continue
        used, mean, _ = found
        assert not used[hit].any()
        assert np.linalg.norm(mean - PLACE) < 5.0 * SIGMA * np.sqrt(3.0 / used.sum())
    assert refused < 10


@pytest.mark.parametrize('at', range(1, 60))
def test_two_places_are_never_averaged(rng, at):
    """A few at another place are left out; where the larger part is not clear it is refused."""
    values = noisy(rng, 60)
    values[at:] += [2e-3, 0.0, 0.0]
    found = average(values)
    assert (found is None) == (41 <= at <= 45)
    if found is not None:
        used = found[0]
        assert not used[:at].any() or not used[at:].any()


@pytest.mark.parametrize(
    ('count', 'way'), [(20, 20.0), (100, 20.0), *((few, 100.0 * few) for few in range(FEW, 8))]
)
@pytest.mark.parametrize('sigma_given', [SIGMA, SIGMA / 10.0])
def test_a_steady_motion_is_refused(rng, count, way, sigma_given):
    """A target that slips or an arm that sags: hardly seen from one measurement to the next."""
    drift = np.linspace(0.0, way * SIGMA, count)[:, np.newaxis] * [0.6, 0.48, 0.64]
    assert average(noisy(rng, count) + drift, sigma_given) is None


@pytest.mark.parametrize('late', np.arange(0.3, 1.3, 0.1).round(1))
@pytest.mark.parametrize('sigma_given', [SIGMA, SIGMA / 10.0])
def test_an_arrival_is_no_noise(rng, late, sigma_given):
    """Of stamps that late the most of a stop is a move of 1 m, smooth as that of a controller."""
    share = np.clip(1.0 + (np.arange(0.1, 1.2, 0.02) - late) / 1.5, 0.0, 1.0)
    left = 1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    found = average(noisy(rng, len(left)) + left[:, np.newaxis] * [0.6, 0.48, 0.64], sigma_given)
    assert (found is None) == (late > 0.95)
    assert found is None or np.linalg.norm(found[1] - PLACE) < 3.0 * SIGMA


@pytest.mark.parametrize('depth', [5.0, 20.0])
def test_noise_along_one_axis_is_no_motion(rng, depth):
    """A camera knows depth less well than the rest."""
    noise = rng.normal(scale=SIGMA * np.array([1.0, 1.0, depth]), size=(400, 20, 3))
    assert sum(average(each) is None for each in noise) < 20


@pytest.mark.parametrize('count', [5, 10, 60])
def test_noise_larger_than_the_sigma_given_is_no_motion(rng, count):
    refused = sum(average(noisy(rng, count), SIGMA / 10.0) is None for _ in range(200))
    assert refused <= 14


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
    st.sampled_from([5.0, 8.0, 13.0]),
    st.sampled_from([0.05, 0.1, 0.2]),
)
def test_nothing_that_vibrates_is_in_the_mean(seed, rate, amplitude, frequency, decay):
    """The mean is off by the noise alone, and none is used while the swing is beyond its limit."""
    rng = np.random.default_rng(seed)
    values, size = vibrating(rng, round(2.0 * rate), rate, amplitude, frequency, decay)
    used, mean, _ = average(values)
    count = int(used.sum())
    assert count > rate  # half of the stop at least
    assert np.linalg.norm(mean - PLACE) < 5.0 * SIGMA * np.sqrt(3.0 / count)
    first = int(np.argmax(used))
    period = int(np.ceil(rate / frequency))
    assert size[min(first + period, len(size) - 1)] < 10.0 * SIGMA


def test_a_stop_that_vibrates_all_the_time_is_refused(rng):
    values, _ = vibrating(rng, 200, 100.0, 2e-3, 3.0, 100.0)
    assert average(values) is None


@pytest.mark.parametrize('count', range(1, FEW))
def test_few_measurements_are_taken_as_they_are(count):
    values = np.arange(count)[:, np.newaxis] * np.ones(3)
    used, mean, _ = average(values)
    assert used.all()
    np.testing.assert_allclose(mean, values.mean(axis=0))


def test_each_stop_is_averaged_by_itself(rng):
    """As those before and after it were not there, and one that spreads costs no other."""
    counts = [1, 30, 2, 40, 3, 30]
    parts = [noisy(rng, count) for count in counts]
    parts[1][7] += 0.1
    parts[3] += np.linspace(0.0, 20.0 * SIGMA, 40)[:, np.newaxis]
    begins = np.cumsum([0, *counts[:-1]])
    found = averages(np.concatenate(parts), begins, np.full(len(counts), SIGMA))
    assert found.rests.tolist() == [True, True, True, False, True, True]
    for k in np.flatnonzero(found.rests).tolist():
        used, mean, spread = average(parts[k])
        np.testing.assert_array_equal(found.used[begins[k] :][: counts[k]], used)
        np.testing.assert_array_equal(found.values[k], mean)
        assert found.spreads[k] == spread


def test_the_limit_of_the_spread_is_beyond_chance(rng):
    """A stop of a few measurements passes, however they fall."""
    for _ in range(2000):
        assert average(noisy(rng, FEW))[2] < MOST_SPREAD * 2.0 * SIGMA


@pytest.mark.parametrize('places', [2, 3])
def test_several_places_are_told_of_their_own_stop(rng, places):
    """Of three noisy stops, a metre apart, the last is measured in places by turns.

    In the second the target changes its place once.
    """
    values = rng.normal(scale=1e-3, size=(180, 3)) + np.repeat(np.eye(3), 60, axis=0)
    values[90:120, 2] += 0.1
    values[120:, 2] += 0.1 * (np.arange(60) % places)
    found = averages(values, np.array([0, 60, 120]), np.full(3, 1e-4))
    assert found.doubled.tolist() == [False, False, True]
