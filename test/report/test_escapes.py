# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of others are text wherever they come out."""

import csv
import io
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, strategies as st
from measured import measured

from calib_ros.estimation.problem import Problem
from calib_ros.files.export import exports
from calib_ros.files.journal import Journal, read_journal
from calib_ros.files.loading import Loaded
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain_file import load_chain, parse_chain
from calib_ros.kinematics.parameter import Parameter
from calib_ros.report import reports
from calib_ros.report.content import Origin
from calib_ros.report.markdown import markdown
from calib_ros.report.page import with_code
from calib_ros.report.plots import before_after_png
from calib_ros.report.reports import identification_report
from calib_ros.sampling.sample import Sample
from calib_ros.texts import from_cell, in_markdown, one_line, to_cell

HOSTILE = (
    *("=cmd|' /C calc'!A0", '+1', '-1+1', '@SUM(1)', '\t=1', '\r=1', "'=1", "''@x", 'a,=1\n=2'),
    *('<script>alert(1)</script>', '&lt;b>', '| a | b |', '[x](javascript:1)', '![x](http://y)'),
    *('# head', '> quote', '`code`', '**bold**', '_it_', '\\', '$x^{$', 'a\u202eb', 'x\x1b[31m'),
    *('line\nbreak\u2028and\x85more', '', "'", '-'),
)


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags = []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)


@given(st.sampled_from(HOSTILE) | st.text())
def test_a_cell_is_no_formula_and_reads_back(text):
    cell = to_cell(text)
    assert not cell.startswith(('=', '+', '-', '@', '\t', '\r'))
    assert from_cell(cell) == text


@given(st.text())
def test_markdown_is_one_line_without_tags(text):
    found = in_markdown(text)
    assert found == one_line(found)
    assert '<' not in found
    parser = Tags()
    parser.feed(found)
    assert parser.tags == []


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('shoulder_pan_joint.theta', 'shoulder_pan_joint.theta'),
        ('RMS 1.2 -> 0.3 mm (by 5-fold)', 'RMS 1.2 -> 0.3 mm (by 5-fold)'),
        ('<b>', '&lt;b>'),
        ('&lt;', '&amp;lt;'),
        ('a|b', r'a\|b'),
        ('![x](y)', r'!\[x\](y)'),
        ('**_x_** `y`', r'\*\*\_x\_\*\* \`y\`'),
        ('# x', r'\# x'),
        ('a\nb\x1bc', 'a b c'),
        ('a\\|b', r'a\\\|b'),
    ],
)
def test_markdown(text, expected):
    assert in_markdown(text) == expected


@pytest.fixture(scope='module')
def result():
    return identify(Problem(load_chain('ur5e'), measured()))


def test_a_report_is_of_one_form_whatever_the_names(result, monkeypatch):
    """Of the robot, a joint, what was dropped, and in a warning."""
    monkeypatch.setattr(reports, 'SURVEYED', 100)
    problem = Problem(load_chain('ur5e'), measured())

    def lines_of(name):
        first = replace(result.parameters[0], name=Parameter(name, 'a'))
        found = replace(
            result,
            chain=replace(result.chain, name=name),
            parameters=(first, *result.parameters[1:]),
        )
        report = identification_report(Loaded(problem, {}, (name,)), found, Origin())
        return markdown(report, {'samples': 3, 'dropped': {name: 1}}).splitlines()

    usual = lines_of('x')
    (row,) = (k for k, line in enumerate(usual) if line.startswith('| x.a |'))
    for name in HOSTILE[:-3]:
        lines = lines_of(name)
        assert len(lines) == len(usual), name
        assert '<' not in ''.join(lines), name
        plain = lines[row].replace(r'\\', '').replace(r'\|', '')
        assert plain.count('|') == usual[row].count('|'), name


@pytest.mark.usefixtures('drawn')
@pytest.mark.parametrize('name', ['$x^{$', '\\', '<script>'])
def test_a_figure_is_drawn_whatever_the_name(result, name):
    renamed = replace(result, chain=replace(result.chain, name=name))
    assert before_after_png(renamed).startswith(b'\x89PNG')


@pytest.mark.parametrize('name', [name for name in HOSTILE if name.isprintable() and name])
def test_exports_hold_no_formula(name):
    nominal = load_chain('ur5e')
    first = replace(nominal.joints[0], name=name)
    chain = replace(nominal, name=name, joints=(first, *nominal.joints[1:]), parallel=None)
    for each in exports(chain, chain):
        if each.name.endswith('.csv'):
            rows = list(csv.reader(io.StringIO(each.content)))
            assert rows[0][0].startswith('# ')
            names = [*rows[0][1:], *(row[0] for row in rows[1:])]
            assert not any(text.startswith(('=', '+', '@', "'=1")) for text in names if text)
            assert from_cell(rows[2][0]) == name
        if each.name.startswith('dh_') and each.name.endswith('.yaml'):
            assert parse_chain(each.content).joints[0].name == name


@pytest.mark.parametrize('name', HOSTILE)
def test_a_journal_keeps_the_names_of_messages(tmp_path, name):
    sample = Sample(1, np.zeros(2), position=np.zeros(3), device=name, target=name, frame_id=name)
    path = tmp_path / 'journal.csv'
    journal = Journal(path, 2)
    journal.add(sample)
    journal.close()
    (found,), _ = read_journal(path, 2)
    assert (found.device, found.target, found.frame_id) == (name, name, name)
    with path.open(newline='') as file:
        _, row = csv.reader(file)
    assert not any(cell.startswith(('=', '+', '-', '@', '\t', '\r')) for cell in row)


def test_no_line_ends_between_a_bracket_and_its_code():
    found = with_code('fit (--session A,B), (or --force) (--new-base)')
    for code in ('--session A,B', '--new-base'):
        assert f'<span class="whole">(<code>{code}</code></span>' in found
    assert found.count('whole') == 2
