# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A node from the command line to its end by a signal."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from calib_ros.errors import CalibrationError, trouble
from calib_ros.ros.arguments import NODE, typed, usage


def run(make: Callable[[], Any], arguments: Sequence[str] | None) -> int:
    """Run the node that is made until SIGINT or SIGTERM; return the exit status.

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
    _handle_signals(lambda number, frame: stop.set())
    node = executor = None
    status, finished = 0, True
    try:
        rclpy.init(args=command, signal_handler_options=SignalHandlerOptions.NO)
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.announce()
        while not stop.is_set() and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
    except ExternalShutdownException:
        pass
    except (CalibrationError, ParameterException, rclpy_implementation.RCLError) as err:
        print(f'calibration_node: {err}', file=sys.stderr)
        status = 1
    except OSError as err:  # a journal of another user, say
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
    if not finished:  # the interpreter cannot end while a thread computes
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _handle_signals(handler: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)
