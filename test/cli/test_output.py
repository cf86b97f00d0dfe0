# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize('given', ['', '--version', 'robots'])
def test_who_reads_no_further_is_no_error(given):
    command = f'{sys.executable} -m calib_ros {given} | true; exit ${{PIPESTATUS[0]}}'
    assert printed_in('bash', command) == (141, '')


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='a device of Linux')
@pytest.mark.parametrize('given', ['', '--version', 'robots', 'chain ur10e'])
def test_output_that_finds_the_disk_full_is_told_once(given):
    """Python tried again at its end: a second message, and exit status 120."""
    full = 'calib_ros: the disk is full: make room, or write to another place\n'
    command = f'{sys.executable} -m calib_ros {given} > /dev/full'
    assert printed_in('sh', command) == (1, full)


def printed_in(shell, command):
    """Return the exit status and errors of a command whose output Python buffers, as usual."""
    environment = {name: value for name, value in os.environ.items() if name != 'PYTHONUNBUFFERED'}
    given = [shell, '-c', command]
    ended = subprocess.run(given, env=environment, capture_output=True, text=True, check=False)
    return ended.returncode, ended.stderr
