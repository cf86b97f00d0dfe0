# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Progress of long work: stages and shares, and cancellation between stages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

from calib_ros.errors import CalibrationError

Notify: TypeAlias = Callable[[str | float], None]
"""Called with each stage that begins (text), and with the share done."""


def quiet(at: str | float) -> None:
    """Ignore progress."""


def share_of(progress: Notify, begin: float, end: float) -> Notify:
    """Return a progress function for a part of the work, between two shares of the whole."""
    return lambda at: progress(at if isinstance(at, str) else begin + at * (end - begin))


class CancelledError(CalibrationError):
    """Work cancelled on request."""


class Progress:
    """Progress of work on another thread; `what` names the work."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._lock = threading.Lock()
        self._cancelled = False
        self._began: float | None = None
        self._stage, self._ends = '', 0.0
        self.share = 0.0

    def __call__(self, at: str | float) -> None:
        """Note the stage that begins, or the share done, which never decreases."""
        with self._lock:
            self._refuse_cancelled()
            if isinstance(at, str):
                self._stage = at
            elif self._began is not None and self.share < at:
                now, self.share = time.monotonic(), min(at, 1.0)
                self._ends = now + (now - self._began) * (1.0 / self.share - 1.0)

    def __str__(self) -> str:
        """Return the work in progress and its times; empty if idle."""
        return '' if self._began is None else f'{self.words}, {self.times}'

    @property
    def words(self) -> str:
        """Return the work and its stage."""
        return f'{self._what} ({self._stage})' if self._stage else self._what

    @property
    def times(self) -> str:
        """Return the time spent, and the time left if known."""
        now = time.monotonic()
        words = f'{now - (self._began or now):.0f} s'
        if 0 < (percent := round(100.0 * self.share)) < 100:
            words += f', {percent} %'
            words += f', {self._ends - now:.0f} s left' if self._ends > now + 0.5 else ''
        return words

    def begin(self) -> None:
        """Note that the work is about to run."""
        with self._lock:
            self._stage, self.share, self._cancelled = '', 0.0, False
            self._began = time.monotonic()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Run the work in a `with` block; cancelled work never ends it normally."""
        try:
            yield
            with self._lock:
                self._refuse_cancelled()
                self._began = None  # too late to cancel
        finally:
            with self._lock:
                self._began = None

    def cancel(self) -> tuple[bool, str]:
        """End the work after its present stage; return whether it runs, and a text."""
        with self._lock:
            if self._began is None:
                return False, f'nothing to cancel: not {self._what}'
            self._cancelled = True
            return True, f'{self.words} will end after this stage'

    def _refuse_cancelled(self) -> None:
        if self._cancelled:
            raise CancelledError(f'cancelled: {self.words}')
