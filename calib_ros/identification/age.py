# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How a calibration ages: times of measurements, and the usual drift of an arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np

from calib_ros.decision.changes import SIZES
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.settings import GROWTH
from calib_ros.shown import is_time

YEAR = timedelta(days=365.25)
A_DAY = timedelta(days=1)  # clocks of any two time zones differ by less
NEVER = datetime.fromtimestamp(0, timezone.utc)


def drift_of(names: Sequence[Parameter], growth: float = GROWTH) -> FloatArray:
    """Return variances (P,) of the usual drift (a random walk) a year, by that of lengths [m]."""
    sizes = [growth / SIZES['m'] * SIZES[name.unit] if name.of_dh else 0.0 for name in names]
    return np.square(sizes)


def measured_at(sets: Sequence[Observations], otherwise: datetime | None = None) -> datetime:
    """Return the time of the last pose, or `otherwise` if stamps are no times."""
    last = max((int(each.stamps_ns.max()) for each in sets if len(each)), default=0)
    if not is_time(last):
        return otherwise or datetime.now(timezone.utc)
    return datetime.fromtimestamp(last / 1e9, timezone.utc)


def recorded_time(sets: Sequence[Observations]) -> str | None:
    """Return the time of the last pose for a record, at most now; None if no time, or to come."""
    time, now = measured_at(sets, NEVER), datetime.now(timezone.utc)
    unknown = time == NEVER or time - now > A_DAY  # of a clock that is wrong
    return None if unknown else min(time, now).isoformat(timespec='seconds')


def years_since(record: Mapping[str, Any], sets: Sequence[Observations] = ()) -> float:
    """Return the time [years] between the poses of a calibration and new ones.

    If one of the two has no times: until now, since it was made; 1 if not known.
    """
    now = datetime.now(timezone.utc)
    then, new = _time_in(record, 'measured'), min(measured_at(sets, NEVER), now)
    if then is not None and new != NEVER:
        return abs(new - then) / YEAR
    made = _time_in(record, 'created')
    return 1.0 if made is None or made - now > A_DAY else max(0.0, (now - made) / YEAR)


def refuse_older(record: Mapping[str, Any], sets: Sequence[Observations]) -> None:
    """Raise InputError for an update of a calibration by poses older than its own."""
    then, new = _time_in(record, 'measured'), measured_at(sets, NEVER)
    if then is not None and new != NEVER and then - new > A_DAY:
        raise InputError(
            f'the new poses were measured on {new:%Y-%m-%d}, before those of the earlier '
            f'calibration ({then:%Y-%m-%d}): update it in the order of time; if they are newer, '
            'the clock of the recorder is wrong'
        )


def years_between(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    """Return the time [years] between two calibrations by their records; 0 if not known."""
    for key in ('measured', 'created'):
        one, other = _time_in(first, key), _time_in(second, key)
        if one is not None and other is not None:
            return abs(one - other) / YEAR
    return 0.0


def _time_in(record: Mapping[str, Any], key: str) -> datetime | None:
    with suppress(ValueError):
        time = datetime.fromisoformat(str(record.get(key)))
        return time if time.tzinfo else None
    return None
