# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The pages of a workspace, of a plan, and of a calibration brought up to date."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.apply.placement import Placements
from calib_ros.apply.planning import Plan
from calib_ros.apply.workspace import Survey, in_base, regions, spread
from calib_ros.decision.changes import reason_in_words
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report import figures, sections
from calib_ros.report.content import Headline, Origin, Report, Section, section
from calib_ros.report.explorer import explorer
from calib_ros.report.poses import Poses, numbers, unit_of
from calib_ros.report.reports import NOT_YET, bring
from calib_ros.shown import rounded, sentence

BEYOND = 'To use the calibration beyond the measured poses, measure there too.'
STAYS = 'the arm is unchanged within the uncertainty: the correction that it has stays valid'
PREDICTED = '"Before": by the earlier calibration; "after": predicted from the other new poses.'
VISIT = 'visit P1 to P5 in turn, 30 times, and measure each time'
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
    where = ', '.join(f'{value:.3f}' for value in placed.positions[placed.best])
    return (
        f'Best at x, y, z = {where} m, {np.degrees(placed.turns[placed.best]):.0f}° about the '
        f'vertical: {rounded(errors[placed.best])} mm; in the centre of the region '
        f'{rounded(errors[placed.centre])} mm, at the worst place '
        f'{rounded(errors[reached].max())} mm. {int(reached.sum())} of {len(reached)} places can '
        'be reached.'
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


def plan_report(
    chain: Chain,
    joints: FloatArray,
    remarks: Sequence[str],
    origin: Origin,
    found: Plan | None = None,
    wanted_mm: float | None = None,
) -> Report:
    """Return the report of poses (K, n) to measure; `found` is None for those of ISO 9283."""
    shown = [
        _visit(chain, joints),
        sections.coverage(chain, joints, 'How far each joint will move'),
        _listed(chain, joints),
    ]
    what = 'Test poses' if found is None else 'Poses to measure'
    verdict = Headline('info', what, (f'{len(joints)} poses.',))
    steps: tuple[str, ...] = (
        'If you correct programs, not the controller, correct these poses: calib_ros compensate.',
        sentence(VISIT),
        'Then judge: calib_ros verify with --commanded and these poses as they are here.',
    )
    if found is not None:
        curve = figures.predictions(found.accuracy, found.at_random, wanted_mm)
        about = 'From measurement noise alone; model errors add to it.'
        shown.insert(0, Section('promise', 'Predicted accuracy', (about,), curve))
        known = bool(np.isfinite(found.accuracy[-1]))
        if known:
            predicted = f'Predicted RMS position error: {rounded(1e3 * found.accuracy[-1])} mm.'
            verdict = replace(verdict, text=(*verdict.text, predicted))
        steps = (
            'Check for collisions, drive to each pose, wait until the arm is still, and measure.',
            'Then identify: calib_ros identify.',
        )
        if found.lacking or not known:
            heading = 'Not enough: these poses do not determine all parameters'
            verdict = replace(verdict, state='open', heading=heading)
            more = 'Plan again with more poses (--poses), or candidates in which all joints move.'
            steps = (more, *(steps if known else ()))
    return Report(
        kind='Measurement plan',
        robot=chain.name,
        verdict=verdict,
        remarks=tuple(map(sentence, remarks)),
        steps=steps,
        identity=sections.identity_of(chain, origin),
        sections=tuple(shown),
        origin=origin,
    )


def _visit(chain: Chain, joints: FloatArray) -> Section:
    order = list(range(1, len(joints) + 1))
    scale = figures.scale_of('order of visit')
    bar = scale['colorbar']
    bar |= {'tickformat': 'd', 'nticks': min(len(order), 6)}
    bar |= {'orientation': 'h', 'y': 0.0, 'yanchor': 'top'}  # narrow screens keep their width
    bar['title']['side'] = 'top'
    path = figures.in_space(
        in_base(chain, joints)[:, :3, 3],
        'order of visit',
        mode='lines+markers',
        line={'color': '#b0b7bf', 'width': 2},
        marker={'size': 5, 'color': order, **scale},
        text=[f'pose {k}' for k in order],
        hoverinfo='text',
    )
    about = 'In the base frame.'
    return Section('visit', 'Where the target will be', (about,), figures.space(path), height=560)


def _listed(chain: Chain, joints: FloatArray) -> Section:
    show = [unit_of(joint) for joint in chain.joints]
    more = ' The first 200 are shown.' if len(joints) > 200 else ''
    return Section(
        'poses',
        'The poses',
        (f'In the order of visit.{more}',),
        head=('', *(f'{j.name} [{s[1]}]' for j, s in zip(chain.joints, show, strict=True))),
        rows=tuple(
            (str(k + 1), *(f'{s[0] * q:.{s[2]}f}' for s, q in zip(show, row, strict=True)))
            for k, row in enumerate(joints[:200].tolist())
        ),
    )


def update_standing(found: Recalibration) -> tuple[Headline, tuple[str, ...], str]:
    """Return the verdict on an update and why, what has changed, and what to do."""
    why, step = found.refusal()
    if found.accepted:
        names = (name for reasons in found.changed for each in reasons for name in each.names)
        same = all(map(found.calibration.chain.owns_frame, names))
        step = STAYS if same else f'{NOT_YET}: {bring(found.calibration)}'
    heading = 'Accepted: the calibration is brought up to date'
    if not found.accepted:
        heading = 'Not accepted: the earlier calibration stays as it was'
    perhaps, told = 'perhaps ' * bool(why), found.accepted or not (found.determined or found.odd)
    changed = tuple(perhaps + reason_in_words(each) for each in found.changed if told)
    text = (why,) if why else ()
    return Headline('good' if found.accepted else 'bad', heading, text), changed, step


def known_to(found: Recalibration, arrow: str = '→') -> str:
    """Return how well the arm was and is known."""
    known = f'{1e3 * found.known_before:.3f} {arrow} {1e3 * found.known_after:.3f} mm'
    return f'{known} over the joint range (standard deviation)'


def update_report(
    found: Recalibration, poses: Poses, origin: Origin, warnings: Sequence[str] = ()
) -> Report:
    """Return the report of an earlier calibration and new poses."""
    (state, changed, step), arm = update_standing(found), found.calibration.chain
    known, corrected = ('Arm known to', known_to(found)), table_hash(arm) * found.accepted
    text = tuple(map(sentence, (*state.text, *changed)))
    return Report(
        kind='Update of a calibration with a few poses',
        robot=arm.name,
        verdict=replace(state, text=text, gain=sections.gain(found.comparison)),
        accuracy=sections.accuracy_section(
            'Accuracy before and after', found.comparison, poses.things, PREDICTED
        ),
        picture=sections.distribution(poses),
        steps=(sentence(step),),
        remarks=tuple(map(sentence, warnings)),
        identity=sections.identity_of(arm, origin, poses, [known], corrected),
        explorer=explorer(arm, poses),
        sections=(sections.coverage(arm, poses.joints, 'How far each joint was moved'),),
        origin=origin,
    )
