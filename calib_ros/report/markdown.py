# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The report in Markdown, which is kept with a calibration."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from calib_ros.escapes import in_markdown
from calib_ros.identification.identification import Identification
from calib_ros.identification.validation import ErrorFigures, ParameterRow
from calib_ros.kinematics import effects
from calib_ros.kinematics.parameter import Parameter
from calib_ros.report.words import (
    BEFORE,
    chance_in_words,
    identifiability_in_words,
    noise_in_words,
    summary,
)


def markdown(result: Identification, samples: dict[str, Any], warnings: tuple[str, ...]) -> str:
    """Return the report; `samples` is what became of the input."""
    return '\n'.join(
        [
            f'# Calibration of {in_markdown(result.chain.name)}',
            '',
            f'**{in_markdown(summary(result))}**',
            '',
            *_listed(f'warning: {each}' for each in (*warnings, *result.remarks)),
            *_listed(f'{k}: {v}' for k, v in samples.items() if v not in (0, {}, None)),
            *_listed(_about(result)),
            *_accuracy(result),
            *_outliers(result),
            *_effects(result),
            *_section('What the poses determine'),
            *_listed(identifiability_in_words(result)),
            *_parameters(result),
            '',
        ]
    )


def _section(title: str, *text: str) -> list[str]:
    return ['', f'## {title}', '', *(line for each in text for line in (each, ''))]


def _listed(points: Iterable[str]) -> list[str]:
    return [f'- {in_markdown(each)}' for each in points]


def _table(*rows: Iterable[object]) -> list[str]:
    """Return the lines of a table, whose first row is its head."""
    head, *rest = (f'| {" | ".join(map(str, row))} |' for row in rows)
    head = head.replace('|  |', '| |')
    return [head, '|' + '---|' * (head.count('|') - 1), *rest]


def _about(result: Identification) -> Iterator[str]:
    yield f'converged: {"yes" if result.converged else "no"}, {result.iterations} iterations'
    yield f'{result.rank} parameters fitted; {noise_in_words(result)}'
    yield from chance_in_words(result)
    yield from priors_in_words(result)


def _accuracy(result: Identification) -> list[str]:
    heads = ('RMS [mm]', 'mean', 'max', 'mean + 3 sigma', 'RMS [mrad]', 'RMS [px]')
    rows: list[tuple[str, ...]] = [('poses', '', 'number', *heads)]
    for label, which in (('fitted', result.fitted), ('not fitted', result.validation)):
        if which is not None:
            rows += map(_figures, (label, label), ('before', 'after'), which.figures)
            if which.outliers:
                rows.append(_figures(label, 'after, with outliers', which.figures_of_all[1]))
    text = f'"Before" is {BEFORE}. Validated by {result.validated_by}.'
    return [*_section('Accuracy', text), *_table(*rows)]


def _figures(label: str, when: str, found: ErrorFigures) -> tuple[str, ...]:
    lengths = (found.rms_mm, found.mean_mm, found.max_mm, found.mean_plus_3_sigma_mm)
    numbers = (*lengths, found.rms_mrad, found.rms_px)
    return (label, when, str(found.count), *('' if x is None else f'{x:.3f}' for x in numbers))


def _outliers(result: Identification) -> list[str]:
    if not result.outliers:
        return []
    rows = [(o.set, o.sample, o.stamp_ns, f'{o.size:.1f}') for o in result.outliers]
    return [
        *_section('Outliers', 'They carry no or little weight. Size: in usual errors.'),
        *_table(('set', 'sample', 'stamp [ns]', 'size'), *rows),
    ]


def _effects(result: Identification) -> list[str]:
    if not result.verdicts:
        return []
    rows = [
        (
            in_markdown(v.what),
            f'{v.rms_mm_before:.4f}',
            f'{v.rms_mm_after:.4f}',
            'yes' if v.pays else 'no',
        )
        for v in result.verdicts
    ]
    return [
        *_section('Non-geometric effects', 'RMS on configurations left out.'),
        *_table(('', 'before [mm]', 'with it [mm]', 'pays for itself'), *rows),
    ]


def _parameters(result: Identification) -> list[str]:
    text = 'Offsets, standard deviations and 95 % intervals (+-) in mm and mrad.'
    if any(p.name.of_lens for p in result.parameters):
        text += '\nThose of lenses in px, and of their distortion as it is.'
    head = ('parameter', 'value [m, rad]', 'offset', 'std', '95 %', '')
    return [
        *_section('Parameters', text),
        *_table(head, *map(_parameter, result.parameters)),
        '',
        'gauge: redundant by the structure of the chain, kept nominal. not excited: the poses do '
        'not determine it, kept nominal. fixed: held on request.',
    ]


def _parameter(p: ParameterRow) -> tuple[str, ...]:
    width = p.half_width()
    scale = 1.0 if p.name.of_lens else 1e3
    found = ('', '', '')
    if p.std is not None and width is not None:
        found = (f'{scale * p.offset:+.4f}', f'{scale * p.std:.4f}', f'{scale * width:.4f}')
    note = '' if p.status == 'fitted' else p.status
    return (in_markdown(p.name), f'{p.value:.9f}', *found, note)


def priors_in_words(result: Identification) -> list[str]:
    """Return the priors, those of effects by group."""
    known = dict(result.chain.effects)
    why = dict.fromkeys(result.weak, ', because the poses hardly determine it')
    lines = [
        f'prior on {name}: {sigma:.3g} {Parameter(name).unit}{why.get(name, "")}'
        for name, sigma in result.priors.items()
        if name not in known
    ]
    groups: dict[str, list[str]] = {}
    for name in known:
        groups.setdefault(effects.group_of(name), []).append(name)
    for group, names in groups.items():
        sigma, of = result.priors[names[0]], Parameter(names[0]).unit
        lines.append(f'prior on {len(names)} parameters of {group}: {sigma:g} {of}')
    return lines
