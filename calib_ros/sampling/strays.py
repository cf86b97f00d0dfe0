# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stray stamps told from a clock that was moved.

A message whose stamp is far from the last ones of all streams is held back. If messages of its
stream return to where they were, its stamp was a stray one and it is dropped; if they stay away,
the clock was moved, a bag is played again or there was a pause, and all that was held back is let
through in the order in which it came.
"""

from __future__ import annotations

from collections import Counter
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from calib_ros.sampling.track import Stamps

JUMP = 20
"""So many messages of one stream in succession elsewhere mean that the clock was moved."""
JOINTS, POSES = 'joints', 'poses'
STRAY = 'stamp far from those before and after'

Item = TypeVar('Item')


class Held(NamedTuple, Generic[Item]):
    """What came at a time of the joints' clock [ns]."""

    kind: str
    time_ns: int
    item: Item


class Gate(Generic[Item]):
    """Lets messages through, late if they must be held back first, and drops stray ones.

    Parameters
    ----------
    far : float
        Time [s] beyond which two stamps are far from each other.

    """

    def __init__(self, far: float) -> None:
        self._far_ns = round(far * 1e9)
        self._last: dict[str, int] = {}
        self._held: list[Held[Item]] = []
        self.dropped: Counter[str] = Counter()
        """Messages with stray stamps, by stream."""

    def held(self, kind: str) -> int:
        """Return how many messages of a stream are held back."""
        return sum(each.kind == kind for each in self._held)

    def passes(self, kind: str, time_ns: int) -> bool:
        """Let a message through if nothing is held back and its stamp is not far from others."""
        if self._held or not self._is_near(time_ns):
            return False
        self._last[kind] = time_ns
        return True

    def admit(self, kind: str, time_ns: int, item: Item) -> tuple[list[Held[Item]], bool]:
        """Take a message that does not pass; return what may pass now, in the order it came.

        The second value tells whether the clock of the joints was moved.
        """
        given = Held(kind, time_ns, item)
        if self._is_near(time_ns):
            self._last[kind] = time_ns
            found = [*self._now_near(), given]
            self._last[kind] = time_ns
            if strays := self.held(kind):
                self.dropped[kind] += strays
                self._held = [each for each in self._held if each.kind != kind]
            return found, False
        self._held.append(given)
        if self.held(kind) < JUMP:
            return [], False
        moved = [each.time_ns for each in self._held if each.kind == kind]
        found = [
            each
            for each in self._held
            if each.kind == kind or min(abs(each.time_ns - time) for time in moved) <= self._far_ns
        ]
        self._held = [each for each in self._held if each not in found]
        self._last.update((each.kind, each.time_ns) for each in found)
        return found, any(each.kind == JOINTS for each in found)

    def quiet(self, kind: str, times: Stamps) -> NDArray[np.bool_]:
        """Return (M,) which messages of a stream would pass, and free none that is held back."""
        if kind not in self._last or self.held(kind):
            return np.zeros(len(times), dtype=bool)
        before = np.empty_like(times)
        before[:1], before[1:] = self._last[kind], times[:-1]
        found = np.abs(times - before) <= self._far_ns
        for each in self._held:
            found &= np.abs(times - each.time_ns) > self._far_ns
        return np.asarray(found)

    def passed(self, kind: str, time_ns: int) -> None:
        """Note that quiet messages passed, the last of them at a time."""
        self._last[kind] = time_ns

    def release(self) -> list[Held[Item]]:
        """Return what is held back: nothing more comes that could tell."""
        found, self._held = self._held, []
        return found

    def _is_near(self, time_ns: int) -> bool:
        """Tell whether a time is near the last one of any stream."""
        for last in self._last.values():
            if abs(time_ns - last) <= self._far_ns:
                return True
        return not self._last

    def _now_near(self) -> list[Held[Item]]:
        """Let through what is held back and not far from others any more."""
        found = []
        for each in tuple(self._held):
            if self._is_near(each.time_ns):
                self._last[each.kind] = each.time_ns
                self._held.remove(each)
                found.append(each)
        return found
