# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A result in words and tables: a line for the operator, Markdown, JSON, the corrected chain."""

from __future__ import annotations

import platform
from dataclasses import asdict
from datetime import datetime, timezone
from typing import Any

import numpy as np

import calib_ros
from calib_ros import effects
from calib_ros.chain import DH_KINDS, FRAME_KINDS, Chain
from calib_ros.config import dump_chain
from calib_ros.identification import Identification
from calib_ros.planning import Plan
from calib_ros.se3 import FloatArray
from calib_ros.validation import Comparison, ErrorFigures, Parameter, is_length
from calib_ros.workspace import Placements, Region, Spread, Survey, regions

WEAK = 0.01
"""A parameter with a larger standard deviation [m or rad] is named as weakly determined."""


def summary(result: Identification) -> str:
    """Return the one line that an operator reads."""
    before, after = (result.validation or result.fitted).figures
    text = f'{len(result.fitted.judged)} pairs, RMS {before.rms_mm:.3f} -> '
    text += f'{after.rms_mm:.3f} mm (by {result.validated_by})'
    if result.unidentifiable:
        text += f'; not identifiable, kept nominal: {", ".join(result.unidentifiable)}'
    if result.outliers:
        text += f'; {len(result.outliers)} outliers named in the report carry no weight'
    if result.chain.effects:
        groups = dict.fromkeys(effects.group_of(name) for name, _ in result.chain.effects)
        text += f'; with {len(result.chain.effects)} effects ({", ".join(groups)})'
    if result.priors:
        text += f'; priors on {len(result.priors)} parameters'
    sigma = sigma_over_range(result)['max']
    if sigma > before.rms_mm:
        text += f'; trust it only near the measured poses, elsewhere sigma is up to {sigma:.1f} mm'
    weak = weakly_determined(result)
    if weak:
        text += f'; weakly determined: {", ".join(weak)}'
    if result.accepted:
        return f'accepted: {text}'
    return f'NOT accepted, nothing is published: {"; ".join(result.refusals)}. {text}'


def weakly_determined(result: Identification) -> tuple[str, ...]:
    """Return the fitted parameters that are hardly known: judge them by predictions only."""
    return tuple(p.name for p in result.parameters if p.std is not None and p.std > WEAK)


def provenance(result: Identification) -> dict[str, Any]:
    """Return where the numbers of a corrected chain come from, as plain values."""
    before, after = (result.validation or result.fitted).figures
    return {
        'created': datetime.now(timezone.utc).isoformat(timespec='seconds'),
        'software': f'calib_ros {calib_ros.__version__}',
        'accepted': result.accepted,
        'world_frame': result.world_frame,
        'pairs': len(result.fitted.judged),
        'outliers': len(result.outliers),
        'validated_by': result.validated_by,
        'rms_mm_before': round(before.rms_mm, 6),
        'rms_mm_after': round(after.rms_mm, 6),
        'not_identifiable': list(result.unidentifiable),
    }


def calibration_yaml(result: Identification) -> str:
    """Return the corrected chain as the text of a chain file, which can be an input again."""
    head = '# Corrected chain by calib_ros; readable wherever a chain file is expected.\n'
    return head + dump_chain(result.chain, provenance(result))


