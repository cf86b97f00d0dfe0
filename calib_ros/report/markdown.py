# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A report in Markdown, which is kept with a calibration: its words and tables, no figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from calib_ros.escapes import in_markdown
from calib_ros.report.page import Report


def markdown(report: Report, samples: Mapping[str, Any]) -> str:
    """Return a report; `samples` is what became of the input."""
    verdict = report.verdict
    lines = [f'# {in_markdown(report.kind)}: {in_markdown(report.robot)}', '']
    lines += [f'**{in_markdown(verdict.heading)}**', '']
    lines += _paragraphs(verdict.gain, *verdict.text)
    for reason in report.advice:
        lines += _section(reason.heading, reason.meaning, f'What was found: {reason.refusal}')
        lines += _listed(reason.steps)
    for each in (report.accuracy, *report.sections):
        if each is None:
            continue
        text = each.text if each.rows or each.figure is None else ()
        if text or each.said:
            lines += _section(each.title, *text, *each.said)
        if each.rows:
            head, rest = '|' + '---|' * len(each.head), map(_row, each.rows)
            lines += [_row(each.head), head, *rest, '']
    told = [*report.identity, *((k, v) for k, v in samples.items() if v not in (0, {}, None))]
    told += [(each.name, f'SHA-256 {each.sha256}') for each in report.origin.inputs]
    for title, points in (
        ('What to do next', report.steps),
        ('Please note', report.remarks),
        ('Identity', [f'{name}: {value}' for name, value in told]),
    ):
        lines += [*_section(title), *_listed(points)] if points else []
    return '\n'.join(lines)


def _section(title: str, *text: str) -> list[str]:
    return [f'## {in_markdown(title)}', '', *_paragraphs(*text)]


def _paragraphs(*text: str) -> list[str]:
    return [line for each in text if each for line in (in_markdown(each), '')]


def _listed(points: Iterable[str]) -> list[str]:
    return [*(f'- {in_markdown(each)}' for each in points), '']


def _row(cells: Iterable[str]) -> str:
    return f'| {" | ".join(each if _is_number(each) else in_markdown(each) for each in cells)} |'


def _is_number(cell: str) -> bool:
    return cell.lstrip('+-').replace('.', '', 1).isdecimal()
