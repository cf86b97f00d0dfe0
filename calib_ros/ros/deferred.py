# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Services whose work runs on a thread of its own, and is answered when it ends."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from calib_ros.ros.boundary import Answer, Job


class DeferredTrigger:
    """A Trigger service whose work runs on a separate thread, and is answered when it ends.

    An async callback starves the node's timers in rclpy's single-threaded executor. Several
    threads, one for each such service and one for the rest, would need a lock around the session,
    and cost an idle node 13 % more. A call during the work is refused at once.

    `prepare` returns the work on the executor's thread, with a snapshot of what it needs. `answer`
    takes the name and either of them, and converts its result or exception to an answer.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        answer: Callable[[str, Job], Answer],
        prepare: Callable[[], Job],
    ) -> None:
        self._answer, self._prepare = partial(answer, name), prepare
        self._thread: threading.Thread | None = None
        self._running = threading.Event()
        node.create_service(Trigger, name, self._on_call)

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
        """Return what begins the work (`InOrder.execute`), or the answer that it cannot."""
        work: list[Job] = []

        def prepare() -> Answer:
            if self.busy:
                return False, 'refused: the previous call is still running; wait for its answer'
            work.append(self._prepare())
            return True, ''

        response.success, response.message = self._answer(prepare)
        return partial(self._begin, *work, response) if work else response

    def _begin(self, *given: Any) -> None:
        self._running.set()
        thread = threading.Thread(target=self._run, args=given, daemon=True)
        try:
            thread.start()
        except RuntimeError:  # too many processes: it is done here, and messages wait
            self._run(*given)
        else:
            self._thread = thread

    def _run(self, work: Job, response: Any, send: Callable[[Any], None]) -> None:
        response.success, response.message = self._answer(work)
        self._running.clear()  # before the answer, since the caller may call again at once
        try:
            send(response)
        except Exception:  # the node has ended
            return
