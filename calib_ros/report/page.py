# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A report as HTML and PDF: single files that need no network.

Only this module imports jinja2, plotly and weasyprint; without them `render` and `on_paper` return
None. All foreign text is escaped.
"""

from __future__ import annotations

import html
import logging
import re
from functools import cache
from importlib import resources
from typing import Any

from calib_ros.report.content import Report, State
from calib_ros.shown import rounded
from calib_ros.texts import one_line

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
    from calib_ros.report.drawing import drawing

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
    values |= {'marks': MARKS, 'css': _template('report.css'), 'js': _template('report.js')}
    return str(_environment(jinja2).get_template(template).render(**values))


@cache  # pages of a fleet compile their template once
def _environment(jinja2: Any) -> Any:
    loader, undefined = jinja2.FunctionLoader(_template), jinja2.StrictUndefined
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=undefined, finalize=_shown, trim_blocks=True
    )
    safe = environment.filters['safe']
    environment.filters['rounded'] = rounded
    environment.filters['typed'] = lambda text: safe(with_code(text))
    return environment


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
