# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From test poses to the verdict on the command line."""

import numpy as np
import pytest
from designs import design_of
from verified import UR, measured

from calib_ros.apply.candidates import Visibility
from calib_ros.apply.verification import verify
from calib_ros.cli.main import main
from calib_ros.cli.options import Status
from calib_ros.files.layouts import joint_columns
from calib_ros.files.programs import csv_of, joints_csv, read_joints
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.se3 import to_quat
from calib_ros.report.verdicts import in_words


@pytest.fixture
def folder(cell, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'result').mkdir()
    (tmp_path / 'result' / 'calibration.yaml').write_text(
        Calibration.of(cell[1], fitted=[cell[2]]).dump()
    )
    return tmp_path


def write_table(path, seen):
    columns = (*joint_columns(6), 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw')
    values = np.column_stack([seen.joints, seen.positions, to_quat(seen.rotations)])
    path.write_text(csv_of(columns, values))


def test_the_whole_way_from_test_poses_to_the_verdict(cell, folder, capsys):
    """Plan the test poses, correct them, measure the real arm there, and judge."""
    true = cell[0]
    assert main(['plan', '--chain', 'ur10e', '--iso9283', '--out', 'tests.csv']) == 0
    assert 'P1 to P5 of ISO 9283 in a cube of' in capsys.readouterr().out
    correct = ['compensate', 'tests.csv', '--chain', 'ur10e', '--out', 'corrected.csv']
    assert main([*correct, '--calibration', 'result/calibration.yaml']) == 0
    capsys.readouterr()
    write_table(folder / 'measured.csv', measured(true, read_joints(folder / 'corrected.csv', UR)))
    judge = ['verify', 'measured.csv', '--commanded', 'tests.csv', '--chain', 'ur10e']
    judge.append('--calibration')
    for calibration in ('result', 'result/calibration.yaml'):
        assert main([*judge, calibration, '--new-tool', '--new-base']) == 1
        assert 'at least 8 are needed' in capsys.readouterr().err
        for tolerance, status, word in (('1', 0, 'PASS'), ('0.01', Status.NOT_ACCEPTED, 'FAIL')):
            assert main([*judge, calibration, '--tolerance', tolerance]) == status
            out = capsys.readouterr().out
            assert out.startswith(f'{word}: ')
            assert 'poses like these   RMS 0.' in out
            assert 'about the calibration' not in out
            assert '15 times at 5 poses' in out
            assert len([line for line in out.splitlines() if line[:6].strip().isdigit()]) == 5
    judge[judge.index('tests.csv')] = 'corrected.csv'
    assert main([*judge, 'result', '--tolerance', '1']) == Status.NOT_ACCEPTED
    out = ' '.join(capsys.readouterr().out.split())
    assert 'give the program as it was before calib_ros compensate' in out


def test_an_arm_without_correction_passes_only_with_a_remark(cell, folder, capsys):
    """Its joint values tell of the calibration alone."""
    q = UR.random_joints(8, np.random.default_rng(3))
    (folder / 'program.csv').write_text(joints_csv(q))
    write_table(folder / 'measured.csv', measured(cell[0], q))
    common = ['verify', 'measured.csv', '--chain', 'ur10e', '--calibration', 'result']
    common += ['--tolerance', '1']
    assert main(common) == 0
    assert 'this judges the calibration' in ' '.join(capsys.readouterr().out.split())
    assert main([*common, '--commanded', 'program.csv']) == Status.NOT_ACCEPTED
    assert 'this judges the calibration' not in capsys.readouterr().out


@pytest.mark.parametrize(
    ('table', 'calibration', 'said'),
    [
        ('none.csv', 'result', 'cannot read none.csv'),
        ('measured.csv', 'missing', 'there is no calibration at missing'),
    ],
)
def test_verify_needs_what_it_is_given(folder, capsys, table, calibration, said):
    given = ['verify', table, '--chain', 'ur10e', '--calibration', calibration]
    assert main([*given, '--tolerance', '1']) == 1
    assert said in capsys.readouterr().err


def test_plan_writes_test_poses_that_are_seen(folder, capsys):
    common = ['plan', '--chain', 'ur10e', '--iso9283', '--out', 'tests.csv']
    box = ['--box', '0.2', '-0.5', '0.2', '1', '0.5', '1', '--tracker', '3', '0', '1']
    assert main([*common, *box]) == 0
    joints = read_joints(folder / 'tests.csv', UR)
    seen = Visibility(np.array([[0.2, -0.5, 0.2], [1.0, 0.5, 1.0]]), np.array([3.0, 0.0, 1.0]))
    assert seen.sees(design_of(UR), joints).all()
    assert joints_csv(joints) == (folder / 'tests.csv').read_text()


def test_measurements_that_were_fitted_prove_nothing(cell, arm, folder, capsys):
    """They cannot pass, and the screen and the report say why."""
    true, _, fitted = cell
    new = measured(true, UR.random_joints(40, np.random.default_rng(5)), 1)
    half = verify(arm, [fitted, new], 5e-4)
    assert half.reused == 0.5
    assert '\n50 % of these are measurements to which the calibration was fitted' in in_words(half)
    assert verify(arm, [new], 5e-4).reused == 0.0
    for name, seen, warned in (('fitted', fitted, True), ('new', new, False)):
        write_table(folder / f'{name}.csv', seen)
        judge = ['verify', f'{name}.csv', '--chain', 'ur10e', '--calibration', 'result']
        assert main([*judge, '--tolerance', '1', '--out', name]) == (3 if warned else 0)
        files = [folder / name / each for each in ('report.html', 'verification.txt')]
        for text in (capsys.readouterr().out, *(file.read_text() for file in files)):
            assert ('to which the calibration was fitted' in ' '.join(text.split())) is warned
            assert ('PASS: the calibration' in text or 'PASS: the RMS' in text) is not warned
