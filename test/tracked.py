# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tracks of two joints."""

import numpy as np

from calib_ros.sampling.track import Track

MS = 1_000_000
MAX_GAP = 0.1
BOTH = (0, 1)


def track(revolute=(True, True), capacity=1000):
    return Track(revolute, MAX_GAP, capacity)


def add(made, columns, stamp_ns, values):
    made.extend(columns, np.array([stamp_ns]), np.array([values], dtype=float))


def fill(made, samples, columns=BOTH):
    """Add samples (stamp [ms], values) of one publisher."""
    for ms, values in samples:
        add(made, columns, round(ms * MS), values)
    made.sort()
    return made


def filled(samples, columns=BOTH, **options):
    return fill(track(**options), samples, columns)


def stamps_of(ms):
    return np.array([round(each * MS) for each in ms], dtype=np.int64)


def at(made, *ms, **options):
    return made.at(stamps_of(ms), **options)


def causes(made, *ms):
    return made.causes(stamps_of(ms))


def came(made, *ms):
    """Return the signs of the last moves before some times [ms]."""
    return made.approach(stamps_of(ms), at(made, *ms).joints)
