# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames in which each device has measured."""

from __future__ import annotations

from collections import Counter

from calib_ros.sampling.slices import NO_ACCIDENT
from calib_ros.settings import EXCEPTION
from calib_ros.values import MOST_NAMES


class FrameNames:
    """Frames in which each device has measured; each should have one: the `wanted` one if any."""

    def __init__(self, wanted: str = '') -> None:
        self.wanted = wanted
        self._known: dict[str, Counter[str]] = {}
        self._told: set[str] = set()  # frames that are not wanted, up to MOST_NAMES
        self.usual: dict[str, str] = {}
        """The usual frames of devices with more than a few measurements."""

    def required(self, device: str) -> str:
        """Return the frame wanted of a device; none if only others have measured in it."""
        there = [name for name, frames in self._known.items() if self.wanted in frames]
        return '' if there and device not in there else self.wanted

    def decides(self, device: str, frame_id: str) -> bool:
        """Tell whether measurements are the first ones of a device in the wanted frame."""
        return frame_id == self.wanted != '' and frame_id not in self._known.get(device, ())

    def fault(self, device: str, frame_id: str, count: int) -> str:
        """Note the frame of some measurements; return why it cannot be used, or empty text.

        Only the required frame can, or else the usual one.
        """
        wanted = self.required(device)
        if wanted and frame_id != wanted:
            if len(self._told) < MOST_NAMES:
                self._told.add(frame_id)
            told = frame_id if frame_id in self._told else '...'
            return f'in frame "{told}", not in frame_id "{wanted}"'
        if not frame_id.isprintable():  # it is written to tables
            return 'in a frame whose name cannot be printed'
        if not self.note(device, frame_id, count):
            return f'in one of more than {MOST_NAMES} frames'
        usual = self.usual.get(device, frame_id)
        if frame_id == (wanted or usual):
            return ''
        return f'in frame "{frame_id}", not in "{usual}" like the others'

    def note(self, device: str, frame_id: str, count: int) -> bool:
        """Note the frame of measurements; return False beyond MOST_NAMES frames."""
        known = self._known.setdefault(device, Counter())
        if frame_id not in known and len(known) == MOST_NAMES:
            return False
        known[frame_id] += count
        if known[frame_id] >= NO_ACCIDENT:
            self.usual.setdefault(device, frame_id)
        return True

    def main(self, device: str) -> str | None:
        """Return the required or usual frame of a device, or the most frequent one so far."""
        known = self._known.get(device)
        most = max(known, key=known.__getitem__) if known else None
        return self.required(device) or self.usual.get(device, most)

    @property
    def different(self) -> tuple[str, ...]:
        """Return the frames of one device if more than a few measurements are not in its own.

        That is the required one, as soon as any are in it.
        """
        for device, known in self._known.items():
            required, own = self.required(device), self.main(device)
            many = known.total() - known[own or ''] > EXCEPTION * known.total()
            if required not in known if required else many:
                return tuple(sorted(known))
        return ()
