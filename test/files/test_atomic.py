# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files and folders as a whole or not at all, whoever is killed and whoever else writes."""

import errno
import fcntl
import itertools
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from measured import measured, rows_of, write_csv
from rosbags.rosbag2 import Writer

from calib_ros.atomic import confined, whole_folder, write_file, write_files
from calib_ros.cli import identify, main, options, results
from calib_ros.cli.inputs import Loaded
from calib_ros.cli.results import Identified
from calib_ros.errors import InputError
from calib_ros.files.bags import replay
from calib_ros.files.recording import Recording, write_bag
from calib_ros.identification import calibration
from calib_ros.identification.identification import identify as identified_from
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason, Rule
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report import plots, words
from calib_ros.report.page import Origin
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings

OWN = ('a.txt', 'b.txt', 'sub')
KILLED = 77


def make(path, label, *, overwrite=True, own=OWN):
    with whole_folder(path, own, overwrite=overwrite) as folder:
        write_files(folder, {name: f'{name} of {label}' for name in ('a.txt', 'b.txt')})
        write_files(folder / 'sub', {'c.txt': f'c of {label}'})


def tree(folder):
    """Return the text of each file below a folder."""
    paths = sorted(path for path in folder.rglob('*') if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in paths}


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


def forked(work):
    """Run some work in a child process; return its id."""
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        work()
        status = 0
    except InputError:
        status = 3
    finally:
        os._exit(status)


