# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import errno
import hashlib
import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import pandas
import plants
import pytest
from distributed import LocalCluster

from calib_ros.cli import identify
from calib_ros.cli.common import Status
from calib_ros.cli.main import main
from calib_ros.files.history import History
from calib_ros.files.rows import Row
from calib_ros.fleet import cluster, results, run as running
from calib_ros.fleet.plant import read_plant

COMMON = ('--chain', 'ur10e', '--history', 'history', '--serial', '0042')


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope='module')
def identified(tmp_path_factory):
    folder = tmp_path_factory.mktemp('identified')
    plants.write_plant(folder, ['0042'], 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(['identify', 'nights/0042/000.csv', *COMMON, '--out', 'result']) == 0
    return folder


@pytest.fixture
def calibrated(folder, identified):
    """Return the folder of a robot of which the first of two nights is identified and filed."""
    return shutil.copytree(identified, folder, dirs_exist_ok=True)


def piped(text):
    """Return the path of a pipe that holds bytes."""
    end, begin = os.pipe()
    os.write(begin, text)
    os.close(begin)
    return f'/dev/fd/{end}'


@pytest.mark.parametrize('command', ['identify', 'verify'])
def test_a_result_is_told_although_its_history_is_full(calibrated, monkeypatch, capsys, command):
    """The verdict was lost with the row, and the report of verify too."""

    def fail(history, row):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), 'history')

    monkeypatch.setattr(History, 'file', fail)
    more = [] if command == 'identify' else ['--calibration', 'result']
    capsys.readouterr()
    assert main([command, 'nights/0042/001.csv', *COMMON, *more, '--out', 'new']) == 1
    out, err = capsys.readouterr()
    assert 'position error' in out
    assert Path('new/report.html').exists()
    (line,) = err.strip().splitlines()[-1:]
    assert line == 'calib_ros: history: the disk is full: make room, or write to another place'


