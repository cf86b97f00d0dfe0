# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What every command shows, in 80 columns.

The screens are in `screens/`, with 0 for every digit of a result. After a wanted change:

    SCREENS=write python -m pytest test/cli/test_screens.py
"""

import errno
import io
import os
import re
import shlex
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import plants
import pytest
from measured import TEST, TRUE, UR, measured, rows_of, write_csv

from calib_ros.cli import parser, screen
from calib_ros.cli.commands import COMMANDS
from calib_ros.cli.main import main
from calib_ros.cli.screen import Work
from calib_ros.files.boards import read_board

SCREENS = Path(__file__).parent / 'screens'
ESCAPE = '\x1b'
UR5E, FILED = ('--chain', 'ur5e'), ('--history', 'history', '--serial', '0042')
BOARD = ('--columns', '5', '--rows', '4', '--square', '0.03', '--marker', '0.02')
BUMP = {'elbow_joint.theta': 2e-3}


class Terminal(io.StringIO):
    """What stands for a terminal of 80 columns."""

    def isatty(self):
        return True


def assert_shown(name, text):
    path = SCREENS / f'{name}.txt'
    if os.environ.get('SCREENS') == 'write':
        path.write_text(text)
    assert text == path.read_text(), f'if this is wanted: {__doc__.splitlines()[-2].strip()}'
    assert max(map(len, text.splitlines()), default=0) <= 80


def without_digits(text):
    """Return a text with 0 for the digits and + for the signs of its numbers."""
    number = r'(?<![\w.])[+-]?\d[\d.]*(?!\w)'
    return re.sub(number, lambda found: re.sub(r'\d', '0', found[0].replace('-', '+')), text)


@pytest.fixture(scope='module')
def cell(tmp_path_factory):
    """A folder with tables, a bag, results, a history, a plant, a task, a program, images."""
    folder = tmp_path_factory.mktemp('cell')
    bumped = rows_of(measured(TRUE.with_offsets(BUMP), seed=7))
    for name, rows in {
        'measured': rows_of(measured()),
        'good_arm': rows_of(measured(UR, seed=5)),
        'new': rows_of(measured(seed=11))[:TEST],
        'bumped': bumped,
        'one': bumped[:1],
    }.items():
        write_csv(folder / f'{name}.csv', rows)
    plants.write_plant(folder, ['0042', '0043'], 3, bumps={'0043': (2, BUMP)})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for given in (
            ('identify', 'measured.csv', *UR5E, *FILED, '--out', 'result'),
            ('identify', 'bumped.csv', *UR5E, '--out', 'bumped'),
            ('board', 'charuco', *BOARD, '--out', 'board.pdf'),
            ('simulate', 'bag', *UR5E, '--poses', '8'),
            ('plan', *UR5E, '--poses', '5', '--draw', '60', '--out', 'tests.csv'),
        ):
            assert main([*given, '--quiet']) == 0
    return folder


@pytest.fixture
def new(cell):
    """Return the folder NEW, which is there for one test."""
    (cell / 'NEW').mkdir()
    yield cell / 'NEW'
    shutil.rmtree(cell / 'NEW')


@pytest.fixture
def shown(cell, monkeypatch, capsys):
    """Return a function that runs a command in that folder, and returns all that it shows."""
    monkeypatch.chdir(cell)
    monkeypatch.setenv('COLUMNS', '80')

    def shown(*arguments):
        capsys.readouterr()
        try:
            status = main(list(arguments))
        except SystemExit as err:
            status = err.code
        return status, ''.join(capsys.readouterr())

    return shown


def test_the_overview(shown):
    status, text = shown()
    assert status == 2
    assert_shown('overview', text)
    assert shown('--help') == (0, text)
    assert shown('help', 'plan') == shown('plan', '--help')


@pytest.mark.parametrize('name', COMMANDS)
def test_the_help_of_a_command(shown, name):
    status, text = shown(name, '--help')
    assert status == 0
    assert_shown(f'{name}_help', text)
    assert 'default: None' not in text


@pytest.mark.parametrize(
    ('given', 'wrong'),
    [
        (('plan', '--chain', 'ur5e', '--pose', '9', '--otu', 'x'), 'option "--otu": did you mean'),
        (('identify', 'x.csv', '--chian', 'ur5e'), 'option "--chian": did you mean "--chain"?'),
        (('bag2csv', 'bag', 't.csv', '--chain', 'ur5e', '--xyz=3'), 'unknown option "--xyz"\n'),
        (('workspace', *UR5E, '--calibration=c'), '"--calibration": give RESULT first, without'),
        (('robots', 'ur5e'), 'unexpected argument "ur5e"\n'),
        (('identify', 'a.csv', 'b.csv', *UR5E), 'join several files in one table, with'),
        (('chain',), 'required: ROBOT'),
        (('identify', 'measured.csv'), '--chain (calib_ros robots lists the arms supplied)'),
        (('verify', 'a.csv', '--tolerance', '0,2'), "must be a plain number [mm], not '0,2'"),
        (('identify', 'measured.csv', *UR5E, '--folds', 'five'), "a whole number, not 'five'"),
        (('simulate', 'bag', *UR5E, '--storage', 'rosbag1'), "invalid choice: 'rosbag1'"),
    ],
)
def test_wrong_usage_ends_with_an_example_of_that_command(shown, given, wrong):
    status, text = shown(*given)
    assert status == 2
    assert text.startswith(f'usage: calib_ros {given[0]} ')
    assert wrong in text
    assert text.endswith(f'example: calib_ros {COMMANDS[given[0]].examples[0]}\n')


@pytest.mark.parametrize('name', COMMANDS)
def test_the_examples_of_a_help_are_right(name):
    for example in COMMANDS[name].examples:
        given = shlex.split(example)
        assert given[0] == name
        assert parser.parser_of(given).parse_args(given)


RESULTS = {
    'bag2csv': (0, 'bag', 'NEW/table.csv', *UR5E),
    'board': (0, 'charuco', *BOARD, '--out', 'NEW/board.pdf'),
    'chain': (0, 'ur5e', '--out', 'NEW/ur5e.yaml'),
    'compare': (3, 'result', 'bumped'),
    'compensate': (0, 'tests.csv', *UR5E, '--calibration', 'result', '--out', 'NEW/p.csv'),
    'csv2bag': (0, 'measured.csv', 'NEW/bag', *UR5E),
    'demo': (0, '--poses', '20', '--out', 'NEW/demo'),
    'export': (0, 'result/calibration.yaml', *UR5E, '--out', 'NEW/export'),
    'fleet': (3, 'plant.yaml', '--history', 'NEW/history', '--out', 'NEW/report'),
    'history': (0, 'history'),
    'identify': (0, 'measured.csv', *UR5E, '--out', 'NEW/result'),
    'images': (0, 'images', '--board', 'board.yaml', '--out', 'NEW/corners.csv'),
    'import': (0, 'measured.csv', *UR5E, '--out', 'NEW/table.csv'),
    'plan': (0, *UR5E, '--poses', '20', '--draw', '200', '--out', 'NEW/plan.csv'),
    'robots': (0,),
    'simulate': (0, 'NEW/bag', *UR5E, '--poses', '3'),
    'verify': (0, 'new.csv', *UR5E, '--calibration', 'result', '--tolerance', '0.5'),
    'workspace': (0, 'result', *UR5E, '--poses', '200', '--out', 'NEW/map'),
}
MORE = {
    'identify_refused': (3, 'identify', 'good_arm.csv', *UR5E),
    'identify_previous': (0, 'identify', 'bumped.csv', *UR5E, '--previous', 'result'),
    'identify_previous_refused': (3, 'identify', 'one.csv', *UR5E, '--previous', 'result'),
    'identify_of_a_program': (1, 'identify', 'result/report.html', *UR5E),
    'verify_of_a_bag': (3, 'verify', 'bag', *UR5E, '--calibration', 'result', '--tolerance', '1'),
    'identify_another_arm': (3, 'identify', 'measured.csv', '--chain', 'ur10'),
    'verify_of_a_lost_calibration': (3, 'verify', 'bumped.csv', *UR5E, '--calibration', 'result'),
    'a_table_as_command': (2, 'measured.csv'),
    'a_bag_as_command': (2, 'bag'),
    'nothing_there': (1, 'identify', 'missing.csv', *UR5E),
}


@pytest.fixture
def served(cell, monkeypatch, request):
    """Where the commands run, with the images or the cluster that the command named needs."""
    monkeypatch.chdir(cell)
    if request.param == 'images':
        cv2 = pytest.importorskip('cv2')
        from photographs import drawn

        (cell / 'images').mkdir()
        page = drawn(read_board(cell / 'board.yaml'))
        for image, shown in (
            ('board.png', np.pad(page, 200, constant_values=255)),
            ('wall.png', 0 * page),
        ):
            cv2.imwrite(str(cell / 'images' / image), shown)
    if request.param != 'fleet':
        yield request.param, ()
        return
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(1, processes=False, dashboard_address=None) as local:
        yield request.param, ('--scheduler', local.scheduler_address)


def test_a_wrong_command_proposes_the_right_one(shown):
    status, text = shown('identfy')
    assert (status, 'command "identfy": did you mean "identify"?' in text) == (2, True)
    assert 'did you mean' not in shown('calibrate')[1]  # not "compare"


def test_every_command_has_a_screen():
    assert {*RESULTS} == {*COMMANDS}


@pytest.mark.parametrize('served', [*RESULTS, *MORE], indirect=True)
@pytest.mark.usefixtures('new')
def test_the_result_of_a_command(monkeypatch, served):
    """In 80 columns; what may take over 2 s works where a sign of life is shown.

    A verdict is green or red as the status is, or neither if there is nothing to correct.
    """
    name, more = served
    expected, *arguments = MORE.get(name) or (RESULTS[name][0], name, *RESULTS[name][1:], *more)
    monkeypatch.setenv('TERM', 'dumb')
    monkeypatch.setattr(screen, 'FIRST_S', 1e6)
    begun, verdicts, title = [], [], screen.Screen.title
    told = lambda of, text, good=None: verdicts.append(good) or title(of, text, good)  # noqa: E731
    monkeypatch.setattr(screen.Screen, 'title', told)
    monkeypatch.setattr(screen, 'Work', lambda what: begun.append(what) or Work(what))
    terminal = Terminal()
    monkeypatch.setattr(sys, 'stdout', terminal)
    monkeypatch.setattr(sys, 'stderr', terminal)
    try:
        status = main(arguments)
    except SystemExit as err:
        status = err.code
    assert status == expected
    assert verdicts in ([], [None if name == 'identify_refused' else expected == 0])
    assert ESCAPE not in terminal.getvalue()
    assert begun or name not in {*RESULTS} - {'board', 'chain', 'export', 'history', 'robots'}
    assert_shown(name, without_digits(terminal.getvalue()))


@pytest.mark.parametrize('name', ['identify', 'identify_refused'])
def test_a_result_on_a_terminal(shown, monkeypatch, name):
    pytest.importorskip('rich')
    monkeypatch.delenv('NO_COLOR', raising=False)
    monkeypatch.setenv('TERM', 'xterm-256color')
    _, *arguments = MORE.get(name) or (0, name, 'measured.csv', *UR5E)
    coloured, plain = Terminal(), Terminal()
    monkeypatch.setattr(sys, 'stdout', coloured)
    main(arguments)
    assert ESCAPE in coloured.getvalue()
    monkeypatch.setenv('NO_COLOR', '1')
    monkeypatch.setattr(sys, 'stdout', plain)
    main(arguments)
    text = re.sub(r'\x1b\[[0-9;]*m', '', plain.getvalue())
    assert re.search(r'\x1b\[[0-9;]*3[0-9]', plain.getvalue()) is None
    assert text == re.sub(r'\x1b\[[0-9;]*m', '', coloured.getvalue())
    assert_shown(f'{name}_terminal', without_digits(text))


def test_quiet_says_nothing_but_what_is_asked_for(shown):
    assert shown('identify', 'measured.csv', *UR5E, '--quiet') == (0, '')
    assert shown('identify', 'measured.csv', *UR5E, '--quiet', '--json')[1].startswith('{')
    status, text = shown('identify', 'good_arm.csv', *UR5E, '--quiet')
    words = 'calib_ros: Nothing to correct: .*\ncalib_ros: There is nothing .* -> To .*\n'
    assert (status, re.fullmatch(words, text) is None) == (3, False)


def test_names_of_others_bring_no_escape_codes(shown):
    status, text = shown('identify', f'{ESCAPE}[31mred.csv', *UR5E)
    assert (status, ESCAPE in text) == (1, False)


def test_in_a_log_the_sign_of_life_is_a_line(shown, monkeypatch):
    monkeypatch.setattr(screen, 'EVERY_S', 1e-4)
    _, text = shown('identify', 'measured.csv', *UR5E)
    assert re.search(r'^calib_ros: .*, \d+ s', text, re.MULTILINE)
    assert ESCAPE not in text


def test_on_a_terminal_the_sign_is_a_bar_that_vanishes(shown, monkeypatch):
    pytest.importorskip('rich')
    monkeypatch.setenv('TERM', 'xterm-256color')
    monkeypatch.setattr(screen, 'FIRST_S', 1e-4)
    monkeypatch.setattr(sys, 'stderr', Terminal())
    main(['identify', 'measured.csv', *UR5E])
    said = sys.stderr.getvalue()
    assert 'identifying' in said
    assert said.endswith('\x1b[2K')


def test_a_warning_goes_above_the_bar(monkeypatch):
    """A missing extra was told behind the bar, on its line."""
    pytest.importorskip('rich')
    monkeypatch.setenv('TERM', 'xterm-256color')
    monkeypatch.setattr(screen, 'FIRST_S', 1e-4)
    monkeypatch.setattr(sys, 'stderr', Terminal())
    made, end = screen.Screen(), time.monotonic() + 60
    with made.work('counting'):
        while 'counting' not in sys.stderr.getvalue():
            assert time.monotonic() < end, 'no bar'
        made.warn('no jinja2', 'note')
    assert re.search(r'\x1b\[2K(\x1b\[33m)?note: no jinja2', sys.stderr.getvalue())


def test_work_tells_the_time_left(monkeypatch):
    monkeypatch.setattr(time, 'monotonic', lambda: 10.0)
    work = screen.Work('reading bag')
    monkeypatch.setattr(time, 'monotonic', lambda: 16.0)
    assert str(work) == 'reading bag, 6 s'
    work('third file')
    work(0.75)
    assert str(work) == 'reading bag (third file), 6 s, 75 %, 2 s left'
    work(0.5)  # never backwards
    monkeypatch.setattr(time, 'monotonic', lambda: 17.0)
    assert str(work) == 'reading bag (third file), 7 s, 75 %, 1 s left'
    work(1.0)  # all that is measured is done: no bar at its end
    assert str(work) == 'reading bag (third file), 7 s'


@pytest.mark.parametrize(
    ('command', 'least'),
    [
        (('identify', 'measured.csv', '--model', 'auto'), 7),
        (('csv2bag', 'measured.csv', 'NEW/bag'), 100),
    ],
)
@pytest.mark.usefixtures('new')
def test_a_command_tells_how_much_is_left(shown, monkeypatch, command, least):
    shares = []

    class Heard(Work):
        def __call__(self, at):
            super().__call__(at)
            shares.extend([] if isinstance(at, str) else [(self, at)])

    monkeypatch.setattr(screen, 'Work', Heard)
    status, text = shown(*command, *UR5E)
    assert status == 0, text
    assert len(shares) >= least
    last = {}
    for work, share in shares:
        assert last.get(id(work), 0.0) <= share <= 1.0
        last[id(work)] = share
    assert max(last.values()) > 0.6


@pytest.mark.parametrize(
    ('error', 'status', 'words'),
    [
        (OSError(errno.ENOSPC, 'No space left on device', 'x'), 1, 'make room'),
        (PermissionError(errno.EACCES, 'Permission denied', 'x'), 1, 'choose another place'),
        (FileExistsError(errno.EEXIST, 'File exists', 'x'), 1, 'choose another name'),
        (NotADirectoryError(errno.ENOTDIR, 'Not a directory', 'x'), 1, 'choose another place'),
        (OSError(errno.ENAMETOOLONG, 'File name too long', 'x'), 1, 'choose a shorter one'),
        (MemoryError(), 1, 'out of memory'),
        (KeyboardInterrupt(), 130, 'no half-written file remains'),
    ],
)
def test_what_goes_wrong_below_is_one_line_with_advice(shown, monkeypatch, error, status, words):
    def fail(*_):
        raise error

    monkeypatch.setattr('calib_ros.kinematics.chain_file.load_chain', fail)
    found, text = shown('chain', 'ur5e')
    assert (found, text.count('\n')) == (status, 1)
    assert words in text


@pytest.mark.parametrize('name', ['board', 'chain', 'csv2bag', 'export', 'plan'])
def test_a_full_disk_leaves_nothing_behind(new, shown, monkeypatch, name):
    """It is told in one line that names what was asked for; what was there before stays."""
    sync, calls = os.fsync, []

    def full(handle):
        calls.append(handle)
        if len(calls) > 1 or name == 'chain':
            raise OSError(errno.ENOSPC, 'No space left on device')
        sync(handle)

    monkeypatch.setattr(os, 'fsync', full)
    (new / 'notes').write_text('mine')
    status, text = shown(name, *RESULTS[name][1:])
    assert (status, [path.name for path in new.iterdir()]) == (1, ['notes'])
    line = text.splitlines()[-1]
    assert re.match(r'calib_ros: \S*NEW/[^.]\S*: the disk is full: make room', line)
    assert 'partial' not in text
