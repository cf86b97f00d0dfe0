# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the pages of a workspace and of a plan say."""

from __future__ import annotations

from typing import Any

import numpy as np

from calib_ros.apply.placement import Placements
from calib_ros.apply.planning import Plan
from calib_ros.apply.workspace import Spread, Survey, in_base, regions
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report import figures
from calib_ros.report.page import Origin, Report, Section, Verdict
from calib_ros.report.reports import coverage, identity_of

MOST_POSES = 200
"""Poses of a plan that have a row."""
MOST_REGIONS = 6


def workspace_report(
    arm: Calibration, found: Survey, origin: Origin, placed: Placements | None = None
) -> Report:
    """Return the report of a survey, and of the placements of a task if there are any."""
    parts = [('removed by the calibration', found.removed)]
    if not np.isnan(found.remaining).any():
        parts += [('sigma of what remains', found.sigma), ('expected to remain', found.remaining)]
    spreads = [(label, Spread.of(1e3 * errors)) for label, errors in parts]
    first, last = spreads[0][1], spreads[-1][1]
    text = [f'The calibration removes {first.rms:.3f} mm RMS, {first.max:.3f} mm at most.']
    if len(parts) > 1:
        text.append(f'Expected to remain: {last.rms:.3f} mm RMS, {last.max:.3f} mm at most.')
    if arm.region is not None:
        text.append(f'The calibration is {arm.region.in_words()}.')
    sections = [
        Section(
            'map',
            'Errors by radius and height',
            ('Radius: distance from the axis of the base. Height: above its origin.',),
            figures.error_map(found),
        )
    ]
    for label, errors in parts[:2]:
        ranked = regions(found.positions, errors)
        name = label.split()[0]
        sections.append(
            Section(
                f'regions-{name}',
                f'Where the most is {label}' if label[0] == 'r' else f'Where the {label} is most',
                head=('region', 'poses', 'RMS [mm]', 'radius [m]', 'height [m]'),
                rows=tuple(
                    (
                        each.words,
                        str(each.poses),
                        f'{1e3 * each.rms:.4f}',
                        f'{each.radius[0]:.2f} to {each.radius[1]:.2f}',
                        f'{each.height[0]:.2f} to {each.height[1]:.2f}',
                    )
                    for each in ranked[:MOST_REGIONS]
                ),
            )
        )
    if placed is not None:
        sections.insert(0, _placed(placed))
    return Report(
        kind='Errors over the workspace',
        robot=arm.chain.name,
        verdict=Verdict('info', 'What the calibration changes, and where', tuple(text)),
        accuracy=Section(
            'accuracy',
            'Position errors [mm]',
            (f'At {len(found.joints):,} random poses of the joint range.',),
            head=('', 'RMS', 'mean', 'median', '95 %', 'max'),
            rows=tuple(
                (label, *(f'{x:.4f}' for x in (s.rms, s.mean, s.median, s.percentile_95, s.max)))
                for label, s in spreads
            ),
        ),
        identity=identity_of(arm.chain, origin, corrected=table_hash(arm.chain)),
        sections=tuple(sections),
        inputs=origin.inputs,
        settings=origin.settings,
    )


def _placed(placed: Placements) -> Section:
    """Return the placements of a task in space."""
    reached = ~np.isnan(placed.errors)
    best = placed.positions[placed.best]
    where = ', '.join(f'{value:.3f}' for value in best)
    data = [
        _cloud(placed.positions[reached], 1e3 * placed.errors[reached], 'expected error [mm]'),
        _marks(best[np.newaxis], 'best place'),
    ]
    return Section(
        'placements',
        'Where to put the task',
        (
            f'Best at x, y, z = {where} m, {np.degrees(placed.turns[placed.best]):.0f}° about the '
            f'vertical: {1e3 * placed.errors[placed.best]:.4f} mm; in the centre of the region '
            f'{1e3 * placed.errors[placed.centre]:.4f} mm. '
            f'{int(reached.sum())} of {len(reached)} places can be reached.',
        ),
        {'data': data, 'layout': _space()},
        height=560,
    )


def _cloud(positions: FloatArray, values: FloatArray, title: str) -> dict[str, Any]:
    x, y, z = (figures.numbers(each) for each in positions.T)
    marker = {'size': 4, 'color': figures.numbers(values), 'colorscale': 'Viridis'}
    marker |= {'reversescale': True, 'colorbar': {'title': {'text': title}, 'thickness': 12}}
    cloud = {'type': 'scatter3d', 'mode': 'markers', 'x': x, 'y': y, 'z': z, 'marker': marker}
    return cloud | {'name': title, 'showlegend': False}


