# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Uses of a calibration for arms with a joint that never moves, or that only couplings move."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from commanded import CELL, missed, regular

from calib_ros import Calibration, Observations, Problem, identify, recalibrate
from calib_ros.apply.both_arms import _match_commands
from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.program import Program, compensate_program
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.errors import InputError
from calib_ros.files.programs import program_of, read_joints
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.chain_file import dump_chain, load_chain
from calib_ros.kinematics.follower import mobility
from calib_ros.kinematics.inverse import solve

IIWA = load_chain('kuka_iiwa14')
HELD = replace(IIWA.joints[2], lower=0.3, upper=0.3)
LOCKED = replace(IIWA, joints=(*IIWA.joints[:2], HELD, *IIWA.joints[3:]))
HAND = 3
PALLETISER = Chain(
    'palletiser',
    'standard',
    (
        Joint('turn', a=0.3, alpha=-np.pi / 2, d=0.8, lower=-3.0, upper=3.0),
        Joint('lower', a=1.1, theta=-np.pi / 2, lower=-0.8, upper=1.5),
        Joint('upper', a=1.2, theta=np.pi / 2, lower=-1.2, upper=1.0),
        Joint('level', a=0.2, alpha=-np.pi / 2, lower=0.0, upper=0.0),
        Joint('wrist', d=0.2, lower=-6.0, upper=6.0),
    ),
    effects=(('level.coupling_lower', -1.0), ('level.coupling_upper', -1.0)),
)
MOVING = [0, 1, 2, 4]


@pytest.fixture
def compensator():
    return Compensator(PALLETISER, faulty(PALLETISER, CELL, np.random.default_rng(3)))


@pytest.fixture
def path():
    """A smooth program of the palletiser, and its velocities."""
    t = np.linspace(0.0, 1.0, 30)
    q = np.column_stack([t, 0.5 * t - 0.3, 0.2 - 0.4 * t, 0.0 * t, 2.0 * t])
    return q, np.gradient(q, t, axis=0)


@pytest.mark.parametrize('wanted', [('--poses', 6), ('--iso9283',)])
def test_a_joint_locked_off_zero_is_planned_where_it_is(run, tmp_path, wanted, hurried):
    """It was refused, as if it had been measured at zero."""
    (tmp_path / 'locked.yaml').write_text(dump_chain(LOCKED))
    status, _, err = run('plan', '--chain', 'locked.yaml', *wanted, '--out', 'plan.csv')
    assert (status, err) == (0, '')
    assert (read_joints(tmp_path / 'plan.csv', LOCKED)[:, 2] == HELD.lower).all()


def test_a_locked_joint_does_not_count_as_moving(rng):
    assert mobility(LOCKED)[0] == 6
    small = tuple(replace(each, a=0.01 * each.a, d=0.01 * each.d) for each in PALLETISER.joints)
    assert mobility(PALLETISER) == mobility(replace(PALLETISER, joints=small)) == (4, 3, 1)
    q = LOCKED.random_joints(100, rng)
    found = solve(LOCKED, LOCKED.forward(q), q + rng.normal(scale=0.03, size=q.shape))
    assert found.converged.mean() > 0.97
    np.testing.assert_array_equal(found.joints[:, 2], 0.3)


def test_an_arm_with_a_locked_joint_is_corrected_with_its_velocities(rng):
    true = faulty(LOCKED, CELL, rng)
    compensator = Compensator(LOCKED, true)
    q = regular(replace(LOCKED, joints=IIWA.joints), 100)
    q[:, 2] = 0.3
    program = Program(LOCKED.joint_names, q, velocities=0.1 * np.ones_like(q))
    _, result = compensate_program(compensator, program)
    kept = ~np.isnan(result.joints).any(axis=1)
    assert kept.mean() > 0.9
    assert missed(compensator, q[kept], result.joints[kept]).max() < 1e-6
    np.testing.assert_array_equal(result.joints[kept, 2], 0.3)


def test_what_is_commanded_of_a_coupled_joint_does_not_count(compensator, path):
    q, velocities = path
    expected = compensate(compensator, q).joints
    assert missed(compensator, q, expected)[0].max() < 1e-6
    told = q.copy()
    told[:, HAND] = -q[:, 1] - q[:, 2]
    for names, columns in ((PALLETISER.joint_names, slice(None)), (MOVING, MOVING)):
        names = [PALLETISER.joint_names[k] if isinstance(k, int) else k for k in names]
        program = Program(tuple(names), told[:, columns], velocities[:, columns])
        corrected, result = compensate_program(compensator, program)
        assert not result.refusals
        moved = corrected.positions[:, [names.index(PALLETISER.joint_names[k]) for k in MOVING]]
        np.testing.assert_allclose(moved, expected[:, MOVING], rtol=0.0, atol=1e-12)
        assert corrected.velocities.shape == program.velocities.shape
        if len(names) == 5:
            np.testing.assert_array_equal(corrected.positions[:, HAND], told[:, HAND])


