# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How each robot of a plant stands after a run, the worst first, and as figures for Prometheus."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from calib_ros.files.history import History
from calib_ros.files.rows import Row
from calib_ros.fleet.plant import Robot
from calib_ros.fleet.run import Run, results
from calib_ros.fleet.watch import YEARS, Watched, watch

State: TypeAlias = Literal['changed', 'unreadable', 'refused', 'beyond tolerance', 'fine']
STATES: tuple[State, ...] = get_args(State)
MEANING: Mapping[State, str] = {
    'changed': 'the arm is another one than in the nights before',
    'unreadable': 'some of its measurements could not be used',
    'refused': 'the newest identification was not accepted',
    'beyond tolerance': 'the error of the corrected arm is larger than wanted',
    'fine': 'nothing to do',
}


@dataclass(frozen=True, eq=False)
class Standing:
    """A robot, its newest result, what changed, and what could not be read by source."""

    robot: Robot
    last: Row | None
    watched: Watched
    errors: Mapping[str, str]

    @property
    def state(self) -> State:
        """Return the worst that is to be said of it."""
        if self.watched.changes:
            return 'changed'
        if self.errors or self.last is None:
            return 'unreadable'
        if not self.last.accepted:
            return 'refused'
        return 'beyond tolerance' if self.share > 1.0 else 'fine'

    @property
    def share(self) -> float:
        """Return its error, of that wanted; 0 where none is wanted or known."""
        if self.last is None or self.last.rms_mm is None or self.robot.tolerance is None:
            return 0.0
        return self.last.rms_mm / self.robot.tolerance


def standings(
    robots: Sequence[Robot], history: History, done: Run, years: float = YEARS
) -> tuple[Standing, ...]:
    """Return how robots stand, the worst first."""
    found = []
    for robot in robots:
        rows = results(robot, history)
        last = rows[-1] if rows else None
        watched = watch(rows, robot.since, years)
        found.append(Standing(robot, last, watched, done.errors.get(robot.serial, {})))
    return tuple(
        sorted(found, key=lambda s: (STATES.index(s.state), -s.share, -_rms(s), s.robot.serial))
    )


def _rms(standing: Standing) -> float:
    return (standing.last and standing.last.rms_mm) or 0.0


def counts(found: Sequence[Standing]) -> dict[State, int]:
    """Return how many robots are in each state."""
    number = Counter(each.state for each in found)
    return {state: number[state] for state in STATES}


def metrics(found: Sequence[Standing], done: Run, ended: float) -> str:
    """Return figures in the text format of Prometheus; `ended` is the time of the run [s]."""
    lines: list[str] = []

    def metric(name: str, text: str, values: Sequence[tuple[str, float]]) -> None:
        lines.append(f'# HELP calib_ros_{name} {text}')
        lines.append(f'# TYPE calib_ros_{name} gauge')
        lines.extend(f'calib_ros_{name}{labels} {value:.10g}' for labels, value in values)

    def by_robot(name: str, text: str, values: Sequence[tuple[Standing, float | None]]) -> None:
        metric(
            name,
            text,
            [
                (f'{{serial="{_label(s.robot.serial)}"}}', value)
                for s, value in values
                if value is not None and math.isfinite(value)
            ],
        )

    metric(
        'fleet_robots',
        'Robots by state.',
        [(f'{{state="{state}"}}', number) for state, number in counts(found).items()],
    )
    unread = sum(len(each.errors) for each in found)
    metric('fleet_unreadable_inputs', 'Inputs that could not be used.', [('', unread)])
    metric('fleet_filed_results', 'Results filed by the last run.', [('', done.filed)])
    metric('fleet_work_seconds', 'Time that workers spent in the last run.', [('', done.seconds)])
    metric('fleet_last_run_timestamp_seconds', 'End of the last run.', [('', ended)])
    by_robot(
        'robot_rms_millimetres',
        'RMS position error of the corrected arm.',
        [(s, s.last.rms_mm if s.last else None) for s in found],
    )
    by_robot(
        'robot_measured_timestamp_seconds',
        'When the newest result was measured.',
        [(s, s.last.time.timestamp() if s.last else None) for s in found],
    )
    by_robot(
        'robot_changed_timestamp_seconds',
        'First night after the last change of the arm.',
        [
            (s, s.watched.changes[-1].time.timestamp() if s.watched.changes else None)
            for s in found
        ],
    )
    return '\n'.join(lines) + '\n'


def _label(text: str) -> str:
    return text.replace('\\', r'\\').replace('"', r'\"').replace('\n', r'\n')
