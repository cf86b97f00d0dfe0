# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, strategies as st
from tracked import MS, fill, filled

from calib_ros.sampling.intervals import LOOKS_BACK

# Standing


def brute_standing(stamps, values, still, window, max_gap):
    """Return the intervals by the definition, sample by sample, and the samples that stood."""
    quiet, begins, intervals = [], [], []
    start = 0
    for k in range(len(stamps)):
        if k and stamps[k] - stamps[k - 1] > max_gap:
            start = k
        calm, back = True, k
        for lag in range(1, LOOKS_BACK + 1):
            wanted = stamps[k] - window * lag // LOOKS_BACK
            back = next(i for i in range(len(stamps)) if stamps[i] >= wanted)
            back = max(min(back, k - 1), start)
            calm = calm and np.abs(values[k] - values[back]).max() <= still
        quiet.append(calm)
        begins.append(stamps[back])
        if calm and (k == start or not quiet[k - 1]):
            begin = begins[k]
            if intervals:
                begin = max(begin, intervals[-1][1])
            intervals.append([begin, stamps[k]])
        elif calm:
            intervals[-1][1] = stamps[k]
    return [[begin, end] for begin, end in intervals if begin < end]


@given(st.integers(0, 2**32 - 1))
def test_standing_is_what_its_definition_says(seed):
    rng = np.random.default_rng(seed)
    count = 120
    stamps = np.cumsum(
        rng.choice([5, 10, 10, 10, 15, 250], count, p=[0.2, 0.5, 0.1, 0.1, 0.08, 0.02])
    )
    moving = np.repeat(rng.random(count // 10) < 0.4, 10)
    steps = moving[:, np.newaxis] * rng.normal(scale=2e-3, size=(count, 2))
    values = np.cumsum(steps, axis=0) + rng.normal(scale=1e-4, size=(count, 2))
    made = filled(zip(stamps.tolist(), values.tolist(), strict=True))
    expected = brute_standing((stamps * MS).tolist(), values, 5e-4, 100 * MS, 100 * MS)
    assert made.standing(5e-4, 0.1).tolist() == expected


def test_all_publishers_must_stand():
    made = filled([(ms, (max(0.0, 0.3 - 1e-3 * ms),)) for ms in range(0, 1000, 10)], (0,))
    fill(made, [(ms, (max(0.0, 1e-3 * ms - 0.7),)) for ms in range(0, 1000, 10)], (1,))
    ((begin, end),) = made.standing(1e-3, 0.1).tolist()
    assert abs(begin - 300 * MS) <= 20 * MS
    assert abs(end - 700 * MS) <= 20 * MS


@pytest.mark.parametrize('times', [[300], [100, 700], range(0, 1000, 250), range(300, 340, 10)])
def test_a_publisher_that_is_heard_now_and_then_does_not_part_a_stop(times):
    made = filled((ms, (0.0, 0.0)) for ms in range(0, 1000, 10))
    fill(made, [(ms, (0.0,)) for ms in times], (1,))
    assert made.standing(5e-4, 0.1).tolist() == [[0, 990 * MS]]


def test_of_two_publishers_of_a_joint_none_may_show_that_it_moves():
    """As one that repeats what others published, some time later."""
    made = filled((ms, (0.0, 0.0)) for ms in range(0, 1000, 10))
    fill(made, [(ms, (max(0.0, 1e-4 * (ms - 500)),)) for ms in range(200, 800, 10)], (1,))
    (begin, first), (second, end) = (np.array(made.standing(5e-4, 0.1)) // MS).tolist()
    assert (begin, end) == (0, 990)
    assert 500 <= first <= 510
    assert 780 <= second <= 790


def test_a_joint_that_nobody_shows_to_stand_does_not():
    made = filled([(0, (0.0, 0.0)), (500, (0.0, 0.0))])
    fill(made, [(250, (0.0,))], (1,))
    fill(made, [(ms, (0.0,)) for ms in range(0, 600, 10)], (0,))
    assert made.standing(5e-4, 0.1).tolist() == []


def test_a_joint_that_stands_at_half_a_turn_stands(rng):
    """A driver that counts within one turn reports it now as pi, now as -pi."""
    angles = np.pi + rng.normal(scale=1e-5, size=100)
    angles = (angles + np.pi) % (2.0 * np.pi) - np.pi
    assert np.ptp(angles) > 6.0
    samples = [(10 * k, (angle, 0.0)) for k, angle in enumerate(angles)]
    for revolute in (True, False):
        made = filled(samples, revolute=(revolute, True))
        assert (made.standing(5e-4, 0.1).tolist() == [[0, 990 * MS]]) is revolute
