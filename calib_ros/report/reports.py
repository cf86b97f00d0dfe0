# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the page of an identification says."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from datetime import datetime, timezone

import numpy as np

import calib_ros
from calib_ros.apply.confidence import rms_interval
from calib_ros.apply.workspace import CalibratedArm, survey
from calib_ros.files.rows import EPOCH_NS
from calib_ros.identification.identification import Identification
from calib_ros.identification.problem import Problem
from calib_ros.identification.validation import Comparison, ErrorFigures
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report import figures, words
from calib_ros.report.advice import SPREAD, advice
from calib_ros.report.explorer import explorer
from calib_ros.report.page import Origin, Report, Section, Verdict
from calib_ros.report.poses import Poses

INTERVAL, ONE_SIDED = 0.975, 0.95
"""One-sided confidence of each limit of an interval of 95 %, and of a verdict."""
MOST_OUTLIERS = 50
"""Outliers that have a row of their own table."""
SURVEYED = 4000
"""Random poses of the error map."""
ISO_9283 = (
    'Terms as in ISO 9283: the position accuracy AP is the distance between the pose commanded '
    'and the mean of the poses attained. Where a pose was measured once, its repeatability is '
    'part of the figure.'
)
HEAD = ('', 'poses', 'RMS [mm]', '95 % interval', 'mean', 'max', 'mean + 3 sigma', 'RMS [mrad]')


def identification_report(
    problem: Problem,
    result: Identification,
    poses: Poses,
    origin: Origin,
    warnings: Sequence[str] = (),
    tolerance: float | None = None,
) -> Report:
    """Return the report of an identification; `tolerance` is the wanted RMS error [m]."""
    judged = result.validation or result.fitted
    limits = _limits(judged, 1, ONE_SIDED)
    accuracy = [
        row
        for label, which in (('fitted', result.fitted), ('not fitted', result.validation))
        if which is not None
        for row in accuracy_rows(label, which)
    ]
    if judged.outliers:
        accuracy.append(_row('after, with outliers', judged.figures_of_all[1], None))
    return Report(
        kind='Kinematic calibration',
        robot=result.chain.name,
        verdict=_verdict(result, limits, tolerance),
        advice=advice(result.refusals),
        accuracy=Section(
            'accuracy',
            'Accuracy before and after',
            (
                f'"Before" is {words.BEFORE}. Judged by {result.validated_by}. The interval is '
                'that of the RMS error over poses like these, each configuration counted once.',
                'RMS (root mean square) is the usual size of the error. 1 mrad of orientation '
                'moves the tip of a tool of 1 m by 1 mm.',
                ISO_9283,
            ),
            head=HEAD,
            rows=tuple(accuracy),
        ),
        steps=_steps(result, limits, tolerance),
        remarks=(*warnings, *result.remarks),
        identity=identity_of(
            result.chain,
            origin,
            poses,
            ('Judged by', result.validated_by),
            table_hash(result.chain) if result.accepted else 'none: not accepted',
        ),
        explorer=explorer(result.chain, poses),
        sections=tuple(_sections(problem, result, poses)),
        inputs=origin.inputs,
        settings=origin.settings,
    )


def _verdict(
    result: Identification, limits: tuple[float, float], tolerance: float | None
) -> Verdict:
    both = gain(result.validation or result.fitted)
    if not result.accepted:
        return Verdict(
            'bad',
            'Not accepted: the robot stays as it was',
            (
                f'Why: {"; ".join(each.heading for each in advice(result.refusals))}.',
                'No correction was written or published. The figures below show what was tried.',
            ),
        )
    how = (
        'RMS position error before and after, on poses that were not used to compute the '
        'correction; in brackets the 95 % interval.'
    )
    where = f'The calibration is {result.region.in_words()}.' if result.region else ''
    text = tuple(each for each in (how, where) if each)
    if tolerance is None:
        return Verdict('good', 'Accepted', text, both)
    wanted = f'{1e3 * tolerance:g} mm'
    lower, upper = limits
    if upper <= tolerance:
        return Verdict('good', f'Accepted, and within the tolerance of {wanted}', text, both)
    if lower > tolerance:
        return Verdict('open', f'Accepted, but beyond the tolerance of {wanted}', text, both)
    return Verdict(
        'open', f'Accepted; whether it is within the tolerance of {wanted} is open', text, both
    )


def gain(which: Comparison) -> str:
    """Return the errors before and after with their uncertainty."""
    parts = []
    for when, found in enumerate(which.figures):
        between = _between(_limits(which, when, INTERVAL))
        parts.append(f'{found.rms_mm:.3f} mm' + (f' ({between})' if between else ''))
    return ' → '.join(parts)


def _between(limits: tuple[float, float]) -> str:
    """Return limits [m] in mm; nothing where they are not known."""
    return f'{1e3 * limits[0]:.3f} to {1e3 * limits[1]:.3f}' if np.isfinite(limits[1]) else ''


