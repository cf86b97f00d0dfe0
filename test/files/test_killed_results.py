# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags as a whole or not at all, whoever is killed, and commands that tidy up."""

import os
import resource
import shutil
import signal
import sys

import numpy as np
import pytest
from killed import every_kill, forked, status_of
from measured import measured

from calib_ros.cli import identify, main
from calib_ros.files.bags import replay
from calib_ros.files.recording import Recording, write_bag
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings


def dwells(count):
    recorded = measured(count=count)
    names = tuple(load_chain('ur5e').joint_names)
    return Recording.of_dwells(names, recorded, np.zeros(count, bool))


def test_a_bag_whose_writing_is_killed_is_absent(tmp_path):
    path, truth = tmp_path / 'cells' / 'bag', tmp_path / 'cells' / 'truth.yaml'

    recording = dwells(3)

    def write():
        write_bag(path, recording, 'mcap', {truth: 'truth'})

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


def test_a_command_that_is_terminated_tidies_up(tmp_path, monkeypatch):
    """As by timeout, systemd or docker stop: it ends like one that is interrupted."""
    arguments = ['identify', '--csv', 'unread', '--chain', 'ur5e', '--out', str(tmp_path / 'out')]
    monkeypatch.setattr(sys, 'argv', ['calib_ros', *arguments])
    monkeypatch.setattr(identify, '_loaded', lambda *_: signal.raise_signal(signal.SIGTERM))
    assert status_of(forked(lambda: os._exit(main.main()))) == 130
    assert list(tmp_path.iterdir()) == []
