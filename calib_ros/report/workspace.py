# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of errors over the workspace, and of the best place for a task."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib_ros.apply.placement import Placements
from calib_ros.apply.workspace import Survey, regions, spread
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.report import figures, sections
from calib_ros.report.content import Headline, Origin, Report, Section, section
from calib_ros.report.poses import numbers
from calib_ros.shown import rounded

BEYOND = 'To use the calibration beyond the measured poses, measure there too.'
PLACE = 'To find the best place for a task: calib_ros workspace with --task FILE.'


def workspace_report(
    arm: Calibration, found: Survey, origin: Origin, placed: Placements | None = None
) -> Report:
    """Return the report of a survey, and of the placements of a task, if any."""
    spreads = [(label, spread(1e3 * errors)) for label, errors in found.parts.items()]
    first, last = spreads[0][1], spreads[-1][1]
    text = [f'The calibration removes {_sizes(first)} over random poses of the joint range.']
    rest = 'The remaining error is unknown: the file has no uncertainties.'
    if len(spreads) > 1:
        text.append(f'Expected to remain: {_sizes(last)}.')
        rest = 'Expected to remain: its uncertainty and the RMS error on poses not fitted, '
        rest += 'noise of the measuring device included.'
    if arm.region is not None:
        text.append(f'The calibration is {arm.region.in_words()}.')
    about = 'Radius: distance from the axis of the base. Height: above its origin.'
    errors = Section('map', 'Errors by radius and height', (about,), figures.error_map(found))
    return Report(
        kind='Errors over the workspace',
        robot=arm.chain.name,
        verdict=Headline('info', 'What the calibration changes, and where', tuple(text)),
        accuracy=Section(
            'accuracy',
            'Position errors [mm]',
            (f'At {len(found.joints):,} random poses of the joint range.', rest),
            head=('', *first),
            rows=tuple((label, *map(rounded, each.values())) for label, each in spreads),
        ),
        steps=(
            *((BEYOND,) if arm.region is not None and not arm.region.whole else ()),
            *((PLACE,) if placed is None else ()),
        ),
        identity=sections.identity_of(arm.chain, origin, corrected=table_hash(arm.chain)),
        sections=(*(_placed(each) for each in (placed,) if each), errors, *_worst(found)),
        origin=origin,
    )


def _sizes(errors: dict[str, float]) -> str:
    return f'{rounded(errors["RMS"])} mm RMS (at most {rounded(errors["max"])} mm)'


def _worst(found: Survey) -> Iterator[Section]:
    titles = ('Where the calibration removes most', 'Where it is most uncertain')
    for title, (label, errors) in zip(titles, found.parts.items(), strict=False):
        sectors = regions(found.positions, errors)
        shown = sectors if len(sectors) <= 6 else (*sectors[:6], sectors[-1])
        rows = []
        for each in shown:
            spans = (f'{low:.2f} to {high:.2f}' for low, high in (each.radius, each.height))
            rows.append((each.words, str(each.poses), rounded(1e3 * each.rms), *spans))
        yield Section(
            f'regions-{label.split()[0]}',
            title,
            ('The 6 regions with the most, and the one with the least.',),
            head=('region', 'poses', 'RMS [mm]', 'radius [m]', 'height [m]'),
            rows=tuple(rows),
        )


def placed_in_words(placed: Placements) -> str:
    """Return where to put a task, compared with the centre of all places and the worst."""
    errors = 1e3 * placed.errors
    reached = ~np.isnan(errors)
    moves = np.abs(np.diff(placed.joints[placed.best], axis=0))
    moved = (
        f' From pose to pose no joint moves by more than {moves.max(initial=0.0):.2f} rad or m.'
    )
    where = ', '.join(f'{value:.3f}' for value in placed.positions[placed.best])
    return (
        f'Best at x, y, z = {where} m, {np.degrees(placed.turns[placed.best]):.0f}° about the '
        f'vertical: {rounded(errors[placed.best])} mm; in the centre of the region '
        f'{rounded(errors[placed.centre])} mm, at the worst place '
        f'{rounded(errors[reached].max())} mm. {int(reached.sum())} of {len(reached)} places can '
        'be reached.' + moved * bool(moves.size)
    )


def _placed(placed: Placements) -> Section:
    reached = ~np.isnan(placed.errors)
    values = numbers(1e3 * placed.errors[reached])
    colours = {'size': 4, 'color': values, **figures.scale_of('expected error [mm]')}
    cloud = figures.in_space(
        placed.positions[reached], 'expected error [mm]', marker=colours, showlegend=False
    )
    mark = {'size': 8, 'color': '#b3261e', 'symbol': 'diamond'}
    best = placed.positions[placed.best][np.newaxis]
    place = figures.in_space(best, 'best place', marker=mark, showlegend=True)
    return section(
        'placements',
        'Where to put the task',
        figure=figures.space(cloud, place),
        height=560,
        said=(placed_in_words(placed),),
    )
