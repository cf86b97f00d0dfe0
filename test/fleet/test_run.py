# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import json
import re
import zipfile
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from unittest.mock import ANY

import plants
import pytest
from distributed import LocalCluster
from fsspec.implementations.local import LocalFileSystem

from calib_ros.errors import ConfigError, InputError
from calib_ros.files.history import History
from calib_ros.files.loading import table
from calib_ros.files.rows import Row
from calib_ros.fleet.cluster import Cluster, LostError, done_tasks, workers_of
from calib_ros.fleet.page import fleet_page
from calib_ros.fleet.plant import Pattern, read_plant
from calib_ros.fleet.results import results, verifications
from calib_ros.fleet.run import Run, run
from calib_ros.fleet.source_files import SourceFile, sources
from calib_ros.fleet.status import statuses
from calib_ros.fleet.tasks import Outcome, Task
from calib_ros.kinematics.chain_file import chain_document, dump_chain, load_chain

CHAIN = json.dumps(chain_document(load_chain('ur10e')))


@pytest.fixture(scope='module')
def cluster():
    with LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as local:
        yield Cluster(local.scheduler_address)


@pytest.fixture
def plant(tmp_path):
    return read_plant(plants.write_plant(tmp_path, ('A', 'B'), 2))


def echoed(task):
    if task.source.url == '150':
        raise RuntimeError('150')  # as dask tells of a worker that has died too often
    return Outcome(error=task.source.url, seconds=0.01)


@pytest.mark.parametrize('filed_before', [False, True])
def test_a_chain_that_cannot_be_read_costs_only_its_robot(plant, cluster, tmp_path, filed_before):
    """It stopped the whole plant."""
    history, path, own = (tmp_path / name for name in ('history', 'plant.yaml', 'own.yaml'))
    text = json.loads(path.read_text())
    text['robots'][1]['chain'] = 'own.yaml'
    path.write_text(json.dumps(text))
    history = History(history)
    if filed_before:
        own.write_text(dump_chain(load_chain('ur10e')))
        run(read_plant(path), history, cluster)
    own.write_text('joints: [')
    found = run(read_plant(path), history, cluster, tmp_path / 'report')
    one, other = statuses(read_plant(path), history, found, 100.0)
    assert (found.filed, other.state) == (0 if filed_before else 2, 'fine')
    assert (one.robot.serial, one.states) == ('B', ('unreadable',))
    assert re.search('own.yaml is not valid YAML.*: correct it, or "chain" in the', *one.unread)
    assert 'own.yaml' in fleet_page(tmp_path / 'report', (one, other), found)
    own.unlink()
    (error,) = run(read_plant(path), history, cluster).errors['B'].values()
    assert 'own.yaml: No such file' in error


def keys(history):
    return {(each, row.key) for each in history.serials() for row in history.rows(each)}


def test_what_is_new_is_done_and_filed_once(plant, cluster, tmp_path):
    history, out = History(tmp_path / 'history'), tmp_path / 'report'
    said = []
    first = run(plant, history, cluster, out, said.append)
    assert (first.filed, first.errors, said[-1]) == (4, {}, 1.0)
    rows = history.rows('A')
    assert [row.time for row in rows] == [plants.when(0), plants.when(1)]
    assert all(row.accepted and row.rms_mm < 0.15 for row in rows)
    pages = {path.stem for path in out.glob('robots/*/*.html')}
    assert pages == {history.rows(each)[-1].key for each in 'AB'}

    there = keys(history)
    nowhere = Cluster('tcp://127.0.0.1:1')  # which is not asked for
    assert run(plant, history, nowhere, out) == Run()

    third = tmp_path / 'nights/A/002.DAT'  # a table, as for identify
    third.write_text(plants.night(*plants.robot(0), 2))
    touched = tmp_path / 'nights/B/001.csv'
    touched.write_bytes(touched.read_bytes())
    assert run(plant, history, cluster, out).filed == 1
    assert len(keys(history) - there) == 1
    (page,) = (out / 'robots/A').iterdir()
    assert page.stem == history.rows('A')[-1].key

    page.unlink()  # or another folder of the report
    assert run(plant, history, cluster, out).filed == 0
    assert page.exists()


