# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import os
import subprocess
import sys
from pathlib import Path

import pytest

from calib_ros.cli.screen import Screen


@pytest.mark.parametrize('given', ['--version', 'robots'])
def test_who_reads_no_further_is_no_error(given):
    command = f'{sys.executable} -m calib_ros {given} | true; exit ${{PIPESTATUS[0]}}'
    assert printed_in('bash', command) == (141, '')


@pytest.mark.skipif(not Path('/dev/full').exists(), reason='a device of Linux')
@pytest.mark.parametrize('given', ['', '--version', 'chain ur10e'])
def test_output_that_finds_the_disk_full_is_told_once(given):
    """Python tried again at its end: a second message, and exit status 120."""
    full = 'calib_ros: the disk is full: make room, or write to another place\n'
    command = f'{sys.executable} -m calib_ros {given} > /dev/full'
    assert printed_in('sh', command) == (1, full)


def test_a_home_that_cannot_be_written_is_no_warning(tmp_path):
    """As under cron: matplotlib advised the operator about its cache, twice."""
    made = 'board markers --columns 2 --rows 2 --square 0.04 --marker 0.03'
    made += f' --out {tmp_path}/board.pdf --quiet'
    assert printed_in('sh', f'HOME=/proc/none {sys.executable} -m calib_ros {made}') == (0, '')


def printed_in(shell, command):
    """Return the exit status and errors of a command with the usual buffers and caches."""
    unusual = ('PYTHONUNBUFFERED', 'MPLCONFIGDIR', 'XDG_CONFIG_HOME', 'XDG_CACHE_HOME')
    environment = {name: value for name, value in os.environ.items() if name not in unusual}
    given = [shell, '-c', command]
    ended = subprocess.run(given, env=environment, capture_output=True, text=True, check=False)
    return ended.returncode, ended.stderr


def test_a_verdict_in_a_file_is_wrapped_as_what_follows_it(capsys):
    Screen().title('Nothing to correct at these poses' + 6 * ', by far')
    Screen(quiet=True).title('Accepted')
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == 2
    assert len(shown[0]) <= 80
    assert shown[1].startswith('  ')
