# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How far a long piece of work is: told by stages, and ended between two of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from calib_ros.errors import CalibrationError


class CancelledError(CalibrationError):
    """A piece of work that was ended on request."""


class Progress:
    """What a piece of work on another thread is at; called with each stage that begins.

    `what` says in a word what the work does.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._lock = threading.Lock()
        self._stage = ''
        self._began: float | None = None
        self._cancelled = False

    def __call__(self, stage: str) -> None:
        """Note which stage begins."""
        with self._lock:
            self._refuse_cancelled()
            self._stage = stage

    def __str__(self) -> str:
        """Return in words what is done, and for how long; empty while nothing is."""
        with self._lock:
            if self._began is None:
                return ''
            return f'{self._what} for {time.monotonic() - self._began:.0f} s ({self._stage})'

    def begin(self) -> None:
        """Note that the work is about to run."""
        with self._lock:
            self._stage, self._began, self._cancelled = 'start', time.monotonic(), False

    @contextmanager
    def running(self) -> Iterator[None]:
        """Run the work in a `with` block; what is cancelled within it never leaves it well."""
        try:
            yield
            with self._lock:
                self._refuse_cancelled()
                self._began = None  # too late to cancel
        finally:
            with self._lock:
                self._began = None

    def cancel(self) -> tuple[bool, str]:
        """End the work after the stage that it is in; return whether it runs, and words."""
        with self._lock:
            if self._began is None:
                return False, f'nothing to cancel: not {self._what}'
            self._cancelled = True
            return True, f'{self._what} ends after this stage ({self._stage})'

    def _refuse_cancelled(self) -> None:
        if self._cancelled:
            raise CancelledError(f'cancelled after the stage "{self._stage}"')
