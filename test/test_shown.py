# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Public values on a screen."""

import copy
import importlib
import pkgutil
import re
import sys
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from types import new_class
from typing import Generic, TypeVar

import numpy as np
import pytest

import calib_ros
from calib_ros.annotated import as_annotated
from calib_ros.apply.design import Design
from calib_ros.apply.planning import plan
from calib_ros.apply.simulation import measure
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.shown import Shown, interval_mm, moment, rounded, rows_in_words, two_digits

CHAIN = calib_ros.load_chain('ur10e')
JOINTS = CHAIN.random_joints(200, np.random.default_rng(1))
SEEN = measure(CHAIN, JOINTS, np.random.default_rng(2), 1e-4, 1e-4)
PROBLEM = calib_ros.Problem(CHAIN, SEEN)
RESULT = calib_ros.identify(PROBLEM)
ARM = calib_ros.Calibration.of(RESULT)
DESIGN = Design.of(PROBLEM)
PLANNED = {'candidates': JOINTS[:40], 'task': JOINTS[:5], 'count': 8, 'draws': 2}
PLAN = partial(plan, DESIGN, **PLANNED | {'count': 3})
CORRECTED = calib_ros.Compensator(CHAIN, ARM.chain)
NOT_NUMBERS = (JOINTS > 0.0, JOINTS + 1j, JOINTS.astype('datetime64[s]'), JOINTS.astype(str), 'a')
VALUES = (CHAIN, SEEN, PROBLEM, RESULT, ARM, RESULT.posterior)


@pytest.mark.parametrize(
    ('stamp_ns', 'text'),
    [
        (1_760_432_012_000_000_000, '2025-10-14 08:53:32.000 UTC'),
        (1_760_432_012_034_567_800, '2025-10-14 08:53:32.034 UTC'),
        (3_500_000_001, '3.500 s'),
    ],
)
def test_a_stamp_is_told_as_a_time_or_in_seconds(stamp_ns, text):
    assert moment(stamp_ns) == text


@pytest.mark.parametrize('value', VALUES, ids=lambda value: type(value).__name__)
def test_a_value_fits_on_a_screen(value):
    lines = repr(value).splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 99
    assert lines[0].startswith(type(value).__name__ + '(')
    assert repr(value).count('(') == repr(value).count(')')  # no value is cut in its middle
    assert 'in a Unmodelled' not in repr(value)  # a tuple with names
    assert len(re.findall('<tr>', value._repr_html_())) >= 5


@pytest.mark.parametrize('name', ['largest_length', 'largest_angle', 'largest_error'])
def test_limits_of_what_is_accepted_may_be_infinite(name):
    """As a study of any arm wants them."""
    found = calib_ros.identify(replace(PROBLEM, **{name: np.inf}))
    assert found.refusals == RESULT.refusals


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        (lambda: calib_ros.Problem(SEEN, CHAIN), 'chain must be of type Chain, not Observations'),
        (lambda: calib_ros.identify(CHAIN), 'problem must be of type Problem, not Chain'),
        (lambda: calib_ros.verify(RESULT, [SEEN], None), r'Calibration \(Calibration.of\(result'),
        (lambda: calib_ros.verify(ARM, SEEN, None), r'sets must be of type Sequence\[Obs'),
        (lambda: calib_ros.difference(ARM, RESULT), 'second must be of type Calibration'),
        (lambda: calib_ros.Calibration.of(CHAIN), 'result must be of type Identification'),
        (lambda: calib_ros.Compensator(CHAIN, ARM), 'calibrated must be of type Chain, not Cal'),
        (lambda: calib_ros.CalibrationSession('ur10e'), 'chain must be of type Chain, not .ur10e'),
        (lambda: Design.of(RESULT), 'problem must be of type Problem, not Identification'),
        (lambda: calib_ros.recalibrate(ARM, RESULT, 1.0), 'problem must be of type Problem'),
        (lambda: calib_ros.recalibrate(ARM, PROBLEM, 1.0, new='tool'), r'new must be of type Seq'),
        (lambda: calib_ros.corrected_urdf('<robot/>', ARM), 'must be of type Chain, not Cal'),
        (lambda: calib_ros.chain_from_urdf(Path('a')), 'text must be of type str, not Pos'),
        (lambda: calib_ros.dump_chain(ARM), 'chain must be of type Chain, not Calibration'),
    ],
)
def test_arguments_of_another_type_are_named(call, said):
    with pytest.raises(calib_ros.CalibrationError, match=said):
        call()


