# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files and folders as a whole or not at all, whoever is killed and whoever else writes."""

import errno
import fcntl
import os
import shutil
import sys
from pathlib import Path

import pytest
from killed import every_kill, forked, killed_at, status_of, tree

from calib_ros.atomic import confined, whole_folder, write_file, write_files, write_together
from calib_ros.errors import InputError

OWN = ('a.txt', 'b.txt', 'sub')


def make(path, label, *, overwrite=True, own=OWN):
    with whole_folder(path, own, overwrite=overwrite) as folder:
        write_files(folder, {name: f'{name} of {label}' for name in ('a.txt', 'b.txt')})
        write_files(folder / 'sub', {'c.txt': f'c of {label}'})


def expected(label):
    return {
        'a.txt': f'a.txt of {label}',
        'b.txt': f'b.txt of {label}',
        'sub/c.txt': f'c of {label}',
    }


NOTES = {'notes.txt': 'mine', 'mine/deep/raw.csv': '1,2'}


def add_notes(path):
    (path / 'mine' / 'deep').mkdir(parents=True)
    for name, text in NOTES.items():
        (path / name).write_text(text)


@pytest.mark.parametrize('earlier', ['none', 'A and notes'])
def test_a_killed_process_leaves_the_new_folder_or_the_old_one(tmp_path, monkeypatch, earlier):
    monkeypatch.setattr(os, 'fsync', lambda handle: None)  # no disk is lost here: half the time
    path = tmp_path / 'out'
    gaps = 0

    def begin():
        if path.exists():
            shutil.rmtree(path)
        if earlier != 'none':
            make(path, 'A')
            add_notes(path)

    notes = {} if earlier == 'none' else NOTES
    before = {} if earlier == 'none' else expected('A') | notes

    def check():
        nonlocal gaps
        found = tree(path)
        if not path.exists() and earlier != 'none':  # between the two renames
            gaps += 1
            assert tree(tmp_path / '.out.partial' / 'out.old') == before
        else:
            assert found in (before, expected('B') | notes)
        with pytest.raises(KeyboardInterrupt), whole_folder(path, OWN, overwrite=True):
            raise KeyboardInterrupt  # a run that ends like this cleans up, and puts back
        assert tree(path) in (before, expected('B') | notes)
        assert path.exists() or earlier == 'none'
        make(path, 'C')
        assert tree(path) == expected('C') | notes
        assert [each.name for each in tmp_path.iterdir()] == ['out']
        begin()

    begin()
    assert every_kill(tmp_path, lambda: make(path, 'B'), check, 3) > 20
    begin()
    gaps, number = 0, 1
    while killed_at(number, tmp_path, lambda: make(path, 'B'), ('os.rename',)):
        check()
        number += 1
    assert gaps == (earlier != 'none')
    assert tree(path) == expected('B') | notes


def test_a_folder_that_came_back_by_other_hands_is_not_lost(tmp_path):
    path = tmp_path / 'out'
    make(path, 'A')
    number = 1
    while path.exists():  # until it is killed between the two renames
        assert killed_at(number, tmp_path, lambda: make(path, 'B'), ('os.rename',))
        number += 1
    path.mkdir()
    (path / 'new.txt').write_text('by hand')
    with pytest.raises(InputError, match=r'out\.old is the earlier .*out: move it away'):
        make(path, 'C')
    assert tree(path) == {'new.txt': 'by hand'}
    assert tree(tmp_path / '.out.partial' / 'out.old') == expected('A')


def test_only_one_process_writes_a_folder(tmp_path):
    path = tmp_path / 'out'
    with whole_folder(path, OWN) as folder:
        write_files(folder, {'a.txt': 'first'})
        assert status_of(forked(lambda: make(path, 'B'))) == 3
        with pytest.raises(InputError, match=r'another process is writing .*out: wait'):
            make(path, 'C')
    assert tree(path) == {'a.txt': 'first'}
    assert [each.name for each in tmp_path.iterdir()] == ['out']


