# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The programs. They take seconds to load, and an interruption meanwhile ends them in silence."""

import importlib
import signal


def command_line() -> int:
    """Run the command line; return its exit status."""
    return _run('calib_ros.cli.main')


def node() -> int:
    """Run the node; return its exit status."""
    return _run('calib_ros.ros.node')


def _run(name: str) -> int:
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else it is ignored, as of a background job
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    module = importlib.import_module(name)
    signal.signal(signal.SIGINT, before)
    status: int = module.main()
    return status
