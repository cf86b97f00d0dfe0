# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from types import NoneType

import numpy as np
import pytest
from measured import FIGURES, TEST, TRAIN, TRUE, UR, measured, rows_of, write_csv

from calib_ros import read_table
from calib_ros.apply.simulation import random_frame
from calib_ros.cli.common import SETTINGS, Status
from calib_ros.cli.identify import RESULT_FILES
from calib_ros.cli.main import main
from calib_ros.identification.calibration import load_calibration
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import dump_chain, load_chain
from calib_ros.settings import Settings


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Return the folder of a result, written once, and what was printed of it as JSON."""
    folder = tmp_path_factory.mktemp('written')
    table = write_csv(folder / 'cell.csv', rows_of(measured()))
    out, said = folder / 'deep' / 'result', io.StringIO()
    given = ['--csv', str(table), '--chain', 'ur5e', '--out', str(out), '--json']
    with contextlib.redirect_stdout(said):
        assert main(['identify', *given]) == 0
    return out, json.loads(said.getvalue())


def assert_same_result(found, expected, tolerance):
    assert found['parameters'].keys() == expected['parameters'].keys()
    for name, parameter in expected['parameters'].items():
        for key in ('value', 'offset', 'std'):
            assert found['parameters'][name][key] == pytest.approx(parameter[key], abs=tolerance)
    for when in ('before', 'after'):
        assert found['validation'][when] == pytest.approx(
            expected['validation'][when], abs=1e6 * tolerance
        )


def test_json_is_one_document_with_all_the_keys(written):
    out, document = written
    text = (out / 'result.json').read_text()
    assert document == json.loads(text)
    assert text.count('\n') < 200  # a row of the covariance on a line
    found = load_calibration(out, UR)
    lower = [x for row in document['covariance']['lower'] for x in row]
    known = found.covariance[np.tril_indices(30)]
    np.testing.assert_allclose(lower, known, rtol=1e-6, atol=1e-9 * np.max(known))
    assert document['accepted'] is True
    assert document['converged'] is True
    assert document['rank'] == 30
    assert set(document['unidentifiable']) == {
        *(f'shoulder_pan_joint.{kind}' for kind in ('d', 'theta')),
        *(f'wrist_3_joint.{kind}' for kind in ('a', 'alpha', 'd', 'theta')),
    }
    assert document['samples'] == {'samples': TRAIN, 'held_out': TEST, 'sets': 1}
    assert document['parameters'].keys() == set(UR.parameter_names)
    for name, parameter in document['parameters'].items():
        assert isinstance(parameter['value'], float)
        placed = name.startswith(('base.', 'tool.'))
        assert isinstance(parameter['offset'], NoneType if placed else float)
        if name in document['unidentifiable']:
            assert parameter['std'] is None
            assert parameter['offset'] == 0.0
        else:
            assert 0.0 < parameter['std'] < 1e-3
    for when in ('before', 'after'):
        assert document['validation'][when].keys() >= FIGURES
        assert document['validation'][when]['count'] == TEST
    before, after = (document['validation'][when]['rms_mm'] for when in ('before', 'after'))
    assert after < 0.2 < 0.5 < before


def test_the_corrected_chain_is_a_chain_that_predicts(run, written):
    corrected, table = written[0] / 'calibration.yaml', written[0].parents[1] / 'cell.csv'
    q = UR.random_joints(1000, np.random.default_rng(99))
    error = load_chain(corrected).forward(q) - TRUE.forward(q)
    assert np.sqrt((error[:, :3, 3] ** 2).sum(axis=1).mean()) < 1e-4
    assert np.abs(error[:, :3, :3]).max() < 1e-3
    _, out, _ = run('identify', table, '--chain', corrected, '--json')
    before, after = (json.loads(out)['validation'][when]['rms_mm'] for when in ('before', 'after'))
    assert before == pytest.approx(after, abs=1e-4)


@pytest.mark.parametrize(
    ('storage', 'held_out', 'oriented'), [('mcap', TEST, True), ('sqlite3', 0, False)]
)
def test_a_table_and_its_bag_give_the_same(run, tmp_path, storage, held_out, oriented):
    seen, bag = measured(oriented=oriented), tmp_path / 'bag'
    rows = rows_of(seen, held_out)
    table = write_csv(tmp_path / 'cell.csv', rows)
    status, out, err = run('csv2bag', table, bag, '--chain', 'ur5e', '--storage', storage)
    assert (status, err) == (0, '')
    assert f'{TRAIN + TEST - held_out} poses to fit, {held_out} held out' in out
    moves = np.diff(seen.joints, axis=0, prepend=seen.joints[:1])
    shown = np.sign(np.angle(np.exp(1j * moves)))  # by the bag, as the shorter way
    signs = [{f's{k}': each for k, each in enumerate(row, 1)} for row in shown]
    signed = write_csv(tmp_path / 's.csv', [r | s for r, s in zip(rows, signs, strict=True)])
    found = [run('identify', each, '--chain', 'ur5e', '--json') for each in (signed, bag)]
    assert [(status, err) for status, _, err in found] == [(0, '')] * 2
    from_table, from_bag = (json.loads(out) for _, out, _ in found)
    assert_same_result(from_bag, from_table, 1e-9)
    assert from_bag['validation']['by'] == from_table['validation']['by']
    samples = from_bag['samples']
    assert (samples['samples'], samples['held_out']) == (TRAIN + TEST - held_out, held_out)
    assert samples['dropped'] == {}


@pytest.mark.parametrize(
    ('columns', 'cells'),
    [
        ('location,socket', ['A,1'] * 2),
        ('x,y,z,qx,qy,qz,qw', ['1,2,3,0,0,0,1', '1,2,3,,,,']),
        ('x,y,z,device,split', ['1,2,3,A,train', '1,2,3,B,test']),
    ],
)
def test_what_a_bag_cannot_hold_is_not_made_up(run, tmp_path, columns, cells):
    """Positions of a ball in a socket, orientations of poses without, one device of two."""
    rows = [f'{k},0,0,0,0,0,{row}' for k, row in enumerate(cells)]
    table = tmp_path / 'table.csv'
    table.write_text('\n'.join([f'q1,q2,q3,q4,q5,q6,{columns}', *rows]))
    status, _, err = run('csv2bag', table, tmp_path / 'bag', '--chain', 'ur5e')
    assert (status, 'a bag can hold only poses or positions of one' in err) == (1, True)


def test_what_a_bag_leaves_out_is_told(run, tmp_path):
    more = {f's{k}': 1 for k in range(1, 7)}
    more |= {f'c{i}{j}': 1e-8 * (i == j) for i in range(1, 7) for j in range(i, 7)}
    rows = [row | more for row in rows_of(measured(), 0)]
    table = write_csv(tmp_path / 'cell.csv', rows)
    status, _, err = run('csv2bag', table, tmp_path / 'bag', '--chain', 'ur5e')
    told = 'note: the bag has no covariances, signs s1 ... of the table: its result may differ\n'
    assert (status, err) == (0, told)


@pytest.mark.parametrize(('command', 'program'), [('robots', False), ('plan', True)])
def test_a_command_without_a_program_does_not_ask_for_its_first_line(capsys, command, program):
    with pytest.raises(SystemExit):
        main([command, '--angle', 'deg'])
    told = capsys.readouterr().err
    assert ('"--angle"' in told, 'first line of the file' in told) == (True, program)


@pytest.mark.parametrize('name', ['q', 'A'])
def test_a_bag_is_made_of_any_table_that_identify_reads(run, tmp_path, name):
    """With the same options, which its message proposes."""
    header = ';'.join([*(f'{name}{k} [deg]' for k in range(1, 7)), 'X [mm];Y [mm];Z [mm]'])
    (tmp_path / 'table.csv').write_text(f'{header}\n0;90;0;0;0;0;1;2,5;3\n0;0;9;0;0;0;1;2;3\n')
    command = ('csv2bag', 'table.csv', 'bag', '--chain', 'ur5e')
    status, _, err = run(*command)
    assert status == (name != 'q')
    if status:
        assert '--columns' in err
        status, _, err = run(*command, '--columns', 'q*=A*')
    assert (status, 'decimal commas' in err) == (0, True)
    run('bag2csv', 'bag', 'back.csv', '--chain', 'ur5e')
    first = read_table(tmp_path / 'back.csv', 6).fitted[0]
    np.testing.assert_allclose(first.joints[0], [0, np.pi / 2, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(first.positions[0], [1e-3, 2.5e-3, 3e-3], atol=1e-9)


def test_a_simulation_is_repeated_by_its_seed(run, tmp_path):
    truths = {}
    for name, seed in (('a', 1), ('b', 1), ('c', 2)):
        bag = tmp_path / name
        run('simulate', bag, '--chain', 'ur5e', '--poses', 3, '--seed', seed)
        truths[name] = (tmp_path / f'{name}_truth.yaml').read_text()
    assert truths['a'] == truths['b'] != truths['c']


def test_a_simulated_arm_has_the_backlash_of_its_chain(run, tmp_path):
    slack = load_chain('ur10e_on_linear_axis')
    slack = slack.with_effects(['linear_axis_joint.play', 'elbow_joint.backlash'])
    (tmp_path / 'slack.yaml').write_text(dump_chain(slack))
    bag, out = tmp_path / 'bag', tmp_path / 'result'
    run('simulate', bag, '--chain', tmp_path / 'slack.yaml')
    run('identify', bag, '--chain', 'ur10e_on_linear_axis', '--model', 'backlash', '--out', out)
    truth, found = load_chain(tmp_path / 'bag_truth.yaml'), load_chain(out / 'calibration.yaml')
    for name, value in truth.effects:
        assert found.value(name) == pytest.approx(value, abs=5e-5), name
    report = (out / 'report.md').read_text()
    for size in ('prior on 1 parameters of backlash: .* mm', '6 parameters of backlash: .* mrad'):
        assert re.search(size, report)


@pytest.mark.usefixtures('drawn')
def test_demo_shows_the_whole_way(run, tmp_path):
    status, out, err = run('demo', '--poses', 20, '--out', tmp_path / 'demo')
    assert (status, err) == (0, '')
    assert 'Accepted' in out
    assert 'elbow_joint.theta' in out
    there = {path.name for path in (tmp_path / 'demo').iterdir()}
    assert there == {*RESULT_FILES, 'bag', 'bag_truth.yaml'}
    assert (tmp_path / 'demo' / 'before_after.png').read_bytes().startswith(b'\x89PNG')
    status, _, err = run('demo', '--poses', 20, '--out', tmp_path / 'demo')
    assert status == 1
    assert '--force' in err
    for note in ('notes.txt', 'bag/notes.txt'):
        (tmp_path / 'demo' / note).write_text('mine')
    again = run('demo', '--poses', 20, '--out', tmp_path / 'demo', '--force')
    assert again == (0, out, '')
    for note in ('notes.txt', 'bag/notes.txt'):
        assert (tmp_path / 'demo' / note).read_text() == 'mine'


def test_a_calibration_that_is_not_accepted_keeps_the_earlier_one_aside(run, written, tmp_path):
    out = tmp_path / 'out'
    shutil.copytree(written[0], out)
    accepted = (out / 'calibration.yaml').read_bytes()
    worse = write_csv(tmp_path / 'worse.csv', rows_of(measured(UR)))
    arguments = ('identify', '--csv', worse, '--chain', 'ur5e', '--out', out, '--force')
    status, said, _ = run(*arguments)
    assert status == Status.NOT_ACCEPTED == 3
    assert 'Nothing to correct' in said
    assert (out / 'calibration.previous.yaml').read_bytes() == accepted
    there = {path.name for path in out.iterdir()}
    assert there == {*RESULT_FILES, 'calibration.previous.yaml'} - {'calibration.yaml'}
    assert 'no gain on held-out poses' in (out / 'report.md').read_text()


def test_a_damaged_bag_is_refused_or_warns_and_says_so_in_the_report(run, tmp_path):
    bag = tmp_path / 'bag'
    run('simulate', bag, '--chain', 'ur5e', '--poses', 40)
    (file,) = bag.glob('*.mcap')
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    given = ('identify', bag, '--chain', 'ur5e', '--json')
    status, said, _ = run(*given)
    assert status == Status.NOT_ACCEPTED
    refused = json.loads(said)
    assert 'of the messages could not be read' in refused['refusals'][0]
    assert refused['rules'] == ['UNREADABLE']
    status, said, err = run(*given, '--out', tmp_path / 'out', '--largest-loss', '0.5')
    assert status == 0
    assert err.startswith('warning: ')
    assert err.count('\n') == 1
    document = json.loads(said)
    assert document['warnings'] == [err.removeprefix('warning: ').rstrip('\n')]
    assert 15 < document['samples']['samples'] < 40
    assert document['warnings'][0] in (tmp_path / 'out' / 'report.md').read_text()


def test_a_command_is_kept_without_what_logs_in(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr('calib_ros.cli.identify._run', lambda options, _: kept.append(options))
    url = 'memory://user:secret@h/x'
    assert main(['identify', 'a table.csv', '--chain', 'ur10e', '--history', url]) is None
    assert kept[0].typed == "calib_ros identify 'a table.csv' --chain ur10e --history memory://h/x"


def test_the_package_is_a_program_that_reads_a_pipe(table, tmp_path):
    command = [sys.executable, '-m', 'calib_ros', 'import', '-', '--chain', 'ur5e', '--out']
    subprocess.run([*command, tmp_path / 'own.csv'], input=table.read_bytes(), check=True)
    assert len((tmp_path / 'own.csv').read_text().splitlines()) == TRAIN + TEST + 1


def test_tab_completes_options_and_robots(tmp_path):
    pytest.importorskip('argcomplete')
    for line, wanted in (
        ('calib_ros verify --tol', '--tolerance '),
        ('calib_ros plan --chain kuka_i', 'kuka_iiwa14 '),
    ):
        found = tmp_path / 'found'
        environment = {**os.environ, '_ARGCOMPLETE': '1', 'COMP_LINE': line, 'COMP_TYPE': '9'}
        environment |= {'COMP_POINT': str(len(line)), '_ARGCOMPLETE_STDOUT_FILENAME': str(found)}
        command = [sys.executable, '-m', 'calib_ros.cli.main']
        subprocess.run(command, env=environment, check=False, capture_output=True)
        assert found.read_text() == wanted


def test_every_setting_is_in_a_group():
    grouped = [name for names in SETTINGS.values() for name in names]
    assert sorted(grouped) == sorted(item.name for item in fields(Settings))


def seen_by(ends, count, seed, remounted=False):
    """Return rows of a table of the arm, some for each (device, target), wherever these are."""
    rows = []
    for device, target in ends:
        rng = np.random.default_rng([len(device), len(target)])
        frames = {'base': random_frame(rng, 2.0), 'tool': random_frame(rng, 0.1)}
        if remounted:
            frames['tool'] = random_frame(rng, 0.1)
        true = replace(TRUE, **frames)
        made = rows_of(measured(true, count, seed), held_out=0)
        rows += [row | {'device': device, 'target': target} for row in made]
    return rows


@pytest.fixture(scope='module')
def of_two(tmp_path_factory):
    """Return the folder of a calibration by two devices with a target each."""
    folder = tmp_path_factory.mktemp('of_two')
    table = write_csv(folder / 'first.csv', seen_by((LEICA, VICON), 20, 1))
    given = ['identify', str(table), '--chain', 'ur5e', '--out', str(folder / 'result')]
    assert main(given) == 0
    return folder / 'result'


LEICA, VICON = ('leica', 'ball'), ('vicon_2', 'cube')


@pytest.mark.parametrize('ends', [(VICON,), (VICON, LEICA)])
def test_what_each_device_measures_again_is_judged_in_its_own_frame(of_two, run, tmp_path, ends):
    """In whatever order, and without the others: the second was judged in the first one's."""
    write_csv(tmp_path / 'new.csv', seen_by(ends, 10, 2))
    judged = ['new.csv', '--chain', 'ur5e']
    status, out, _ = run('verify', *judged, '--calibration', of_two, '--tolerance', '0.3')
    assert (status, out[:6]) == (0, 'PASS: ')
    of_arm = '--calibration', of_two, '--tolerance', '0.3', '--json', '--out', 'verified'
    status, out, _ = run('verify', *judged, *of_arm)
    told = json.loads(out)
    assert (status, told['verdict'], told['limit_mm'], told['poses']) == (0, 'PASS', 0.3, 10)
    assert told['lower_mm'] < told['rms_mm'] < told['upper_mm'] < 0.3 < told['before']['rms_mm']
    status, out, _ = run('identify', *judged, '--previous', of_two)
    assert (status, out[:8]) == (0, 'Accepted')