def _steps(
    result: Identification, limits: tuple[float, float], tolerance: float | None
) -> tuple[str, ...]:
    """Return what to do with a result."""
    if not result.accepted:
        return (
            'Do what is said above under "What to do", the first point first.',
            'Then identify again. Nothing is lost: the measurements so far can be used with the '
            'new ones.',
        )
    found = []
    if tolerance is not None and limits[0] > tolerance:
        if not result.chain.effects:
            found.append(
                'To come nearer to the tolerance, identify with --model auto: it corrects what '
                'gears, gravity and play add, where that helps.'
            )
        found.append(
            'Compare what is left with the accuracy of the measuring device: no calibration gets '
            'below that.'
        )
    elif tolerance is not None and limits[1] > tolerance:
        found.append(f'Measure more poses to decide about the tolerance, {SPREAD}.')
    found.append('Bring the correction to the robot: calib_ros export, or ~/export of the node.')
    found.append(
        'Then measure at least five new poses (calib_ros plan --iso9283) and judge the corrected '
        'arm: calib_ros verify.'
    )
    if result.region is not None and not result.region.whole:
        found.append(
            'Use it near the measured poses. To use it elsewhere, measure poses there as well.'
        )
    return tuple(found)


def _limits(which: Comparison, when: int, confidence: float) -> tuple[float, float]:
    """Return the limits [m] of the RMS before (0) or after (1), without outliers."""
    residuals = (which.before, which.after)[when]
    mask = which.judged & ~np.isnan(residuals.position).any(axis=1)
    return rms_interval(residuals.position[mask], residuals.configurations[mask], confidence)


def accuracy_rows(label: str, which: Comparison) -> list[tuple[str, ...]]:
    """Return the rows of the table of accuracy, before and after."""
    return [
        _row(f'{label}, {name}', found, _limits(which, when, INTERVAL))
        for when, (name, found) in enumerate(zip(('before', 'after'), which.figures, strict=True))
    ]


def _row(label: str, found: ErrorFigures, limits: tuple[float, float] | None) -> tuple[str, ...]:
    between = '' if limits is None else _between(limits)
    turned = '' if found.rms_mrad is None else f'{found.rms_mrad:.3f}'
    lengths = (found.mean_mm, found.max_mm, found.mean_plus_3_sigma_mm)
    shown = (f'{each:.3f}' for each in lengths)
    return (label, f'{found.count:,}', f'{found.rms_mm:.3f}', between, *shown, turned)


def identity_of(
    chain: Chain,
    origin: Origin,
    poses: Poses | None = None,
    judged: tuple[str, str] = ('', ''),
    corrected: str = '',
) -> tuple[tuple[str, str], ...]:
    """Return what the result is of, by whom and when; what is not told is left out."""
    rows = [
        ('Robot', chain.name),
        ('Serial number', origin.serial),
        ('Joints', ', '.join(chain.joint_names)),
        ('Measuring device', origin.device),
        ('Operator', origin.operator),
        ('Measured', _measured(poses)),
        ('Poses', '' if poses is None else f'{len(poses):,}'),
        judged,
        ('Report made', datetime.now(timezone.utc).strftime('%Y-%m-%d %H:%M UTC')),
        (
            'Software',
            f'calib_ros {calib_ros.__version__}, Python {platform.python_version()}, '
            f'numpy {np.__version__}',
        ),
        ('Corrected table, SHA-256', corrected),
    ]
    return tuple((label, value) for label, value in rows if value)