def as_document(result: Identification, samples: dict[str, Any]) -> dict[str, Any]:
    """Return the result as one JSON document; `samples` is what became of the input."""

    def comparison(which: Comparison | None) -> dict[str, Any] | None:
        if which is None:
            return None
        before, after = which.figures
        with_outliers = which.figures_of_all[1]
        return {
            'before': asdict(before),
            'after': asdict(after),
            'outliers': which.outliers,
            'after_with_outliers': asdict(with_outliers),
        }

    validation = comparison(result.validation)
    return {
        'converged': result.converged,
        'accepted': result.accepted,
        'refusals': list(result.refusals),
        'iterations': result.iterations,
        'rank': result.rank,
        'unidentifiable': list(result.unidentifiable),
        'not_excited': list(result.not_excited),
        'weakly_determined': list(weakly_determined(result)),
        'parameters': {
            p.name: {
                'value': p.value,
                'offset': p.offset,
                'std': p.std,
                'unit': unit(p.name),
                'status': p.status,
            }
            for p in result.parameters
        },
        'fitted': comparison(result.fitted),
        'validation': None if validation is None else {'by': result.validated_by, **validation},
        'before_is': BEFORE,
        'noise_in_sigma': asdict(result.noise),
        'outliers': [asdict(outlier) for outlier in result.outliers],
        'gauges': result.gauges,
        'covariance': {'names': list(result.names), 'matrix': result.covariance.tolist()},
        'correlated': [list(pair) for pair in result.correlated()],
        'observability': asdict(result.observability),
        'predicted_sigma_mm': sigma_over_range(result),
        'priors': result.priors,
        'effects': dict(result.chain.effects),
        'verdicts': [asdict(verdict) for verdict in result.verdicts],
        'samples': samples,
        'robot': result.chain.name,
        'versions': {
            'calib_ros': calib_ros.__version__,
            'python': platform.python_version(),
            'numpy': np.__version__,
        },
    }


BEFORE = 'the nominal chain with its base and tool frames fitted to the same pairs'


def unit(name: str) -> str:
    """Return the unit of a parameter."""
    kind = name.partition('.')[2]
    if kind in DH_KINDS or kind in FRAME_KINDS:
        return 'm' if is_length(name) else 'rad'
    return effects.unit(name)


def markdown(result: Identification, samples: dict[str, Any], warnings: tuple[str, ...]) -> str:
    """Return the report that is kept with a calibration."""
    lines = [f'# Calibration of {result.chain.name}', '', f'**{summary(result)}**', '']
    lines += [f'- warning: {text}' for text in warnings]
    lines += [f'- {key}: {value}' for key, value in samples.items() if value not in (0, {}, None)]
    lines += [
        f'- converged: {"yes" if result.converged else "no"}, {result.iterations} iterations',
        f'- {result.rank} parameters fitted; {noise_in_words(result)}',
        *(f'- {text}' for text in priors_in_words(result)),
        '',
        '## Accuracy',
        '',
        f'"Before" is {BEFORE}. Validated by {result.validated_by}.',
        '',
        '| poses | | number | RMS [mm] | mean | max | mean + 3 sigma | RMS [mrad] |',
        '|---|---|---|---|---|---|---|---|',
    ]
    for label, which in (('fitted', result.fitted), ('not fitted', result.validation)):
        if which is not None:
            lines += map(_figures_row, (label, label), ('before', 'after'), which.figures)
            if which.outliers:
                lines.append(_figures_row(label, 'after, with outliers', which.figures_of_all[1]))
    if result.outliers:
        lines += ['', '## Outliers', '', 'They carry no or little weight. Size: in usual errors.']
        lines += ['', '| set | sample | stamp [ns] | size |', '|---|---|---|---|']
        lines += [
            f'| {o.set} | {o.sample} | {o.stamp_ns} | {o.size:.1f} |' for o in result.outliers
        ]
    if result.verdicts:
        lines += [
            '',
            '## Non-geometric effects',
            '',
            'RMS on configurations left out.',
        ]
        lines += ['', '| | before [mm] | with it [mm] | pays for itself |', '|---|---|---|---|']
        lines += [
            f'| {v.what} | {v.rms_mm_before:.4f} | {v.rms_mm_after:.4f} | '
            f'{"yes" if v.pays else "no"} |'
            for v in result.verdicts
        ]
    lines += ['', '## What the poses determine', '']
    lines += [f'- {text}' for text in identifiability_in_words(result)]
    lines += ['', '## Parameters', '']
    lines += ['Offsets and standard deviations in mm and mrad.', '']
    lines += ['| parameter | value [m, rad] | offset | std | |', '|---|---|---|---|---|']
    lines += [_parameter_row(parameter) for parameter in result.parameters]
    lines += [
        '',
        'gauge: redundant by the structure of the chain, kept nominal. not excited: the poses do '
        'not determine it, kept nominal. fixed: held on request.',
        '',
    ]
    return '\n'.join(lines)


