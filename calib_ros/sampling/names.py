# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names in messages: which joints of the chain they hold, in which frames things are measured."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.sampling.messages import MessageError
from calib_ros.sampling.slices import NO_ACCIDENT, Columns
from calib_ros.settings import EXCEPTION
from calib_ros.values import MOST_NAMES

Layout: TypeAlias = tuple[Columns, NDArray[np.intp]]
OTHERS = 'none of the joints in the message'


class JointNames:
    """Finds the joints of a chain in messages that may name others, and only part of them.

    `names` are those that messages have for the joints of the chain, in its order.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._layouts: dict[tuple[str, ...], Layout] = {}
        self.foreign: tuple[str, ...] = ()
        """Names that come while some of the chain's joints are never named."""

    def layout(self, key: tuple[str, ...]) -> Layout:
        """Return which joints of the chain messages name, and the columns of their values."""
        if key not in self._layouts:
            if len(self._layouts) == MOST_NAMES:
                self._layouts.clear()
            known = [(k, key.index(n)) for k, n in enumerate(self._names) if n in key]
            index = np.array([i for _, i in known], dtype=np.intp)
            self._layouts[key] = tuple(k for k, _ in known), index
            named = {name for names in self._layouts for name in names}
            missing = [name for name in self._names if name not in named]
            self.foreign = tuple(sorted(named)) if missing else ()
        layout = self._layouts[key]
        if not layout[0]:
            raise MessageError(OTHERS)
        return layout

    def foreign_ones(self, missing: Sequence[int]) -> str:
        """Return in words that other joints come than those of some numbers; empty if none do."""
        if not (missing and self.foreign):
            return ''
        return (
            f'waiting for joint states, set joint_names? Those that come name '
            f'{", ".join(self.foreign)}, not {", ".join(self._names[k] for k in missing)}'
        )


class FrameNames:
    """The frames in which each device has measured; there should be one of each."""

    def __init__(self) -> None:
        self._known: dict[str, Counter[str]] = {}
        self._usual: dict[str, str] = {}

    def check(self, device: str, frame_id: str, wanted: str, count: int = 1) -> None:
        """Note the frame of some measurements; refuse any but the one `wanted`, or the usual."""
        if wanted and frame_id != wanted:
            raise MessageError(f'in frame "{frame_id}", not in frame_id "{wanted}"')
        if not frame_id.isprintable():  # it shall be a cell of a table
            raise MessageError('in a frame whose name cannot be printed')
        self.note(device, frame_id, count)
        usual = self._usual.get(device, frame_id)
        if frame_id != (wanted or usual):
            raise MessageError(strange(frame_id, usual))

    def note(self, device: str, frame_id: str, count: int = 1) -> None:
        """Note the frame of measurements that were taken before."""
        known = self._known.setdefault(device, Counter())
        if frame_id not in known and len(known) == MOST_NAMES:
            raise MessageError(f'in one of more than {MOST_NAMES} frames')
        known[frame_id] += count
        if known[frame_id] >= NO_ACCIDENT:
            self._usual.setdefault(device, frame_id)

    def usual(self, device: str) -> str | None:
        """Return the usual frame of a device; None while few measurements have come."""
        return self._usual.get(device)

    @property
    def settled(self) -> int:
        """Return of how many devices the usual frame is known."""
        return len(self._usual)

    def main(self, device: str) -> str | None:
        """Return the usual frame of a device, or the most frequent one while few have come."""
        known = self._known.get(device)
        return self._usual.get(device) or (max(known, key=known.__getitem__) if known else None)

    @property
    def several(self) -> bool:
        """Tell whether any device measured in several frames."""
        return any(len(known) > 1 for known in self._known.values())

    @property
    def different(self) -> tuple[str, ...]:
        """Return the different frames in which one device measured; empty when none did.

        A few measurements in others do not count.
        """
        for known in self._known.values():
            if known.total() - max(known.values()) > EXCEPTION * known.total():
                return tuple(sorted(known))
        return ()


def strange(frame_id: str, usual: str) -> str:
    """Return in words that a measurement is not in the frame in which others are."""
    return f'in frame "{frame_id}", not in "{usual}" as others'