def test_a_night_counts_once_whatever_its_file_is_called(plant, cluster, tmp_path, monkeypatch):
    history, out, plant = History(tmp_path / 'history'), tmp_path / 'report', plant[:1]
    first, copy = (tmp_path / f'nights/A/{name}.csv' for name in ('000', '000 copy'))
    copy.write_bytes(first.read_bytes())
    found = run(plant, history, cluster, out)
    assert found.filed == len(keys(history)) == 2
    ((one, other),) = found.copies['A'].items()
    assert {one, other} == {str(first), str(copy)}

    done = []
    monkeypatch.setattr('calib_ros.fleet.tasks.table', lambda *_: done.append(0))
    again = run(plant, history, cluster, out)
    assert (again.copies, again.filed, again.errors, done) == (found.copies, 0, {}, [])
    (status,) = statuses(plant, history, again, 100.0)
    assert status.remarks == (f'{one} has the content of {other}: one night',)
    assert status.state == 'fine'
    assert len(status.watched.nights) == 2

    (tmp_path / 'nights/A/001.csv').rename(tmp_path / 'nights/A/moved.csv')
    assert run(plant, history, cluster, out).copies == found.copies
    assert done == []


def test_the_measurements_of_another_robot_are_told_of(plant, cluster, tmp_path):
    nights = tmp_path / 'nights'
    (nights / 'B' / '001.csv').write_bytes((nights / 'A' / '001.csv').read_bytes())
    history = History(tmp_path / 'history')
    found = statuses(plant, history, run(plant, history, cluster, None), 100.0)
    for each, other in zip(sorted(found, key=lambda one: one.robot.serial), 'BA', strict=True):
        assert 'unreadable' in each.states
        (said,) = each.errors.values()
        assert f'001.csv has the measurements of {other}: only one robot made them' in said
    last = max(history.rows('B'), key=lambda row: row.time)
    assert f'remove {last.key}.parquet' in said
    (nights / 'B' / '001.csv').unlink()
    (tmp_path / f'history/robot=B/{last.key}.parquet').unlink()
    found = statuses(plant, history, run(plant, history, cluster, None), 100.0)
    assert not any(each.errors for each in found)


def test_a_night_counts_once_after_an_upgrade(plant, cluster, tmp_path, monkeypatch):
    history = History(tmp_path / 'history')
    run(plant[:1], history, cluster)
    old = history.rows('A')
    for row in old:
        history.file(replace(row, software='9.9.9', filed=row.filed + timedelta(days=1)))
    assert len(history.rows('A')) == 4
    robot = plant[0]
    assert [row.key for row in results(robot, history.rows('A'))] == [row.key for row in old]
    monkeypatch.setattr('calib_ros.__version__', '9.9.9')
    assert {row.software for row in results(robot, history.rows('A'))} == {'9.9.9'}
    monkeypatch.setattr('calib_ros.__version__', '10')  # whose results are not there yet
    assert {row.software for row in results(robot, history.rows('A'))} == {'9.9.9'}


def test_a_night_whose_file_was_put_right_counts_once(unsearched, plant, cluster, tmp_path):
    plant = plant[:1]
    history, place = History(tmp_path / 'history'), tmp_path / 'nights/A/001.csv'
    right = place.read_text()
    head, *lines = (line.split(',') for line in right.splitlines())
    off = [[*row[:7], *(str(1.05 * float(x)) for x in row[7:10]), *row[10:]] for row in lines]
    place.write_text('\n'.join(','.join(row) for row in (head, *off)))
    found = run(plant, history, cluster)
    assert statuses(plant, history, found, 100.0)[0].state == 'refused'
    place.write_text(right)
    found = run(plant, history, cluster)
    rows = history.rows('A')
    assert [row.time for row in rows] == [plants.when(0), plants.when(1), plants.when(1)]
    for each in (rows, (*rows[:1], *rows[:0:-1])):
        assert [row.verdict for row in results(plant[0], each)] == ['accepted', 'accepted']


