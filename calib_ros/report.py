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
from calib_ros.chain import Chain
from calib_ros.config import dump_chain
from calib_ros.identification import ErrorFigures, Identification, Parameter

WEAK = 0.01
"""A parameter with a larger standard deviation [m or rad] is named as weakly determined."""


def summary(result: Identification) -> str:
    """Return the one line that an operator reads."""
    figures = result.validation or result.fitted
    before, after = figures.before.figures, figures.after.figures
    text = f'{result.fitted.after.figures.count} pairs, RMS {before.rms_mm:.3f} -> '
    text += f'{after.rms_mm:.3f} mm (by {result.validated_by})'
    if result.unidentifiable:
        text += f'; not identifiable, kept nominal: {", ".join(result.unidentifiable)}'
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
    figures = result.validation or result.fitted
    return {
        'created': datetime.now(timezone.utc).isoformat(timespec='seconds'),
        'software': f'calib_ros {calib_ros.__version__}',
        'accepted': result.accepted,
        'pairs': result.fitted.after.figures.count,
        'validated_by': result.validated_by,
        'rms_mm_before': round(figures.before.figures.rms_mm, 6),
        'rms_mm_after': round(figures.after.figures.rms_mm, 6),
        'not_identifiable': list(result.unidentifiable),
    }


def calibration_yaml(result: Identification) -> str:
    """Return the corrected chain as the text of a chain file, which can be an input again."""
    head = '# Corrected chain by calib_ros; readable wherever a chain file is expected.\n'
    return head + dump_chain(result.chain, provenance(result))


def as_document(result: Identification, samples: dict[str, Any]) -> dict[str, Any]:
    """Return the result as one JSON document; `samples` is what became of the input."""

    def comparison(which: Any) -> dict[str, Any] | None:
        if which is None:
            return None
        return {'before': asdict(which.before.figures), 'after': asdict(which.after.figures)}

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
        'noise_in_sigma': result.noise,
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
    return 'm' if name.rpartition('.')[2] in ('a', 'd', 'x', 'y', 'z') else 'rad'


def markdown(result: Identification, samples: dict[str, Any], warnings: tuple[str, ...]) -> str:
    """Return the report that is kept with a calibration."""
    lines = [f'# Calibration of {result.chain.name}', '', f'**{summary(result)}**', '']
    lines += [f'- warning: {text}' for text in warnings]
    lines += [f'- {key}: {value}' for key, value in samples.items() if value not in (0, {}, None)]
    lines += [
        f'- converged: {"yes" if result.converged else "no"}, {result.iterations} iterations',
        f'- {result.rank} parameters fitted; residuals are {result.noise:.2f} times the sigma '
        'that was given, and the standard deviations below are scaled to them',
        '',
        '## Accuracy',
        '',
        f'"Before" is {BEFORE}. Validated by {result.validated_by}.',
        '',
        '| poses | | number | RMS [mm] | mean [mm] | max [mm] | RMS [mrad] |',
        '|---|---|---|---|---|---|---|',
    ]
    for label, which in (('fitted', result.fitted), ('not fitted', result.validation)):
        if which is not None:
            lines.append(_figures_row(label, 'before', which.before.figures))
            lines.append(_figures_row(label, 'after', which.after.figures))
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


def _figures_row(label: str, when: str, figures: ErrorFigures) -> str:
    turn = '' if figures.rms_mrad is None else f'{figures.rms_mrad:.3f}'
    return (
        f'| {label} | {when} | {figures.count} | {figures.rms_mm:.3f} | {figures.mean_mm:.3f} | '
        f'{figures.max_mm:.3f} | {turn} |'
    )


def _parameter_row(p: Parameter) -> str:
    std = '' if p.std is None else f'{1e3 * p.std:.4f}'
    offset = '' if p.std is None else f'{1e3 * p.offset:+.4f}'
    note = '' if p.status == 'fitted' else p.status
    return f'| {p.name} | {p.value:.9f} | {offset} | {std} | {note} |'


def against_truth(result: Identification, truth: Chain) -> str:
    """Return a table of the fitted joint parameters beside those of the true chain."""
    rows = ['  parameter                 true   identified        std   deviation']
    for p in result.parameters:
        if p.std is None or p.name.partition('.')[0] in ('base', 'tool'):
            continue
        true = truth.value(p.name) - (p.value - p.offset)
        rows.append(
            f'  {p.name:22} {1e3 * true:+8.3f}   {1e3 * p.offset:+10.3f}   {1e3 * p.std:8.4f}'
            f'   {(p.offset - true) / p.std:+6.1f} std'
        )
    return '\n'.join(rows)