def priors_in_words(result: Identification) -> list[str]:
    """Return the priors, those of effects by group."""
    known = dict(result.chain.effects)
    lines = [
        f'prior on {name}: {sigma:g} {unit(name)}'
        for name, sigma in result.priors.items()
        if name not in known
    ]
    groups: dict[str, list[str]] = {}
    for name in known:
        groups.setdefault(effects.group_of(name), []).append(name)
    for group, names in groups.items():
        sigma, of = result.priors[names[0]], unit(names[0])
        lines.append(f'prior on {len(names)} parameters of {group}: {sigma:g} {of}')
    return lines


def sigma_over_range(result: Identification) -> dict[str, float]:
    """Return how well positions are predicted over the whole joint range [mm]."""
    sigma = 1e3 * result.predicted_sigma()
    return {'median': float(np.median(sigma)), 'max': float(sigma.max())}


def noise_in_words(result: Identification) -> str:
    """Return how large the residuals are against the sigmas given."""
    noise = result.noise
    text = f'residuals are {noise.position:.2f} times the sigma of position'
    if noise.orientation is not None:
        text += f' and {noise.orientation:.2f} times that of orientation'
    if noise.consistent:
        return f'{text}, which a chi-squared test lets pass'
    return f'{text}; the sigmas given are wrong, standard deviations follow the residuals'


def identifiability_in_words(result: Identification) -> list[str]:
    """Return which parameters trade against which, which are weak, and the indices."""
    lines = []
    for name, partners in result.gauges.items():
        if partners:
            lines.append(f'{name} against {", ".join(partners)}: only their combination shows')
        else:
            lines.append(f'{name}: no measured pose depends on it')
    weak = weakly_determined(result)
    if weak:
        lines.append(f'weakly determined (std above {1e3 * WEAK:g} mm or mrad): {", ".join(weak)}')
    for first, second, value in result.correlated():
        lines.append(f'{first} and {second} are correlated by {value:+.3f}')
    sigma = sigma_over_range(result)
    lines.append(
        f'one sigma of predicted positions over the joint range: {sigma["median"]:.3f} mm '
        f'(median), {sigma["max"]:.3f} mm at most'
    )
    o = result.observability
    lines.append(
        f'observability O1 {o.o1:.4g}, O2 {o.o2:.4g}, O3 {o.o3:.4g}, O4 {o.o4:.4g}, O5 {o.o5:.4g}'
    )
    return lines


def _figures_row(label: str, when: str, figures: ErrorFigures) -> str:
    turn = '' if figures.rms_mrad is None else f'{figures.rms_mrad:.3f}'
    return (
        f'| {label} | {when} | {figures.count} | {figures.rms_mm:.3f} | {figures.mean_mm:.3f} | '
        f'{figures.max_mm:.3f} | {figures.mean_plus_3_sigma_mm:.3f} | {turn} |'
    )


def _parameter_row(p: Parameter) -> str:
    std = '' if p.std is None else f'{1e3 * p.std:.4f}'
    offset = '' if p.std is None else f'{1e3 * p.offset:+.4f}'
    note = '' if p.status == 'fitted' else p.status
    return f'| {p.name} | {p.value:.9f} | {offset} | {std} | {note} |'


