# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The results of a robot that count: one for each content, by time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timezone

import calib_ros
from calib_ros.files.rows import Row
from calib_ros.fleet.plant import Robot
from calib_ros.identification.age import A_DAY

OLDEST = datetime(2025, 1, 1, tzinfo=timezone.utc)
"""No result was filed before there was this software: an earlier clock was reset, as to 2002."""


def results(robot: Robot, rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return the identifications of a robot with its present settings.

    One for each content, and for each source and time, which a corrected file shares with the
    wrong one: that of this version, or else the last filed.
    """
    hashed = robot.settings_hash
    own = [row for row in rows if row.kind == 'identify' and row.settings == hashed]
    return _unique(_unique(own, lambda row: row.inputs), lambda row: (row.source, row.time))


def verifications(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return the comparable verifications.

    One for each set of poses and calibration, whatever the tolerance or version.
    """
    own = [row for row in rows if row.kind == 'verify' and row.rms_mm and row.rms_freedom]
    return _unique(own, lambda row: (row.inputs, row.chain))


def _unique(rows: Sequence[Row], key: Callable[[Row], object]) -> tuple[Row, ...]:
    """Return rows ordered by time, one for each key.

    Rows filed before their stamps count as measured when filed, unless the clock had been reset;
    those to come do not count.
    """
    past = [row for row in rows if not to_come(row)]
    dated = [
        replace(row, time=row.filed) if too_late(row) and row.filed > OLDEST else row
        for row in past
    ]
    newest = sorted(dated, key=lambda row: (row.software == calib_ros.__version__, row.filed))
    unique = {key(row): row for row in newest}
    return tuple(sorted(unique.values(), key=lambda row: (row.time, row.source, row.key)))


def too_late(row: Row) -> bool:
    """Tell whether a result was filed before its stamps, in any time zone: a wrong clock."""
    return row.time - row.filed > A_DAY


def to_come(row: Row) -> bool:
    """Tell whether a result was measured and filed by a clock ahead of ours: it has no time."""
    return min(row.time, row.filed) - datetime.now(timezone.utc) > A_DAY