def unsupported(*arguments, **more):
    raise OSError(errno.EOPNOTSUPP, 'not supported')


@pytest.fixture(params=[True, False])
def locks(request, monkeypatch):
    """Return whether the file system has locks."""
    if not request.param:
        monkeypatch.setattr(fcntl, 'flock', unsupported)
    return request.param


@pytest.fixture(params=[True, False])
def links(request, monkeypatch):
    """Return whether the file system has hard links."""
    if not request.param:
        monkeypatch.setattr(os, 'link', unsupported)
    return request.param


@pytest.mark.usefixtures('locks')
@pytest.mark.parametrize('overwrite', [True, False])
def test_of_several_processes_one_wins(tmp_path, overwrite):
    for number in range(2):
        path = tmp_path / f'out{number}'
        hear, tell = os.pipe()

        def work(k, path=path, hear=hear, tell=tell):
            os.close(tell)
            os.read(hear, 1)  # returns for all of them when the last end is closed
            make(path, str(k), overwrite=overwrite)

        children = [forked(lambda k=k: work(k)) for k in range(4)]
        os.close(tell)
        os.close(hear)
        statuses = [status_of(child) for child in children]
        assert set(statuses) <= {0, 3}
        winners = [k for k, status in enumerate(statuses) if status == 0]
        assert len(winners) == 1 or (overwrite and winners)
        assert tree(path) in [expected(str(k)) for k in winners]
    assert len(list(tmp_path.iterdir())) == 2


def test_without_locks_leftovers_are_left_to_the_user(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, 'flock', unsupported)
    (tmp_path / '.out.partial').mkdir()
    with pytest.raises(InputError, match=r'remove .*\.out\.partial if none runs'):
        make(tmp_path / 'out', 'A')
    assert (tmp_path / '.out.partial').exists()


def test_a_disk_that_cannot_be_written_is_told_by_the_name_asked_for(tmp_path, monkeypatch):
    def refused(self, *_, **__):
        if self == tmp_path:
            return
        raise OSError(errno.EROFS, 'Read-only file system', str(self))

    for module, name in ((os, 'open'), (Path, 'unlink'), (Path, 'mkdir')):
        monkeypatch.setattr(module, name, refused)

    def both(path):
        write_together({path: 'A', path.with_name('beside'): 'A'})

    for write in (lambda path: write_file(path, 'A'), both, lambda path: make(path, 'A')):
        with pytest.raises(OSError, match='Read-only') as caught:
            write(tmp_path / 'out')
        assert caught.value.filename == str(tmp_path / 'out')


def test_what_is_no_folder_of_ours_is_not_followed(tmp_path):
    elsewhere = tmp_path / 'elsewhere'
    (elsewhere / 'out').mkdir(parents=True)
    (elsewhere / 'out' / 'precious').write_text('mine')
    (tmp_path / '.out.partial').symlink_to(elsewhere)
    with pytest.raises(OSError, match=r'\.out\.partial'):
        make(tmp_path / 'out', 'A')
    assert (elsewhere / 'out' / 'precious').read_text() == 'mine'


@pytest.mark.usefixtures('links')
def test_names_in_the_way_are_kept_unless_overwritten(tmp_path):
    path = tmp_path / 'out'
    make(path, 'A', overwrite=False)
    add_notes(path)
    (path / 'link').symlink_to('nowhere')
    path.chmod(0o750)
    with pytest.raises(InputError, match=r'already holds a\.txt, b\.txt, sub: .*--force'):
        make(path, 'B', overwrite=False)
    with pytest.raises(InputError, match='exists already'):
        make(path, 'B', own=None)
    assert tree(path) == expected('A') | NOTES
    nested = {'mine/a.txt': 'not of ours', 'mine/deep/b.txt': 'nor this'}
    write_files(path / 'mine', {'a.txt': 'not of ours', 'deep/b.txt': 'nor this'})
    make(path, 'B')
    assert tree(path) == expected('B') | NOTES | nested
    assert os.readlink(path / 'link') == 'nowhere'
    assert path.stat().st_mode & 0o777 == 0o750