def plan_in_words(plan: Plan, candidates: int, wanted_mm: float | None, needed: int | None) -> str:
    """Return what a plan promises: a table over the number of poses, and how good it is."""
    count = len(plan.joints)
    first = int(np.isfinite(plan.accuracy).sum())
    shown = np.unique(np.linspace(count - first + 1, count, min(first, 12)).round().astype(int))
    lines = ['predicted RMS position error [mm]', ' poses   planned   random']
    for number in shown.tolist():
        planned, random = (1e3 * each[number - 1] for each in (plan.accuracy, plan.at_random))
        by_chance = f'{random:8.4f}' if np.isfinite(random) else '       -'
        lines.append(f'{number:6} {planned:9.4f} {by_chance}')
    if not first:
        lines.append(f'{count:6}         - too few poses to determine all parameters')
    text = f'{count} of {candidates} candidates'
    if plan.efficiency is not None:
        text += f', at least {100.0 * plan.efficiency:.0f} % of what the best choice would bring'
    lines.append(f'{text}; moves take {plan.travel:.0f} s')
    if needed is not None:
        lines.append(f'{wanted_mm:g} mm: {needed} poses')
    if plan.lacking:
        lines.append(
            f'no choice of these candidates determines {", ".join(plan.lacking)}: move the joints '
            'further and in more combinations, or fix these parameters'
        )
    lines.append('from the noise of the measurement alone; what the model lacks comes on top')
    return '\n'.join(lines)


def workspace_in_words(survey: Survey) -> str:
    """Return the errors over the workspace as Markdown: figures, and where they are largest."""
    parts = [('removed by the calibration', survey.removed)]
    if np.isnan(survey.remaining).any():
        rest = 'What remains is not known: the covariance is in the folder of the result.'
    else:
        parts += [
            ('sigma of what remains', survey.sigma),
            ('expected to remain', survey.remaining),
        ]
        rest = 'Expected to remain: sigma and the RMS error on poses that were not fitted.'
    lines = [
        f'Position errors [mm] at {len(survey.joints)} random poses of the joint range.',
        '',
        '| | RMS | mean | median | 95 % | max |',
        '|---|---|---|---|---|---|',
    ]
    for label, errors in parts:
        s = Spread.of(1e3 * errors)
        figures = (s.rms, s.mean, s.median, s.percentile_95, s.max)
        lines.append(f'| {label} | ' + ' | '.join(f'{value:.4f}' for value in figures) + ' |')
    lines += ['', rest]
    for label, errors in parts[:2]:
        found = regions(survey.positions, errors)
        lines += ['', f'Largest RMS, {label}:', '']
        lines += [f'- {region_in_words(region)}' for region in found[:3]]
        lines += ['', f'Least: {region_in_words(found[-1])}']
    return '\n'.join(lines) + '\n'


def region_in_words(region: Region) -> str:
    """Return where a region is and its error."""
    (near, far), (low, high) = region.radius, region.height
    return (
        f'{region.words}: {1e3 * region.rms:.4f} mm (radius {near:.2f} to {far:.2f} m, '
        f'height {low:.2f} to {high:.2f} m, {region.poses} poses)'
    )


def placements_in_words(placements: Placements, aim: str, model: str) -> str:
    """Return where to place a task, against the centre of all places."""
    reached = placements.errors[~np.isnan(placements.errors)]
    best, centre = (
        f'{1e3 * placements.errors[k]:.4f} mm at {_place(placements.positions[k])} m in the base '
        f'frame, turned by {np.degrees(placements.turns[k]):.0f} degrees'
        for k in (placements.best, placements.centre)
    )
    return (
        f'expected {aim} error of the task, {model} model; the arm reaches it at '
        f'{len(reached)} of {len(placements.errors)} placements\n'
        f'best:   {best}\ncentre: {centre}\nworst:  {1e3 * reached.max():.4f} mm\n'
    )


def _place(position: FloatArray) -> str:
    return ' '.join(f'{value:.3f}' for value in position)


def against_truth(result: Identification, truth: Chain) -> str:
    """Return a table of the fitted joint parameters beside those of the true chain."""
    width = max(len(name) for name in result.names)
    rows = [f'  {"parameter":{width}}     true   identified        std   deviation']
    for p in result.parameters:
        if p.std is None or p.name.partition('.')[0] in ('base', 'tool'):
            continue
        true = truth.value(p.name) - (p.value - p.offset)
        rows.append(
            f'  {p.name:{width}} {1e3 * true:+8.3f}   {1e3 * p.offset:+10.3f}   {1e3 * p.std:8.4f}'
            f'   {(p.offset - true) / p.std:+6.1f} std'
        )
    return '\n'.join(rows)