def test_sessions_without_stamps_are_nights_and_one_put_right_is_no_other_setting(plant, tmp_path):
    """Both sessions have the date of their table, and so its time."""
    history, robot = History(tmp_path / 'history'), plant[0]
    settings = robot.settings_hash
    about = {'kind': 'identify', 'verdict': 'accepted', 'chain': CHAIN}
    row = Row('A', plants.when(0), '0', settings, 'a#A', **about)
    corrected = replace(row, inputs='1', filed=row.filed + timedelta(hours=1))
    other = replace(row, inputs='2', source='a#B')
    for each in (row, corrected, other):
        history.file(each)
    assert {each.inputs for each in results(robot, history.rows('A'))} == {'1', '2'}
    (status,) = statuses(plant[:1], history, Run(), 100.0)
    assert status.remarks == ()


def test_poses_verified_twice_count_once(plant, tmp_path):
    errors = {'rms_mm': 0.1, 'rms_freedom': 30.0}
    about = {'kind': 'verify', 'verdict': 'holds', 'chain': '{}'}
    row = Row('A', plants.when(0), 'poses', 'settings', **about, **errors)
    others = (
        replace(row, settings='with a tolerance', filed=row.filed + timedelta(days=1)),
        replace(row, chain='[]'),
        replace(row, inputs='other poses'),
        replace(row, kind='validate'),
        replace(row, rms_freedom=None, inputs='others'),
    )
    assert set(verifications((row, *others))) == set(others[:3])


def test_nights_by_other_settings_are_told_of(plant, cluster, tmp_path):
    history = History(tmp_path / 'history')
    run(plant[:1], history, cluster)
    (tmp_path / 'nights/A/000.csv').unlink()
    changed = replace(plant[0], settings=replace(plant[0].settings, folds=4))
    found = run((changed,), history, cluster)
    (status,) = statuses((changed,), history, found, 100.0)
    (remark,) = status.remarks
    assert remark.startswith('nights in the history by other settings or another chain')
    assert 'not compared: 1 (put their files back' in remark
    later = replace(changed, since=plants.when(1))
    assert statuses((later,), history, found, 100.0)[0].remarks == ()


def test_hidden_files_are_no_nights(plant, tmp_path):
    """As rsync has them until a copy is whole, and calib_ros until a bag is."""
    nights = tmp_path / 'nights/A'
    pattern = Pattern(str(nights / '*'))
    expected = [str(path) for path in sorted(nights.iterdir())]
    (nights / '.002.csv').write_text('half a night')
    (nights / '.002.csv.Xy12Za').write_text('half a night')
    (nights / '.bag.partial/bag').mkdir(parents=True)
    (nights / '.bag.partial/bag/001.csv').write_text('half a night')
    for each in (pattern, Pattern(str(nights / '**/*.csv'))):
        found, wrong = sources(replace(plant[0], measured=(each,)))
        assert [source.name for source in found] == expected
        assert wrong == {}
    (own,), _ = sources(replace(plant[0], measured=(Pattern(str(nights / '.002.csv')),)))
    assert own.name == str(nights / '.002.csv')


def test_a_folder_called_as_a_table_is_a_bag(plant, cluster, tmp_path):
    """It was read as a table: Is a directory; a longer recording in it was not seen."""
    folder = tmp_path / 'nights/A/1.csv'
    folder.mkdir()
    inside, marks = folder / 'part.mcap', set()
    robot = replace(plant[0], measured=(Pattern(str(folder)),))
    inside.touch()
    for length in (5, 10):  # the folder keeps its date
        with inside.open('r+b') as file:
            file.write(b'#' * length)
        (found,), _ = sources(robot)
        marks.add(found.fingerprint)
    assert len(marks) == 2
    (error,) = run((robot,), History(tmp_path / 'history'), cluster).errors['A'].values()
    assert '1.csv is not a readable rosbag2 recording' in error


