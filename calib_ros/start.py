# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The programs. They take seconds to load, and an interruption meanwhile ends them in silence."""

import gc
import importlib
import signal
import sys


def command_line() -> int:
    """Run the command line; return its exit status."""
    gc.set_threshold(100_000)  # the many objects of modules while they load are no garbage
    return _run('calib_ros.cli.main')


def node() -> int:
    """Run the node; return its exit status."""
    return _run('calib_ros.ros.node')


def _run(name: str) -> int:
    try:
        import fcntl  # noqa: F401
    except ImportError:
        sys.exit('calib_ros does not run on Windows itself: use it in WSL')
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # a background job: none
    if usual:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    module = importlib.import_module(name)
    if usual:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    status: int = module.main()
    return status
