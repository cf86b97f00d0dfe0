# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Error boundaries around every callback and every service.

An exception in a callback would end the spinning.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from rclpy.exceptions import InvalidHandle

from calib_ros.errors import CalibrationError, trouble

Answer = tuple[bool, str]
Job = Callable[[], Answer]


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

    def answer(self, name: str, work: Job) -> Answer:
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
