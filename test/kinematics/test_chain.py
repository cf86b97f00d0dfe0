# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from calib_ros.errors import ConfigError
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.joint import Frame
from calib_ros.kinematics.parameter import DELAY, FRAME_KINDS

HALF = np.pi / 2


def row_of(alphas, convention, types='rrrrrr'):
    kinds = {'r': 'revolute', 'p': 'prismatic'}
    rows = [
        Joint(f'j{k + 1}', kinds[types[k]], a=0.3, alpha=alpha) for k, alpha in enumerate(alphas)
    ]
    return Chain('arm', convention, tuple(rows))


@pytest.mark.parametrize(
    ('alphas', 'convention', 'types', 'parallel'),
    [
        # A row leads from its axis to the next (standard) or from the one before (modified).
        ((HALF, 0.0, 0.0, HALF, -HALF, 0.0), 'standard', 'rrrrrr', ('j2', 'j3')),
        ((0.0, HALF, 0.0, 0.0, HALF, -HALF), 'modified', 'rrrrrr', ('j3', 'j4')),
        ((HALF, np.pi, HALF), 'standard', 'rrr', ('j2',)),
        ((HALF, np.radians(4.9), np.radians(5.1), HALF), 'standard', 'rrrr', ('j2', 'j3')),
        # Those further apart than tan(f) / 2, with f between them, are known better by beta.
        ((HALF, np.radians(30.0), np.radians(32.0), HALF), 'standard', 'rrrr', ('j2',)),
        # Axes that are parallel count, prismatic ones too.
        ((0.0, 0.0, 0.0), 'standard', 'rpr', ('j1', 'j2')),
        ((0.0, 0.0, 0.0), 'standard', 'rpp', ('j1', 'j2')),
        ((0.0, np.radians(30.0), 0.0), 'standard', 'rpp', ('j1',)),
        ((0.0, 0.0, 0.0), 'modified', 'rrp', ('j2', 'j3')),
        ((0.0, 0.0, 0.0), 'modified', 'rpp', ('j2', 'j3')),
    ],
)
def test_parallel_by_convention_tilt_and_type(alphas, convention, types, parallel):
    assert row_of(alphas, convention, types).parallel == parallel


def test_a_nominal_beta_tilts_the_axis():
    rows = tuple(Joint(f'j{k}', a=0.3, beta=beta) for k, beta in enumerate([0.01, 0.6, 0.0]))
    assert Chain('arm', 'standard', rows).parallel == ('j0',)


@pytest.mark.parametrize(
    ('a', 'degrees', 'kinds'),
    [
        (0.0, 0.0, ('a', 'alpha', 'beta', 'b', 'theta')),
        (0.04, 14.9, ('a', 'alpha', 'beta', 'b', 'theta')),
        (0.05, 4.9, ('a', 'alpha', 'theta', 'beta')),
        (0.04, 15.1, ('a', 'alpha', 'd', 'theta')),
    ],
)
@pytest.mark.parametrize(('convention', 'row'), [('standard', 'j1'), ('modified', 'j2')])
def test_axes_that_coincide_may_be_shifted_both_ways(a, degrees, kinds, convention, row):
    bend = {'a': a, 'alpha': np.radians(degrees)}
    chain = Chain('arm', convention, tuple(Joint(name, **bend) for name in ('j1', 'j2')))
    assert tuple(n.kind for n in chain.parameter_names if n.owner == row) == kinds
    assert chain.table.shape == (2, 5)
    table = chain.with_offsets({'j1.b': 0.1}).table
    assert table[:, 5].tolist() == [0.1, 0.0]
    if 'b' in kinds:  # a shift that was found has its parameter, however far the axes are apart
        moved = chain.with_offsets({f'{row}.a': 0.1, f'{row}.b': 1e-3})
        assert moved.parameter_names == chain.parameter_names


@pytest.mark.parametrize(
    ('given', 'offsets'),
    [
        ({'b': 0.3}, {}),
        ({'a': 0.0434, 'b': 0.0}, {'j1.a': 5e-4, 'j1.b': 5e-4}),
        ({'alpha': np.radians(14.97)}, {'j1.alpha': 1e-3, 'j1.b': 5e-4}),
    ],
    ids=['given', 'further apart', 'more tilted'],
)
def test_a_shift_b_of_parallel_axes_stays_a_parameter(given, offsets):
    rows = (Joint('j1', **given), Joint('j2', alpha=np.pi / 2))
    chain = Chain('arm', 'standard', rows).with_offsets(offsets)
    own = [n.kind for n in chain.parameter_names if n.owner == 'j1']
    assert own == ['a', 'alpha', 'beta', 'b', 'theta']


