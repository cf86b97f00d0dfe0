# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros fleet` and `calib_ros history`: many robots, and results over time."""

from __future__ import annotations

import argparse
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

from calib_ros.atomic import write_file
from calib_ros.cli import checks, common
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.files.history import History
from calib_ros.shown import counted, rounded


def _run_fleet(options: argparse.Namespace, screen: Screen) -> int:
    from calib_ros.fleet.cluster import Cluster
    from calib_ros.fleet.page import metrics, write_report
    from calib_ros.fleet.plant import read_plant
    from calib_ros.fleet.run import run
    from calib_ros.fleet.status import counts, statuses

    if not 0.0 < options.years < 1e9:
        raise InputError(f'--years must be positive, not {options.years:g}')
    checks.at_least(options, workers=0)
    if options.scheduler:
        checks.refuse(options, ('workers', 'memory'), 'does not apply to workers of a --scheduler')
    robots = read_plant(options.plant)
    history = History(options.history)
    cluster = Cluster(options.scheduler, options.workers, options.memory)
    with screen.work(counted(len(robots), 'robot')) as work, _tidied_up(screen):
        done = run(robots, history, cluster, options.out, work)
        work('comparing nights')
        found = statuses(robots, history, done, options.years)
    number = counts(found)
    title = ', '.join(f'{count} {state}' for state, count in number.items() if count)
    screen.title(title, number['fine'] == len(found))
    for each in found:
        for words in each.actions:
            Screen().say(f'- {each.robot.serial}, {words}')  # even if quiet: the mail of cron
        for error in each.unread:
            screen.warn(f'{each.robot.serial}: {error}')
        for remark in () if options.quiet else each.remarks:
            screen.warn(f'{each.robot.serial}: {remark}', 'note')
    screen.say(f'{done.filed} new results in {options.history}')
    if options.metrics is not None:
        write_file(options.metrics, metrics(found, done, time.time()), overwrite=True)
    if options.out is not None:
        if missing := write_report(options.out, found, done):
            screen.warn(missing, 'note')
        screen.say(f'wrote {options.out}: open {options.out / "index.html"}')
    if number['fine'] + number['unreadable'] < len(found):
        return common.Status.NOT_ACCEPTED
    return common.Status.INCOMPLETE if number['unreadable'] else 0


@contextmanager
def _tidied_up(screen: Screen) -> Iterator[None]:
    """Let the first Ctrl-C end the work, and ignore others while the workers end."""

    def end(*_: object) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, end)
    try:
        yield
    except KeyboardInterrupt:
        screen.warn('results so far are saved; the next run continues', 'note')
        raise
    finally:
        signal.signal(signal.SIGINT, before)


def _run_history(options: argparse.Namespace, screen: Screen) -> int:
    history = History(options.history)
    serials = history.serials()
    if not serials:
        raise InputError(f'{options.history} holds no results: is it a history?')
    if options.robot is not None:
        if options.robot not in serials:
            raise UnknownNameError('robot', options.robot, serials)
        serials = (options.robot,)
    width = max(map(len, ('robot', *serials)))
    columns = 'time (UTC)        what      verdict        poses  RMS [mm]  from'
    screen.data(f'{"robot":{width}}  {columns}')
    status = 0
    for serial in serials:
        try:
            for row in history.rows(serial):
                rms = '' if row.rms_mm is None else rounded(row.rms_mm)
                line = f'{serial:{width}}  {row.time:%Y-%m-%d %H:%M}  {row.kind:8}  '
                line += f'{row.verdict:13}  {row.poses:5}  {rms:>8}  {row.source}'
                screen.data(line.rstrip())
        except InputError as err:  # costs its robot only
            screen.warn(f'{serial}: {err}')
            status = common.Status.INCOMPLETE
    return status
