# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The samples taken, and which of them an identification can use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from calib_ros.sampling.names import FrameNames, strange
from calib_ros.sampling.sample import Sample


class Kept:
    """Samples in the order in which they were taken; in the frame `wanted`, if any is.

    `changed` is called when samples were left out, with one that was taken back.
    """

    def __init__(
        self,
        frames: FrameNames,
        wanted: str,
        dropped: Counter[str],
        changed: Callable[[Sample | None], None],
    ) -> None:
        self.wanted = wanted
        self._frames, self._dropped, self._changed = frames, dropped, changed
        self.samples: list[Sample] = []
        self._once: set[tuple[str, str]] = set()

    def usable(self) -> list[Sample]:
        """Return the samples in the frame of their device, `frame_id` or the usual one.

        Those of targets that were measured once are left out where others were more often: they
        tell nothing about the arm, and hundreds of them would take minutes.
        """
        wanted = self.wanted
        found = self.samples
        if wanted or self._frames.several:
            found = [each for each in found if self._frame_of(each, wanted) == each.frame_id]
        counts = Counter((each.device, each.target) for each in found if not each.validation)
        once = {key for key, count in counts.items() if count == 1}
        if once != self._once:  # the list does not only grow
            self._once = once
            self._changed(None)
        if not once or len(once) == len(counts):
            return found
        return [each for each in found if (each.device, each.target) not in once]

    def _frame_of(self, sample: Sample, wanted: str = '') -> str:
        """Return in which frame a sample should be; some do not tell in which they are."""
        return (
            sample.frame_id and (wanted or self._frames.main(sample.device))
        ) or sample.frame_id

    def leave_out_strange(self) -> None:
        """Take back samples in strange frames, the first ones say, if there are only a few."""
        for sample in tuple(self.samples):
            if self.is_strange(sample):
                self.samples.remove(sample)
                self._changed(sample)

    def is_strange(self, sample: Sample) -> bool:
        """Tell whether a sample is one of a few in a frame of their own; count it if so."""
        if self.wanted or not self._frames.several or self._frames.different:
            return False
        frame_id = self._frame_of(sample)
        strays = sample.frame_id != frame_id
        if strays:
            self._dropped[f'measurements: {strange(sample.frame_id, frame_id)}'] += sample.count
        return strays

    @property
    def different(self) -> str:
        """Return in words that one device measured in different frames, if it matters."""
        if self.wanted or not self._frames.different:
            return ''
        return f'poses came in different frames ({", ".join(self._frames.different)})'
