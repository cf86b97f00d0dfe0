# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A report as HTML, PDF and Markdown: single files that need no network.

Only this module imports jinja2, plotly and weasyprint; without them `render` and `on_paper` return
None. All foreign text is escaped.
"""

from __future__ import annotations

import html
import logging
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from importlib import resources
from typing import Any, Literal, TypeAlias

import calib_ros
from calib_ros.files.rows import Input
from calib_ros.report.advice import Advice
from calib_ros.shown import clipped
from calib_ros.texts import in_markdown, one_line

State: TypeAlias = Literal['good', 'bad', 'open', 'info']
MARKS: dict[State, str] = {'good': '✔', 'bad': '✘', 'open': '?', 'info': 'i'}
VALUE = r"""(?:auto|none|[cm]m|deg|rad|[xyzw]{3,4})\b|"[^"]*"|'[^']*'|[^\s()]*[\dA-Z*=_][^\s()]*"""
TYPED = re.compile(
    rf'((?:(?<![\w-])--[a-z][\w-]*|calib_ros [a-z\d]+)(?: (?:{VALUE})(?<![.,;:]))?)'
)
"""An option or a command, with a value that is no plain word."""
BEFORE_UNIT = re.compile(r'(?<=\d) (?=(?:%|mm|mrad)(?!\w))')
"""Where no line is broken."""
NEEDS_JINJA = (
    'report.html is not written: it needs jinja2 and plotly (pip install "calib_ros[report]", '
    'or apt install python3-jinja2 python3-plotly)'
)
MISSING_PDF = (
    'report.pdf is not written: it needs weasyprint and jinja2 (pip install "calib_ros[pdf]", or '
    'apt install weasyprint)'
)


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


@dataclass(frozen=True)
class Headline:
    """What a reader sees first: state, words, and the `gain` from before to after."""

    state: State
    heading: str
    text: tuple[str, ...] = ()
    gain: str = ''


@dataclass(frozen=True)
class Section:
    """Text, a plotly figure, a table, or several; `said` also holds without the figure."""

    name: str
    title: str
    text: tuple[str, ...] = ()
    figure: Mapping[str, Any] | None = None
    head: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    height: int = 420
    said: tuple[str, ...] = ()


def section(name: str, title: str, *text: str, **more: Any) -> Section:
    """Return a section with the paragraphs that are not empty."""
    return Section(name, title, tuple(filter(None, text)), **more)


@dataclass(frozen=True)
class Origin:
    """Origin of a result, known only to its caller; empty if not given."""

    inputs: tuple[Input, ...] = ()
    operator: str = ''
    serial: str = ''
    device: str = ''
    settings: str = ''  # configuration to repeat it
    command: str = ''  # command to repeat it, if any
    conditions: str = ''  # temperature, load and the like

    def document(self) -> dict[str, Any]:
        """Return it as plain values, without the settings, which have their own file."""
        return {name: value for name, value in asdict(self).items() if name != 'settings'}


@dataclass(frozen=True)
class Report:
    """Content of the page, in order."""

    kind: str
    robot: str
    verdict: Headline
    advice: tuple[Advice, ...] = ()
    accuracy: Section | None = None
    picture: Section | None = None  # beside the accuracy: a figure or a table
    steps: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    identity: tuple[tuple[str, str], ...] = ()
    explorer: Mapping[str, Any] | None = None
    sections: tuple[Section, ...] = ()
    origin: Origin = Origin()
    software: str = field(default=f'calib_ros {calib_ros.__version__}')

    @property
    def title(self) -> str:
        """Return the name of the robot, with its serial number if known, on one line."""
        return clipped(' '.join(filter(None, (self.robot, self.origin.serial))))

    @property
    def of(self) -> str:
        """Return the name of the first input file."""
        return next((each.name.split('/')[0] for each in self.origin.inputs), '')

    @property
    def shown(self) -> tuple[Section, ...]:
        """Return the sections that may have a figure."""
        return (*filter(None, (self.picture,)), *self.sections)


def plotly_script() -> str | None:
    """Return plotly's JavaScript, or None."""
    try:
        from plotly.offline import get_plotlyjs

        return str(get_plotlyjs())
    except (ImportError, FileNotFoundError):
        return None


def render(report: Report, script: str = '') -> str | None:
    """Return a report as HTML, without the `script` at a path; None without jinja2 or plotly."""
    plotly = '' if script else plotly_script()
    if plotly is None:
        return None
    drawn = {each.name: each.figure for each in report.shown if each.figure}
    data = {'figures': drawn, 'explorer': report.explorer}
    shown = {'drawings': None, 'script': script, 'plotly': plotly, 'data': data}
    return filled('report.html.jinja', report=report, **shown)


def on_paper(report: Report) -> bytes | None:
    """Return a report as PDF, without figures in space; None without jinja2 or weasyprint."""
    try:
        import weasyprint
    except (ImportError, OSError):  # OSError: missing system libraries
        return None
    from calib_ros.report.plots import drawing

    drawings = {each.name: drawing(each.figure, each.height) for each in report.sections}
    if report.picture:  # as high as wide
        height = report.picture.height
        drawings[report.picture.name] = drawing(report.picture.figure, height, height)
    logging.getLogger('weasyprint').setLevel(logging.ERROR)  # ignores screen styles
    drawings = {name: each for name, each in drawings.items() if each}
    page = filled('report.html.jinja', report=report, drawings=drawings)
    found: bytes | None = weasyprint.HTML(string=page).write_pdf() if page else None
    return found


def filled(template: str, **values: Any) -> str | None:
    """Return a page with the shared style and scripts, or None without jinja2."""
    try:
        import jinja2
    except ImportError:
        return None
    loader, undefined = jinja2.FunctionLoader(_template), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=undefined, finalize=_shown, trim_blocks=True
    )
    values |= {'marks': MARKS, 'css': _template('report.css'), 'js': _template('report.js')}
    safe = environment.filters['safe']
    environment.filters['typed'] = lambda text: safe(with_code(text))
    page: str = environment.get_template(template).render(**values)
    return page


def _template(name: str) -> str:
    return (resources.files('calib_ros.report') / 'templates' / name).read_text(encoding='utf-8')


def with_code(text: str) -> str:
    """Return a text as HTML, with commands and options as code that does not break at hyphens."""
    parts = enumerate(map(html.escape, TYPED.split(str(_shown(text)))))
    typed = ''.join(f'<code>{part}</code>' if k % 2 else part for k, part in parts)
    return re.sub(r'\((<code>.*?</code>)', r'<span class="whole">(\1</span>', typed)


def _shown(value: object) -> object:
    """Return a foreign text, indented as it is, without characters that hide or reverse others.

    A number on a single line stays with its unit; texts of several lines may be copied.
    """
    if isinstance(value, str) and not hasattr(value, '__html__'):
        lines = value.split('\n')
        if len(lines) == 1:
            return BEFORE_UNIT.sub('\xa0', one_line(value))
        return '\n'.join(' ' * (len(x) - len(x.lstrip(' '))) + one_line(x) for x in lines)
    return value


def markdown(report: Report, samples: Mapping[str, Any]) -> str:
    """Return the text and tables of a report; `samples` is the account of the input."""
    verdict = report.verdict
    lines = [f'# {in_markdown(report.kind)}: {in_markdown(report.title)}', '']
    lines += [f'**{in_markdown(verdict.heading)}**', '']
    lines += _paragraphs(verdict.gain, *verdict.text)
    for reason in report.advice:
        lines += _section(reason.heading, reason.meaning, f'What was found: {reason.refusal}')
        lines += _numbered(reason.steps) if reason.steps else []
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
