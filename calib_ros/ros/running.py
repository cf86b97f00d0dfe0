# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The run of a node, until a signal ends it."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Collection, Sequence
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from calib_ros.errors import CalibrationError, trouble
from calib_ros.ros.arguments import NODE
from calib_ros.ros.command_line import refuse_ignored_files, shared_names, typed, usage


def run_node(make: Callable[[Collection[str]], Any], arguments: Sequence[str] | None) -> int:
    """Run a node, made with `shared_names`, until a signal ends it; return the exit status.

    rclpy must not see the signals: its handler invalidates the context while messages are taken.
    """
    command = typed(sys.argv if arguments is None else [NODE, *arguments])
    parser = usage(NODE)
    try:
        parser.parse_args(remove_ros_args(command)[1:])
    except rclpy_implementation.UnknownROSArgsError as err:
        parser.error(f'unknown ROS arguments: {err}')
    except rclpy_implementation.RCLInvalidROSArgsError as err:
        parser.error(str(err))
    stop = threading.Event()
    node = executor = None

    def on_signal(number: int, frame: Any) -> None:
        stop.set()
        if node is None:
            raise KeyboardInterrupt

    _handle_signals(on_signal)
    status, finished = 0, True
    try:
        rclpy.init(args=command, signal_handler_options=SignalHandlerOptions.NO)
        node = make(shared_names(command))
        refuse_ignored_files(command, node.get_fully_qualified_name())
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.announce()
        _spin(node, executor, stop)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    except (CalibrationError, OSError, ParameterException, rclpy_implementation.RCLError) as err:
        print(f'calibration_node: {trouble(err)}', file=sys.stderr)
        status = 1
    finally:
        _handle_signals(signal.SIG_IGN)  # a second one must not interrupt the clean-up
        if node is not None:
            finished = node.close()
            status = 1 if node.lost else status
        if executor is not None:
            executor.shutdown()
        rclpy.try_shutdown()
    if not finished:  # a computing thread blocks the interpreter's exit
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _spin(node: Any, executor: SingleThreadedExecutor, stop: threading.Event) -> None:
    while not stop.is_set() and rclpy.ok():
        executor.spin_once(timeout_sec=0.1)
    for _ in (*node.waitables, *node.timers):  # calls that came before the end are answered
        executor.spin_once(timeout_sec=0.0)


def _handle_signals(handler: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # by nohup
            signal.signal(number, handler)