@pytest.mark.parametrize(
    ('kind', 'lower', 'upper', 'expected'),
    [
        ('revolute', None, None, (-np.pi, np.pi)),
        ('prismatic', None, None, (-0.5, 0.5)),
        ('revolute', -0.5, 0.2, (-0.5, 0.2)),
        ('prismatic', -4.0, 4.0, (-4.0, 4.0)),
        # Where one end is missing, as far as without limits, and no less than the whole stroke.
        ('prismatic', -1.5, None, (-1.5, 0.5)),
        ('prismatic', 0.2, None, (0.2, 1.2)),
        ('prismatic', None, 1.5, (-0.5, 1.5)),
        ('prismatic', None, -0.2, (-1.2, -0.2)),
    ],
)
def test_a_joint_ranges_over_its_limits_and_a_whole_stroke_without(kind, lower, upper, expected):
    found = Joint('j', kind, lower=lower, upper=upper).range
    assert found == pytest.approx(expected, abs=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_a_frame_moves_by_its_offsets(seed):
    first, second = np.random.default_rng(seed).uniform(-1.0, 1.0, (2, 6))
    start = Frame().moved(dict(zip(FRAME_KINDS, first, strict=True)))
    moved = start.moved(dict(zip(FRAME_KINDS, second, strict=True)))
    np.testing.assert_allclose(start.offsets(), first, atol=1e-12)
    np.testing.assert_allclose(moved.offsets(start), second, atol=1e-12)


@pytest.mark.parametrize('name', ['joint_names', 'frame_names', 'all_parameters', 'held', 'walk'])
def test_another_base_changes_nothing_else(name):
    chain = row_of((0.0, HALF), 'standard', 'rr')
    known = getattr(chain, name)
    assert getattr(chain.with_frame('base', Frame()), name) is known


def test_delays_of_a_frame_add_up():
    assert Frame().moved({'x': 1.0}).delay is None
    later = Frame().moved({DELAY: 0.25})
    assert later.delay == 0.25
    assert later.moved({DELAY: 0.5}).delay == 0.75
    assert later.moved({'x': 1.0}).delay == 0.25
    chain = row_of((HALF, 0.0), 'standard')
    assert chain.value(f'base.{DELAY}') == 0.0
    assert chain.with_frame('base', later).value(f'base.{DELAY}') == 0.25


ONE = row_of((HALF, 0.0), 'standard')


@pytest.mark.parametrize(
    ('made', 'said'),
    [
        (lambda: row_of((), 'standard'), 'chain "arm" has no joints'),
        (lambda: replace(ONE, parallel=('j1', 'j1')), 'names joint "j1" twice'),
        (lambda: ONE.with_offsets({'j1.a': np.inf}), 'the offset of j1.a must be a finite number'),
        (lambda: ONE.with_offsets({'j3.a': 0.0}), 'unknown parameter "j3.a"'),
        (lambda: ONE.with_effects(['j3.ratio']), 'unknown parameter "j3.ratio"'),
        (lambda: ONE.value('j3.a'), 'unknown parameter "j3.a"'),
        (lambda: ONE.frame('base_2'), 'unknown frame "base_2": .*valid: base, tool'),
        (lambda: replace(ONE, parallel=('j3',)), '"parallel": unknown joint "j3"'),
        (lambda: Joint('j', 'screw'), 'joint "j": unknown type "screw": valid: '),
        (
            lambda: Joint('j', lower=2.0, upper=1.0),
            'limits of joint "j": lower 2.0 must not exceed upper 1.0',
        ),
        (lambda: Joint('j', sign=2), 'sign of joint "j" must be 1 or -1, not 2'),
        (lambda: Joint('j', d=np.nan), 'd of joint "j" must be a finite number'),
    ],
)
def test_what_is_no_chain_and_no_change_of_one_is_refused(made, said):
    with pytest.raises(ConfigError, match=said):
        made()


def test_a_frame_moves_along_and_turns_about_the_axes_of_its_parent():
    start = Frame(se3.transform(se3.turned(0.1, 0.2, 0.3), np.array([1.0, 2.0, 3.0])), delay=0.1)
    moved = start.moved({'x': 0.5, 'rz': 0.4})
    np.testing.assert_allclose(moved.matrix[:3, 3], [1.5, 2.0, 3.0])
    turn = moved.matrix[:3, :3] @ start.matrix[:3, :3].T
    np.testing.assert_allclose(turn, se3.turned(0.0, 0.0, 0.4), atol=1e-15)
    np.testing.assert_allclose(moved.offsets(start), [0.5, 0.0, 0.0, 0.0, 0.0, 0.4], atol=1e-12)
    np.testing.assert_array_equal(start.moved({}).matrix, start.matrix)
    assert (moved.delay, start.moved({'delay': 0.05}).delay) == (0.1, pytest.approx(0.15))
    assert Frame().moved({'delay': 0.05}).delay == 0.05
    assert Frame(fixed=True).moved({'y': 1.0}).fixed