def test_identify_and_verify_are_filed(calibrated, capsys):
    identify = ['identify', 'nights/0042/000.csv', '--out', 'result', '--force']
    assert main([*identify, *COMMON[:4]]) == 1
    assert 'add --serial' in capsys.readouterr().err
    assert main([*identify, *COMMON]) == 0  # once more
    verify = ['verify', 'nights/0042/001.csv', *COMMON, '--calibration', 'result']
    assert [main([*verify, '--tolerance', '0.5']), main(verify)] == [0, 0]
    rows = History('history').rows('0042')
    assert [row.kind for row in rows] == ['identify', 'verify', 'verify']
    assert {row.verdict for row in rows} == {'accepted', 'PASS', 'holds'}
    result = json.loads((calibrated / 'result/result.json').read_text())
    assert rows[0].rms_mm == result['validation']['after']['rms_mm']
    assert rows[0].time == plants.when(0)

    capsys.readouterr()
    assert main(['history', 'history']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert [line.split()[3] for line in lines[1:]] == ['identify', 'verify', 'verify']
    assert main(['history', 'history', '--robot', '42']) == 1
    assert 'did you mean "0042"' in capsys.readouterr().err
    assert main(['history', 'nothing']) == 1

    other = History('history')
    other.file(replace(rows[0], serial='0041'))
    (calibrated / f'history/robot=0041/{other.rows("0041")[0].key}.parquet').write_bytes(b'PAR1')
    assert main(['history', 'history']) == Status.INCOMPLETE
    said = capsys.readouterr()
    assert said.out.splitlines()[1:] == lines[1:]
    assert '0041: ' in said.err
    other.file(replace(rows[0], serial='0040', source='a\x1b[31mb'))
    assert main(['history', 'history', '--robot', '0040']) == 0
    assert 'a?[31mb' in capsys.readouterr().out  # no command to the terminal


def test_nights_that_no_file_keeps_are_filed_all_the_same(folder, monkeypatch):
    """Of pipes the rest was hashed, which is empty; of a file what it was when all was done."""
    plants.write_plant(folder, ['0042'], 2)
    nights = sorted(Path('nights/0042').iterdir())
    for k, night in enumerate(nights):
        pipe = piped(night.read_bytes())
        assert main(['identify', '--csv', pipe, *COMMON, '--out', f'out{k}']) == 0
    assert len(History('history').rows('0042')) == 2
    origin = json.loads(Path('out0/result.json').read_text())['origin']
    assert hashlib.sha256().hexdigest() not in json.dumps(origin)

    identified, growing = identify.identified, Path('growing.csv')
    *rows, last = nights[0].read_text().splitlines(keepends=True)
    growing.write_text(''.join(rows))

    def while_it_grows(*given):
        found = identified(*given)
        growing.write_text(''.join((*rows, last)))
        return found

    with monkeypatch.context() as patch:
        patch.setattr(identify, 'identified', while_it_grows)
        assert main(['identify', str(growing), *COMMON]) == 0
    assert [main(['identify', str(growing), *COMMON]) for _ in range(2)] == [0, 0]
    assert len(History('history').rows('0042')) == 4


@pytest.mark.usefixtures('calibrated')
def test_the_same_table_read_or_judged_in_another_way_is_another_result():
    """A wrong unit stayed on file, and a correction that does not arrive was never filed."""
    table = 'nights/0042/001.csv'
    verify = ['verify', table, *COMMON, '--calibration', 'result', '--tolerance', '0.5']
    assert main([*verify, '--length', 'mm']) == Status.NOT_ACCEPTED
    assert main([*verify, '--length', 'm']) == 0
    assert [main(verify), main(verify)] == [0, 0]  # the second time nothing is new
    assert main([*verify, '--sigma-position', '0.0001']) == 0  # not the earlier device, by chance
    assert main([*verify, '--commanded', table]) == Status.NOT_ACCEPTED
    rows = History('history').rows('0042')[1:]
    assert sorted(row.verdict for row in rows) == ['FAIL', *['PASS'] * 3, 'no verdict']


@pytest.mark.usefixtures('calibrated')
def test_programs_and_logs_through_pipes_make_other_results():
    """They were not part of what was filed, so the second result was taken for the first."""
    table = Path('nights/0042/001.csv')
    verify = [*COMMON, '--calibration', 'result', '--tolerance', '0.5']
    for more in ([], ['--commanded', str(table)]):
        main(['verify', piped(table.read_bytes()), *verify, *more])
    rows = History('history').rows('0042')[1:]
    assert sorted(row.verdict for row in rows) == ['FAIL', 'PASS']

    read = pandas.read_csv(table)
    joints = [name for name in read if name[0] == 'q' and name[1:].isdigit()]
    assert len(joints) == 6
    read.drop(columns=joints).to_csv('poses.csv', index=False)
    for turn in (0.0, 2e-3):  # larger ones make it look for mistakes
        log = (read[['stamp_ns', *joints]] + [0.0, *[turn] * 6]).to_csv(index=False).encode()
        main(['verify', 'poses.csv', '--joints', piped(log), *verify])
    rows = History('history').rows('0042')[3:]
    assert sorted(row.verdict for row in rows) == ['FAIL', 'PASS']


def test_sessions_of_a_table_are_nights_of_their_own(folder):
    """Without stamps both have the time of the table: one was taken for the other, put right."""
    plants.write_plant(folder, ['0042'], 2)
    nights = (pandas.read_csv(f'nights/0042/00{k}.csv').assign(session=k) for k in range(2))
    pandas.concat(nights).drop(columns='stamp_ns').to_csv('both.csv', index=False)
    for session in '01':
        assert main(['identify', 'both.csv', '--session', session, *COMMON]) == 0
    rows = History('history').rows('0042')
    assert [row.source for row in rows] == ['both.csv#0', 'both.csv#1']
    (robot,) = read_plant(Path('plant.yaml'))
    own = [replace(row, settings=robot.settings_hash) for row in rows]
    assert len(results.results(robot, own)) == 2


def test_an_impatient_operator_ends_a_fleet_in_good_order(folder, monkeypatch, capsys):
    plants.write_plant(folder, ['A'], 1)
    ended = []

    def interrupted(*_):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)  # the second one ends nothing
            ended.append('workers')

    monkeypatch.setattr(running, 'run', interrupted)
    before = signal.getsignal(signal.SIGINT)
    assert main(['fleet', 'plant.yaml', '--history', 'history']) == 130
    assert ended == ['workers']
    assert signal.getsignal(signal.SIGINT) is before
    assert capsys.readouterr().err.splitlines() == [
        'note: results so far are saved; the next run continues',
        'calib_ros: interrupted: no half-written file remains',
    ]


