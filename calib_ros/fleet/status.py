# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The state of the robots of a plant after a run, worst first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import timedelta
from itertools import pairwise
from statistics import median_low

from calib_ros.estimation.levels import SEVERAL
from calib_ros.files.history import History
from calib_ros.fleet.plant import Robot
from calib_ros.fleet.robot_status import RobotStatus
from calib_ros.fleet.run import Run
from calib_ros.identification.age import A_DAY
from calib_ros.report.content import State
from calib_ros.shown import some

STATES: Mapping[str, tuple[State, str]] = {
    'changed': ('bad', 'the arm differs from earlier nights'),
    'worse': ('bad', 'the errors of its verifications have grown'),
    'refused': ('open', 'the newest identification was not accepted'),
    'beyond tolerance': ('open', 'the error of the corrected arm exceeds the tolerance'),
    'unreadable': ('open', 'some of its measurements could not be used'),
    'fine': ('good', 'nothing to do'),
}
"""States from worst to best, with their looks and meanings."""


def _without_twins(found: Sequence[RobotStatus]) -> Iterator[RobotStatus]:
    """Yield statuses; newest measurements that are those of another robot are unreadable."""
    owners: dict[str, list[str]] = {}
    for one in found:
        if one.last is not None:
            owners.setdefault(one.last.inputs, []).append(one.robot.serial)
    for one in found:
        last, errors = one.last, dict(one.errors)
        own = owners[last.inputs] if last is not None else []
        if last is not None and len(own) > 1:
            others = some([serial for serial in own if serial != one.robot.serial], 3)
            errors[last.source] = (
                f'{last.source} has the measurements of {", ".join(others)}: only one robot made '
                'them. If it is another, put the right file there, or correct "measured" in the '
                f'plant file, and remove {last.key}.parquet from the history'
            )
        yield replace(one, errors=errors)


def _silent(found: Sequence[RobotStatus]) -> Iterator[RobotStatus]:
    """Yield statuses; those that miss several usual nights of two others are told.

    So is a robot that alone has such nights: the others stopped, or its clock is ahead.
    """
    usual: dict[str, timedelta] = {}
    for one in found:
        times = [night.row.time for night in one.watched.nights]
        if len(times) >= SEVERAL:
            usual[one.robot.serial] = max(median_low(b - a for a, b in pairwise(times)), A_DAY)
    ends = sorted(one.last.time for one in found if one.last and one.robot.serial in usual)
    for one in found:
        if one.last and one.robot.serial in usual and len(ends) > 1:
            last, newest, few = one.last.time, ends[-2], SEVERAL * usual[one.robot.serial]
            told: tuple[str, ...] = ()
            if newest - last > few:
                told = (f'nothing measured since {last:%Y-%m-%d}; other robots were',)
            elif last - newest > few:
                since = f'no other robot was measured since {newest:%Y-%m-%d}'
                told = (f'{since}: did they stop, or is its clock ahead?',)
            one = replace(one, remarks=(*one.remarks, *told))
        yield one


def statuses(
    robots: Sequence[Robot], history: History, done: Run, years: float
) -> tuple[RobotStatus, ...]:
    """Return the states of robots, worst first."""
    found = [RobotStatus.of(robot, history, done, years) for robot in robots]
    order = list(STATES)

    def rank(one: RobotStatus) -> tuple[int, float, float, str]:
        rms = (one.last and one.last.rms_mm) or 0.0
        return order.index(one.state), -one.share, -rms, one.robot.serial

    return tuple(sorted(_silent([*_without_twins(found)]), key=rank))


def counts(found: Sequence[RobotStatus]) -> dict[str, int]:
    """Return the number of robots in each state."""
    number = Counter(each.state for each in found)
    return {state: number[state] for state in STATES}
