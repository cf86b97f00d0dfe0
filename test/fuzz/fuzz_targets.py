# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every reader as a function of bytes, and the contract that it has to keep.

A reader takes whatever it is given, or says what is wrong by a `CalibrationError` of at most 1,000
characters or an `OSError`; within ten seconds of CPU and 500 MB.
"""

import contextlib
import faulthandler
import io
import os
import resource
import shutil
import signal
import sys
import tempfile
from pathlib import Path

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from calib_ros.errors import LONGEST, CalibrationError
from calib_ros.kinematics.chain import Chain, Joint

HERE = Path(__file__).parent
CORPUS = HERE / 'corpus'
SECONDS, MEGABYTES = 10, 500
ARM = Chain(
    'arm',
    'standard',
    (Joint('a', alpha=1.5, d=0.3), Joint('b', a=0.4), Joint('c', 'prismatic', a=0.1)),
)
TARGETS = {}


class TooSlowError(BaseException):
    """More than the seconds of CPU allowed; no reader may catch it."""


class TooLargeError(BaseException):
    """More than the memory allowed."""


def target(suffix):
    """Register a reader of a file with this name or ending, in a folder of its own."""

    def register(run):
        def given(data):
            folder = Path(tempfile.mkdtemp(dir=_memory()))
            path = folder / (suffix if '.' in suffix[1:] else f'file{suffix}')
            try:
                path.write_bytes(data)
                run(path)
            finally:
                shutil.rmtree(folder)

        TARGETS[run.__name__] = given
        return run

    return register


def _memory():
    return '/dev/shm' if os.access('/dev/shm', os.W_OK) else None


def keep_contract(name, data):
    """Run a target; raise what no user may see."""

    def ring(*_):
        raise TooSlowError(f'{name}: longer than {SECONDS} s')

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of this process: others may be busy
    faulthandler.dump_traceback_later(12 * SECONDS, exit=True)  # where no signal gets through
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            TARGETS[name](data)
    except CalibrationError as err:
        if len(str(err)) > LONGEST:
            raise AssertionError('a message of too many characters') from err
    except OSError:
        pass
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if grown > 1000 * MEGABYTES:
        raise TooLargeError(f'{name}: {grown / 1000:.0f} MB')


def corpus(name):
    """Return the seeds of a target, and what made it fail once."""
    return [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]


@target('.csv')
def table(path):
    from calib_ros.estimation.problem import Problem
    from calib_ros.files.tables import read_table

    read = read_table(path, len(ARM.joints))
    problem = Problem(ARM, read.fitted[0], read.held_out, more=read.fitted[1:])
    for observations in (*read.fitted, *read.held_out):
        if observations.distances is None:
            from calib_ros.estimation.samples import Samples

            Samples(observations, problem.sigma_position, problem.sigma_orientation)


@target('.csv')
def foreign(path):
    """The layout in the first lines, up to a mark of its own; then the table."""
    from calib_ros.files.columns import as_csv
    from calib_ros.files.foreign import Foreign
    from calib_ros.files.layouts import load_layout

    layout, _, rows = path.read_bytes().partition(b'===\n')
    given = path.with_suffix('.yaml')
    given.write_bytes(layout)
    path.write_bytes(rows)
    columns, _ = Foreign(load_layout(str(given)), ARM).convert(path)
    as_csv(columns)


@target('.yaml')
def board(path):
    from calib_ros.files.boards import read_board

    _ = read_board(path).corners


@target('.yaml')
def lens(path):
    from calib_ros.files.lenses import read_lens

    read_lens(path)


@target('.csv')
def detections(path):
    import numpy as np

    from calib_ros.files.boards import read_board
    from calib_ros.files.detections import observed, read_detections
    from calib_ros.files.image_places import read_places

    known = read_board(CORPUS / 'board' / 'seed0')
    with contextlib.suppress(CalibrationError):
        read_places(path, len(ARM.joints))
    found = read_detections(path, known)
    observed(found, known, dict.fromkeys(found.names, np.zeros(len(ARM.joints))), False)


@target('.csv')
def journal(path):
    from calib_ros.files.journal import Journal, read_journal

    samples, _ = read_journal(path, len(ARM.joints))
    writing = Journal(path, len(ARM.joints))
    for sample in samples[:2]:
        writing.add(sample)
    writing.close()


@target('.csv')
def waypoints(path):
    from calib_ros.files.programs import read_joints, read_poses

    for read in (lambda: read_joints(path, ARM), lambda: read_poses(path)):
        with contextlib.suppress(CalibrationError):
            read()


@target('.csv')
def program_csv(path):
    _program(path)


@target('.yaml')
def program_yaml(path):
    _program(path)


def _program(path):
    from calib_ros.files.programs import read_program

    read = read_program(path, ARM)
    read.text_with(read.program)


@target('.yaml')
def chain(path):
    import numpy as np

    from calib_ros.files.export import exports
    from calib_ros.kinematics.chain_file import dump_chain, load_chain, parse_chain

    found = load_chain(path)
    found.forward(found.random_joints(5, np.random.default_rng(0)))
    parse_chain(dump_chain(found))
    if len(path.read_bytes()) % 64 == 0:  # the slow part now and then
        exports(found, found)


@target('.yaml')
def calibration(path):
    from calib_ros.identification.calibration import load_calibration

    load_calibration(path, ARM)


@target('.urdf')
def urdf(path):
    from calib_ros.kinematics.chain_file import chain_text, read_urdf
    from calib_ros.kinematics.corrected_urdf import corrected_urdf

    found = read_urdf(path)
    corrected_urdf(chain_text(path), found.with_offsets({f'{found.joint_names[0]}.theta': 1e-3}))


def _replayed(path):
    from calib_ros.files.bags import replay
    from calib_ros.sampling.session import CalibrationSession

    session = CalibrationSession(ARM)
    replayed = replay(path, session)
    for reason in replayed.refusals(session.account(), 0.1):
        assert len(reason) <= LONGEST
    return str(replayed), str(session.account())


@target('.mcap')
def bag_mcap(path):
    _replayed(path)


@target('.db3')
def bag_sqlite3(path):
    _replayed(path)


@target('metadata.yaml')
def metadata(path):
    """Of a bag whose file is whole."""
    seed = sorted((CORPUS / 'bag_mcap').iterdir())[0]
    shutil.copy(seed, path.parent / 'bag.mcap')
    _replayed(path.parent)


def message(data):
    """The first byte chooses the type; messages are divided by a mark."""
    from calib_ros.files.bags import _deserialiser
    from calib_ros.sampling.batches import feed
    from calib_ros.sampling.messages import JOINT_STATE, MEASURES
    from calib_ros.sampling.session import CalibrationSession
    from calib_ros.sampling.sources import Source
    from calib_ros.sampling.streams import Stream

    session = CalibrationSession(ARM)
    types = [JOINT_STATE, *MEASURES]
    batch = []
    for part in data.split(MARK):
        kind = types[part[0] % len(types)] if part else JOINT_STATE
        source = None if kind == JOINT_STATE else Source(f'/{kind}', kind)
        batch.append((Stream(f'/{kind}', kind, source), part[1:]))
    problems = feed(session, batch, _deserialiser({}))
    session.finish()
    assert not any('internal error' in text for text in problems), problems
    str(session.account())


MARK = b'\xfe\xed'
TARGETS['message'] = message


def settings(data):
    """Options of identify, one in a line."""
    from calib_ros.cli import parser
    from calib_ros.cli.common import settings_of
    from calib_ros.sampling.session import CalibrationSession

    lines = data.decode(errors='replace').replace('\0', '').split('\n')
    with contextlib.suppress(SystemExit):
        given = ['identify', 'bag', '--chain', 'ur10e', *lines]
        CalibrationSession(ARM, settings_of(parser.parser_of(given).parse_args(given)))


TARGETS['settings'] = settings


def command(data):
    """A command line that ends before it computes much: its files are not there."""
    from calib_ros.cli import main

    lines = data.decode(errors='replace').replace('\0', '').split('\n')
    folder = tempfile.mkdtemp(dir=_memory())
    back = Path.cwd()
    os.chdir(folder)
    try:
        if lines[0] in ('identify', 'verify', 'compensate', 'workspace', 'export', 'chain'):
            with contextlib.suppress(SystemExit):
                main.main([line for line in lines if '/' not in line])
    finally:
        os.chdir(back)
        shutil.rmtree(folder)


TARGETS['command'] = command


if __name__ == '__main__':  # judge files: TARGET FILE ...
    for name_ in sys.argv[2:]:
        keep_contract(sys.argv[1], Path(name_).read_bytes())
