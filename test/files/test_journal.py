# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import os
from contextlib import closing
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from calib_ros.errors import InputError
from calib_ros.files.foreign import Foreign
from calib_ros.files.journal import Journal, is_whole, read_journal, table_text
from calib_ros.files.layouts import Layout
from calib_ros.files.measurements import view_of
from calib_ros.files.tables import read_table
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.sampling.sample import Sample, View

JOINTS = 3
floats = st.floats(-1e6, 1e6)  # what a session takes
vectors = st.lists(floats, min_size=JOINTS, max_size=JOINTS).map(np.array)
names = st.text(st.characters(exclude_categories=['C', 'Z'], include_characters=' '), max_size=8)


@pytest.mark.parametrize(
    ('row', 'whole'), [(b'1,2,', 1), (b'1,2', 0), (b'1,2,0.5 0.', 0), (b'1,\0,', 0), (b'1,', 0)]
)
def test_a_row_is_whole_if_only_its_line_end_may_be_missing(row, whole):
    assert is_whole(row, 3) == whole


def rotation(seed):
    return se3.exp_rotation(np.random.default_rng(seed).normal(scale=2.0, size=(1, 3)))[0]


def covariance(seed):
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return root @ root.T


@st.composite
def samples(draw):
    """Draw a sample of any kind, with whatever may be missing missing or not."""
    optional = {
        'approach': st.lists(
            st.sampled_from([-1.0, 0.0, 1.0]), min_size=JOINTS, max_size=JOINTS
        ).map(np.array),
        'velocity': vectors,
        'acceleration': vectors,
    }
    seed = st.integers(0, 2**32 - 1)
    if draw(st.booleans()):
        measured = {'distance': draw(floats)}
        eye = False
    else:
        measured = {'position': draw(vectors)}
        if draw(st.booleans()):
            measured['rotation'] = rotation(draw(seed))
        if draw(st.booleans()):
            measured['covariance'] = covariance(draw(seed))
        eye = draw(st.booleans())
    return Sample(
        draw(st.integers(1, 2**62)),
        draw(vectors),
        **{name: draw(kind) for name, kind in optional.items() if draw(st.booleans())},
        **measured,
        session=draw(names),
        device=draw(names.filter(bool)),
        target=draw(names),
        frame_id=draw(names).lstrip('/'),  # as messages give it
        eye_in_hand=eye,
        validation=draw(st.booleans()),
        delay=draw(floats),
        count=draw(st.integers(1, 10**6)),
        spread=draw(st.floats(0.0, allow_infinity=False, allow_nan=False)),
    )


def written(path, many, joints=JOINTS):
    journal = Journal(path, joints)
    for sample in many:
        journal.add(sample)
    journal.close()


