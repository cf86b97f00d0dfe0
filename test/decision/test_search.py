# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""When mistakes are looked for, and which of several explanations are named."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, UR10E, measured_arm
from in_sockets import cell

from calib_ros import Problem, identify
from calib_ros.apply.simulation import measure, random_frame
from calib_ros.decision import mistakes
from calib_ros.decision.diagnosis import Diagnosis
from calib_ros.decision.mistakes import (
    _beam_search,
    _best_trials,
    _named,
    _suspicious,
    _wrong_rotations,
    diagnose,
)
from calib_ros.decision.undoing import Suspect

FAULTY = SimpleNamespace(largest_error=0.5, largest_length=0.1, largest_angle=0.2, sets=())


def test_good_results_are_not_searched(monkeypatch):
    monkeypatch.setattr(mistakes, 'diagnose', None)
    assert identify(Problem(UR10E, measured_arm(1, 40)[2])).accepted


def figures(mm=499.0, mrad=199.0):
    return SimpleNamespace(rms_mm=mm, rms_mrad=mrad)


def judged(*each, outliers=0.3):
    return SimpleNamespace(figures_of_all=each, share_of_outliers=outliers)


@pytest.mark.parametrize(
    ('change', 'suspicious'),
    [
        ({}, False),
        ({'refusals': ('not',)}, False),
        ({'converged': False}, True),
        ({'coupled': True}, True),
        ({'coupled': True, 'refusals': ('not',)}, False),
        ({'comparison': judged(figures(501.0), figures())}, True),
        ({'comparison': judged(figures(), figures(mrad=201.0))}, True),
        ({'comparison': judged(figures(mrad=None), figures(), outliers=0.36)}, True),
        ({'comparison': judged(figures(), figures(501.0))}, True),
        ({'fitted': judged(figures(501.0), figures())}, True),
        ({'fitted': judged(figures(), figures(501.0))}, False),  # judged on other poses
        ({'parameters': [SimpleNamespace(beyond=lambda *limits: limits == (0.1, 0.2))]}, True),
        ({'parameters': [SimpleNamespace(beyond=lambda *limits: False)]}, False),
    ],
)
def test_mistakes_are_looked_for_where_errors_are_those_of_no_faulty_arm(change, suspicious):
    usual = judged(figures(), figures())
    result = {
        'converged': True,
        'refusals': (),
        'coupled': False,
        'comparison': usual,
        'fitted': usual,
        'parameters': (),
    }
    assert _suspicious(FAULTY, SimpleNamespace(**result | change)) == suspicious


@pytest.mark.parametrize(('count', 'searched'), [(5, False), (6, True)])
def test_few_poses_and_wires_alone_are_not_searched(count, searched, monkeypatch):
    """Base and tool explain nearly all of five."""
    tried = []
    monkeypatch.setattr(mistakes, 'in_frames', lambda *_: tried.append(0) or given(error=0.0))
    seen = measured_arm(1, count)[2]
    assert diagnose(Problem(UR10E, seen), far=True) is None
    assert bool(tried) == searched
    wire = replace(seen, distances=np.ones(count), oriented=np.zeros(count, dtype=bool))
    assert diagnose(Problem(UR10E, wire)) is None
    assert bool(tried) == searched


@pytest.mark.parametrize(
    ('lengths', 'angles', 'oriented', 'what'),
    [
        (1e3, 1.0, False, 'the positions are in mm, not metres'),
        (1.0, np.degrees(1.0), True, 'the joint values are in degrees, not radians'),
    ],
)
def test_mistakes_beside_sockets_are_those_of_what_is_measured(lengths, angles, what, oriented):
    """Units of positions were not named beside sockets, and the search took a minute."""
    true, problem = cell(0, noise=3e-5, count=20)
    rng = np.random.default_rng(50)
    true = replace(true, base=random_frame(rng, 2.0))
    seen = measure(true, true.random_joints(30, rng), rng, *NOISE, oriented=oriented)
    seen = replace(seen, base='base_tracker', positions=lengths * seen.positions)
    sets = [replace(e, joints=angles * e.joints) for e in (*problem.sets, seen)]
    found = diagnose(replace(problem, observations=sets[0], more=sets[1:]))
    assert [each.what for each in found.suspects] == [what]


