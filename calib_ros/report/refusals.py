# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The advice on each rule of acceptance: its heading, its meaning, and what to do in order.

It is in `templates/refusals.md`, which is also a page of the documentation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

from calib_ros.decision.reasons import Rule

AGAIN = (
    'Then identify again with old and new measurements, or with the new ones alone if something '
    'was loose.'
)


@dataclass(frozen=True)
class Advice:
    """A refusal in plain words."""

    heading: str
    meaning: str
    steps: tuple[str, ...]  # what to do; none if it follows from another refusal
    refusal: str = ''  # the sentence of its rule
    again: str = AGAIN  # what to identify next
    in_short: str = ''  # the heading, with the mistake if there is one
    sound: str = ''  # the verdict, if the arm shows no errors
    unless: tuple[str, ...] = ()  # for each step, when it is needless

    @property
    def found(self) -> str:
        """Return what was found, as a sentence."""
        return f'What was found: {self.refusal}' + '.' * (self.refusal[-1:] not in '.?')


MARKED = re.compile(r'^\d\. (?:<!-- unless (\w+) -->)?', re.MULTILINE)


@cache
def rules() -> Mapping[Rule, Advice]:
    """Return the advice on each rule, from the sections of `templates/refusals.md`."""
    file = resources.files('calib_ros.report') / 'templates' / 'refusals.md'
    found = {}
    for section in file.read_text(encoding='utf-8').split('\n## ')[1:]:
        heading, about, listed, *again = section.split('\n\n')
        name, meaning = about.removeprefix('`Rule.').split('`. ', 1)
        _, *parts = MARKED.split(listed)
        steps, last = tuple(map(_unwrapped, parts[1::2])), _unwrapped(' '.join(again)) or AGAIN
        unless = tuple(parts[::2])
        found[Rule[name]] = Advice(heading, _unwrapped(meaning), steps, again=last, unless=unless)
    return found


def _unwrapped(text: str) -> str:
    return ' '.join(text.replace('`', '').split())


GOOD_ARM = Advice(
    'There is nothing to correct that this device can see',
    'The error is within the assumed noise of the measuring device: the arm is as good as this '
    'device can see.',
    ('To look for smaller errors, measure with a more accurate device.',),
    sound='Nothing to correct',
)
"""Instead of `Rule.GAIN`, if the error before is within the noise."""
GOOD_HERE = Advice(
    'At these poses this device sees nothing to correct',
    'At these poses the error is within the assumed noise of the measuring device. '
    'Elsewhere it may be larger: these poses tell little about the rest of the joint range.',
    ('Add poses all over the workspace, each joint moved through most of its range.',),
    sound='Nothing to correct at these poses',
)
"""The same if the poses do not determine the error elsewhere."""