def status_of(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at(number, where, work):
    """Run some work that is killed just before its n-th call that touches files below `where`.

    Returns whether it was: False when it has ended before.
    """

    def child():
        calls = 0

        def count(event, arguments):
            nonlocal calls
            touched = event.partition('.')[0] in ('open', 'os', 'shutil') and arguments
            if touched and str(arguments[0]).startswith(str(where)):
                calls += 1
                if calls == number:
                    os._exit(KILLED)

        sys.addaudithook(count)
        work()

    status = status_of(forked(child))
    assert status in (0, KILLED)
    return status == KILLED


def every_kill(where, work, check, step=1):
    """Kill some work at its calls in turn, and check what is left; return how many there are."""
    number = 1
    while killed_at(number, where, work):
        check()
        number += step
    return number - step


@pytest.mark.parametrize('earlier', ['none', 'A and notes'])
def test_a_killed_process_leaves_the_new_folder_or_the_old_one(tmp_path, earlier):
    path = tmp_path / 'out'
    gaps = 0

    def begin():
        if path.exists():
            for name in sorted(path.rglob('*'), reverse=True):
                name.rmdir() if name.is_dir() else name.unlink()
            path.rmdir()
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
    assert every_kill(tmp_path, lambda: make(path, 'B'), check) > 20
    assert gaps == (earlier != 'none')
    assert tree(path) == expected('B') | notes


def test_a_folder_that_came_back_by_other_hands_is_not_lost(tmp_path):
    path = tmp_path / 'out'
    make(path, 'A')
    number = 1
    while path.exists():  # until it is killed between the two renames
        assert killed_at(number, tmp_path, lambda: make(path, 'B'))
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


@pytest.mark.parametrize('locks', [True, False])
@pytest.mark.parametrize('overwrite', [True, False])
def test_of_several_processes_one_wins(tmp_path, monkeypatch, overwrite, locks):
    """Also on a file system without locks."""
    if not locks:
        monkeypatch.setattr(fcntl, 'flock', unsupported)
    for number in range(5):
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
    assert len(list(tmp_path.iterdir())) == 5


def unsupported(*arguments, **more):
    raise OSError(errno.EOPNOTSUPP, 'not supported')


def test_without_locks_leftovers_are_left_to_the_user(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, 'flock', unsupported)
    (tmp_path / '.out.partial').mkdir()
    with pytest.raises(InputError, match=r'remove .*\.out\.partial if none runs'):
        make(tmp_path / 'out', 'A')
    assert (tmp_path / '.out.partial').exists()


def test_what_is_no_folder_of_ours_is_not_followed(tmp_path):
    elsewhere = tmp_path / 'elsewhere'
    (elsewhere / 'out').mkdir(parents=True)
    (elsewhere / 'out' / 'precious').write_text('mine')
    (tmp_path / '.out.partial').symlink_to(elsewhere)
    with pytest.raises(OSError, match=r'\.out\.partial'):
        make(tmp_path / 'out', 'A')
    assert (elsewhere / 'out' / 'precious').read_text() == 'mine'


def test_names_in_the_way_are_kept_unless_overwritten(tmp_path):
    path = tmp_path / 'out'
    make(path, 'A', overwrite=False)
    add_notes(path)
    (path / 'link').symlink_to('nowhere')
    path.chmod(0o750)
    with pytest.raises(InputError, match=r'holds a\.txt, b\.txt, sub already.*--force'):
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


def test_other_files_go_along_without_hard_links(tmp_path, monkeypatch):
    path = tmp_path / 'out'
    make(path, 'A')
    add_notes(path)
    monkeypatch.setattr(os, 'link', unsupported)
    make(path, 'B')
    assert tree(path) == expected('B') | NOTES


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


@pytest.mark.parametrize('links', [True, False])
def test_a_file_is_written_once(tmp_path, monkeypatch, links):
    if not links:
        monkeypatch.setattr(os, 'link', unsupported)
    path = tmp_path / 'file'
    write_file(path, 'first')
    with pytest.raises(InputError, match='exists already'):
        write_file(path, 'second')
    assert tree(tmp_path) == {'file': 'first'}
    write_file(path, b'third', overwrite=True)
    assert tree(tmp_path) == {'file': 'third'}


def test_of_two_files_at_the_same_moment_one_is_kept(tmp_path, monkeypatch):
    """The other process has looked before this one was there."""
    path = tmp_path / 'file'
    monkeypatch.setattr(Path, 'exists', lambda self: False)
    write_file(path, 'first')
    with pytest.raises(InputError, match='exists already'):
        write_file(path, 'second')
    assert tree(tmp_path) == {'file': 'first'}


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
        assert [given & flags for given in opened.values()] == [flags, flags]

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


def dwells(count):
    recorded = measured(count=count)
    names = tuple(load_chain('ur5e').joint_names)
    return Recording.of_dwells(names, recorded, np.zeros(count, bool))


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_bag_whose_writing_is_killed_is_absent(tmp_path, monkeypatch, storage):
    path, truth = tmp_path / 'cells' / 'bag', tmp_path / 'cells' / 'truth.yaml'

    recording = dwells(3)

    def write():
        write_bag(path, recording, storage, {truth: 'truth'})

    def check():
        if path.exists():
            assert truth.read_text() == 'truth'
            assert (path / 'metadata.yaml').read_text().endswith('\n')
            session = CalibrationSession(load_chain('ur5e'), Settings())
            assert replay(path, session).warnings == ()
            assert len(session.samples) == 3
            shutil.rmtree(path)

    write()  # here first, so that no child has to load the message types
    check()
    assert every_kill(tmp_path, write, check) > 10
    check()
    write_message = Writer.write
    for last in (1, 7, 17):
        with monkeypatch.context() as patch:
            count = itertools.count(1)

            def write_one(*arguments, last=last, count=count):
                if next(count) == last:
                    os._exit(KILLED)
                write_message(*arguments)

            patch.setattr(Writer, 'write', write_one)
            assert status_of(forked(write)) == KILLED
            assert not path.exists()
    write()
    check()
    assert not [each for each in (tmp_path / 'cells').iterdir() if 'bag' in each.name]


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('limit', [0, 1000, 20000])
def test_a_bag_on_a_full_disk_is_absent(tmp_path, storage, limit):
    def child():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        with pytest.raises(OSError, match=r'cannot write .*bag: '):
            write_bag(tmp_path / 'bag', dwells(40), storage, {tmp_path / 'truth': 'true'})

    assert status_of(forked(child)) == 0
    assert list(tmp_path.iterdir()) == []


def test_a_command_that_writes_a_bag_says_so_when_the_disk_is_full(tmp_path):
    """It ends with status 1 and one line, in a process of its own."""
    table = write_csv(tmp_path / 'cell.csv', rows_of(measured()))
    line = 'import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000)); '
    line += 'from calib_ros.cli.main import main; sys.exit(main())'
    done = subprocess.run(
        [sys.executable, '-c', line, 'csv2bag', str(table), 'bag', '--chain', 'ur5e'],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert 'calib_ros: cannot write bag: [Errno 27] File too large' in done.stderr.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ['cell.csv']


@pytest.fixture
def identified(monkeypatch):
    """Return results of A and B, as the command line has them, and a stamp that stays."""

    def found(label, seed):
        problem = Problem(load_chain('ur5e'), measured(seed=seed))
        result, settings = identified_from(problem), Settings(folds=seed)
        origin = Origin(settings=words.configuration_yaml('ur5e', settings))
        loaded = Loaded(problem, {'samples': label}, (f'of {label}',))
        return Identified(loaded, result, origin)

    monkeypatch.setattr(plots, 'before_after_png', lambda result: repr(result.names).encode())
    monkeypatch.setattr(results, 'identification_report', lambda *of: of[1])
    monkeypatch.setattr(options, 'render', lambda result: f'page of {result.names}')
    monkeypatch.setattr(results, 'markdown', lambda result, samples: f'{samples} {result.names}')
    monkeypatch.setattr(
        calibration, 'datetime', Mock(now=lambda zone: Mock(isoformat=lambda **k: ''))
    )
    return {'A': found('A', 5), 'B': found('B', 6)}


@pytest.mark.parametrize('accepted', [True, False])
def test_an_identification_that_is_killed_mixes_nothing(
    tmp_path, monkeypatch, identified, accepted
):
    if not accepted:
        found = identified['B']
        refused = replace(found.result, refusals=(Reason(Rule.GAIN, 'no gain'),))
        identified['B'] = replace(found, result=refused)
    out = tmp_path / 'out'

    def run(label):
        monkeypatch.setattr(identify, '_identified', lambda *given: identified[label])
        arguments = ['--csv', 'unread', '--chain', 'ur5e', '--out', str(out), '--force']
        main.main(['identify', *arguments])
        return tree(out)

    run('A')
    (out / 'notes.txt').write_text('mine')
    a, b = run('A'), run('B')
    assert ('calibration.yaml' in b) == accepted
    assert accepted or b['calibration.previous.yaml'] == a['calibration.yaml']
    assert a['notes.txt'] == b['notes.txt'] == 'mine'
    (out / 'calibration.previous.yaml').unlink(missing_ok=True)

    def check():
        kept = out if out.exists() else tmp_path / '.out.partial' / 'out.old'
        assert tree(kept) in (a, b)
        assert run('A').items() >= a.items()
        assert [each.name for each in tmp_path.iterdir()] == ['out']
        (out / 'calibration.previous.yaml').unlink(missing_ok=True)

    run('A')
    assert every_kill(tmp_path, lambda: run('B'), check, step=11) > 50
    assert tree(out) == b


def test_two_identifications_into_one_folder(tmp_path):
    """One is accepted, the other one says why not; nothing of both is mixed."""
    command = [sys.executable, '-m', 'calib_ros.cli.main', 'identify', '--chain', 'ur5e', '--json']
    tables = [write_csv(tmp_path / f'{seed}.csv', rows_of(measured(seed=seed))) for seed in (5, 6)]
    runs = [
        subprocess.Popen(
            [*command, '--csv', str(table), '--out', str(tmp_path / 'out')],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for table in tables
    ]
    answers = [(*run.communicate(), run.returncode) for run in runs]
    (_, error, _), (said, _, _) = sorted(answers, key=lambda each: -each[2])
    assert sorted(status for _, _, status in answers) == [0, 1]
    assert error.startswith('calib_ros: ')
    assert 'another process is writing' in error or 'already' in error
    assert (tmp_path / 'out' / 'result.json').read_text() == said
