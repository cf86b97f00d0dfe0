# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Error boundaries: around every callback, every service, and the node as a whole.

An exception in a callback would end the spinning.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from operator import itemgetter
from typing import Any

import rclpy
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from rclpy.waitable import NumberOfEntities, Waitable
from std_srvs.srv import Trigger

from calib_ros.errors import CalibrationError, trouble
from calib_ros.ros.arguments import NODE, refuse_ignored_files, shared_names, typed, usage

Answer = tuple[bool, str]


class Boundary:
    """Log exceptions of callbacks and services, and continue."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged: dict[str, str] = {}
        self.failed: dict[str, str] = {}  # failures since it was last emptied

    def guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that logs its exceptions."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except InvalidHandle:  # the node has ended
                return
            except Exception:
                self._log()

        return guarded

    def tried(self, what: str, work: Callable[[], Any]) -> Any:
        """Return the result of some work, or report a failure and return None."""
        try:
            return work()
        except Exception as err:
            self.failed[what] = f'{what} failed: {err!r}'
            if self._logged.get(what) != str(err):  # not every second
                self._logged[what] = str(err)
                self._log()
            return None

    def answer(self, name: str, work: Callable[[], Answer]) -> Answer:
        """Run the work of a service; an error becomes its answer and is logged."""
        try:
            success, text = work()
        except (CalibrationError, OSError) as err:
            success, text = False, trouble(err)
        except Exception as err:
            self._log()
            success, text = False, f'internal error, see the log: {err!r}'
        if not success:  # rclpy allows one severity per line of code
            self._logger.warning(f'{name}: {text}')
        elif text:
            self._logger.info(f'{name}: {text}')
        return bool(success), str(text)

    def _log(self) -> None:
        self._logger.error(f'internal error: {traceback.format_exc()}')


class InOrder(Waitable):  # type: ignore[misc]  # see pyproject.toml
    """The services of a node, answered in the order of the calls.

    Jazzy's executors answer the calls that wait in the order in which the services were created:
    a ~/clear overtook the ~/identify before it.
    """

    def __init__(self, node: Node) -> None:
        super().__init__(node.default_callback_group)
        self._logger = node.get_logger()
        self._services: list[Service] = list(node.services)
        self._places: list[int] = []  # in the wait set
        self._waited = ExitStack()
        node.add_waitable(self)

    def __enter__(self) -> None:
        """Keep services from being destroyed while they are waited for; forget those that were."""
        for each in tuple(self._services):
            try:
                self._waited.enter_context(each.handle)
            except InvalidHandle:
                self._services.remove(each)

    def __exit__(self, *error: object) -> None:
        """Let services be destroyed."""
        self._waited.close()

    def __contains__(self, service: object) -> bool:
        """Tell whether a service is one of these, not to be served by the executor."""
        return service in self._services

    def get_num_entities(self) -> NumberOfEntities:
        """Return what it adds to a wait set."""
        return NumberOfEntities(num_services=len(self._services))

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Wait for calls."""
        self._places = [wait_set.add_service(each.handle) for each in self._services]

    def is_ready(self, wait_set: Any) -> bool:
        """Tell whether calls wait."""
        return any(wait_set.is_ready('service', place) for place in self._places)

    def take_data(self) -> list[tuple[int, Service, Any, Any]]:
        """Return the calls that wait, in the order in which they came."""
        come = []
        for service in self._services:
            with suppress(InvalidHandle), service.handle:
                take = partial(service.handle.service_take_request, service.srv_type.Request)
                for request, header in iter(take, (None, None)):
                    stamp = header.received_timestamp or header.source_timestamp  # 0: unknown
                    come.append((stamp, service, request, header))
        return sorted(come, key=itemgetter(0))

    async def execute(self, taken_data: list[tuple[int, Service, Any, Any]]) -> None:
        """Answer calls; the answer of one that fails is blank."""
        for _, service, request, header in taken_data:
            response = service.srv_type.Response()
            try:
                try:
                    response = service.callback(request, response)
                finally:
                    service.send_response(response, header)
            except Exception as err:  # as of rclpy, for a parameter of no known type
                name = service.srv_name
                self._logger.error(f'{name}: the call cannot be answered: {err!r}')


class DeferredTrigger:
    """A Trigger service whose work runs on a separate thread.

    The answer is sent through the service's `send_response` right after the callback, on the same
    thread. It is replaced here by one that holds the answer back until the work has ended. An
    async callback starves the node's timers in rclpy's single-threaded
    executor. Several threads, one for each such service and one for the rest, would need a lock
    around the session, and cost an idle node 13 % more. A call during the work is refused at once.

    `prepare` returns a snapshot on the executor's thread, `work` answers from it. `answer` takes
    the name and either of them, and converts its result or exception to an answer.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        answer: Callable[[str, Callable[[], Answer]], Answer],
        prepare: Callable[[], Any],
        work: Callable[[Any], Answer],
    ) -> None:
        self._answer = partial(answer, name)
        self._prepare, self._work = prepare, work
        self._thread: threading.Thread | None = None
        self._running = threading.Event()
        self._snapshot: list[Any] = []
        self._service = node.create_service(Trigger, name, self._on_call)
        self._send = self._service.send_response
        self._service.send_response = self._send_unless_deferred

    @property
    def busy(self) -> bool:
        """Tell whether work runs."""
        return self._running.is_set()

    def join(self, timeout: float | None) -> bool:
        """Wait for the work [s], with None to its end; return whether it has ended."""
        if self._thread is not None:
            self._thread.join(timeout)
        return self._thread is None or not self._thread.is_alive()

    def _on_call(self, request: Any, response: Any) -> Any:
        def prepare() -> Answer:
            if self.busy:
                return False, 'refused: the previous call is still running; wait for its answer'
            self._snapshot = [self._prepare()]
            return True, ''

        response.success, response.message = self._answer(prepare)
        return response

    def _send_unless_deferred(self, response: Any, header: Any) -> None:
        if not self._snapshot:
            self._send(response, header)
            return
        given = self._snapshot.pop(), response, header
        self._running.set()
        self._thread = threading.Thread(target=self._run, args=given, daemon=True)
        self._thread.start()

    def _run(self, snapshot: Any, response: Any, header: Any) -> None:
        response.success, response.message = self._answer(lambda: self._work(snapshot))
        self._running.clear()  # before the answer, since the caller may call again at once
        try:
            self._send(response, header)
        except Exception:  # the node has ended
            return


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