@pytest.mark.parametrize('ends', [(VICON,), (VICON, LEICA)])
def test_new_targets_are_those_that_were_measured(of_two, run, tmp_path, ends):
    """To both commands: an update freed the first one's frame alone, measured or not."""
    write_csv(tmp_path / 'new.csv', seen_by(ends, 20, 2, remounted=True))
    judged = ['new.csv', '--chain', 'ur5e', '--new-tool']
    status, out, _ = run('verify', *judged, '--calibration', of_two, '--tolerance', '0.3')
    assert (status, out[:6]) == (0, 'PASS: ')
    status, out, _ = run('identify', *judged, '--previous', of_two, '--json')
    assert (status, json.loads(out)['changed']) == (0, [])


def test_json_of_a_verdict_alone_is_printed_and_has_no_infinity(of_two, run, tmp_path):
    write_csv(tmp_path / 'new.csv', seen_by((LEICA,), 10, 2))
    judged = ['new.csv', '--chain', 'ur5e', '--calibration', of_two, '--json', '--tolerance']
    status, out, _ = run('verify', *judged, '0.001', '--quiet')
    assert (status, json.loads(out)['verdict']) == (3, 'FAIL')
    status, out, _ = run('verify', *judged, '0.3', '--confidence', str(np.nextafter(1.0, 0.0)))
    found = json.loads(out, parse_constant=pytest.fail)
    assert (status, found['verdict'], found['upper_mm']) == (3, 'UNDECIDED', None)
    status, _, err = run('verify', *judged, '0.3', '--sources', '/pose')
    assert (status, '--sources does not apply to a table' in err) == (1, True)


