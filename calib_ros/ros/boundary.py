# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The boundary around every callback: an exception in one would end the spinning."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from std_srvs.srv import Trigger

from calib_ros.errors import CalibrationError, trouble

Answer = tuple[bool, str]


class Boundary:
    """Logs by the node's logger what callbacks and services raise, and goes on."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged: dict[str, str] = {}
        self.failed: dict[str, str] = {}
        """What has failed since somebody has emptied it, in words."""

    def guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that logs what it raises."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except InvalidHandle:  # the node was ended meanwhile: nobody hears any more
                return
            except Exception:
                self._log()

        return guarded

    def tried(self, what: str, work: Callable[[], Any]) -> Any:
        """Return what a part of the work returns; None when it fails, which is told then."""
        try:
            return work()
        except Exception as err:
            self.failed[what] = f'{what} failed: {err!r}'
            if self._logged.get(what) != str(err):  # not every second
                self._logged[what] = str(err)
                self._log()
            return None

    def answer(self, name: str, work: Callable[[], Answer]) -> Answer:
        """Run the work of a service; an error is its answer. Who reads the log sees it, too."""
        try:
            success, text = work()
        except CalibrationError as err:
            success, text = False, str(err)
        except OSError as err:
            success, text = False, trouble(err)
        except Exception as err:
            self._log()
            success, text = False, f'internal error, see the log: {err!r}'
        if not success:  # rclpy knows calls by their line, and takes one severity for each
            self._logger.warning(f'{name}: {text}')
        elif text:
            self._logger.info(f'{name}: {text}')
        return bool(success), str(text)

    def _log(self) -> None:
        self._logger.error(f'internal error: {traceback.format_exc()}')


class DeferredTrigger:
    """A Trigger service whose work runs on a thread of its own.

    Jazzy's executors send the answer through the service's `send_response` right after the
    callback, on the same thread. It is replaced here by one that holds the answer of an accepted
    call back until its work has ended. An async callback starves the node's timers in rclpy's
    single-threaded executor. Several threads, one for each such service and one for the rest,
    would need a lock around all that the session holds, and cost an idle node 13 % more. A call
    that comes meanwhile is refused at once.

    `prepare` returns a snapshot, on the executor's thread, and `work` answers with it. `answer`
    takes the name and either, and makes an answer of what it returns or raises.
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

    def join(self, timeout: float) -> bool:
        """Wait for the work [s]; return whether it has ended."""
        if self._thread is not None:
            self._thread.join(timeout)
        return self._thread is None or not self._thread.is_alive()

    def _on_call(self, request: Any, response: Any) -> Any:
        def prepare() -> Answer:
            if self._running.is_set():
                return False, 'refused: the call before is still running, wait for its answer'
            self._snapshot = [self._prepare()]
            return True, ''

        response.success, response.message = self._answer(prepare)
        return response

    def _send_unless_deferred(self, response: Any, header: Any) -> None:
        if not self._snapshot:
            self._send(response, header)
            return
        snapshot = self._snapshot.pop()
        self._running.set()
        self._thread = threading.Thread(
            target=self._run, args=(snapshot, response, header), daemon=True
        )
        self._thread.start()

    def _run(self, snapshot: Any, response: Any, header: Any) -> None:
        response.success, response.message = self._answer(lambda: self._work(snapshot))
        self._running.clear()  # before the answer: the caller may call again at once
        try:
            self._send(response, header)
        except Exception:  # the node is gone meanwhile, and with it the one who asked
            return