def test_measurements_find_their_command_whatever_is_reported_of_it(compensator, path):
    q, _ = path
    measured = compensate(compensator, q).joints.copy()
    measured[:, HAND] = -q[:, 1] - q[:, 2]
    seen = Observations.from_arrays(measured, np.zeros((len(q), 3)))
    commanded, corrected = _match_commands(PALLETISER, compensator.calibrated, seen, q)
    np.testing.assert_array_equal(commanded, q)
    assert corrected.all()


def test_tables_need_not_have_held_joints(tmp_path, path):
    file = tmp_path / 'program.csv'
    file.write_text('q1,q2,q3,q5,s1,s2,s3,s5,label\n0.1,0.2,0.3,0.4,1,-1,0,1,pick\n')
    np.testing.assert_array_equal(read_joints(file, PALLETISER), [[0.1, 0.2, 0.3, 0.0, 0.4]])
    source = program_of(file, PALLETISER)
    assert source.program.names == ('turn', 'lower', 'upper', 'wrist')
    np.testing.assert_array_equal(source.program.approach, [[1.0, -1.0, 0.0, 0.0, 1.0]])
    moved = replace(source.program, positions=source.program.positions + 1.0)
    assert source.text_with(moved).splitlines()[1] == '1.1,1.2,1.3,1.4,1,-1,0,1,pick'
    file.write_text('q1,q2,q5\n0.1,0.2,0.4\n')
    with pytest.raises(InputError, match='q3'):
        read_joints(file, PALLETISER)


def test_tables_of_measurements_need_not_have_coupled_joints(run, tmp_path):
    (tmp_path / 'arm.yaml').write_text(dump_chain(PALLETISER))
    file = tmp_path / 'measured.csv'
    for q in ('q1,q2,q3,q5', 'turn,lower,upper,wrist'):
        file.write_text(f'{q},x,y,z\n0.1,0.2,0.3,0.4,1,2,3\n')
        args = ('--chain', 'arm.yaml', '--out', 'read.csv', '--force')
        assert run('import', 'measured.csv', *args)[0] == 0
        row = next(csv.DictReader((tmp_path / 'read.csv').read_text().splitlines()))
        assert [float(row[f'q{k}']) for k in range(1, 6)] == [0.1, 0.2, 0.3, 0.0, 0.4]


def test_a_command_that_moves_a_locked_joint_is_refused(rng):
    q = LOCKED.random_joints(1, rng)
    q[0, 2] = 0.31
    (refusal,) = compensate(Compensator(LOCKED, LOCKED), q).refusals
    assert 'the command 0.31 of' in refusal.reason


@pytest.mark.parametrize(('seed', 'oriented'), [(0, True), (1, False)])
def test_heights_of_a_new_device_and_target_of_a_level_hand_are_not_asked_for(seed, oriented):
    """Couplings fitted to noise keep it not quite level: no number of poses was enough."""
    rng = np.random.default_rng(seed)
    true = faulty(PALLETISER, Cell(angle_error=3e-4), rng)
    true = replace(true, effects=PALLETISER.effects)
    known = replace(PALLETISER, base=None, tool=replace(true.tool, fixed=False))

    def seen(now, count):
        q = PALLETISER.random_joints(count, rng)
        measured = measure(now, q, rng, 5e-5, 1e-4, oriented=oriented)
        return Problem(known, measured, sigma_position=5e-5, sigma_orientation=1e-4)

    previous = Calibration.of(identify(seen(true, 60)))
    new = {'base': random_frame(rng, 2.0), 'tool': random_frame(rng, 0.2)}
    found = recalibrate(previous, seen(replace(true, **new), 12), 0.1, new=(*new,))
    assert (found.accepted, found.changed) == (True, ())


def test_without_a_joint_that_moves_nothing_is_planned(run, tmp_path):
    """It asked for more candidates apart from each other."""
    joints = tuple(replace(joint, lower=0.1, upper=0.1) for joint in IIWA.joints)
    (tmp_path / 'still.yaml').write_text(dump_chain(replace(IIWA, joints=joints)))
    status, _, told = run('plan', '--chain', 'still.yaml')
    assert (status, 'no joint can move: the limits of each are equal' in told) == (1, True)
