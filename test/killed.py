# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes that are killed while they write."""

import os
import sys

from calib_ros.errors import InputError

KILLED = 77


def tree(folder):
    """Return the text of each file below a folder."""
    paths = sorted(path for path in folder.rglob('*') if path.is_file())
    return {str(path.relative_to(folder)): path.read_text() for path in paths}


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


def killed_at(number, where, work, calls_of=('open', 'os.', 'shutil.')):
    """Run some work that is killed just before its n-th call that touches files below `where`.

    Returns whether it was: False when it has ended before.
    """

    def child():
        calls = 0

        def count(event, arguments):
            nonlocal calls
            touched = event.startswith(calls_of) and arguments
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