def test_a_link_to_a_folder_stays_one(tmp_path):
    (tmp_path / 'real').mkdir()
    (tmp_path / 'out').symlink_to('real')
    make(tmp_path / 'out', 'A')
    assert (tmp_path / 'out').is_symlink()
    assert tree(tmp_path / 'real') == expected('A')


def test_the_current_folder_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / 'out' / 'in').mkdir(parents=True)
    monkeypatch.chdir(tmp_path / 'out' / 'in')
    for path in (Path(), Path('..')):
        with pytest.raises(InputError, match='choose a folder in it'):
            make(path, 'A')
    assert not tree(tmp_path)


def test_a_full_disk_changes_nothing(tmp_path, monkeypatch):
    path = tmp_path / 'out'
    make(path, 'A')

    def full(handle):
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    with pytest.raises(OSError, match=r'No space left on device: .*a\.txt'):
        make(path, 'B')
    assert tree(tmp_path) == {f'out/{name}': text for name, text in expected('A').items()}


@pytest.mark.usefixtures('links')
@pytest.mark.parametrize('fails_again', [False, True])
def test_of_files_that_belong_together_none_is_replaced_alone(tmp_path, monkeypatch, fails_again):
    names = [tmp_path / name for name in 'abc']
    names[0].write_text('a of A')
    replace = os.replace

    def not_c(first, second):
        if second == names[2]:
            raise OSError(errno.EIO, 'Input/output error')
        replace(first, second)

    monkeypatch.setattr(os, 'replace', not_c)
    if fails_again:
        monkeypatch.setattr(Path, 'unlink', unsupported)
        with pytest.raises(InputError, match=r'b is new, but files that belong .*do not use it'):
            write_together(dict.fromkeys(names, 'B'), overwrite=True)
        return
    with pytest.raises(OSError, match=r'output error: .*c'):
        write_together(dict.fromkeys(names, 'B'), overwrite=True)
    assert tree(tmp_path) == {'a': 'a of A'}
    monkeypatch.setattr(os, 'replace', replace)
    write_together(dict.fromkeys(names, 'B'), overwrite=True)
    assert tree(tmp_path) == {'a': 'B', 'b': 'B', 'c': 'B'}


def test_a_process_killed_meanwhile_leaves_no_files_of_two_sets(tmp_path):
    names = [tmp_path / name for name in 'abc']

    def write(text):
        write_together(dict.fromkeys(names, text), overwrite=True)

    def check():
        found = {name: text for name, text in tree(tmp_path).items() if name[0] != '.'}
        assert 'a' in found
        assert len(set(found.values())) == 1
        write('A')

    write('A')
    assert every_kill(tmp_path, lambda: write('B'), check) > 10
    assert tree(tmp_path) == dict.fromkeys('abc', 'B')
    assert len(list(tmp_path.iterdir())) == 3


def test_what_killed_processes_leave_does_not_pile_up(tmp_path, locks):
    """Without locks it cannot be told from the work of others, which goes on."""
    path, number = tmp_path / 'file', 1
    while killed_at(number, tmp_path, lambda: write_file(path, 'A', overwrite=True)):
        number += 1
    assert number > 5
    write_file(path, 'B', overwrite=True)
    assert path.read_text() == 'B'
    assert len(list(tmp_path.iterdir())) == (1 if locks else 2)


def test_processes_that_write_one_file_wait_for_each_other(tmp_path, locks):
    def work(label):
        for _ in range(30):
            write_together({tmp_path / name: label for name in 'ab'}, overwrite=True)

    children = [forked(lambda k=k: work(str(k))) for k in range(3)]
    assert [status_of(child) for child in children] == [0, 0, 0]
    found = tree(tmp_path)
    assert set(found) == {'a', 'b'}
    assert not locks or found['a'] == found['b']