def test_a_fleet_with_a_bumped_and_a_damaged_robot(folder, capsys):
    bump = {'B': (2, {'elbow_joint.theta': 2e-4})}
    plants.write_plant(folder, ['A', 'B', '<C>'], 3, 40, bump)
    bad = folder / 'nights/<C>/002.csv'
    bad.write_text(bad.read_text()[:300])
    command = ['fleet', 'plant.yaml', '--history', 'history', '--out', 'report']
    with LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as local:
        command += ['--metrics', 'calib.prom', '--scheduler', local.scheduler_address]
        assert main(command) == Status.NOT_ACCEPTED
    said = capsys.readouterr()
    assert '1 changed, 1 unreadable, 1 fine' in said.out
    assert 'B, 2025-10-11: changed: elbow_joint.theta by +0.' in said.out
    assert '<C>: ' in said.err
    assert '002.csv' in said.err

    text = (folder / 'calib.prom').read_text()
    assert 'calib_ros_fleet_robots{state="changed"} 1\n' in text
    assert 'calib_ros_fleet_unreadable_inputs 1\n' in text
    when = plants.FIRST + 2 * plants.DAY + 39
    assert f'calib_ros_robot_changed_timestamp_seconds{{serial="B"}} {when}\n' in text
    page = (folder / 'report/index.html').read_text()
    assert '&lt;C&gt;' in page
    assert '<C>' not in page
    own = History('history').rows('<C>')[-1]
    link = f'<a href="robots/%253CC%253E/{own.key}.html">&lt;C&gt;</a>'
    assert f'<h3>{link}</h3>' in page
    assert f'<td class="robot">{link}</td>' in page
    robots = (folder / f'report/robots/%3CC%3E/{own.key}.html').read_text()
    assert 'within the tolerance of 0.3\xa0mm RMS' in robots
    assert len(pandas.read_parquet('history')) == 8

    plant = json.loads((folder / 'plant.yaml').read_text())
    plant['groups']['line']['tolerance'] = 0.01
    (folder / 'plant.yaml').write_text(json.dumps(plant))
    quiet = [*command[:-1], 'tcp://127.0.0.1:1', '--quiet']
    bad.unlink()
    assert main(quiet) == Status.NOT_ACCEPTED
    said = capsys.readouterr().out
    assert said.startswith('- B, 2025-10-11: changed: elbow_joint.theta by +0.')
    assert said.count('- B, ') == 2
    for serial in ('A', 'B', '<C>'):
        assert f'- {serial}, beyond tolerance: 0.' in said
    assert said.endswith(' mm, wanted 0.01 mm\n')

    assert main([*quiet, '--metrics', 'none/calib.prom']) == 1  # but alarms are told
    told = capsys.readouterr()
    assert told.out == said
    assert 'none/calib.prom: No such file or directory' in told.err

    plant['groups']['line']['tolerance'] = 0.3
    plant['robots'][1]['since'] = '2025-10-11'
    (folder / 'plant.yaml').write_text(json.dumps(plant))
    command = quiet[:-1]
    assert main(command) == 0
    plant['robots'][1]['measured'] = 'nowhere/*.csv'
    (folder / 'plant.yaml').write_text(json.dumps(plant))
    assert main(command) == Status.INCOMPLETE


def test_robots_are_called_as_in_the_plant_and_each_error_has_its_file(
    folder, monkeypatch, capsys
):
    """'zelle 3' was told as 'Zelle 3', and too few poses without the file that has them."""
    (plant,) = read_plant(plants.write_plant(folder, ['zelle 3'], 0))
    about = {'kind': 'identify', 'verdict': 'refused', 'chain': '{}', 'reasons': ('bad poses',)}
    filed = Row(plant.serial, plants.when(0), 'i', plant.settings_hash, **about)
    History('history').file(filed)
    told = {'few.csv': 'too few poses', 'x.csv': 'x.csv has no rows'}
    done = running.Run(errors={plant.serial: told})
    monkeypatch.setattr(running, 'run', lambda *_: done)
    assert main(['fleet', 'plant.yaml', '--history', 'history']) == Status.NOT_ACCEPTED
    out, err = capsys.readouterr()
    assert '- zelle 3, not accepted: bad poses\n' in out
    assert err == (
        'warning: zelle 3: too few poses (few.csv)\nwarning: zelle 3: x.csv has no rows\n'
    )


def test_memory_that_is_no_size_or_too_small_is_told(folder, capsys):
    plants.write_plant(folder, ['A'], 1)
    for memory in ('abc', '2'):
        command = ['fleet', 'plant.yaml', '--history', 'history', '--workers', '1']
        assert main([*command, '--memory', memory]) == 1
        assert f'no workers at this machine (--memory {memory}): ' in capsys.readouterr().err


def test_what_cannot_be_asked_for(folder, capsys):
    plants.write_plant(folder, ['A'], 0)
    for more, words in (
        (['--years', '0'], '--years must be positive'),
        (['--workers', '-1'], '--workers must be'),
        (['--scheduler', 'tcp://a:1', '--workers', '2'], '--workers does not apply'),
        (['--scheduler', 'tcp://a:1', '--memory', '1GiB'], '--memory does not apply'),
        (['--history', 'nowhere://x'], 'nowhere://x cannot be opened'),
        (['--history', 'plant.yaml'], 'a history must be a folder: plant.yaml is not one'),
    ):
        assert main(['fleet', 'plant.yaml', '--history', 'history', *more]) == 1
        assert words in capsys.readouterr().err


def test_a_scheduler_that_is_lost_is_told_of(folder, capsys, monkeypatch):
    monkeypatch.setattr(cluster, 'ANSWER_S', 0.5)
    plants.write_plant(folder, ['A'], 1)
    command = ['fleet', 'plant.yaml', '--history', 'history', '--scheduler', 'tcp://127.0.0.1:1']
    assert main(command) == 1
    assert not list(folder.glob('history/*'))
    assert 'tcp://127.0.0.1:1' in capsys.readouterr().err
