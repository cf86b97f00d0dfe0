# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""When a calibration was measured, and how old it is when new poses are."""

from dataclasses import replace
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from fits import UR10E, arm, problem

from calib_ros import Calibration, identify, recalibrate
from calib_ros.errors import InputError
from calib_ros.identification.age import (
    YEAR,
    measured_at,
    refuse_older,
    years_between,
    years_since,
)
from calib_ros.identification.calibration import parse_calibration

BEGIN = datetime(2025, 3, 1, 22, 0, tzinfo=timezone.utc)


def at(time, count=8, seed=1):
    """Return a problem of poses, the last of which was measured at a time."""
    seen = problem(arm(4), count, seed)
    last = round(time.timestamp() * 1e9)
    stamps = last + np.arange(1 - count, 1, dtype=np.int64) * 10**9
    return replace(seen, observations=replace(seen.observations, stamps_ns=stamps))


@pytest.fixture(scope='module')
def earlier():
    """Return a calibration measured at BEGIN, as it is read from a file."""
    seen = at(BEGIN, 40, 0)
    text = Calibration.of(identify(seen), fitted=seen.all_sets).dump()
    return parse_calibration(text, 'earlier.yaml', UR10E)


def test_the_time_is_that_of_the_measurement():
    assert measured_at(problem(UR10E, 8, 1).all_sets, BEGIN) == BEGIN
    assert measured_at(at(BEGIN).all_sets) == BEGIN


@pytest.mark.parametrize('days', [0.5, 0.999, 1.0, 400.0])
def test_age_counts_parts_of_a_day_by_the_stamps_of_the_poses(earlier, days):
    """A nightly update is a little less than a day old; backlogs are worked off in minutes."""
    new = at(BEGIN + timedelta(days=days))
    assert years_since(earlier.record, new.all_sets) == pytest.approx(days / 365.25, rel=1e-3)
    updated = recalibrate(earlier, new, days / 365.25).calibration
    assert years_since(updated.record, new.all_sets) < 1e-7  # whole seconds


def test_without_times_the_clock_tells_the_age():
    now = datetime.now(timezone.utc)
    for then in (now - timedelta(days=0.5), now - timedelta(days=400), now + timedelta(minutes=5)):
        age = max(0.0, (now - then) / YEAR)
        record = {'created': then.isoformat(), 'measured': None}
        assert years_since(record) == pytest.approx(age, rel=1e-3)
        assert years_since(record, at(BEGIN).all_sets) == pytest.approx(age, rel=1e-3)
    set_back = {'created': (now + timedelta(days=400)).isoformat()}
    unknown = ({}, {'created': 'today'}, {'created': '2020-01-01T00:00:00'}, set_back)
    assert [years_since(each) for each in unknown] == [1.0] * 4


def test_the_time_between_two_calibrations_is_that_between_their_poses():
    earlier = {'measured': '2025-03-01T22:00:00+00:00', 'created': '2026-03-01T22:00:00+00:00'}
    later = {'measured': '2025-03-02T22:00:00+00:00', 'created': '2026-03-01T23:00:00+00:00'}
    assert years_between(earlier, later) == years_between(later, earlier) == 1.0 / 365.25
    hour = years_between(earlier, {**later, 'measured': None})
    assert hour == pytest.approx(1.0 / 24.0 / 365.25)
    assert years_between(earlier, {}) == 0.0


def test_updates_by_poses_older_than_those_of_the_calibration_are_refused(earlier):
    """They would take the arm back to what it was before the last change; a check may use them."""
    two_days = at(BEGIN - timedelta(days=2)).all_sets
    with pytest.raises(InputError, match=r'on 2025-02-27, before .* \(2025-03-01\)'):
        refuse_older(earlier.record, two_days)
    assert years_since(earlier.record, two_days) == pytest.approx(2.0 / 365.25)
    refuse_older(earlier.record, at(BEGIN - timedelta(hours=14)).all_sets)


def test_stamps_in_the_future_are_no_times():
    """Else a recorder's wrong clock would refuse all poses once it is right."""
    now = datetime.now(timezone.utc)
    later = at(now + timedelta(days=4000), 40)
    record = Calibration.of(identify(later), fitted=later.all_sets).record
    for new in (later, at(now - timedelta(days=5))):
        refuse_older(record, new.all_sets)
        assert years_since(record, new.all_sets) < 1e-4
