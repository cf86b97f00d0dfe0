# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A page of a report, taken apart without a browser, and a problem to report on."""

import json
from html.parser import HTMLParser

import numpy as np
from measured import TEST, TRAIN, UR, measured

from calib_ros.estimation.problem import Problem
from calib_ros.files.loading import Loaded
from calib_ros.report.content import Origin
from calib_ros.report.page import render
from calib_ros.report.reports import identification_report


class Page(HTMLParser):
    """Tags with their attributes, the text that is seen, and the data of a page."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self._inside = [], [], []
        self.data = None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in ('meta', 'link', 'input', 'br'):
            self._inside.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        self._inside.pop()

    def handle_data(self, text):
        tag, attributes = self._inside[-1] if self._inside else ('', {})
        if attributes.get('id') == 'data':
            self.data = json.loads(text)
        elif tag not in ('script', 'style'):
            self.words.append(' '.join(text.split()))

    @property
    def text(self):
        return ' '.join(self.words)


def problem_of(count=TRAIN, chain=UR, **more):
    rows = measured(count=count + TEST)
    held_out = rows.select(np.arange(count, count + TEST))
    return Problem(chain, rows.select(np.arange(count)), held_out, **more)


def report_of(problem, result, warnings=(), tolerance=None):
    wanted_mm = tolerance and 1e3 * tolerance
    return identification_report(Loaded(problem, {}, warnings), result, Origin(), wanted_mm)


def page_of(report):
    return Page(render(report))