def test_a_device_that_a_calibration_does_not_know_has_no_frame_of_another(of_two, run, tmp_path):
    write_csv(tmp_path / 'new.csv', seen_by((('optitrack', 'ball'), LEICA), 10, 2))
    judged = ['new.csv', '--chain', 'ur5e', '--calibration', of_two]
    status, _, err = run('verify', *judged, '--new-base')
    assert status == 1
    assert 'knows the frames base (leica), tool (ball), base_vicon_2 (vicon_2), ' in err
    assert 'not base (optitrack): name devices and targets as they were' in err


def test_a_loose_target_is_not_blamed_on_the_device_as_well(run, tmp_path):
    moved = se3.transform(np.eye(3), np.full(3, 1.2e-3))
    loose = replace(TRUE, tool=replace(TRUE.tool, matrix=TRUE.tool.matrix @ moved))
    rows = rows_of(measured(), 0)[:20] + rows_of(measured(loose), 0)[20:]
    write_csv(tmp_path / 'cell.csv', rows)
    status, out, _ = run('identify', 'cell.csv', '--chain', 'ur5e')
    assert status == Status.NOT_ACCEPTED
    assert 'Something moved while you measured: the target' in out
    assert 'device noise' not in ' '.join(out.split())


def test_one_gross_pose_leaves_no_doubt_about_the_arm(run, written, tmp_path):
    rows = rows_of(measured(seed=25, count=20), 0)
    rows[7]['x'] += 0.03
    write_csv(tmp_path / 'new.csv', rows)
    given = ('identify', 'new.csv', '--chain', 'ur5e', '--previous', written[0])
    status, out, _ = run(*given)
    assert status == Status.NOT_ACCEPTED
    assert 'Line 9 contradicts all others: without it they would be accepted' in out
    assert 'Perhaps changed' not in out
    write_csv(tmp_path / 'new.csv', rows[:7] + rows[8:])
    assert run(*given)[0] == 0


@pytest.mark.parametrize('moved', [0.0, 2e-3])
def test_an_unchanged_arm_needs_no_other_correction(run, written, tmp_path, moved):
    rows = rows_of(measured(seed=25, count=10), 0)
    for row in rows:
        row['x'] += moved
    write_csv(tmp_path / 'new.csv', rows)
    status, out, _ = run('identify', 'new.csv', '--chain', 'ur5e', '--previous', written[0])
    assert status == 0
    assert ('Changed: base' in out) == (moved > 0.0)
    assert 'its correction stays valid' in ' '.join(out.split())
    assert 'calib_ros export' not in out
