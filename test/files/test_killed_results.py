# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags and results as a whole or not at all, whoever is killed."""

import itertools
import os
import resource
import shutil
import signal
import sys
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from killed import KILLED, every_kill, forked, status_of, tree
from measured import measured
from rosbags.rosbag2 import Writer

from calib_ros.cli import given, identify, main
from calib_ros.cli.identify import Identified
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.estimation.problem import Problem
from calib_ros.files.bags import Recording, replay, write_bag
from calib_ros.files.loading import Loaded
from calib_ros.identification import calibration
from calib_ros.identification.identification import identify as identified_from
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report import plots, words
from calib_ros.report.page import Origin
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings


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
        truth.unlink(missing_ok=True)

    write()  # here first, so that no child has to load the message types
    check()
    assert every_kill(tmp_path, write, check, step=3) > 10
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
        with pytest.raises(OSError, match=r'/bag'):
            write_bag(tmp_path / 'bag', dwells(40), storage, {tmp_path / 'truth': 'true'})

    assert status_of(forked(child)) == 0
    assert list(tmp_path.iterdir()) == []


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
    monkeypatch.setattr(identify, 'identification_report', lambda *of: of[1])
    monkeypatch.setattr(given.page, 'render', lambda result: f'page of {result.names}')
    monkeypatch.setattr(identify, 'markdown', lambda result, samples: f'{samples} {result.names}')
    monkeypatch.setattr(
        calibration, 'datetime', Mock(now=lambda zone: Mock(isoformat=lambda **k: ''))
    )
    return {'A': found('A', 5), 'B': found('B', 6)}


def test_a_command_that_is_terminated_tidies_up(tmp_path, monkeypatch):
    """As by timeout, systemd or docker stop: it ends like one that is interrupted."""
    arguments = ['identify', '--csv', 'unread', '--chain', 'ur5e', '--out', str(tmp_path / 'out')]
    monkeypatch.setattr(sys, 'argv', ['calib_ros', *arguments])
    monkeypatch.setattr(identify, '_identified', lambda *_: signal.raise_signal(signal.SIGTERM))
    assert status_of(forked(lambda: os._exit(main.main()))) == 130
    assert list(tmp_path.iterdir()) == []


def test_an_identification_that_is_killed_mixes_nothing(tmp_path, monkeypatch, identified):
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
    assert 'calibration.yaml' not in b
    assert b['calibration.previous.yaml'] == a['calibration.yaml']
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
