# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved during the session, in whole sentences."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, UR10E, arm

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision import steps
from calib_ros.decision.moved import (
    ASIDE,
    BEFORE_THAT,
    FROM_THERE,
    IF_IN_ORDER,
    Step,
    looks_alike,
    name_of,
    place_of,
    thing_of,
)
from calib_ros.decision.reasons import Rule
from calib_ros.decision.steps import find_step
from calib_ros.estimation import fitting

AGAIN = ', measure again after ~/clear'
SIZE = 1.234e-3
FRAME = Step(('base',), 'base', 'the device', 0, 4, 0, SIZE, 'm', 0.3, '', 'row 5')
JOINT = replace(FRAME, owners=('elbow_joint',), kind='joint', thing='the joint', unit='rad')
LOAD = replace(FRAME, owners=('the load',), kind='load', thing='the load of the arm')
WIRES = {'wire': 2e-3, 'other': -1e-3}
LATER = replace(FRAME, where=f'line 9{IF_IN_ORDER}'), replace(FRAME, size=-2e-3, where='line 20')
ZERO = replace(FRAME, owners=('wire',), kind='zero', thing='the device', longer=WIRES)


@pytest.mark.parametrize(
    ('step', 'said', 'told'),
    [
        (
            FRAME,
            'the device moved by 1.2 mm (base) before row 5',
            f'base moved by 1.2 mm before pose 7{AGAIN}',
        ),
        (
            replace(FRAME, unused=FROM_THERE),
            'the device moved by 1.2 mm (base) before row 5; measurements from there on carry no '
            'weight: base is outdated, measure again',
            f'base moved by 1.2 mm before pose 7 and is outdated{AGAIN}',
        ),
        (
            replace(FRAME, unused=BEFORE_THAT, owners=('base', 'base_b')),
            'the device moved by 1.2 mm (base, base_b) before row 5; measurements before that '
            'carry no weight',
            'base, base_b moved by 1.2 mm before pose 7',
        ),
        (
            replace(FRAME, slow=True, longer=WIRES, unused=FROM_THERE),
            'the device seems to have moved slowly, by 1.2 mm over the session (base); if the '
            'poses follow an order, arm errors may look like this: mix them; measurements from '
            'there on carry no weight',
            'base seems to move slowly, by 1.2 mm in all: mix the order of poses',
        ),
        (
            replace(FRAME, apart=True),
            'the device moved by 1.2 mm (base) before row 5; arm errors may look like this, as '
            'poses before and after lie apart: mix them',
            f'base moved by 1.2 mm before pose 7{AGAIN}',
        ),
        (
            replace(FRAME, apart=True, turned='a'),
            'the device moved by 1.2 mm (base) before row 5; errors of a may look so, as it moved '
            'just there: mix poses',
            f'base moved by 1.2 mm before pose 7{AGAIN}',
        ),
        (
            JOINT,
            'the zero of elbow_joint moved by 1.2 mrad before row 5',
            f'the zero of elbow_joint moved by 1.2 mrad before pose 7{AGAIN}',
        ),
        (
            replace(JOINT, slow=True),
            'the zero of elbow_joint seems to have moved slowly, by 1.2 mrad over the session; '
            'the correction is now off by half of that: see why, and measure again; if the poses '
            'follow an order, arm errors may look like this: mix them',
            'the zero of elbow_joint seems to move slowly, by 1.2 mrad in all: mix the order of '
            'poses',
        ),
        (
            replace(JOINT, slow=True, spoils=True),
            'the zero of elbow_joint seems to have moved slowly, by 1.2 mrad over the session; '
            'the correction is now off by half of that: see why, and measure again; if the poses '
            'follow an order, arm errors may look like this: mix them',
            f'the zero of elbow_joint seems to move slowly, by 1.2 mrad in all: see why{AGAIN}',
        ),
        (
            LOAD,
            'the load of the arm changed before row 5: poses differ by 1.2 mm; measure with one '
            'load, or fit only the poses before or only those after',
            f'the load of the arm changed before pose 7{AGAIN}',
        ),
        (
            ZERO,
            'the zero of wire moved by 1.2 mm before row 5; subtract 2 mm from the distances of '
            'wire and add 1 mm to the distances of other from there on',
            f'the zero of wire moved by 1.2 mm before pose 7{AGAIN}',
        ),
        (
            replace(ZERO, unused=BEFORE_THAT),
            'the zero of wire moved by 1.2 mm before row 5; measurements before that carry no '
            'weight; add 2 mm to the distances of wire and subtract 1 mm from the distances of '
            'other before that',
            'the zero of wire moved by 1.2 mm before pose 7',
        ),
        (
            replace(FRAME, where=f'line 5{IF_IN_ORDER}', later=LATER, unused=ASIDE),
            'the device moved by 1.2 mm (base) before line 5, by 1.2 mm before line 9, by -2 mm '
            'before line 20 (if rows are in the order of measurement); measurements with it '
            'elsewhere carry no weight; if these are several devices, name each (column device, '
            'or sources)',
            'base moved by 1.2 mm before pose 7 and later again',
        ),
        (
            replace(FRAME, kind='tool', later=LATER[1:]),
            'the device moved by 1.2 mm (base) before row 5, by -2 mm before line 20; if these '
            'are several targets, name each (column target, or sources)',
            f'base moved by 1.2 mm before pose 7 and later again{AGAIN}',
        ),
        (
            replace(JOINT, size=-SIZE, later=LATER[1:]),
            'the zero of elbow_joint moved by -1.2 mrad before row 5, by -2 mm before line 20',
            f'the zero of elbow_joint moved by -1.2 mrad before pose 7 and later again{AGAIN}',
        ),
        (
            replace(JOINT, size=-SIZE),
            'the zero of elbow_joint moved by 1.2 mrad before row 5',
            f'the zero of elbow_joint moved by 1.2 mrad before pose 7{AGAIN}',
        ),
        (
            replace(JOINT, instead='the target turned', unused=BEFORE_THAT),
            'the zero of elbow_joint moved by 1.2 mrad before row 5; or the target turned; '
            'measurements before that carry no weight',
            f'the zero of elbow_joint moved by 1.2 mrad before pose 7{AGAIN}',
        ),
        (
            replace(JOINT, size=4.712),
            'the zero of elbow_joint moved by 90° before row 5',
            f'the zero of elbow_joint moved by 90° before pose 7{AGAIN}',
        ),
        (
            replace(LOAD, later=LATER[:1]),
            'the load of the arm changed before row 5, before line 9: poses differ by 1.2 mm; '
            'measure with one load, or fit only the poses before or only those after',
            f'the load of the arm changed before pose 7{AGAIN}',
        ),
    ],
)
def test_what_moved_is_told(step, said, told):
    assert str(step) == said
    assert step.told(7) == told
    rule = Rule.ENCODER if step.kind == 'joint' else Rule.MOVED
    assert step.reason.rule is rule
    assert step.reason.short == said.split(';')[0].split(':')[0]
    assert step.harmful == (AGAIN in told and not step.outdated)


