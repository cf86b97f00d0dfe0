# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How each robot of a plant stands after a run, the worst first, and as figures for Prometheus."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from calib_ros.apply.confidence import Drift, drift
from calib_ros.errors import CalibrationError
from calib_ros.files.history import History
from calib_ros.files.rows import Row
from calib_ros.fleet.plant import Robot
from calib_ros.fleet.run import Run, results
from calib_ros.fleet.watch import Watched, watch

State: TypeAlias = Literal['changed', 'worse', 'unreadable', 'refused', 'beyond tolerance', 'fine']
STATES: tuple[State, ...] = get_args(State)
MEANING: Mapping[State, str] = {
    'changed': 'the arm is another one than in the nights before',
    'worse': 'the errors of its verifications have grown',
    'unreadable': 'some of its measurements could not be used',
    'refused': 'the newest identification was not accepted',
    'beyond tolerance': 'the error of the corrected arm is larger than wanted',
    'fine': 'nothing to do',
}
ESCAPES = str.maketrans({'\\': r'\\', '"': r'\"', '\n': r'\n'})
"""How Prometheus takes what would end a label."""


@dataclass(frozen=True, eq=False)
class Standing:
    """A robot, its newest result, what changed, and what could not be read by source.

    `drift` is the chart of its verifications `verified`.
    """

    robot: Robot
    last: Row | None
    watched: Watched
    errors: Mapping[str, str]
    verified: tuple[Row, ...]
    drift: Drift

    @classmethod
    def of(
        cls, robot: Robot, history: History, errors: Mapping[str, str], years: float
    ) -> Standing:
        """Return how a robot stands; a false alarm of each kind comes once in so many years."""
        try:
            return cls._of(robot, history.rows(robot.serial), errors, years)
        except (CalibrationError, ValueError, KeyError) as err:  # rows of others, or damaged ones
            told = {**errors, '': f'its rows in the history cannot be compared: {err}'}
            return cls._of(robot, (), told, years)

    @classmethod
    def _of(
        cls, robot: Robot, rows: tuple[Row, ...], errors: Mapping[str, str], years: float
    ) -> Standing:
        own = results(robot, rows)
        known = tuple(
            row
            for row in rows
            if row.kind == 'verify' and row.rms_mm and row.rms_freedom and robot.compares(row.time)
        )
        found = drift([r.rms_mm or 0 for r in known], [r.rms_freedom or 0 for r in known], years)
        watched = watch([row for row in own if robot.compares(row.time)], years)
        return cls(robot, own[-1] if own else None, watched, errors, known, found)

    @property
    def state(self) -> State:
        """Return the worst that is to be said of it."""
        if self.watched.changes:
            return 'changed'
        if self.drift.alarms:
            return 'worse'
        if self.errors or self.last is None:
            return 'unreadable'
        if not self.last.accepted:
            return 'refused'
        return 'beyond tolerance' if self.share > 1.0 else 'fine'

    @property
    def alarms(self) -> tuple[str, ...]:
        """Return what has changed and since when, in words."""
        grown = (
            f'{self.verified[first].time:%Y-%m-%d}: the errors of its verifications have grown'
            for first in self.drift.since
        )
        return (*(f'{each.time:%Y-%m-%d}: {each}' for each in self.watched.changes), *grown)

    @property
    def share(self) -> float:
        """Return its error, of that wanted; 0 where none is wanted or known."""
        if self.last is None or self.last.rms_mm is None or self.robot.tolerance is None:
            return 0.0
        return self.last.rms_mm / self.robot.tolerance


def standings(
    robots: Sequence[Robot], history: History, done: Run, years: float
) -> tuple[Standing, ...]:
    """Return how robots stand, the worst first."""
    found = [Standing.of(r, history, done.errors.get(r.serial, {}), years) for r in robots]

    def rank(one: Standing) -> tuple[int, float, float, str]:
        rms = (one.last and one.last.rms_mm) or 0.0
        return STATES.index(one.state), -one.share, -rms, one.robot.serial

    return tuple(sorted(found, key=rank))


def counts(found: Sequence[Standing]) -> dict[State, int]:
    """Return how many robots are in each state."""
    number = Counter(each.state for each in found)
    return {state: number[state] for state in STATES}


def metrics(found: Sequence[Standing], done: Run, ended: float) -> str:
    """Return figures in the text format of Prometheus; `ended` is the time of the run [s]."""

    def by_robot(value: Callable[[Standing, Row], float | None]) -> dict[str, float | None]:
        labels = (each.robot.serial.translate(ESCAPES) for each in found)
        values = (value(each, each.last) if each.last else None for each in found)
        return {f'{{serial="{label}"}}': x for label, x in zip(labels, values, strict=True)}

    def changed(one: Standing, _: Row) -> float | None:
        return one.watched.changes[-1].time.timestamp() if one.watched.changes else None

    states = {f'{{state="{state}"}}': number for state, number in counts(found).items()}
    unread = sum(len(each.errors) for each in found)
    rms, measured = by_robot(lambda _, row: row.rms_mm), by_robot(lambda _, r: r.time.timestamp())
    tables: tuple[tuple[str, str, Mapping[str, float | None]], ...] = (
        ('fleet_robots', 'Robots by state.', states),
        ('fleet_unreadable_inputs', 'Inputs that could not be used.', {'': unread}),
        ('fleet_filed_results', 'Results filed by the last run.', {'': done.filed}),
        ('fleet_work_seconds', 'Time that workers spent in the last run.', {'': done.seconds}),
        ('fleet_last_run_timestamp_seconds', 'End of the last run.', {'': ended}),
        ('robot_rms_millimetres', 'RMS position error of the corrected arm.', rms),
        ('robot_measured_timestamp_seconds', 'When the newest result was measured.', measured),
        (
            'robot_changed_timestamp_seconds',
            'First night after the last change of the arm.',
            by_robot(changed),
        ),
    )
    lines: list[str] = []
    for name, text, values in tables:
        lines += [f'# HELP calib_ros_{name} {text}', f'# TYPE calib_ros_{name} gauge']
        lines += [
            f'calib_ros_{name}{labels} {value:.10g}'
            for labels, value in values.items()
            if value is not None and math.isfinite(value)
        ]
    return '\n'.join(lines) + '\n'