def test_arrays_are_taken_where_their_type_is_a_generic_alias():
    """As `NDArray` is from numpy 2.5 on: no command ran there."""
    array = new_class('NDArray', (Generic[TypeVar('Scalar', bound=np.generic)],))

    @as_annotated
    def taken(values: array[np.float64]):
        return values

    np.testing.assert_equal(taken([1, 2]), [1.0, 2.0])
    with pytest.raises(calib_ros.CalibrationError, match='values must be real numbers'):
        taken('a')


def test_results_are_read_only():
    """An offset by mistake changed the result for all who hold it."""
    commands = JOINTS[:5].copy()
    corrected = calib_ros.compensate(CORRECTED, commands)
    verified = calib_ros.verify(ARM, [SEEN], 1e-3).comparison.after
    results = ARM.covariance, PLAN().joints, corrected.command, verified.position
    for array in (*results, RESULT.uncertainty.parts, RESULT.confidence_ellipsoid(JOINTS[:1])):
        with pytest.raises(ValueError, match='read-only'):
            array += 1.0
    commands += 1.0  # what was given stays the caller's


@pytest.mark.parametrize(
    ('call', 'said'),
    [
        *(
            (partial(calib_ros.Problem, CHAIN, SEEN, **{name: value}), f'{name} must be {what}')
            for name, value, what in (
                ('largest_length', -1.0, 'a positive number, not -1.0'),
                ('largest_angle', 0.0, 'a positive number'),  # their priors were divided by it
                ('largest_error', np.nan, 'of type float, not nan'),
                ('sigma_position', 0.0, 'a positive number, not 0.0'),
                ('sigma_touch', np.inf, 'a positive number'),
                ('sigma_scale', 1.0, 'at least 0 and below 1, not 1.0'),
                ('folds', 1, 'at least 2, not 1'),
            )
        ),
        *(
            (partial(calib_ros.Settings, **{name: value}), f'{name} must be .*, not {value}')
            for name, value in (
                *(('sigma_position', 0.0), ('sigma_position', -1e-4), ('sigma_position', np.nan)),
                *(('sigma_orientation', np.inf), ('max_gap', -0.1), ('max_gap', np.inf)),
                *(('joint_buffer', 1), ('pose_buffer', 0), ('folds', 1), ('largest_angle', 0.0)),
                *(('sigma_position', 50), ('largest_error', 10), ('largest_angle', 5)),
            )
        ),
        (partial(calib_ros.Problem, CHAIN, SEEN, priors={'*.a': 0}), r"priors\['\*.a'\] must"),
        (partial(calib_ros.recalibrate, ARM, PROBLEM, -1.0), 'years must be a number of at least'),
        (partial(calib_ros.recalibrate, ARM, PROBLEM, np.inf), 'years must be a number of at'),
        (partial(calib_ros.recalibrate, ARM, PROBLEM, 1.0, -1e-5), 'growth must be a number'),
        (partial(PLAN, apart=-1.0), 'apart must be a number of at least 0, not -1.0'),
        (partial(PLAN, count=0), 'count must be at least 1, not 0'),
        (partial(PLAN, draws=0), 'draws must be at least 1, not 0'),
        (partial(PLAN, chosen=[1, 2, 100]), 'must be 3 numbers from 0 to 39, not .1, 2, 100'),
        (partial(PLAN, chosen=[1, 2, -1]), 'chosen must be 3 numbers from 0 to 39'),
        (partial(PLAN, chosen=[1, 2]), 'chosen must be 3 numbers from 0 to 39'),
        (partial(calib_ros.verify, ARM, [SEEN], 0.0), 'tolerance must be between 0 and'),
        (partial(calib_ros.read_table, 'a.csv', -1), 'joints must be at least 1, not -1'),
        (partial(calib_ros.read_table, 'a.csv', 6, sigmas=(1e-4, -1.0)), r'sigmas\[1\] must be'),
        (partial(RESULT.confidence_ellipsoid, np.zeros((1, 6)), 'a'), 'level must be of type'),
        (partial(RESULT.confidence_ellipsoid, np.zeros((1, 6)), 1.0), 'level must be between'),
        (partial(RESULT.predicted_sigma, 0), 'count must be at least 1'),
        (partial(RESULT.correlated, 'a'), 'threshold must be of type float'),
    ],
)
def test_numbers_that_cannot_be_are_named(call, said):
    with pytest.raises(calib_ros.CalibrationError, match=said):
        call()


