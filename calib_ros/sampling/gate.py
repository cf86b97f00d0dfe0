# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages with stray stamps, or of a moved clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from calib_ros.sampling.account import Cause, Lost
from calib_ros.sampling.slices import JOINTS, NO_ACCIDENT, POSES, Slice, StreamKey

STRAY = Lost('stamp far from those before and after (do the clocks of all publishers agree?)')


class Gate:
    """Distinguishes stray stamps from a moved clock: more than `far` [s] away.

    A message far from the last ones of all streams is held. If its stream returns, the stamp was
    stray and the message is dropped; if it stays away, the clock was moved, a bag is played again
    or there was a pause, and all held messages pass in order.
    """

    def __init__(self, far: float) -> None:
        self._far_ns = round(far * 1e9)
        self._last: dict[str, int] = {}
        self._held: list[tuple[str, int, Slice]] = []
        self.dropped: Counter[Cause] = Counter()  # messages with stray stamps

    def held(self, kind: str) -> int:
        """Return the number of held messages of a kind."""
        return sum(each[0] == kind for each in self._held)

    @property
    def images(self) -> set[int]:
        """Return the numbers of held images."""
        found = ((each.key, each.numbers) for *_, given in self._held for each in given.pieces)
        return {int(n[0, 0]) for key, n in found if isinstance(key, StreamKey) and key.images}

    def admit(self, given: Slice) -> Iterator[tuple[Slice, bool]]:
        """Yield what may pass now, and whether the joints' clock was moved back before it.

        Held messages pass with a later message, in order of arrival.
        """
        begin, end = 0, len(given)
        while begin < end:
            left = given.between(begin, end)
            count = self._plain(left)
            if count:
                yield left.between(0, count), False
            else:
                count = 1
                found, back = self._admitted(left.between(0, 1))
                yield from ((each, back and each is found[0]) for each in found)
            begin += count

    def release(self) -> list[Slice]:
        """Return the held messages: no later one can decide."""
        found, self._held = self._held, []
        return [item for _, _, item in found]

    def _plain(self, given: Slice) -> int:
        """Pass messages up to the first that must be held, or releases others."""
        times, numbers = given.times, np.arange(len(given))
        near = np.zeros(len(given), dtype=bool)  # to the last one of any kind
        back = near.copy()
        for kind, which in ((JOINTS, given.joints), (POSES, ~given.joints)):
            before = np.maximum.accumulate(np.where(which, numbers, -1))
            before = np.concatenate([[-1], before[:-1]])
            known = np.where(before < 0, self._last.get(kind, 0), times[before])
            seen = (before >= 0) | (kind in self._last)
            near |= seen & (np.abs(times - known) <= self._far_ns)
            back |= seen & which & given.joints & (times < known - self._far_ns)
        for kind, time_ns, _ in self._held:
            near &= given.joints != (kind == JOINTS)
            near &= np.abs(times - time_ns) > self._far_ns
        count = int(np.argmin(np.append(near & ~back, False)))
        for kind in (JOINTS, POSES):
            where = given.where(kind)
            passed = int(np.searchsorted(where, count))
            if passed:
                self._last[kind] = int(times[where[passed - 1]])
        return count

    def _admitted(self, given: Slice) -> tuple[list[Slice], bool]:
        """Take one message; return what passes, and whether the joints' clock was moved back."""
        kind, time_ns = JOINTS if given.joints[0] else POSES, int(given.times[0])
        if self._is_near(kind, time_ns):
            self._last[kind] = time_ns
            found = [*self._now_near(), given]
            self._last[kind] = time_ns
            if strays := self.held(kind):
                self.dropped[Cause(kind, STRAY)] += strays
                self._held = [each for each in self._held if each[0] != kind]
            return found, False
        self._held.append((kind, time_ns, given))
        if self.held(kind) < NO_ACCIDENT:
            return [], False
        moved = [time for other, time, _ in self._held if other == kind]

        def passes(each: tuple[str, int, Slice]) -> bool:
            return min(abs(each[1] - time) for time in moved) <= self._far_ns or each[0] == kind

        freed = [each for each in self._held if passes(each)]
        self._held = [each for each in self._held if not passes(each)]
        before = self._last.get(JOINTS, 0)
        self._last.update((other, time) for other, time, _ in freed)
        return [item for *_, item in freed], self._last.get(JOINTS, 0) < before

    def _is_near(self, kind: str, time_ns: int) -> bool:
        lasts, last = self._last.values(), self._last.get(JOINTS, 0)
        held = next((time for other, time, _ in reversed(self._held) if other == JOINTS), last)
        if kind == JOINTS and time_ns < (last if held < last else last - self._far_ns):
            return False  # their clock was moved back perhaps: these do not return
        if held < last and 2 * time_ns < held + last:  # and this belongs to them
            return False
        return not lasts or any(abs(time_ns - last) <= self._far_ns for last in lasts)

    def _now_near(self) -> list[Slice]:
        found = []
        for each in tuple(self._held):
            if self._is_near(*each[:2]):
                self._last[each[0]] = each[1]
                self._held.remove(each)
                found.append(each[2])
        return found