def test_mistakes_of_sockets_are_named_beside_right_positions():
    true, problem = cell(0, noise=3e-5, count=20)
    rng = np.random.default_rng(51)
    true = replace(true, base=random_frame(rng, 2.0))
    seen = measure(true, true.random_joints(30, rng), rng, *NOISE)
    seen = replace(seen, base='base_tracker')
    sets = [replace(each, joints=np.degrees(each.joints)) for each in problem.sets]
    found = diagnose(replace(problem, observations=seen, more=sets))
    assert found.suspects[0].what == 'the joint values are in degrees, not radians'


@pytest.mark.parametrize(
    ('change', 'tried'),
    [
        ({}, True),
        ({'oriented': np.arange(9) > 0}, False),
        ({'socket': True}, False),
        ({'inverse': True}, False),
    ],
)
def test_positions_are_tried_alone_where_all_poses_are_whole(change, tried, monkeypatch):
    tries = []
    monkeypatch.setattr(mistakes, 'in_frames', lambda *_: tries.append(0) or given(error=0.0))
    seen = replace(measured_arm(1, 9)[2], **change)
    problem = SimpleNamespace(**vars(FAULTY), sigma_orientation=1e-3)
    assert (_wrong_rotations(problem, UR10E, (seen,), given(), ()) is not None) == tried
    assert bool(tries) == tried


@pytest.fixture
def searched(monkeypatch):
    """Return a function that sets the suspects, and the share of errors that some leave."""

    def search(options, shares, pairs=()):
        def trials_of(tried):
            found = [shares.get(''.join(sorted(sets[0])), 1.0) for _, sets in tried]
            return [SimpleNamespace(share=share, error=share, whole=share) for share in found]

        suspects = [
            Suspect(
                name,
                f'undo {name}',
                (lambda each, name=name: each | {name},),
                rank=rank,
                part=part,
                published=f'publish {name}',
            )
            for name, rank, part in options
        ]
        hidden = [tuple(one for one in suspects if one.what in pair) for pair in pairs]
        monkeypatch.setattr(mistakes, 'suspects', lambda *_: suspects)
        monkeypatch.setattr(mistakes.orders, 'in_any_order', lambda *_: ())
        monkeypatch.setattr(mistakes, 'hidden', lambda chain, others: hidden)
        monkeypatch.setattr(mistakes, 'trials_of', trials_of)
        monkeypatch.setattr(mistakes, 'refine_trial', lambda problem, trial: trial)

    return search


def given(share=1.0, error=1.0):
    return SimpleNamespace(sets=(frozenset(),), share=share, error=error)


def named(problem=FAULTY, start=None, **options):
    start = start or given()
    return _named(problem, start, _best_trials(problem, UR10E, (), start, **options))


@pytest.mark.parametrize(
    ('shares', 'ranks', 'whats'),
    [
        ({'a': 0.1}, {}, 'a'),
        ({'a': 0.1, 'b': 0.14}, {}, 'ab'),  # as good
        ({'a': 0.1, 'b': 0.14}, {'b': 2}, 'a'),  # but less usual
        ({'a': 0.1, 'b': 0.14}, {'a': 2}, 'b'),
        ({'a': 0.1, 'b': 0.16}, {'b': 2}, 'ab'),  # another explanation, nearly as good
        ({'a': 0.1, 'b': 0.35}, {}, 'a'),
        ({'a': 0.29}, {}, 'a'),
        ({'a': 0.31}, {}, ''),  # not clearly better than the given input
        ({'a': 0.1, 'b': 0.11, 'c': 0.12, 'd': 0.13}, {}, 'abc'),
    ],
)
def test_of_equal_explanations_the_most_usual_are_named(searched, shares, ranks, whats):
    searched([(name, ranks.get(name, 1), '') for name in 'abcdefg'], shares)
    found = named()
    assert ''.join(each.what for each in found.suspects if found) == whats if whats else not found
    if whats:
        assert (found.given, found.corrected) == (1.0, min(filter(None, shares.values())))


def test_an_explanation_leaves_a_faulty_arm_and_much_less_of_the_spread(searched):
    searched([('a', 1, '')], {'a': 0.2})
    assert named()
    assert named(start=given(share=2.0))
    assert not named(start=given(share=0.6))
    assert not named(start=given(error=0.6))
    assert not named(SimpleNamespace(**vars(FAULTY) | {'largest_error': 0.0}))


