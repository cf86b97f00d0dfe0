# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report of a fleet: alarms, ranking, charts by robot, links to each robot's own report."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any
from urllib.parse import quote

import calib_ros
from calib_ros.atomic import write_file
from calib_ros.errors import MOST_ENTRIES
from calib_ros.fleet.run import Run, page_path
from calib_ros.fleet.standing import MEANING, Standing, State, counts
from calib_ros.fleet.work import PLOTLY
from calib_ros.report.page import MARKS, MISSING, State as Mark, filled, plotly_script

MOST_ROBOTS, MOST_NIGHTS = MOST_ENTRIES, MOST_ENTRIES // 10
"""Robots, the worst ones, and nights of each, that the page shows; the history has all."""
LOOKS: dict[State, Mark] = {
    'changed': 'bad',
    'worse': 'bad',
    'unreadable': 'bad',
    'refused': 'open',
    'beyond tolerance': 'open',
    'fine': 'good',
}


def write_report(out: Path, found: Sequence[Standing], done: Run) -> str:
    """Write the page and the script that it shares with those of the robots.

    Returns what is missing to write it, if anything.
    """
    script = plotly_script()
    page = None if script is None else page_of(out, found, done)
    if script is None or page is None:
        return MISSING
    out.mkdir(parents=True, exist_ok=True)
    if not (out / PLOTLY).exists() or (out / PLOTLY).stat().st_size != len(script.encode()):
        write_file(out / PLOTLY, script, overwrite=True)
    write_file(out / 'index.html', page, overwrite=True)
    return ''


def page_of(out: Path, found: Sequence[Standing], done: Run) -> str | None:
    """Return the page; None where jinja2 is not installed."""
    shown = found[:MOST_ROBOTS]
    return filled(
        'fleet.html.jinja',
        mark=LOOKS[found[0].state] if found else 'info',
        marks=MARKS,
        looks=LOOKS,
        counts={state: number for state, number in counts(found).items() if number},
        meaning=MEANING,
        total=len(found),
        alarmed=[each for each in shown if each.alarms],
        unreadable=[each for each in shown if each.errors],
        rows=[(each, _link(out, each)) for each in shown],
        done=done,
        script=PLOTLY,
        software=f'calib_ros {calib_ros.__version__}',
        made=datetime.now(timezone.utc).strftime('%Y-%m-%d %H:%M UTC'),
        data=[_chart(each) for each in shown],
    )


def _link(out: Path, standing: Standing) -> str:
    """Return the address of a robot's own report; empty if there is none."""
    if standing.last is None:
        return ''
    path = page_path(out, standing.last)
    return quote(path.relative_to(out).as_posix()) if path.exists() else ''


def _chart(standing: Standing) -> dict[str, Any]:
    """Return the nights of a robot: errors, and how strongly each joint seems changed."""
    nights = standing.watched.nights[-MOST_NIGHTS:]
    joints = list(nights[0].strength) if nights else []
    verified = standing.verified[-MOST_NIGHTS:]
    return {
        'serial': standing.robot.serial,
        'tolerance': standing.robot.tolerance,
        'time': [night.row.time.isoformat(timespec='seconds') for night in nights],
        'rms': [night.row.rms_mm for night in nights],
        'changes': [
            change.time.isoformat(timespec='seconds') for change in standing.watched.changes
        ],
        'verified': {
            'time': [row.time.isoformat(timespec='seconds') for row in verified],
            'rms': [row.rms_mm for row in verified],
            'sums': standing.drift.sums[-MOST_NIGHTS:].round(3).T.tolist(),
        },
        'joints': {
            joint: [round(night.strength[joint], 2) for night in nights] for joint in joints
        },
    }