@pytest.mark.parametrize('what', ['a folder', 'a pipe', 'a device', '.', '..'])
def test_what_is_no_file_is_not_replaced(tmp_path, monkeypatch, what):
    """As root `--out /dev/null --force` put a file in place of the device."""
    monkeypatch.chdir(tmp_path)
    path = Path(what)
    if what == 'a folder':
        path.mkdir()
    elif what == 'a pipe':
        os.mkfifo(path)
    elif what == 'a device':
        path.symlink_to('/dev/null')
    with pytest.raises(InputError, match=f'{what} is not a file: choose another name'):
        write_file(path, 'A', overwrite=True)
    assert path.exists()
    assert not path.is_file()
    assert not tree(tmp_path)


def test_a_name_may_be_as_long_as_the_disk_takes(tmp_path):
    write_file(tmp_path / ('x' * 255), 'A')
    assert tree(tmp_path) == {'x' * 255: 'A'}
    write_file(tmp_path / os.fsdecode(b'\xff'), 'B')
    assert (tmp_path / os.fsdecode(b'\xff')).read_text() == 'B'


@pytest.mark.parametrize('seen', [True, False])
def test_a_file_is_written_once(tmp_path, monkeypatch, links, seen):
    """Also where another process has looked before this one was there."""
    if links and not seen:  # without links nobody else is noticed
        monkeypatch.setattr(Path, 'exists', lambda self: False)
    path = tmp_path / 'file'
    write_file(path, 'first')
    with pytest.raises(InputError, match='exists already'):
        write_file(path, 'second')
    assert tree(tmp_path) == {'file': 'first'}
    write_file(path, b'third', overwrite=True)
    assert tree(tmp_path) == {'file': 'third'}


def test_temporary_files_follow_no_links_and_have_names_of_their_own(tmp_path):
    def child():
        opened = {}

        def note(event, arguments):
            if event == 'open' and str(arguments[0]).startswith(str(tmp_path)):
                opened[str(arguments[0])] = arguments[2]

        sys.addaudithook(note)
        for _ in range(2):
            write_file(tmp_path / 'file', 'x', overwrite=True)
        flags = os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        created = [given for given in opened.values() if given & os.O_CREAT]
        assert [given & flags for given in created] == [flags, flags]

    assert status_of(forked(child)) == 0


def test_the_umask_holds_for_files(tmp_path):
    before = os.umask(0o027)
    try:
        write_file(tmp_path / 'file', 'x')
    finally:
        os.umask(before)
    assert (tmp_path / 'file').stat().st_mode & 0o777 == 0o640


def test_names_of_others_lead_into_the_folders_only(tmp_path):
    data, more = tmp_path / 'data', tmp_path / 'more'
    for folder in (data / 'sub', more, tmp_path / 'data2'):
        folder.mkdir(parents=True)
    (data / 'out').symlink_to(tmp_path)
    (data / 'file.yaml').symlink_to('/etc/passwd')
    (data / 'inner.yaml').symlink_to(data / 'sub' / 'x.yaml')
    folders = (data, more)
    assert confined('a.yaml', folders, '') == data / 'a.yaml'
    assert confined('sub/../b.yaml', folders, '') == data / 'b.yaml'
    assert confined(f'{more}/c.yaml', folders, '') == more / 'c.yaml'
    assert confined('inner.yaml', folders, '') == data / 'sub' / 'x.yaml'
    for name in (
        *('../x.yaml', f'{tmp_path}/x.yaml', f'{tmp_path}/data2/x.yaml', 'out/x.yaml'),
        *('file.yaml', '/etc/shadow', '~/x.yaml', '~nobody_at_all/x.yaml', 'a\0b'),
        *(f'{data}/../x.yaml', 'sub/../../more2/x.yaml'),
    ):
        with pytest.raises(InputError, match='outside the folders of the node: set it'):
            confined(name, folders, 'set it')
    with pytest.raises(InputError) as caught:
        confined('/' + 5000 * 'x', folders, 'set it')
    assert len(str(caught.value)) < 400