@pytest.mark.parametrize(('owners', 'are'), [(('tool',), 'is'), (('tool', 'tool_b'), 'are')])
def test_a_frame_held_in_the_wrong_place_is_told(owners, are):
    reason = replace(FRAME, owners=owners, kind='tool', held=True).reason
    assert reason.rule is Rule.MISTAKE
    said = f'the {", ".join(owners)} held by the chain file {are} off by 1.2 mm: '
    assert reason == f'{said}correct it, or remove fixed: true there'


def test_several_zeros_are_of_the_arm():
    step = replace(JOINT, kind='joints', thing='the zeros of several joints')
    assert (
        step.reason == 'the zeros of several joints changed before row 5: poses differ by 1.2 mrad'
    )
    assert step.reason.rule is Rule.ENCODER
    assert replace(step, unused=FROM_THERE).harmful


@pytest.mark.parametrize(
    ('joint', 'instead'),
    [
        (0, "the measuring device or the robot's foot turned about the axis of this joint"),
        (2, ''),
        (5, 'the target turned about the axis of this joint'),
    ],
)
def test_the_zero_of_an_end_joint_is_named_with_what_looks_alike(joint, instead):
    """A target that turned on its flange "was" a joint that lost its zero."""
    rng = np.random.default_rng(2)
    true, q = arm(rng), UR10E.random_joints(30, rng)
    slipped = q + 5e-3 * np.outer(np.arange(30) >= 18, np.arange(6) == joint)
    seen = replace(measure(true, slipped, rng, *NOISE), joints=q)
    step = find_step(fitting.fit(Problem(UR10E, seen, **SIGMAS)))
    assert (step.what, step.instead) == (UR10E.joint_names[joint], instead)


@pytest.mark.parametrize(('seed', 'sample'), [(3, 19), (31, 22)])
def test_a_foot_that_bends_seems_to_move_near_where_poses_lie_apart(seed, sample):
    """Three Panda arms, measured in front and then behind: their foot "moved by 2 mm"."""
    rng, last = np.random.default_rng(seed), np.arange(26) >= 20
    true = arm(rng)
    q = UR10E.random_joints(26, rng)
    q[:, 1] = np.where(last, -2.6, -1.6) + rng.uniform(-0.25, 0.25, 26)
    q[:, 0] = np.where(last, 2.4, 0.4) + rng.uniform(-0.4, 0.4, 26)
    seen = measure(true, q, rng, *NOISE, oriented=False)
    tilt = np.outer(3e-3 * true.forward(q)[:, 0, 3], [0, 1, 0])
    bent = replace(seen, positions=seen.positions + np.cross(tilt, seen.positions))
    step = find_step(fitting.fit(Problem(UR10E, bent, **SIGMAS)))
    assert (step.kind, step.sample) == ('base', sample)
    assert 'poses before and after lie apart' in str(step)


