# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which implausible results are refused, and in which order reasons are told, part by part."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from fits import UR10E as UR

from calib_ros.decision import plausibility
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.estimation.levels import TELLING

LENGTHS = [f'{j.name}.{kind}' for j in UR.joints for kind in 'ad' if getattr(j, kind)]


@pytest.mark.parametrize(
    ('scale', 'change', 'told'),
    [
        (6e-3, {}, 'grow alike, by 0.6 %, more than sigma_scale allows'),
        (-6e-3, {}, 'shrink alike, by 0.6 %, more'),
        (4.9e-3, {}, ''),  # as a print may be off
        (6e-3, {'sigma_scale': 7e-3}, ''),
        (6e-3, {'sigma_scale': 0.0}, ''),
        (6e-3, {'refusals': ('no gain',)}, ''),
        (6e-3, {'names': LENGTHS[:2], 'beside': 2e-4}, ''),  # two may be so by chance
        (
            6e-3,
            {'names': LENGTHS[:2], 'beside': 2e-4, 'pixels': 1},
            'grow alike',
        ),  # but a print is likelier
        (6e-3, {'beside': 2e-2}, ''),  # they do not grow alike
        (2e-3, {'by_scale': 0.15}, 'all lengths of the arm grow alike, by 0.2 %, as if'),
        (2e-3, {'by_scale': 0.14}, ''),
        (-2e-3, {'by_scale': 0.15, 'sigma_scale': 0.0}, 'shrink alike, by 0.2 %, as if'),
    ],
)
def test_all_lengths_grow_alike_where_the_device_is_out_of_scale(scale, change, told):
    given = {'sigma_scale': 1e-5, 'refusals': (), 'names': LENGTHS, 'pixels': None} | change
    names = [*given['names'], 'elbow_joint.theta']  # whatever angles do
    grown = np.array([scale * UR.value(name) for name in names])
    grown[:-1:2] += given.get('beside', 0.0)
    grown[-1] = 1.0
    result = SimpleNamespace(
        refusals=given['refusals'],
        region=SimpleNamespace(by_scale=given.get('by_scale', 0.0)),
        posterior=SimpleNamespace(
            names=names, offsets=0.7 * grown, shift=0.3 * grown, scale=scale
        ),
    )
    problem = SimpleNamespace(
        sigma_scale=given['sigma_scale'],
        model=UR,
        sets=[SimpleNamespace(pixels=given['pixels'])],
    )
    found = [*plausibility._scale(problem, result)]
    assert told in ' '.join(found)
    assert bool(found) == bool(told)


@pytest.mark.parametrize(
    ('count', 'bend', 'told'), [(TELLING, 0.0, True), (TELLING - 1, 0.0, False), (20, 0.05, False)]
)
def test_a_joint_moves_one_way_in_a_session_that_is_long_enough(count, bend, told, rng):
    """Each configuration counts once, however often it was measured."""
    q = rng.normal(size=(count, 2))
    q[:, 1] = np.arange(count) * (1.0 - bend * np.arange(count))
    twice = np.repeat(np.arange(count), 2)
    seen = SimpleNamespace(joints=q[twice], configurations=twice)
    problem = SimpleNamespace(sets=[seen], chain=SimpleNamespace(joint_names=('pan', 'lift')))
    found = plausibility._order(problem)
    assert ('an error of lift, moved' in found) == told
    assert bool(found) == told


@dataclass(frozen=True)
class Judged:
    refusals: tuple = ()
    remarks: tuple = ()
    coupled: bool = False


@pytest.mark.parametrize(
    ('found', 'another', 'refused', 'remarked'),
    [
        ({}, True, [], []),
        ({'lens': 'lens', 'sigmas': 'sigmas'}, True, [], ['lens', 'sigmas']),
        ({'lens': 'lens', 'imitated': True, 'sigmas': 'sigmas'}, True, ['lens', 'sigmas'], []),
        ({'lens': 'lens', 'given': 'gain', 'sigmas': 's'}, True, ['lens', 'gain', 's'], []),
        ({'board': 'board', 'sigmas': 'sigmas'}, True, [], ['board', 'sigmas']),
        ({'board': 'board', 'pixels': 1, 'sigmas': 's'}, True, ['s', 'board'], []),
        ({'board': 'board', 'lens': 'lens', 'pixels': 1}, True, [], ['lens']),
        ({'scale': 'scale', 'sigmas': 'sigmas'}, True, ['sigmas', 'scale'], []),
        ({'sessions': 'two', 'given': 'gain'}, True, ['two', 'gain'], []),
        ({'sessions': 'two', 'lens': 'lens', 'given': 'gain'}, False, ['gain'], []),
        ({'given': 'mistake', 'sigmas': 's'}, False, ['mistake', 's'], []),
        ({'coupled': True, 'motion': 'fast', 'order': 'one way'}, True, [], ['fast', 'one way']),
    ],
)
def test_what_explains_a_refusal_comes_before_it(found, another, refused, remarked, monkeypatch):
    """But for a mistake that is named already (not `another`), or another lens."""
    parts = {
        'stretched': found.get('board', ''),
        '_lens': (found.get('lens', ''), 'imitated' in found),
        '_sigmas': found.get('sigmas', ''),
        '_scale': [Reason(Rule.SCALE, found['scale'])] if 'scale' in found else [],
        '_sessions': found.get('sessions', ''),
        '_motion': found.get('motion', ''),
    }
    for name, part in parts.items():
        monkeypatch.setattr(plausibility, name, lambda *_, part=part: part)
    monkeypatch.setattr(plausibility, '_order', lambda _: found.get('order', ''))
    monkeypatch.setattr(plausibility, '_lag', lambda _, result: result)
    seen = SimpleNamespace(socket=False, plane=False, pixels=found.get('pixels'))
    given = tuple(Reason(Rule.GAIN, found[name]) for name in ('given',) if name in found)
    result = plausibility.remarked(
        SimpleNamespace(sets=[seen], separations=()),
        Judged(given, ('first',), 'coupled' in found),
        another,
    )
    assert list(result.refusals) == refused
    assert [each for each in result.remarks if each != plausibility.COUPLED] == [
        'first',
        *remarked,
    ]
    assert (plausibility.COUPLED in result.remarks) == ('coupled' in found)
