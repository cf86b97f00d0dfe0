# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from datetime import datetime, timedelta, timezone
from threading import Barrier

import numpy as np
import pandas
import pyarrow.dataset
import pytest
from fits import UR10E as CHAIN, measured_arm

from calib_ros import Problem, Settings, identify
from calib_ros.apply import simulation
from calib_ros.errors import ConfigError, InputError
from calib_ros.files.hashes import samples_hash, settings_hash
from calib_ros.files.history import History
from calib_ros.files.result_rows import result_row
from calib_ros.files.rows import Filing, Row

BEGIN = datetime(2026, 1, 31, 23, 30, 0, 123_456, timezone.utc)


@pytest.fixture(scope='module')
def result():
    return identify(Problem(CHAIN, measured_arm(1, 30)[2]))


def row(k=0, serial='SN 1/ö', **more):
    about = {'inputs': f'{k:064x}', 'settings': 's', 'verdict': 'accepted', 'kind': 'identify'}
    return Row(serial, time=BEGIN + timedelta(days=k), **(about | more))


def test_a_row_comes_back_as_it_was_filed(result, tmp_path):
    settings = settings_hash(CHAIN, Settings())
    filed = result_row(result, Filing('0042', BEGIN, 'i' * 64, settings, 'a.csv', 'f'))
    store = History(tmp_path / 'history')
    assert store.file(filed)
    assert store.serials() == ('0042',)
    (found,) = store.rows('0042')
    for each in fields(Row):
        np.testing.assert_array_equal(getattr(found, each.name), getattr(filed, each.name))
    assert found.accepted
    assert found.rms_mm == result.comparison.figures[1].rms_mm
    assert found.lower_mm < found.rms_mm < found.upper_mm
    np.testing.assert_array_equal(found.covariance, result.covariance)
    joints = CHAIN.random_joints(5, np.random.default_rng(0))
    np.testing.assert_allclose(
        found.corrected().forward(joints), result.chain.forward(joints), atol=1e-12
    )


@pytest.mark.parametrize('where', ['{}', 'file://{}', 'memory://{}'])
def test_the_same_result_is_there_once(tmp_path, where):
    store = History(where.format(tmp_path / 'history'))
    assert [store.file(row(k)) for k in (0, 1, 0)] == [True, True, False]
    again = row(1, filed=BEGIN)
    assert again.key == row(1).key
    assert not store.file(again)
    assert [each.inputs for each in store.rows('SN 1/ö')] == [row(k).inputs for k in (0, 1)]
    if where == '{}':
        parts = [path.name for path in (tmp_path / 'history').rglob('*') if path.is_file()]
        assert sorted(parts) == sorted(f'{row(k).key}.parquet' for k in (0, 1))


def test_whatever_a_result_depends_on_makes_it_another_one():
    known = {row().key, row(1).key, row(kind='verify').key, row(settings='t').key}
    known |= {row(software='0.0.1').key, row(serial='2').key}
    assert len(known) == 6
    settings = [Settings(), Settings(folds=4)]
    nominals = [CHAIN, CHAIN.with_offsets({CHAIN.parameter_names[0]: 1e-3})]
    hashes = {settings_hash(chain, each) for chain in nominals for each in settings}
    assert len(hashes) == 4


def test_pandas_and_arrow_read_it_as_a_plain_dataset(tmp_path):
    store = History(tmp_path)
    for k in range(12):
        names = tuple(f'joint.{number}' for number in range(k))
        fitted = {'names': names, 'offsets': np.arange(k) * 1e-3, 'covariance': np.eye(k)}
        store.file(row(k, '007' if k % 2 else 'B', rms_mm=0.1 * k, **fitted))
    assert len(store.rows('B')) == 6  # makes its cache
    store.file(row(12, 'B'))
    frame = pandas.read_parquet(tmp_path).sort_values('time')
    assert len(frame) == 13
    assert frame.serial.tolist() == ['007' if k % 2 else 'B' for k in range(12)] + ['B']
    assert frame.time.iloc[3] == BEGIN + timedelta(days=3)
    assert frame.rms_mm.iloc[3] == pytest.approx(0.3)
    assert frame.columns.tolist() == ['key', *(each.name for each in fields(Row)), 'robot']
    data = pyarrow.dataset.dataset(tmp_path, partitioning='hive')
    chosen = data.to_table(filter=pyarrow.dataset.field('robot') == 'B')
    assert set(chosen['serial'].to_pylist()) == {'B'}
    assert sorted(len(each) for each in chosen['offsets']) == [0, 0, 2, 4, 6, 8, 10]


def test_what_was_read_before_is_kept_and_never_needed(tmp_path):
    store = History(tmp_path)
    for k in range(8):
        store.file(row(k))
    first = store.rows('SN 1/ö')
    (kept,) = (tmp_path / '.cache').iterdir()
    store.file(row(20))
    assert [each.key for each in store.rows('SN 1/ö')] == [
        *(each.key for each in first),
        row(20).key,
    ]
    gone = tmp_path / 'robot=SN%201%2F%C3%B6' / f'{row(3).key}.parquet'
    gone.unlink()
    kept.write_bytes(kept.read_bytes().replace(b'SN 1', b'SN 2'))
    left = {each.key for each in store.rows('SN 1/ö')}
    assert left == {each.key for each in first} - {row(3).key} | {row(20).key}


