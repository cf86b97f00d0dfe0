# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses to measure, in words and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.apply.planning import Plan
from calib_ros.apply.workspace import in_base
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report import figures, sections
from calib_ros.report.content import Headline, Origin, Report, Section
from calib_ros.report.poses import unit_of
from calib_ros.shown import counted, rounded, sentence

VISIT = 'visit P1 to P5 in turn, 30 times, and measure each time'


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
            'Check for collisions, move to each pose, wait until the arm is still, and measure.',
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


def accuracy_in_words(plan: Plan) -> list[str]:
    """Return the lines of a table: the expected accuracy by number of poses."""
    count = len(plan.joints)
    first = int(np.isfinite(plan.accuracy).sum())
    shown = np.unique(np.linspace(count - first + 1, count, min(first, 12)).round().astype(int))
    head = 'predicted RMS position error [mm], from measurement noise alone'
    lines = [head, ' poses   planned   random']
    for number in shown.tolist():
        planned, random = (1e3 * each[number - 1] for each in (plan.accuracy, plan.at_random))
        by_chance = rounded(random) if np.isfinite(random) else '-'
        lines.append(f'{number:6} {rounded(planned):>9} {by_chance:>8}')
    if not first:
        why = f'too few poses to determine all parameters: at least {plan.least} are needed'
        lines.append(f'{count:6}         - {why}')
    return lines


def outlook(plan: Plan, candidates: int, wanted_mm: float | None, needed: int | None) -> list[str]:
    """Return the efficiency of a plan, how many poses are needed, and what it leaves open."""
    text = f'{len(plan.joints)} of {candidates} candidates'
    if plan.efficiency is not None:
        text += f', at least {100.0 * plan.efficiency:.0f} % as good as the best choice'
    lines = [f'{text}; moves take {plan.travel:.0f} s']
    if needed is not None:
        lines.append(f'{counted(needed, "pose")} will reach {wanted_mm:g} mm')
    if plan.lacking:
        lines.append(
            f'no choice of these candidates determines {", ".join(plan.lacking)}: move the joints '
            'further and in more combinations, or fix these parameters. The figures ignore these '
            'parameters, and hold only where the joints move as in the candidates'
        )
    return lines
