# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The state of one robot after a run, with what is wrong and what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from calib_ros.apply.chart import Drift, drift
from calib_ros.errors import CalibrationError
from calib_ros.files.history import History
from calib_ros.files.rows import Row
from calib_ros.fleet.change import alarms_of
from calib_ros.fleet.plant import Robot
from calib_ros.fleet.results import results, to_come, too_late, verifications
from calib_ros.fleet.run import Run
from calib_ros.fleet.watch import Watched, watch
from calib_ros.identification.age import A_DAY
from calib_ros.shown import counted, rounded, some


@dataclass(frozen=True, eq=False)
class RobotStatus:
    """A robot, its newest result, changes, unread sources, verifications and their `drift`."""

    robot: Robot
    last: Row | None
    watched: Watched
    errors: Mapping[str, str]
    verified: tuple[Row, ...]
    drift: Drift
    remarks: tuple[str, ...] = ()

    @classmethod
    def of(cls, robot: Robot, history: History, done: Run, years: float) -> RobotStatus:
        """Return the state of a robot; each kind of false alarm occurs once in so many years."""
        try:
            return cls._of(robot, history.rows(robot.serial), done, years)
        except (CalibrationError, ValueError, KeyError) as err:  # foreign or damaged rows
            found = cls._of(robot, (), done, years)
            told = {'': f'its rows in the history cannot be compared: {err}'}
            return replace(found, errors={**told, **found.errors})

    @classmethod
    def _of(cls, robot: Robot, rows: tuple[Row, ...], done: Run, years: float) -> RobotStatus:
        own = results(robot, rows) if rows else ()
        last = own[-1] if own else None
        compared = tuple(row for row in own if robot.compares(row.time))
        known = tuple(r for r in verifications(rows) if robot.compares(r.time))
        found = drift([r.rms_mm or 0 for r in known], [r.rms_freedom or 0 for r in known], years)
        watched = watch(compared, years)
        errors, copies = (of.get(robot.serial, {}) for of in (done.errors, done.copies))
        errors = {**errors, **_to_come(rows)}
        remarks = [f'{one} has the content of {other}: one night' for one, other in copies.items()]
        remarks += [*_clocks(rows, own), *_others(robot, rows, own), *watched.remarks]
        return cls(robot, last, watched, errors, known, found, tuple(remarks))

    @property
    def states(self) -> tuple[str, ...]:
        """Return all states that apply, worst first."""
        found = {
            'changed': bool(self.watched.changes),
            'worse': bool(self.drift.alarms),
            'refused': self.last is not None and not self.last.accepted,
            'beyond tolerance': self.share > 1.0,
            'unreadable': bool(self.errors) or self.last is None,
        }
        return tuple(state for state, holds in found.items() if holds) or ('fine',)

    @property
    def state(self) -> str:
        """Return the worst state."""
        return self.states[0]

    @property
    def alarms(self) -> tuple[str, ...]:
        """Return what has changed and since when."""
        grown = (
            f'{self.verified[first].time:%Y-%m-%d}: the errors of its verifications have grown'
            for first in self.drift.since
        )
        return (*alarms_of(self.watched.changes), *grown)

    @property
    def actions(self) -> tuple[str, ...]:
        """Return reasons to look at the robot or its calibration."""
        found = list(self.alarms)
        if self.last is not None and not self.last.accepted:
            found.append(f'not accepted: {"; ".join(some(self.last.reasons, 1))}')
        if self.last is not None and self.last.rms_mm is not None and self.share > 1.0:
            wanted = self.robot.tolerance
            found.append(f'beyond tolerance: {rounded(self.last.rms_mm)} mm, wanted {wanted:g} mm')
        return tuple(found)

    @property
    def unread(self) -> tuple[str, ...]:
        """Return what could not be used: each error with its source."""
        return tuple(
            error if source in error else f'{error} ({source})'
            for source, error in self.errors.items()
        )

    @property
    def share(self) -> float:
        """Return the error as a share of the tolerance; 0 if unknown."""
        if self.last is None or self.last.rms_mm is None or self.robot.tolerance is None:
            return 0.0
        return self.last.rms_mm / self.robot.tolerance


def _others(robot: Robot, rows: Sequence[Row], own: Sequence[Row]) -> Iterator[str]:
    others = (row for row in rows if row.accepted and row.settings != robot.settings_hash)
    nights = {row.inputs for row in others if row.source and robot.compares(row.time)}
    if number := len(nights.difference(row.inputs for row in own)):
        yield (
            'nights in the history by other settings or another chain, not compared: '
            f'{number} (put their files back to identify them again)'
        )


def _to_come(rows: Sequence[Row]) -> dict[str, str]:
    ahead = (row for row in rows if to_come(row))
    return {
        row.source or row.kind: (
            f'measured and filed on {row.filed:%Y-%m-%d}, in the future, so it does not count: '
            f'set the clock, there or here, and remove {row.key}.parquet from the history'
        )
        for row in ahead
    }


def _clocks(rows: Sequence[Row], own: Sequence[Row]) -> Iterator[str]:
    if ahead := [row for row in rows if too_late(row) and not to_come(row)]:
        row = max(ahead, key=lambda each: each.filed)
        yield (
            f'{counted(len(ahead), "result")} with stamps later than the filing, on '
            f'{row.filed:%Y-%m-%d} of {row.time:%Y-%m-%d} ({row.source or row.kind}): set the '
            'clock of the recorder, or of the computer that filed them'
        )
    if not own:
        return
    newest = max(own, key=lambda row: row.filed)
    if newest.time < own[-1].time and newest.filed - own[-1].filed > A_DAY / 2:  # another run
        yield (
            f'{newest.source} was filed last, and its stamps are of {newest.time:%Y-%m-%d}, '
            'before other nights: unless it is an old one, a clock was set back'
        )