def _measured(poses: Poses | None) -> str:
    """Return when it was measured, where the stamps tell."""
    if poses is None or not len(poses) or poses.lines or poses.stamps_ns[0] < EPOCH_NS:
        return ''
    first, last = (
        datetime.fromtimestamp(int(stamp) // 10**9, timezone.utc).strftime('%Y-%m-%d %H:%M')
        for stamp in (poses.stamps_ns[0], poses.stamps_ns[-1])
    )
    return f'{first} to {last} UTC'


def distributions(poses: Poses) -> list[Section]:
    """Return how many of the judged poses are how good."""
    chosen = poses.judged
    errors = [1e3 * np.linalg.norm(each[chosen], axis=1) for each in (poses.before, poses.after)]
    return [
        Section(
            'cumulated',
            'How many poses are how good',
            ('Outliers are left out. The further left a curve, the better.',),
            figures.cumulated(errors[0], errors[1]),
        )
    ]


def _sections(problem: Problem, result: Identification, poses: Poses) -> list[Section]:
    """Return the sections below the poses."""
    found = distributions(poses)
    found.append(
        Section(
            'noise',
            'What is left against the noise of the device',
            (
                'If nothing but the stated noise of the measuring device were left, all dots '
                'would lie on the dotted line. A steeper line: more is left, or the stated noise '
                'is too small.',
                f'In figures: {words.noise_in_words(result)}.',
                *words.chance_in_words(result),
            ),
            figures.against_noise(poses),
        )
    )
    if result.outliers:
        found.append(_outliers(result, poses))
    found += _parameters(problem, result)
    gauges = tuple(
        f'{name} cannot be told apart from {", ".join(partners)}: only their combination shows, '
        f'and {name} keeps its nominal value.'
        if partners
        else f'{name}: no measured pose depends on it; it keeps its nominal value.'
        for name, partners in result.gauges.items()
    )
    if gauges:
        found.append(Section('gauges', 'What no measurement of this kind can tell', gauges))
    found.append(coverage(result.chain, poses.joints, 'How far each joint was moved'))
    if result.verdicts:
        found.append(
            Section(
                'effects',
                'Errors beyond geometry',
                ('RMS position error on configurations left out, with and without each effect.',),
                head=('effect', 'without [mm]', 'with it [mm]', 'used'),
                rows=tuple(
                    (
                        v.what,
                        f'{v.rms_mm_before:.4f}',
                        f'{v.rms_mm_after:.4f}',
                        'yes' if v.pays else 'no: does not pay for itself',
                    )
                    for v in result.verdicts
                ),
            )
        )
    if result.accepted:
        found.append(_map(result))
    return found


def coverage(chain: Chain, joints: FloatArray, title: str) -> Section:
    """Return how far joint values (N, n) reach in the range of each joint."""
    figure, rows = figures.coverage(chain, joints)
    return Section(
        'coverage',
        title,
        ('Errors show only where a joint was: blank parts of its range hold no poses.',),
        figure,
        ('joint', 'range', 'poses from, to', 'parts with poses'),
        rows,
        100 + 45 * len(rows),
    )


def _outliers(result: Identification, poses: Poses) -> Section:
    """Return the outliers of the fit, the largest first, by line or stamp."""
    rows = np.flatnonzero(poses.outlier & ~np.isnan(poses.size))
    rows = rows[np.argsort(-poses.size[rows])]
    after = 1e3 * np.linalg.norm(poses.after, axis=1)
    more = f' The {MOST_OUTLIERS} largest are shown.' if len(rows) > MOST_OUTLIERS else ''
    return Section(
        'outliers',
        f'Outliers: {len(rows)} poses carry no or little weight',
        (
            'They differ from all the others by more than errors of this arm and device do. '
            f'Measure them again, or look what happened there.{more}',
        ),
        head=('where', 'pose', 'size [usual errors]', 'error after [mm]'),
        rows=tuple(
            (poses.source(k), str(k + 1), f'{poses.size[k]:.1f}', f'{after[k]:.3f}')
            for k in rows[:MOST_OUTLIERS].tolist()
        ),
    )


def _parameters(problem: Problem, result: Identification) -> list[Section]:
    """Return the parameters of the arm: figures, and a table with all."""
    own = [p for p in result.parameters if not result.chain.owns_frame(p.name)]
    geometric = [p for p in own if p.name.unit in ('m', 'rad')]
    effects = {name for name, _ in result.chain.effects}
    geometric = [p for p in geometric if p.name not in effects]
    found = []
    for name, title, lengths, limit in (
        ('lengths', 'Lengths found', True, problem.largest_length),
        ('angles', 'Angles found', False, problem.largest_angle),
    ):
        figure = figures.forest(geometric, lengths, limit)
        unit = 'mm' if lengths else 'mrad'
        if figure is not None:
            found.append(
                Section(
                    name,
                    title,
                    (
                        'Offsets from the nominal table with their 95 % intervals. An interval '
                        'that holds zero: the nominal value may be right. Limit of common sense: '
                        f'±{1e3 * limit:g} {unit}.',
                    ),
                    figure,
                    height=110 + 24 * len(figure['data'][0]['y']),
                )
            )
    rows = []
    for p in result.parameters:
        unit = p.name.unit
        width = p.half_width()
        offset = '' if p.std is None else f'{1e3 * p.offset:+.4f}'
        within = '' if width is None else f'{1e3 * width:.4f}'
        rows.append((p.name, f'{p.value:.9f} {unit}', offset, within, f'm{unit}', p.status))
    found.append(
        Section(
            'parameters',
            'All parameters',
            (
                'gauge: redundant by the structure of the chain, kept nominal. not excited: the '
                'poses do not determine it, kept nominal. fixed: held on request.',
            ),
            head=('parameter', 'value', 'offset', '± (95 %)', 'unit', 'status'),
            rows=tuple(rows),
        )
    )
    strong = [f'{a} and {b} ({value:+.2f})' for a, b, value in result.correlated()]
    found.append(
        Section(
            'correlations',
            'Which parameters stand in for each other',
            (
                'Two parameters of strong colour change together: the poses tell their '
                'combination better than each alone. Predictions of the arm are not harmed.',
                f'Strongest: {", ".join(strong)}.' if strong else 'None is above 0.9.',
            ),
            figures.correlations(result.names, result.covariance),
            height=max(360, 140 + 15 * len(result.names)),
        )
    )
    return found


def _map(result: Identification) -> Section:
    """Return the error map over the workspace."""
    found = survey(CalibratedArm.of(result), SURVEYED, np.random.default_rng(0))
    where = '' if result.region is None else f'The calibration is {result.region.in_words()}.'
    return Section(
        'map',
        'The error over the workspace',
        (
            f'At {SURVEYED:,} random poses of the whole joint range, by the distance from the '
            f'axis of the base and the height above it. {where}',
        ),
        figures.error_map(found),
    )
