# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sections shared by several pages."""

from __future__ import annotations

import platform
import time
from collections.abc import Sequence
from datetime import datetime, timezone

import numpy as np

import calib_ros
from calib_ros.decision.comparison import Comparison
from calib_ros.decision.residuals import ErrorFigures
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report import figures, words
from calib_ros.report.content import Origin, Section, section
from calib_ros.report.poses import Poses
from calib_ros.shown import rounded

BOTH = (
    'it contains both AP and RP of ISO 9283 (accuracy and repeatability), because each '
    'measurement counts by itself. Std: standard deviation of the errors.'
)
ERROR = (
    'Error: distance from the measured target to its place in the model. With this model in the '
    f'controller {BOTH}'
)
OF_THE_PROGRAM = f'Error: distance from the measured target to its place in the program; {BOTH}'
LABELS = (
    *('RMS [mm]', '95 % interval [mm]', 'mean [mm]', 'largest [mm]', 'mean + 3 std [mm]'),
    *('RMS orientation [mrad]', 'RMS [px]'),
)
"""Rows of the accuracy table below head and count."""


def gain(which: Comparison, intervals: bool = True, count: int = 2) -> str:
    """Return the errors before and after, or one, with their uncertainty if wanted."""
    parts = []
    for when, found in enumerate(which.figures[:count]):
        between = words.rms_range_mm(which, when) if intervals else ''
        parts.append(f'{rounded(found.rms_mm)} mm' + (f' ({between})' if between else ''))
    return f'RMS position error: {" → ".join(parts)}'


def accuracy_section(
    title: str,
    judged: Comparison,
    things: str,
    *text: str,
    intervals: bool = True,
    error: str = ERROR,
) -> Section:
    """Return the accuracy table, before and after; `things` are counted, outliers apart."""
    columns = [
        _column(name, found, words.rms_range_mm(judged, when) if intervals else '')
        for when, (name, found) in enumerate(zip(('before', 'after'), judged.figures, strict=True))
    ]
    if judged.outliers:
        columns.append(_column('after, with outliers', judged.figures_of_all[1]))
    labels = ('', things, *LABELS)
    head, *rows = (row for row in zip(labels, *columns, strict=True) if any(row[1:]))
    return section('accuracy', title, *text, error, head=head, rows=tuple(rows))


def _column(label: str, found: ErrorFigures, between: str = '') -> tuple[str, ...]:
    """Return a column of the table of accuracy, with the interval of the RMS if it is known."""
    lengths = (found.mean_mm, found.max_mm, found.mean_plus_3_sigma_mm)
    rest = (*lengths, found.rms_mrad, found.rms_px)
    shown = ('' if x is None else rounded(x) for x in rest)
    return (label, f'{found.count:,}', rounded(found.rms_mm), between, *shown)


def identity_of(
    chain: Chain,
    origin: Origin,
    poses: Poses | None = None,
    more: Sequence[tuple[str, str]] = (),
    corrected: str = '',
) -> tuple[tuple[str, str], ...]:
    """Return the identity of the result: robot, people, times; unknown entries are omitted."""
    software = f'calib_ros {calib_ros.__version__}, Python {platform.python_version()}, '
    software += f'numpy {np.__version__}'
    rows = [
        ('Robot', chain.name),
        ('Serial number', origin.serial),
        ('Joints', ', '.join(chain.joint_names)),
        ('Measuring device', origin.device),
        ('Operator', origin.operator),
        ('Conditions', origin.conditions),
        ('Measured, by the stamps', _measured(poses)),
        *(((poses.things.capitalize(), f'{len(poses):,}'),) if poses else ()),
        *more,
        ('Report made', datetime.now(timezone.utc).strftime('%Y-%m-%d %H:%M UTC')),
        ('Software', software),
        ('Corrected table, SHA-256', corrected),
    ]
    return tuple((label, value) for label, value in rows if value)


def _measured(poses: Poses | None) -> str:
    if poses is None or not poses.timed:
        return ''
    first, last = (
        datetime.fromtimestamp(int(stamp) // 10**9, timezone.utc).strftime('%Y-%m-%d %H:%M')
        for stamp in (poses.stamps_ns[0], poses.stamps_ns[-1])
    )
    ahead = int(poses.stamps_ns[-1]) > time.time_ns()
    return f'{first} to {last} UTC' + ' (in the future: a clock is wrong)' * ahead


def distribution(poses: Poses) -> Section:
    """Return the distribution of errors of the judged poses."""
    chosen = poses.judged
    before, after = (
        1e3 * np.linalg.norm(each[chosen], axis=1) for each in (poses.before, poses.after)
    )
    return section(
        'cumulated',
        f'Share of {poses.things} within an error',
        'Outliers are left out.' if poses.outlier.any() else '',
        'The further left a curve, the better.',
        figure=figures.cumulated(before, after, poses.things),
        height=400,
    )


def outliers(poses: Poses) -> Section:
    """Return the outliers, largest first."""
    after = 1e3 * np.linalg.norm(poses.after, axis=1)
    rows = np.flatnonzero(poses.outlier)
    rows = rows[np.argsort(-after[rows])]
    more = ' The 50 largest are shown.' if len(rows) > 50 else ''
    return section(
        'outliers',
        f'Outliers: {len(rows):,} of {len(poses):,} {poses.things}',
        'They differ from the others by more than this arm and device explain: little or no '
        'weight in the fit, none in the figures. Measure them again, or find out what happened.'
        f'{more}',
        head=('from', 'residual/typical error', 'error after [mm]'),
        rows=tuple(
            (poses.source(k), size, rounded(after[k]))
            for k in rows[:50].tolist()
            for size in ('held out' if np.isnan(poses.size[k]) else f'{poses.size[k]:.1f}',)
        ),
    )


def coverage(chain: Chain, joints: FloatArray, title: str) -> Section:
    """Return how far joint values (N, n) reach in the range of each joint."""
    figure, rows = figures.histogram(chain, joints)
    return section(
        'coverage',
        title,
        'A joint shows its errors only where it was measured: blank parts of its range have no '
        'poses.',
        figure=figure,
        head=('joint', 'range', 'poses from, to', 'parts with poses'),
        rows=rows,
        height=100 + 45 * len(rows),
    )