def test_what_is_wrong_with_some_rows_is_not_the_arm(searched, monkeypatch):
    searched([], {'': 0.1})
    monkeypatch.setattr(mistakes, 'suspects', lambda *_: [Suspect('arm', 'change', chain=UR10E)])
    assert named().suspects[0].what == 'arm'
    assert not named(of_rows=True)


def test_errors_with_and_without_a_mistake_are_told_in_millimetres():
    told = Diagnosis((Suspect('a', 'undo a'), Suspect('b', 'undo b')), 23.456789, 0.0012)
    said = 'a: undo a; or b: undo b'
    assert told.reason.short == said
    off = 'the uncorrected arm is then typically 1.200 mm off, not 23,457 mm'
    assert str(told) == f'{said} ({off})'


MISTAKES = [('a', 1, 'measured'), ('b', 1, 'order'), ('c', 1, 'j1'), ('d', 1, 'j2')]


@pytest.mark.parametrize(
    ('shares', 'named'),
    [
        ({'a': 0.8, 'ab': 0.5, 'abd': 0.1}, 'abd'),
        ({'d': 0.8, 'bd': 0.5, 'abd': 0.1}, 'abd'),  # in the order of undoing
        ({'a': 0.8, 'ab': 0.5, 'abc': 0.35, 'abcd': 0.1}, 'abcd'),
        ({'a': 0.8, 'ab': 0.77, 'abc': 0.1}, ''),  # the second is no better
        ({'a': 0.8, 'ab': 0.75, 'abc': 0.1}, 'abc'),
        ({'c': 1.01, 'cd': 0.1}, 'cd'),  # they hide each other
        ({'a': 0.1}, ''),  # a single one is named otherwise
        ({'a': 0.8, 'ab': 0.31}, ''),
        ({'a': 0.8, 'ab': 0.29}, 'ab'),
    ],
)
def test_mistakes_at_once_are_searched_one_by_one(searched, shares, named):
    searched(MISTAKES, shares)
    found = _beam_search(FAULTY, UR10E, given())
    assert (found is not None) == bool(named)
    if named:
        (both,) = found.suspects
        assert both.remedy == '; '.join(f'{name} (undo {name})' for name in named)
        assert both.published == '; '.join(f'{name} (publish {name})' for name in named)
        assert (found.given, found.corrected) == (1.0, shares[named])


def test_mistakes_of_one_part_are_not_made_at_once(searched):
    searched([('a', 1, 'order'), ('b', 1, 'order'), ('c', 1, '')], {'ab': 0.1, 'ac': 0.1})
    assert _beam_search(FAULTY, UR10E, given()) is None
    searched([('a', 1, 'order'), ('b', 1, 'j1')], {'ab': 0.1})
    assert _beam_search(FAULTY, UR10E, given(error=0.4)) is None  # a faulty arm is no worse
    assert _beam_search(FAULTY, UR10E, given(error=0.6))
    searched([('a', 1, 'order'), ('b', 1, 'j1')], {'ab': 0.27})
    assert _beam_search(FAULTY, UR10E, given())
    assert _beam_search(FAULTY, UR10E, given(error=0.8)) is None  # 0.24 would be much less


def test_signs_that_hide_each_other_are_tried_together(searched):
    """Six others are better alone, so that one of these would not be kept."""
    alone = {name: 0.9 + 0.01 * k for k, name in enumerate('abcdef')}
    options = [(name, 1, f'j{name}') for name in 'abcdefgh']
    searched(options, alone | {'gh': 0.1})
    assert _beam_search(FAULTY, UR10E, given()) is None
    searched(options, alone | {'gh': 0.1}, pairs=['gh'])
    assert _beam_search(FAULTY, UR10E, given()).suspects[0].remedy == 'g (undo g); h (undo h)'


@pytest.mark.parametrize('pixels', [None, 1])
def test_mistakes_at_once_of_images_are_those_of_boards_and_places(pixels, searched, monkeypatch):
    searched([('a', 1, 'measured'), ('b', 1, 'j1')], {'ab': 0.1})
    both = mistakes.suspects()
    monkeypatch.setattr(mistakes, 'suspects', lambda chain, sets, boards: both if boards else [])
    images = SimpleNamespace(
        **vars(FAULTY) | {'sets': [SimpleNamespace(pixels=pixels, distances=1)]}
    )
    assert (_beam_search(images, UR10E, given()) is None) == (pixels is None)