@pytest.mark.parametrize(
    ('slip', 'said'), [(True, 'the zero of elbow'), (False, 'one arm does not fit all sessions')]
)
def test_another_robot_is_no_joint_that_slipped_between_two_sessions(slip, said):
    """Three Panda arms in one table: "a joint lost its zero while you measured"."""
    rng = np.random.default_rng(2)
    true = arm(rng)
    other = true.with_offsets({'elbow_joint.theta': 5e-3}) if slip else arm(102)
    first, second = (
        measure(each, UR10E.random_joints(40, rng), rng, *NOISE, oriented=False)
        for each in (true, other)
    )
    late = second.stamps_ns + 10**12
    second = replace(second, base='base_two', tool='tool_two', stamps_ns=late)
    result = identify(Problem(UR10E, first, more=(second,), **SIGMAS))
    assert result.step.kind.startswith('joint')
    assert said in result.refusals[0]


def test_a_move_whose_size_hardly_shows_is_not_told():
    """Of a device that was frozen at six stops: "the device moved by 0 mm (base)"."""
    fr3, rng = load_chain('franka_fr3'), np.random.default_rng(4)
    true = faulty(fr3, Cell(), rng)
    seen = measure(true, true.random_joints(36, rng), rng, 2e-5, 1e-4, oriented=False)
    last = [*range(16), *[15] * 5, *range(21, 36)]
    frozen = replace(seen, positions=seen.positions[last])
    assert find_step(fitting.fit(Problem(fr3, frozen, sigma_position=2e-5))) is None


def test_a_move_beside_one_whose_size_hardly_shows_is_told(monkeypatch):
    monkeypatch.setattr(steps, '_step_of', lambda scan, found, k: (None, FRAME)[k])
    assert steps._described(None, SimpleNamespace(stops=(3, 9)), False) == FRAME


@pytest.mark.parametrize(
    ('changed', 'device'),
    [
        ({'socket': True}, 'the socket'),
        ({'distances': np.ones(3)}, 'the measuring device, its zero'),
        ({'velocity': np.ones((3, 6))}, 'the measuring device, its clock'),
        ({'distances': np.zeros(3), 'plane': True}, 'the plane'),
    ],
)
def test_what_stands_beside_the_robot_is_named(changed, device):
    seen = replace(Observations.from_arrays(np.zeros((3, 6)), np.zeros((3, 3))), **changed)
    assert thing_of('base', seen) == f"{device} or the robot's foot"
    problem, first = SimpleNamespace(chain=UR10E, sets=[seen]), device.partition(',')[0]
    told = looks_alike(problem, UR10E.joint_names[0])  # no zero, and no clock, turns
    assert told.startswith(f"{first} or the robot's foot turned about the axis")


@pytest.mark.parametrize('changed', [{'inverse': True}, {'on_flange': True}])
def test_what_a_device_on_the_flange_sees_stands_beside_the_robot(changed):
    seen = replace(Observations.from_arrays(np.zeros((3, 6)), np.zeros((3, 3))), **changed)
    assert thing_of('tool', seen) == 'the measuring device'
    assert thing_of('base', seen) == "the target or the robot's foot"
    assert thing_of('base', seen, several=True) == "the targets or the robot's foot"
    assert thing_of('elbow', seen) == 'the joint'


@pytest.mark.parametrize(
    ('stamp', 'more', 'told'),
    [
        (3.5, {}, 'pose 5 of set 2 (stamp 3.500 s)'),
        (1e6, {}, 'pose 5 of set 2 (stamp 1000000.000 s)'),
        (7, {}, 'pose 5 of set 2 (if rows are in the order of measurement)'),
        (8, {}, 'line 8 (if rows are in the order of measurement)'),
        (7, {'of_messages': True}, 'the pose of 7.000 s'),
        (1.7e9, {'of_messages': True}, 'the pose of 2023-11-14 22:13:20.000 UTC'),
    ],
)
def test_the_place_of_a_step_is_told_as_it_is_found(stamp, more, told):
    """In messages by its time: a number within its set was none that an operator counts."""
    q = UR10E.random_joints(6, np.random.default_rng(0))
    stamps = np.full(6, round(1e9 * stamp)) - np.arange(4, -2, -1) * 10**9 * (stamp < 1e6)
    seen = Observations.from_arrays(q, q[:, :3]).at(np.abs(stamps.astype(np.int64)))
    first = seen.at(seen.stamps_ns + 10**11 * (stamp == 8))  # lines of one table
    assert place_of(Problem(UR10E, first, more=(seen.changed(base='b'),), **more), 1, 4) == told


def test_a_held_out_pose_of_arrays_is_told_from_a_fitted_one():
    q = UR10E.random_joints(6, np.random.default_rng(0))
    seen = Observations.from_arrays(q, q[:, :3])
    names = [name_of(Problem(UR10E, seen, seen), number, 4) for number in (0, 1)]
    assert names == ['pose 5', 'held-out pose 5']