def test_tables_in_an_archive_have_its_dates(plant, tmp_path):
    """Without stamps of its own each was of the moment of its identification, in any order."""
    with zipfile.ZipFile(tmp_path / 'nights.zip', 'w') as archive:
        for name, date in (('a.csv', (2026, 3, 29, 2, 30, 0)), ('b.csv', (1980, 0, 0, 0, 0, 0))):
            archive.writestr(zipfile.ZipInfo(name, date), 'q1')
    url = f'zip://*.csv::file://{tmp_path}/nights.zip'
    found, _ = sources(replace(plant[0], measured=(Pattern(url),)))
    dated = datetime(2026, 3, 29, 2, 30, tzinfo=timezone.utc)
    assert [each.modified for each in found] == [dated, None]


def test_a_fetched_file_is_told_by_its_name_not_that_of_the_copy(plant, cluster, tmp_path):
    head, *rows = plants.night(*plants.robot(0)).splitlines()
    with zipfile.ZipFile(tmp_path / 'nights.zip', 'w') as archive:
        archive.writestr('a.csv', '\n'.join([f'{head},odd', *(f'{row},7' for row in rows)]))
        archive.writestr('b.csv', 'q1\n')
    urls = [f'zip://{name}.csv::file://{tmp_path}/nights.zip' for name in 'ab']
    robot = replace(plant[0], measured=tuple(map(Pattern, urls)))
    history = History(tmp_path / 'history')
    (error,) = run((robot,), history, cluster).errors['A'].values()
    assert error.startswith(f'{urls[1]} has no ')
    (row,) = history.rows('A')
    assert any(said.startswith(f'{urls[0]}: columns not read: odd') for said in row.remarks)


def test_a_store_that_fails_costs_its_pattern_only(plant, tmp_path, monkeypatch):
    (tmp_path / 'nights/A/bag').mkdir()
    known = LocalFileSystem.isdir

    def isdir(files, path):
        if path.endswith('/bag'):
            raise ValueError('throttled')
        return known(files, path)

    monkeypatch.setattr(LocalFileSystem, 'isdir', isdir)
    pattern = str(tmp_path / 'nights/A/*')
    robot = replace(plant[0], measured=(Pattern(pattern), *plant[0].measured))
    found, wrong = sources(robot)
    assert wrong == {pattern: f'{pattern} cannot be listed: throttled'}
    assert found == sources(plant[0])[0]


def test_what_is_damaged_costs_its_robot_only(plant, cluster, tmp_path):
    history = History(tmp_path / 'history')
    bad = tmp_path / 'nights/A/001.csv'
    bad.write_bytes(bad.read_bytes()[:-200] + b'\xff\xfe\n')
    for path in (tmp_path / 'nights/B').iterdir():
        path.unlink()
    first, second = plant
    missing = str(tmp_path / 'archive/*.csv')
    first = replace(first, measured=(Pattern(missing), *first.measured))
    found = run((first, second), history, cluster)
    assert found.filed == 1
    assert found.errors['A'].keys() == {missing, str(bad)}
    assert found.errors['A'][missing] == f'nothing matches {missing}'
    assert str(bad) in found.errors['A'][str(bad)]
    assert found.errors['B'] == {(none := second.measured[0].files): f'nothing matches {none}'}


def test_a_page_that_cannot_be_written_costs_no_result(plant, cluster, tmp_path):
    history, out = History(tmp_path / 'history'), tmp_path / 'report'
    (out / 'robots').mkdir(parents=True)
    (out / 'robots/A').write_text('no folder')
    found = run(plant, history, cluster, out)
    assert found.filed == 4
    (error,) = found.errors['A'].values()
    assert error.startswith('the page of its report: ')
    assert 'robots/A' in error
    (out / 'robots/A').unlink()
    assert run(plant, history, cluster, out) == Run(seconds=ANY)
    assert len(list(out.glob('robots/*/*.html'))) == 2