def without(folder, *columns):
    """Return a history of one row that lacks some columns, and the path of the row."""
    store = History(folder)
    store.file(row(names=('joint.a',), offsets=np.ones(1), covariance=np.eye(1)))
    (path,) = folder.rglob('*.parquet')
    table = pyarrow.parquet.read_table(path, partitioning=None)
    pyarrow.parquet.write_table(table.drop_columns(columns), path)
    return store, path


def test_rows_of_an_older_version_are_read(tmp_path):
    (found,) = without(tmp_path, 'rms_mrad', 'remarks')[0].rows('SN 1/ö')
    assert found.rms_mrad is None
    assert found.remarks == ()


@pytest.mark.parametrize('column', ['offsets', 'covariance', 'filed', 'verdict'])
def test_rows_without_what_is_compared_are_named(tmp_path, column):
    store, path = without(tmp_path, column)
    with pytest.raises(InputError, match=f'{column}.*{path.name}|{path.name}.*{column}'):
        store.rows('SN 1/ö')


@pytest.mark.parametrize('damaged', [True, False])
def test_what_is_no_row_is_named(tmp_path, damaged):
    store = History(tmp_path)
    store.file(row())
    (path,) = tmp_path.rglob('*.parquet')
    other = path.rename(path.with_name(f'{row(1).key}.parquet'))
    if damaged:
        other.rename(path)
        path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=path.name if damaged else 'its name is not its key'):
        store.rows('SN 1/ö')


def test_a_row_of_another_robot_is_named(tmp_path):
    """As of 42a and 42A on a disk that takes both for one: they were compared as one robot."""
    store = History(tmp_path)
    for k in range(10):  # as many are cached
        store.file(row(k, serial='42A'))
    store.file(row(serial='42a'))
    (path,) = tmp_path.glob('robot=42a/*')
    other = path.rename(tmp_path / 'robot=42A' / path.name)
    with pytest.raises(InputError, match=f'{path.name} .* of robot 42a, not 42A: move it away'):
        store.rows('42A')
    other.unlink()
    assert len(store.rows('42A')) == 10


def test_no_flipped_bit_is_read_as_another_number(tmp_path):
    store = History(tmp_path)
    numbers = np.random.default_rng(0).normal(size=(12, 12))
    names = tuple(f'joint.{k}' for k in range(12))
    store.file(row(names=names, offsets=numbers[0], covariance=numbers))
    (path,) = tmp_path.rglob('*.parquet')
    whole = path.read_bytes()
    begin = whole.index(numbers[4].tobytes())
    for place in range(begin, begin + 96, 8):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(InputError, match=path.name):
            store.rows('SN 1/ö')


def test_serials_and_places_that_cannot_be():
    for serial in ('', 'a\nb', 'x' * 201):
        with pytest.raises(ConfigError, match='serial number'):
            Filing(serial, BEGIN, '', '')
    with pytest.raises(ConfigError, match='cannot be opened'):
        History('nowhere://history')


def test_all_that_was_measured_tells_samples_apart():
    """Of distances, touches and images only the joint values counted."""
    rng = np.random.default_rng(0)
    rows = simulation.measure(CHAIN, CHAIN.random_joints(3, rng), rng)
    near = replace(rows, distances=np.ones(3))
    several = [rows, near, replace(near, distances=np.full(3, 1.1)), replace(rows, tool='tool_2')]
    several += [replace(rows, covariance=np.tile(k * np.eye(6), (3, 1, 1))) for k in (1, 2)]
    assert len({samples_hash([each]) for each in several}) == len(several)
    assert samples_hash([rows]) == samples_hash([rows.select(slice(None))])


def test_writers_that_race_file_each_result_once(tmp_path):
    barrier = Barrier(2)

    def write(store):
        barrier.wait()
        for k in range(20):
            store.file(row(k))

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(write, [History(tmp_path), History(tmp_path)]))
    assert len(pandas.read_parquet(tmp_path)) == 20
    assert len(History(tmp_path).rows('SN 1/ö')) == 20


def test_a_writer_that_is_killed_leaves_nothing_that_is_read(tmp_path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    store = History(tmp_path)
    store.file(row())
    with monkeypatch.context() as patch:
        patch.setattr('os.fsync', killed)
        with pytest.raises(KeyboardInterrupt):
            store.file(row(1))
    partial = tmp_path / 'robot=SN%201%2F%C3%B6' / f'.{row(1).key}.parquet.0.partial'
    partial.write_bytes(b'half')  # as kill -9 leaves it
    assert [each.key for each in store.rows('SN 1/ö')] == [row().key]
    assert len(pandas.read_parquet(tmp_path)) == 1
    assert store.file(row(1))
