# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From what messages say to pieces by stream, by the names in them: joints, frames, targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.sampling.messages import LARGEST, MessageError, Readings
from calib_ros.sampling.names import OTHERS, FrameNames, JointNames
from calib_ros.sampling.slices import JOINTS, POSES, Piece, StreamKey
from calib_ros.sampling.sources import Source


class Part(NamedTuple):
    """What messages of one stream say, and their places (N,) among others; source None: joints."""

    places: NDArray[np.intp]
    source: Source | None
    readings: Readings


class Entry:
    """Lets in what can be used and counts what cannot, by its cause."""

    def __init__(self, names: JointNames, frames: FrameNames, joint_count: int) -> None:
        self._names, self._frames, self._joint_count = names, frames, joint_count
        self.received: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.unused: Counter[str] = Counter()
        self.refused: dict[str, str] = {}
        """Why the last messages of a kind cannot be used; without kinds that can."""
        self.latest: tuple[int, Sequence[float]] | None = None

    def pieces(self, parts: Sequence[Part], recording: bool, wanted: str) -> list[Piece]:
        """Return what is to be kept; measurements in a frame `wanted`, if any is."""
        joints = [each for each in parts if each.source is None]
        measured = [each for each in parts if each.source is not None]
        return [*self._joints(joints, recording), *self._measured(measured, recording, wanted)]

    def miss(self, kind: str, count: int, cause: str) -> None:
        """Count messages that came and cannot be used."""
        self.received[kind] += count
        self.dropped[f'{kind}: {cause}'] += count
        if cause != OTHERS:
            self.refused[kind] = cause

    def _joints(self, parts: Sequence[Part], recording: bool) -> Iterator[Piece]:
        """Yield joint values that can be used, those of the chain."""
        latest = -1
        for places, _, (stamps, (_, *names), numbers) in parts:
            try:
                columns, index = self._names.layout(tuple(names))
            except MessageError as err:
                self.miss(JOINTS, len(stamps), str(err))
                continue
            values = numbers[:, index]
            size = np.abs(values).max(axis=1)
            good = size <= LARGEST
            if not good.all():
                infinite = int((~np.isfinite(size)).sum())
                for count, cause in (
                    (infinite, 'NaN or infinite joint value'),
                    (int((~good).sum()) - infinite, 'joint value beyond 1e6'),
                ):
                    if count:
                        self.miss(JOINTS, count, cause)
                places, stamps, values = places[good], stamps[good], values[good]
            if not len(stamps):
                continue
            self.received[JOINTS] += len(stamps)
            self.refused.pop(JOINTS, None)
            if len(columns) == self._joint_count and places[-1] > latest:
                latest = int(places[-1])
                self.latest = (int(stamps[-1]), values[-1].tolist())
            if recording:
                yield Piece(columns, places, stamps, values)
            else:
                self.unused['joints: not recording'] += len(stamps)

    def _measured(self, parts: Sequence[Part], recording: bool, wanted: str) -> Iterator[Piece]:
        """Yield measurements that can be used."""
        for places, source, readings in self._by_frame(parts):
            assert source is not None
            count, frame_id = len(places), readings.strings[0]
            self.received[POSES] += count
            self.refused.pop(POSES, None)
            if not recording:
                self.unused['measurements: not recording'] += count
            elif self._is_in_frame(source.device, frame_id, wanted, count):
                width = readings.numbers.shape[1]
                if width > 7:  # a covariance of zeros stands for none
                    none = ~readings.numbers[:, 7:].any(axis=1)
                    readings.numbers[none, 7:] = np.nan
                key = StreamKey(
                    source.device,
                    source.target or readings.child,
                    source.validation,
                    width == 1 and not source.board,
                    source.eye_in_hand,
                    frame_id,
                    bool(source.board),
                )
                yield Piece(key, places, readings.stamps_ns, readings.numbers)

    def _by_frame(self, parts: Sequence[Part]) -> list[Part]:
        """Return measurements one by one while it is open which of several frames is the usual."""
        frames: dict[str, set[str]] = {}
        for each in parts:
            assert each.source is not None
            if self._frames.usual(each.source.device) is None:
                frames.setdefault(each.source.device, set()).add(each.readings.strings[0])
        if any(len(some) > 1 for some in frames.values()):
            parts = [
                Part(part.places[k : k + 1], part.source, part.readings.rows(slice(k, k + 1)))
                for part in parts
                for k in range(len(part.places))
            ]
        return sorted(parts, key=lambda part: int(part.places[0]))

    def _is_in_frame(self, device: str, frame_id: str, wanted: str, count: int) -> bool:
        """Tell whether measurements are in the frame of their device; count them if not."""
        try:
            self._frames.check(device, frame_id, wanted, count)
        except MessageError as err:
            self.dropped[f'{POSES}: {err}'] += count
            return False
        return True