@pytest.mark.parametrize(
    'call',
    [
        *(
            partial(calib_ros.Problem, CHAIN, SEEN, **{name: value})
            for name, value in [
                *(('priors', wrong) for wrong in (None, [1], {'*.a': 'a'}, {'*.a': True})),
                *(('fixed', wrong) for wrong in (None, 'tool.x', [1])),
                *((name, [None]) for name in ('more', 'held_out', 'separations', 'effects')),
                *(('largest_length', wrong) for wrong in (None, 'a', np.nan, True)),
                ('largest_error', np.nan),
                ('folds', 2.5),
            ]
        ),
        *(
            partial(calib_ros.Settings, **wrong)
            for wrong in ({'folds': 2.5}, {'fixed': 'tool.x'}, {'sigma_pixel': 'a'})
        ),
        *(
            partial(calib_ros.verify, ARM, **{'sets': [SEEN], 'tolerance': 1e-3, **wrong})
            for wrong in ({'tolerance': 'a'}, {'tolerance': np.nan}, {'sets': [1]})
        ),
        *(
            partial(calib_ros.plan, DESIGN, **{**PLANNED, **wrong})
            for wrong in (
                *({'candidates': each} for each in (*NOT_NUMBERS, JOINTS * np.nan, JOINTS[:0])),
                *({'task': each} for each in (JOINTS * np.nan, JOINTS[:0], None)),
                *({'velocities': each} for each in ([1.0], np.zeros(6), np.full(6, np.nan))),
                *({'count': each} for each in (2.5, 'a', None)),
                {'apart': np.nan},
            )
        ),
        *(partial(calib_ros.compensate, CORRECTED, wrong) for wrong in NOT_NUMBERS),
        *(partial(CHAIN.forward, wrong) for wrong in NOT_NUMBERS),
        *(partial(calib_ros.Observations.touching, wrong) for wrong in (*NOT_NUMBERS, None)),
        *(
            partial(
                calib_ros.Observations.from_pixels, JOINTS, JOINTS[:, :2], JOINTS[:, :3], wrong
            )
            for wrong in (None, JOINTS[:, 0])
        ),
        partial(Design.of, PROBLEM, PROBLEM),
        partial(calib_ros.load_calibration, 3),
        partial(calib_ros.load_chain, None),
        partial(calib_ros.identify_model, PROBLEM, None),
        partial(calib_ros.Calibration.of, RESULT, fitted=SEEN),
        partial(calib_ros.recalibrate, ARM, PROBLEM, np.nan),
        partial(calib_ros.Compensator, CHAIN, CHAIN, tool=None),
    ],
)
def test_what_cannot_be_used_is_refused_with_an_error_of_ours(call):
    with pytest.raises(calib_ros.CalibrationError):
        call()


def test_settings_at_the_edge_are_taken():
    edge = {'max_gap': 1e-6, 'joint_buffer': 2, 'pose_buffer': 1, 'folds': 2}
    assert calib_ros.Settings(**edge).folds == 2


def test_an_argument_that_is_missing_is_told_as_python_does():
    with pytest.raises(TypeError, match=r'identify\(\) missing 1 required'):
        calib_ros.identify()


def test_lists_for_arrays_and_integers_for_numbers_are_taken():
    found = calib_ros.plan(DESIGN, **PLANNED | {'candidates': JOINTS[:40].tolist(), 'apart': 0})
    assert np.array_equal(found.joints, calib_ros.plan(DESIGN, **PLANNED | {'apart': 0}).joints)


def test_a_problem_does_not_follow_a_list_that_changes():
    fixed = ['elbow_joint.a']
    problem = calib_ros.Problem(CHAIN, SEEN, fixed=fixed)
    fixed.append('*')
    assert problem.fixed == ('elbow_joint.a',)


def test_a_result_is_a_data_frame():
    frame = RESULT.to_frame()
    assert list(frame['parameter']) == [p.name for p in RESULT.parameters]
    assert frame['offset'].isna().sum() == 12  # base and tool are placed, not off
    assert frame['std'].isna().sum() == sum(p.std is None for p in RESULT.parameters)
    residuals = RESULT.fitted.to_frame()
    assert len(residuals) == 200
    found = plan(Design.of(PROBLEM), JOINTS, JOINTS[:20], 12)
    values = found.to_frame()
    expected = np.column_stack([found.visit + 1, found.joints[found.visit]])
    np.testing.assert_array_equal(values, expected)


