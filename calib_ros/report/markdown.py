# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A report as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from calib_ros.report.content import Report
from calib_ros.texts import in_markdown

COUNTED = {
    'samples': 'poses fitted',
    'held_out': 'poses held out',
    'poses': 'measurements',
    'configurations': 'different poses',
    'joint_states': 'joint states',
    'recorded': 'messages recorded',
    'read': 'messages read',
    'unused': 'not used',
}
"""Words for counts of the input, where poses are what was fitted."""


def markdown(report: Report, samples: Mapping[str, Any]) -> str:
    """Return the text and tables of a report; `samples` is the account of the input."""
    verdict = report.verdict
    lines = [f'# {in_markdown(report.kind)}: {in_markdown(report.title)}', '']
    lines += [f'**{in_markdown(verdict.heading)}**', '']
    lines += _paragraphs(verdict.gain, *verdict.text)
    for reason in report.advice:
        lines += _section(reason.heading, reason.meaning, reason.found)
        lines += ['**What to do:**', '', *_numbered(reason.steps)] if reason.steps else []
    if report.advice:
        lines += _paragraphs(*report.steps)
    elif report.steps:
        lines += [*_section('What to do next'), *_numbered(report.steps)]
    if report.remarks:
        lines += [*_section('Please note'), *_listed(report.remarks)]
    for each in (report.accuracy, report.picture, *report.sections):
        if each is None:
            continue
        text = each.text if each.rows or each.figure is None else ()
        if text or each.said:
            lines += _section(each.title, *text, *each.said)
        if each.rows:
            head, rest = '|' + '---|' * len(each.head), map(_row, each.rows)
            lines += [_row(each.head), head, *rest, '']
    pairs = [*report.identity, *((COUNTED.get(k, k), v) for k, v in samples.items() if v)]
    pairs += [(each.name, f'SHA-256 {each.sha256}') for each in report.origin.inputs]
    identity = [f'{name}: {value}' for name, value in pairs]
    return '\n'.join([*lines, *_section('Identity'), *_listed(identity)])


def _section(title: str, *text: str) -> list[str]:
    return [f'## {in_markdown(title)}', '', *_paragraphs(*text)]


def _paragraphs(*text: str) -> list[str]:
    return [line for each in text if each for line in (in_markdown(each), '')]


def _listed(points: Iterable[str]) -> list[str]:
    return [*(f'- {in_markdown(each)}' for each in points), '']


def _numbered(steps: Iterable[str]) -> list[str]:
    return [*(f'{k}. {in_markdown(each)}' for k, each in enumerate(steps, 1)), '']


def _row(cells: Iterable[str]) -> str:
    return f'| {" | ".join(each if _is_number(each) else in_markdown(each) for each in cells)} |'


def _is_number(cell: str) -> bool:
    return cell.lstrip('+-').replace('.', '', 1).isdecimal()