def assert_equal(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        for field in fields(Sample):
            first, second = getattr(one, field.name), getattr(other, field.name)
            if field.name in ('rotation', 'covariance') and first is not None:
                np.testing.assert_allclose(first, second, rtol=1e-15, atol=4e-15)
            else:
                np.testing.assert_array_equal(first, second, field.name)


@given(st.lists(samples(), min_size=1, max_size=8, unique_by=lambda sample: sample.stamp_ns))
def test_what_is_written_is_read(tmp_path_factory, many):
    """Numbers exactly; a rotation goes as a quaternion, which costs the last digit."""
    path = tmp_path_factory.mktemp('journal') / 'cell.csv'
    written(path, many)
    found, warnings = read_journal(path, JOINTS)
    assert warnings == ()
    assert_equal(found, many)


def plain(number, **more):
    return Sample(number, 0.1 * number * np.ones(JOINTS), position=np.arange(3.0), **more)


def test_a_view_of_thousands_of_corners_is_read(tmp_path):
    """Its cell is longer than csv reads unless told so."""
    seen = View(np.full((3000, 3), 1 / 3), np.full((3000, 2), 1000 / 3), Lens(9e2, 9e2, 5e2, 4e2))
    written(tmp_path / 'cell.csv', [replace(plain(1), rotation=np.eye(3), view=seen)])
    ((found,), warnings) = read_journal(tmp_path / 'cell.csv', JOINTS)
    assert warnings == ()
    np.testing.assert_array_equal(found.view.pixels, seen.pixels)
    with pytest.raises(InputError, match='line 2: fx and fy of a camera must be positive'):
        view_of('0 1 1 1 0 0 0 0 0 1;1 1 1 1 1', 'line 2')  # which resume leaves out


def test_the_samples_of_a_bag_are_a_table_with_any_names(tmp_path):
    many = [plain(1, device='a,b'), plain(2, device='say "b"'), plain(3, target='=1')]
    text = table_text(many, JOINTS)
    assert text.startswith('stamp_ns,q1,q2,q3,x,y,z,device,target,delay,')
    (tmp_path / 'cell.csv').write_text(text)
    assert_equal(read_journal(tmp_path / 'cell.csv', JOINTS)[0], many)


def test_kinds_of_one_stop_are_told_apart(tmp_path):
    """A stop gives each source the same stamp, often between the same device and target."""
    many = [
        plain(1),
        plain(1, validation=True),
        plain(1, device='b'),
        plain(1, target='b'),
        plain(1, session='b'),
        replace(plain(1), rotation=np.eye(3), eye_in_hand=True),
        replace(plain(1, device='d'), position=None, distance=2.0),
        replace(plain(1, device='d')),
        plain(1, device='d', frame_id='b'),  # kept, until frame_id chooses one
    ]
    written(tmp_path / 'cell.csv', many)
    assert_equal(read_journal(tmp_path / 'cell.csv', JOINTS)[0], many)
    journal = Journal(tmp_path / 'cell.csv', JOINTS)
    journal.add(many[6], removed=True)
    journal.close()
    assert_equal(read_journal(tmp_path / 'cell.csv', JOINTS)[0], [*many[:6], *many[7:]])


def test_of_rows_alike_the_last_is_taken_back_and_the_rest_keep_their_order(tmp_path):
    path, many = tmp_path / 'cell.csv', [plain(1), plain(2), plain(1, validation=True)]
    written(path, many)
    journal = Journal(path, JOINTS)
    for change, left in (
        ({'removed': True}, [many[0], many[1]]),
        ({'removed': True}, [many[1]]),
        ({'removed': True}, [many[1]]),  # as of a row that an editor took out
        ({}, [many[1], many[0]]),
    ):
        journal.add(many[0], **change)
        assert_equal(read_journal(path, JOINTS)[0], left)
    journal.close()


def test_a_row_written_twice_is_refused(tmp_path):
    written(tmp_path / 'cell.csv', [plain(1), plain(2), plain(1)])
    with pytest.raises(InputError, match='line 4: stamp_ns 1 already exists'):
        read_journal(tmp_path / 'cell.csv', JOINTS)


@pytest.mark.parametrize('device', ['ball', 'a,b'])
def test_a_journal_of_any_length_is_read(path, monkeypatch, device):
    """By parts, which are not seen: what is taken back, repeated, damaged or cut off is found."""
    many = [plain(k, device=device) for k in range(1, 30)]
    many[7:9] = [plain(8, device='other'), replace(plain(9), covariance=covariance(9))]
    written(path, many)
    with path.open('ab') as file:
        file.write(b'1,2')
    monkeypatch.setattr('calib_ros.files.journal.LARGEST_TABLE', 1000)
    monkeypatch.setattr('calib_ros.files.journal.LARGEST_TEXT', 700)
    found, (warning,) = read_journal(path, JOINTS)
    assert_equal(found, many)
    assert 'line 31 was cut off' in warning
    journal = Journal(path, JOINTS)
    for number in (3, 29):
        journal.add(many[number - 1], removed=True)
    journal.close()
    assert_equal(read_journal(path, JOINTS)[0], [*many[:2], *many[3:28]])
    written(path, [many[0]])
    with pytest.raises(InputError, match='line 33: stamp_ns 1 already exists'):
        read_journal(path, JOINTS)
    with path.open('ab') as file:
        file.write(bytes(2000))
    with pytest.raises(InputError, match='line 34 is incomplete'):
        read_journal(path, JOINTS)


@pytest.mark.parametrize('sessions', [('b', 'a'), ('a',)])
def test_a_journal_longer_than_any_table_is_identified(path, monkeypatch, sessions):
    many = [plain(k, session='ab'[k % 3 == 0]) for k in range(1, 30)]
    written(path, many)
    with path.open('ab') as file:
        file.write(b'1,2')
    at_once = read_table(path, JOINTS, sessions)
    monkeypatch.setattr('calib_ros.files.journal.LARGEST_TEXT', 700)
    monkeypatch.setattr('calib_ros.files.tables.LARGEST_TABLE', 1000)
    shares = []
    by_parts = read_table(path, JOINTS, sessions, progress=shares.append)
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    assert len(shares) >= 5
    assert by_parts.warnings == at_once.warnings
    for one, other in zip(by_parts.fitted, at_once.fitted, strict=True):
        assert (one.base, one.tool) == (other.base, other.tool)
        np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
        np.testing.assert_array_equal(one.positions, other.positions)
    with pytest.raises(InputError, match='holds several sessions, choose one of a, b'):
        read_table(path, JOINTS)


@pytest.mark.parametrize('name', ['ball', 'a,b', 'say "ball"', 'Kugel \u00e4\u2460'])
@pytest.mark.parametrize('share', np.linspace(0.02, 0.98, 5))
def test_a_row_that_was_cut_off_anywhere_is_left_out(path, name, share):
    """Whatever is in it: the rows before are there, and new ones can be added."""
    written(path, [plain(1, target=name)])
    begin = path.stat().st_size
    written(path, [plain(2, target=name)])
    with path.open('r+b') as file:
        file.truncate(begin + round(share * (path.stat().st_size - begin)))
    found, (warning,) = read_journal(path, JOINTS)
    assert_equal(found, [plain(1, target=name)])
    assert 'was cut off and is ignored' in warning
    written(path, [plain(3, target=name)])
    assert_equal(read_journal(path, JOINTS)[0], [plain(1, target=name), plain(3, target=name)])


def test_a_journal_read_with_the_unit_of_another_system_keeps_stamps_and_removals(path):
    with closing(Journal(path, JOINTS)) as journal:
        for number, removed in ((1, False), (2, False), (3, False), (2, True)):
            journal.add(plain(number, rotation=np.eye(3), delay=0.01), removed)
    (found,) = read_table(path, JOINTS, foreign=Foreign(Layout(length='mm'))).fitted
    (known,) = read_table(path, JOINTS).fitted
    assert found.stamps_ns.tolist() == [1, 3]
    assert found.delay.tolist() == known.delay.tolist()
    np.testing.assert_allclose(found.positions, 1e-3 * known.positions, rtol=1e-12)


def test_a_leading_slash_makes_no_other_frame(path):
    """Journals of earlier versions have it, the messages that continue them no longer do."""
    with closing(Journal(path, JOINTS)) as journal:
        for number, frame in enumerate(('/tracker', 'tracker', ''), 1):
            journal.add(plain(number, rotation=np.eye(3), frame_id=frame))
    found = [each.frame_id for each in read_journal(path, JOINTS)[0]]
    assert found == ['tracker', 'tracker', '']
    assert read_table(path, JOINTS).world_frame == 'tracker'


def test_a_header_that_was_cut_off_is_written_anew(path):
    written(path, [])
    header = path.read_bytes()
    path.write_bytes(header[:20])
    assert read_journal(path, JOINTS) == ((), ())
    written(path, [plain(1)])
    assert path.read_bytes().startswith(header)
    assert_equal(read_journal(path, JOINTS)[0], [plain(1)])


@pytest.mark.parametrize(
    'content', ['q1,q2,q3,x,y,z\n1,2,3,4,5,6', 'notes of mine', 'q1\n', 'x' * 100_000]
)
def test_a_file_that_is_no_journal_is_refused_and_left_as_it_is(path, content):
    path.write_text(content)
    with pytest.raises(InputError, match="lacks this robot's columns"):
        Journal(path, JOINTS)
    assert path.read_text() == content


@pytest.mark.parametrize(('mark', 'end'), [(b'\xef\xbb\xbf', b'\n'), (b'', b'\r\n')])
def test_a_journal_that_a_spreadsheet_saved_is_refused_for_that(path, mark, end):
    written(path, [plain(1)])
    content = mark + path.read_bytes().replace(b'\n', end)
    path.write_bytes(content)
    with pytest.raises(InputError, match='was saved by another program'):
        Journal(path, JOINTS)
    assert path.read_bytes() == content
    assert_equal(read_journal(path, JOINTS)[0], [plain(1)])


@pytest.mark.parametrize('tail', [b'', b'1,2', b'\0' * 10, b'\0' * 200_000])
def test_what_a_crash_left_behind_the_last_row_is_cut_off(path, tail):
    Journal(path, JOINTS).close()
    rows = path.read_bytes() + b'1,2,3\n' * 20_000
    path.write_bytes(rows + tail)
    Journal(path, JOINTS).close()
    assert path.read_bytes() == rows


def test_each_row_is_written_by_one_call_and_at_once(tmp_path, monkeypatch):
    """So that a process that is killed leaves whole rows, and all of them."""
    calls, write = [], os.write
    monkeypatch.setattr(os, 'write', lambda file, data: calls.append(data) or write(file, data))
    journal = Journal(tmp_path / 'cell.csv', JOINTS)
    for number in (1, 2):
        journal.add(plain(number))
        assert_equal(read_journal(tmp_path / 'cell.csv', JOINTS)[0][number - 1 :], [plain(number)])
    journal.close()
    assert b''.join(calls) == (tmp_path / 'cell.csv').read_bytes()
    assert [data.count(b'\n') for data in calls] == [1, 1, 1]  # the header's, too
    assert all(data.endswith(b'\n') for data in calls)