def test_without_pandas_that_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(calib_ros.CalibrationError, match='pip install pandas'):
        RESULT.to_frame()


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (0.0, '0.000'),
        (0.00123, '0.0012'),
        (1.6e-13, '0.000'),
        (28.17194, '28.172'),
        (281.7194, '281.7'),
        (999.96, '1000'),
        (127275.477, '127,275'),
        (1210.0, '1210'),
    ],
)
def test_numbers_have_the_digits_that_a_reader_needs(value, text):
    assert rounded(value) == rounded(np.float64(value)) == text
    assert rounded(-value).lstrip('-') == text
    assert rounded(value, '+') == f'+{text}'
    assert interval_mm(value, value) == f'{text} to {text}'


def test_two_digits_have_no_power_of_ten():
    assert [*map(two_digits, (0.8412, 8.412, 151.0))] == ['0.84', '8.4', '150']


def test_a_notebook_shows_the_verdict_and_its_reasons():
    refused = replace(RESULT, refusals=(Reason(Rule.GAIN, 'no <b>gain'),))
    assert 'accepted</strong>' in RESULT._repr_html_()
    (arm,) = (p for p in RESULT.parameters if p.name == 'elbow_joint.a')
    assert f'{1e3 * arm.half_width():.4f}' in RESULT._repr_html_()
    assert 'base.x' not in RESULT._repr_html_()
    shown = refused._repr_html_()
    assert 'not accepted' in shown
    assert 'no &lt;b&gt;gain' in shown
    assert 'not accepted' in replace(refused, validation=None)._repr_html_()


def test_a_refusal_keeps_its_rule_in_a_copy():
    again = copy.deepcopy(Reason(Rule.GAIN, 'no gain', ' (by 3)'))
    assert (again, again.rule, again.short) == ('no gain (by 3)', Rule.GAIN, 'no gain')


def test_arrays_are_told_by_their_shape():
    assert 'joints=float64[200, 6]' in repr(SEEN)


def test_values_are_frozen_and_those_of_arrays_equal_themselves_alone():
    """Comparison of arrays has no truth value, and what has changed since cannot be a key."""
    found = set()
    for module in pkgutil.walk_packages(calib_ros.__path__, 'calib_ros.'):
        if module.name.split('.')[1] not in (
            'kinematics',
            'estimation',
            'decision',
            'identification',
            'apply',
        ):
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if not (isinstance(value, type) and is_dataclass(value)):
                continue
            found.add(value)
            assert value.__dataclass_params__.frozen, value
            if any('Array' in str(field.type) for field in fields(value)):
                assert value.__eq__ is object.__eq__, value
            if issubclass(value, Shown):
                assert value.__repr__ is Shown.__repr__, value
    assert len(found) > 50


def test_names_of_others_stay_text_in_html():
    robot = calib_ros.Chain('<b>arm</b>', 'standard', CHAIN.joints)
    assert '<b>' not in robot._repr_html_()


@pytest.mark.parametrize(
    ('stamps', 'rows', 'said'),
    [
        ([2, 3, 5, 6, 9], [0, 1, 2, 4], 'lines 2 to 3, 5, 9'),  # another set has line 4
        ([10, 10.5, 11, 12], [0, 1, 3], 'poses 1 to 2, 4'),  # in simulated time
        ([10, 10.5, 11, 12], [3], 'pose 4'),
        ([0, 1, 2], [1], 'pose 2'),
        ([2, 3], [1], 'line 3'),
        ([9, 2, 3], [0, 1, 2], 'lines 9, 2 to 3'),
    ],
)
def test_measurements_are_called_by_their_lines_or_numbers(stamps, rows, said):
    stamps_ns = (1e9 * np.array(stamps)).astype(np.int64)
    assert rows_in_words(rows, stamps_ns) == said


def test_measurements_of_messages_are_called_by_their_times():
    stamps_ns = np.arange(5) * 10**9
    assert rows_in_words([0, 1, 3], stamps_ns, True) == 'poses of 0.000 s to 1.000 s, 3.000 s'
    assert rows_in_words([1], 17 * 10**17 + stamps_ns, True) == (
        'pose of 2023-11-14 22:13:21.000 UTC'
    )
