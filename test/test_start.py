# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Programs that are interrupted while they load, or cannot be loaded."""

import signal
import subprocess
import sys

import pytest

SLOW = """
import importlib, signal, time
from calib_ros import start
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a background job
def slow(name):
    print(name, flush=True)
    time.sleep(600.0)
importlib.import_module = slow
"""


@pytest.mark.parametrize(
    ('program', 'module'), [('command_line', 'calib_ros.cli.main'), ('node', 'calib_ros.ros.node')]
)
def test_an_interruption_ends_it_in_silence(program, module):
    """A traceback of numpy or rclpy was printed."""
    given = [sys.executable, '-c', f'{SLOW}start.{program}()']
    with subprocess.Popen(
        given, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout.readline() == f'{module}\n'
        child.send_signal(signal.SIGINT)
        assert child.communicate() == ('', '')
    assert child.returncode == -signal.SIGINT


def test_windows_is_told_what_to_use_instead():
    """A traceback ended in `No module named 'fcntl'`."""
    code = "import sys; sys.modules['fcntl'] = None; from calib_ros import start; "
    code += 'sys.exit(start.command_line())'
    given = [sys.executable, '-c', code, 'robots']
    ended = subprocess.run(given, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (1, '')
    assert ended.stderr == 'calib_ros does not run on Windows itself: use it in WSL\n'