def test_a_row_that_is_no_more_costs_its_robot_only(plant, cluster, tmp_path):
    history = History(tmp_path / 'history')
    run(plant, history, cluster)
    row = next(tmp_path.glob('history/robot=A/*.parquet'))
    row.write_bytes(row.read_bytes()[:500])
    (tmp_path / 'nights/B/002.csv').write_text(plants.night(*plants.robot(1), 2))
    found = run(plant, history, cluster)
    assert found.filed == 1
    assert row.name in found.errors['A']['']
    first, second = statuses(plant, history, found, 100.0)
    assert (first.robot.serial, first.state, first.last) == ('A', 'unreadable', None)
    assert (second.robot.serial, second.state) == ('B', 'fine')
    for number, rms in enumerate((0.1, 0.1, 0.5)):
        errors = {'rms_mm': rms, 'rms_freedom': 30.0}
        about = {'kind': 'verify', 'verdict': 'holds'}
        history.file(Row('B', plants.when(number), str(number), 's', **about, **errors))
    worst = statuses(plant, history, found, 100.0)[0]
    assert (worst.robot.serial, worst.state) == ('B', 'worse')
    assert worst.alarms == ('2025-10-11: the errors of its verifications have grown',)
    repaired = replace(plant[1], since=plants.when(2))
    assert statuses((repaired,), history, found, 100.0)[0].alarms == ()


def test_a_history_that_cannot_be_read_ends_the_run(plant, tmp_path, monkeypatch):
    def denied(*_, **__):
        raise PermissionError(13, 'Permission denied')

    monkeypatch.setattr('fsspec.implementations.local.LocalFileSystem.ls', denied)
    with pytest.raises(InputError, match=r'history .* cannot be read: .*Permission denied'):
        run(plant, History(tmp_path / 'history'), Cluster())


def test_the_task_that_ends_a_worker_is_found(plant, cluster):
    tasks = [Task(plant[0], SourceFile(str(number))) for number in range(200)]
    with workers_of(cluster) as client:
        done = {task.source.url: found for task, found in done_tasks(client, tasks, echoed)}
    assert len(done) == 200
    assert re.fullmatch(r'its worker ended, .*\(--memory\): 150', done.pop('150').error)
    assert all(outcome.error == url for url, outcome in done.items())


def test_a_scheduler_that_dies_is_told_of(plant):
    tasks = [Task(plant[0], SourceFile(str(number))) for number in range(50)]
    local = LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=':0')
    with local, workers_of(Cluster(local.scheduler_address)) as client:
        found = done_tasks(client, tasks, echoed)
        next(found)
        local.close()
        with pytest.raises(LostError, match='results so far are saved; run again'):
            list(found)


def test_faults_of_ours_cost_their_source_only(plant, cluster, tmp_path, monkeypatch):
    history = History(tmp_path / 'history')

    def faulty(path, *rest):
        if path.name == '000.csv':
            raise ZeroDivisionError('by zero')
        return table(path, *rest)

    monkeypatch.setattr('calib_ros.fleet.tasks.table', faulty)
    found = run(plant, history, cluster)
    assert found.filed == 2
    told = [next(iter(each.values())) for each in found.errors.values()]
    assert told == ['ZeroDivisionError: by zero'] * 2


def test_workers_of_another_version_are_refused(plant, cluster, tmp_path, monkeypatch):
    monkeypatch.setattr('calib_ros.fleet.cluster._version', lambda: '0.0.1')
    with pytest.raises(ConfigError, match=r'workers have calib_ros 0\.0\.1'):
        run(plant, History(tmp_path / 'history'), cluster)