def _marks(positions: FloatArray, name: str) -> dict[str, Any]:
    x, y, z = (figures.numbers(each) for each in positions.T)
    marker = {'size': 8, 'color': '#b3261e', 'symbol': 'diamond'}
    mark = {'type': 'scatter3d', 'mode': 'markers', 'x': x, 'y': y, 'z': z, 'marker': marker}
    return mark | {'name': name, 'showlegend': True}


def _space() -> dict[str, Any]:
    axes: dict[str, Any] = {f'{axis}axis': {'title': {'text': f'{axis} [m]'}} for axis in 'xyz'}
    return {'scene': {'aspectmode': 'data', **axes}, 'margin': {'l': 0, 'r': 0, 't': 30, 'b': 0}}


def plan_report(
    chain: Chain,
    joints: FloatArray,
    words: str,
    origin: Origin,
    found: Plan | None = None,
    wanted_mm: float | None = None,
) -> Report:
    """Return the report of poses (K, n) to measure in this order; `words` say what they promise.

    `found` is None for the test poses of ISO 9283.
    """
    positions = in_base(chain, joints)[:, :3, 3]
    x, y, z = (figures.numbers(each) for each in positions.T)
    order = np.arange(1, len(joints) + 1)
    marker: dict[str, Any] = {'size': 5, 'color': order.tolist(), 'colorscale': 'Viridis'}
    marker |= {'colorbar': {'title': {'text': 'order of visit'}, 'thickness': 12}}
    path: dict[str, Any] = {'type': 'scatter3d', 'mode': 'lines+markers', 'x': x, 'y': y, 'z': z}
    path |= {'line': {'color': '#b0b7bf', 'width': 2}, 'marker': marker}
    path |= {'text': [f'pose {k}' for k in order.tolist()], 'hoverinfo': 'text'}
    sections = [
        Section(
            'visit',
            'Where the target will be',
            ("In the arm's base. Check for collisions before you drive there.",),
            {'data': [path], 'layout': _space()},
            height=560,
        )
    ]
    text: tuple[str, ...] = (f'{len(joints)} poses.',)
    if found is not None:
        curve = figures.predictions(found.accuracy, found.at_random, wanted_mm)
        about = 'From the noise of the measurement alone; what the model lacks comes on top.'
        sections.insert(0, Section('promise', 'What the poses promise', (about,), curve))
        if np.isfinite(found.accuracy[-1]):
            text += (f'Predicted RMS position error: {1e3 * found.accuracy[-1]:.4f} mm.',)
    sections.append(coverage(chain, joints, 'How far each joint will move'))
    show = [figures.unit_of(joint) for joint in chain.joints]
    more = f' The first {MOST_POSES} are shown.' if len(joints) > MOST_POSES else ''
    sections.append(
        Section(
            'poses',
            'The poses',
            (f'In the order of visit.{more}',),
            head=('', *(f'{j.name} [{s[1]}]' for j, s in zip(chain.joints, show, strict=True))),
            rows=tuple(
                (str(k + 1), *(f'{s[0] * q:.{s[2]}f}' for s, q in zip(show, row, strict=True)))
                for k, row in enumerate(joints[:MOST_POSES].tolist())
            ),
        )
    )
    lacking = () if found is None else found.lacking
    poor = bool(lacking) or (found is not None and not np.isfinite(found.accuracy[-1]))
    heading = 'Too little: these poses do not determine all parameters' if poor else 'Poses to go'
    return Report(
        kind='Plan of a measurement',
        robot=chain.name,
        verdict=Verdict('open' if poor else 'info', heading, text),
        remarks=tuple(line.strip() for line in words.splitlines() if not line.startswith(' ')),
        steps=(
            'Drive to each pose, wait until the arm stands still, and measure.',
            'Keep a few poses apart that are not fitted: they judge the result.',
            'Then identify: calib_ros identify.',
        )
        if found is not None
        else (
            'Go to P1 to P5 in turn, 30 times, and measure each time.',
            'Then judge: calib_ros verify.',
        ),
        identity=identity_of(chain, origin),
        sections=tuple(sections),
        inputs=origin.inputs,
        settings=origin.settings,
    )
