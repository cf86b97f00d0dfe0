# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of a board on their way to samples.

An image is matched like any measurement, by its stamp and a number, and is kept here undecoded
until its stop is known. Then the middle one of the stop is decoded and processed on a separate
thread: one per stop, however many arrive. Samples leave in the order of their stops, with those
without images, so that live and replayed results are the same.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np

from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.resection import board_poses, uncertainty
from calib_ros.kinematics import se3
from calib_ros.sampling.account import Cause, Lost
from calib_ros.sampling.sample import Flaw, Sample, View
from calib_ros.sampling.slices import POSES
from calib_ros.texts import LARGEST_TABLE

MOST_BYTES = 5 * LARGEST_TABLE
"""Memory for images: six seconds of 30 Hz at 2 megapixels in grey."""
MOST_WAITING = 4  # images that may wait for processing; further ones are dropped


WHILE_OTHERS = Flaw(
    'while others were processed', f'{MOST_WAITING} others were still processed: stop for longer'
)
FORGOTTEN = Flaw(
    'dropped, memory for images full', 'the memory for images was full: send fewer or smaller ones'
)


class Pictures:
    """Images waiting to become samples; `sigma` returns that of a corner [px]."""

    def __init__(self, sigma: Callable[[], float]) -> None:
        self._sigma = sigma
        self.cameras: Mapping[str, Any] = {}  # `BoardCamera` of files/cameras.py, by topic
        self._pool = ThreadPoolExecutor(1, 'images')
        self._last = 0
        self.patient = False
        """True to wait for images instead of dropping them, as from a bag."""
        self.clear()

    def clear(self) -> None:
        """Forget all images and counts."""
        self._kept: dict[int, tuple[str, int, Callable[[], Any]]] = {}
        self._queue: deque[tuple[Sample, Future[Sample | Flaw]]] = deque()
        self.dropped: Counter[Cause] = Counter()  # unused images by cause
        self.refused = ''  # why the last image is not used; empty if it is
        self.reason = ''  # why the last of those dropped is not used

    def keep(self, topic: str, size: int, message: Callable[[], Any]) -> int:
        """Keep an image of some bytes; return its number. `message` decodes it."""
        self._last += 1
        self._kept[self._last] = topic, size, message
        while sum(size for _, size, _ in self._kept.values()) > MOST_BYTES and len(self._kept) > 1:
            for number in [*self._kept][-2::-2]:  # keep the newest, and some of every stop
                del self._kept[number]
        return self._last

    def keep_only(self, numbers: set[int]) -> None:
        """Drop images that no stop can need any more."""
        for number in self._kept.keys() - numbers:
            del self._kept[number]

    def through(self, made: Sequence[Sample], wait: bool) -> list[Sample]:
        """Start to process the images of samples; return finished ones in order.

        With `wait` all of them are finished.
        """
        self._queue += ((each, self._begin(each)) for each in made)
        found: list[Sample] = []
        while self._queue and (wait or self._queue[0][1].done()):
            sample, begun = self._queue.popleft()
            result = begun.result()
            if sample.images:
                self.refused = ''
            if isinstance(result, Flaw):
                self.refused = self.reason = result.reason
                why = (Lost if result is FORGOTTEN else str)(f'image {result.cause}')
                self.dropped[Cause(POSES, why)] += sample.count
            else:
                found.append(result)
        return found

    def _begin(self, sample: Sample) -> Future[Sample | Flaw]:
        """Return the sample once its image is processed, at once if none is."""
        if not sample.images:
            return _ready(sample)
        busy = [begun for _, begun in self._queue if not begun.done()]
        if len(busy) >= MOST_WAITING:
            if not self.patient:
                return _ready(WHILE_OTHERS)
            busy[0].exception()
        middle = len(sample.images) // 2
        kept = [k for k, number in enumerate(sample.images) if number in self._kept]
        if not kept:
            return _ready(FORGOTTEN)
        nearest = min(kept, key=lambda k: abs(k - middle))
        return self._pool.submit(self._look, sample, *self._kept[sample.images[nearest]])

    def _look(
        self, sample: Sample, topic: str, size: int, message: Callable[[], Any]
    ) -> Sample | Flaw:
        """Return the sample of an image; runs on the thread."""
        try:
            view = self.cameras[topic].look(message())
            return view if isinstance(view, Flaw) else self._posed(sample, view)
        except Exception as err:  # damaged bytes fail in many ways
            return Flaw('that cannot be decoded', f'it cannot be decoded: {err!r}')

    def _posed(self, sample: Sample, view: View) -> Sample | Flaw:
        index = np.zeros(len(view.pixels), dtype=np.intp)
        joints = np.repeat(sample.joints[np.newaxis], len(index), axis=0)
        seen = Observations.from_pixels(joints, view.pixels, view.points, index)
        try:
            found = board_poses(seen, view.lens)
        except InputError as err:
            return Flaw('that tells no pose of the board', str(err))
        pose = se3.transform(found.rotations, found.positions)
        return replace(
            sample,
            images=(),
            view=view,
            position=found.positions[0],
            rotation=found.rotations[0],
            covariance=self._sigma() ** 2 * uncertainty(seen, pose, view.lens)[0],
        )


def _ready(result: Sample | Flaw) -> Future[Sample | Flaw]:
    future: Future[Sample | Flaw] = Future()
    future.set_result(result)
    return future
