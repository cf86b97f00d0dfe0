# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The state of a plant as a page and as Prometheus metrics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from urllib.parse import quote

import calib_ros
from calib_ros.atomic import write_file
from calib_ros.errors import MOST_ENTRIES
from calib_ros.files.rows import Row
from calib_ros.fleet.change import Change
from calib_ros.fleet.robot_status import RobotStatus
from calib_ros.fleet.run import Run, page_path
from calib_ros.fleet.status import STATES, counts
from calib_ros.fleet.tasks import PLOTLY
from calib_ros.report.page import NEEDS_JINJA, filled, plotly_script

MOST_NIGHTS = MOST_ENTRIES // 10  # nights of a robot on the page; the history lists all
ESCAPES = str.maketrans({'\\': r'\\', '"': r'\"', '\n': r'\n'})
"""Escapes in Prometheus labels."""


def metrics(found: Sequence[RobotStatus], done: Run, ended: float) -> str:
    """Return metrics in the text format of Prometheus; `ended` is the time of the run [s]."""
    states = {f'{{state="{state}"}}': number for state, number in counts(found).items()}
    unread = sum(len(each.errors) for each in found)
    rms, measured, since = {}, {}, {}
    for each in found:
        label = f'{{serial="{each.robot.serial.translate(ESCAPES)}"}}'
        if each.last is not None:
            rms[label], measured[label] = each.last.rms_mm, each.last.time.timestamp()
        for change in each.watched.changes[-1:]:
            since[label] = change.time.timestamp()
    changes = 'First night after the last change of the arm.'
    tables: tuple[tuple[str, str, Mapping[str, float | None]], ...] = (
        ('fleet_robots', 'Robots by state.', states),
        ('fleet_unreadable_inputs', 'Inputs that could not be used.', {'': unread}),
        ('fleet_filed_results', 'Results filed by the last run.', {'': done.filed}),
        ('fleet_work_seconds', 'Time that workers spent in the last run.', {'': done.seconds}),
        ('fleet_last_run_timestamp_seconds', 'End of the last run.', {'': ended}),
        ('robot_rms_millimetres', 'RMS position error of the corrected arm.', rms),
        ('robot_measured_timestamp_seconds', 'When the newest result was measured.', measured),
        ('robot_changed_timestamp_seconds', changes, since),
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


def write_report(out: Path, found: Sequence[RobotStatus], done: Run) -> str:
    """Write the page and the script shared with robots' pages; return what is missing."""
    script, page = plotly_script(), fleet_page(out, found, done)
    if script is None or page is None:
        return NEEDS_JINJA
    out.mkdir(parents=True, exist_ok=True)
    if not (out / PLOTLY).exists() or (out / PLOTLY).stat().st_size != len(script.encode()):
        write_file(out / PLOTLY, script, overwrite=True)
    write_file(out / 'index.html', page, overwrite=True)
    return ''


def fleet_page(out: Path, found: Sequence[RobotStatus], done: Run) -> str | None:
    """Return the page, or None without jinja2."""
    shown = found[:MOST_ENTRIES]  # the worst
    return filled(
        'fleet.html.jinja',
        mark=STATES[found[0].state][0],
        states=STATES,
        counts={state: number for state, number in counts(found).items() if number},
        total=len(found),
        shown=shown,
        rows=[(each, _link(out, each)) for each in shown],
        done=done,
        script=PLOTLY,
        software=f'calib_ros {calib_ros.__version__}',
        made=datetime.now(timezone.utc).strftime('%Y-%m-%d %H:%M UTC'),
        data=[_chart(each) for each in shown],
    )


def _link(out: Path, status: RobotStatus) -> str:
    if status.last is None:
        return ''
    path = page_path(out, status.last)
    return quote(path.relative_to(out).as_posix()) if path.exists() else ''


def _chart(status: RobotStatus) -> dict[str, Any]:
    def times(rows: Iterable[Row | Change]) -> list[str]:
        return [each.time.isoformat(timespec='seconds') for each in rows]

    nights = status.watched.nights[-MOST_NIGHTS:]
    joints = dict.fromkeys(joint for night in nights for joint in night.strength)
    verified = status.verified[-MOST_NIGHTS:]
    return {
        'tolerance': status.robot.tolerance,
        'time': times(night.row for night in nights),
        'rms': [night.row.rms_mm for night in nights],
        'changes': times(status.watched.changes),
        'verified': {
            'time': times(verified),
            'rms': [row.rms_mm for row in verified],
            'sums': status.drift.sums[-MOST_NIGHTS:].round(3).T.tolist(),
        },
        'joints': {
            joint: [
                None if (x := night.strength.get(joint)) is None else round(x, 2)
                for night in nights
            ]
            for joint in joints
        },
    }
