# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The boundary around every callback: an exception in one would end the spinning."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from rclpy.exceptions import InvalidHandle

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
