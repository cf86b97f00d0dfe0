# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints of a chain in messages that name others too, or only some of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib_ros.estimation.configurations import STILL
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.sampling.hints import Hint
from calib_ros.sampling.slices import JointIndices
from calib_ros.shown import some
from calib_ros.values import MOST_NAMES

OTHERS = 'none of the joints in the message'
NOWHERE = -1  # column of a joint that needs no name


class JointNames:
    """Finds the joints of a chain in messages that may name others, or only some of them.

    `names` are the chain's joints as messages name them. `held` ones need not be named; they have
    this value.
    """

    def __init__(self, names: Sequence[str], held: Mapping[int, float] | None = None) -> None:
        self._names, self.held = names, held or {}
        self._heard: dict[str, tuple[float, float]] = {}  # lowest and highest value of others
        self.blank: set[int] = set()  # joints of the chain that came without a position

    def layout(self, key: Sequence[str]) -> tuple[JointIndices, Index, str]:
        """Return the joints of the chain in messages, the columns (K,) of them, and any fault.

        Of held joints that are not named the column is NOWHERE.
        """
        known = {k: key.index(name) for k, name in enumerate(self._names) if name in key}
        fault = '' if known.keys() - self.held.keys() else OTHERS
        if any(key.count(self._names[k]) > 1 for k in known):
            fault = 'a joint is named twice'
        known = dict(sorted((dict.fromkeys(self.held, NOWHERE) | known).items()))
        return tuple(known), np.array([*known.values()], dtype=np.intp), fault

    def hear(self, names: Sequence[str], numbers: FloatArray) -> None:
        """Note the k names of joint states, and values (N, k) of others than the chain's.

        Beyond MOST_NAMES others are not noted.
        """
        others = []
        for k, name in enumerate(names):
            own = name in self._names
            if own or name in self._heard or len(self._heard) < MOST_NAMES:
                self._heard.setdefault(name, (np.inf, -np.inf))
                others += [] if own else [k]
        if not others or numbers.shape[1] != len(names):
            return
        values = numbers[:, others]
        lowest, highest = np.fmin.reduce(values).tolist(), np.fmax.reduce(values).tolist()
        for k, least, most in zip(others, lowest, highest, strict=True):
            low, high = self._heard[names[k]]
            self._heard[names[k]] = min(low, least), max(high, most)

    @property
    def never(self) -> tuple[str, ...]:
        """Return the joints that must be named and never were."""
        needed = {name for k, name in enumerate(self._names) if k not in self.held}
        return tuple(sorted(needed - self._heard.keys()))

    @property
    def foreign(self) -> tuple[str, ...]:
        """Return the names received if some of the chain's joints are never named."""
        return tuple(sorted(name or '""' for name in self._heard)) if self.never else ()

    @property
    def extra_joints(self) -> list[str]:
        """Return the names of joints that move but are not in the chain."""
        moved = {name for name, (low, high) in self._heard.items() if high - low > STILL}
        return sorted(moved.difference(self._names))

    def silent_ones(self, silent: Sequence[int]) -> list[Hint]:
        """Return a hint that no more joint states of these joints arrive, if any."""
        words = f'no more joint states of {", ".join(self._names[k] for k in silent)}'
        ask = 'does their driver run, and publish them at rest too?'
        return [Hint(f'nothing can be sampled: {words}', f'{words}: {ask}')] if silent else []

    def why_missing(self, missing: Sequence[int]) -> str:
        """Return why joints are missing: no positions or other names arrive; empty if neither."""
        if blank := ', '.join(self._names[k] for k in missing if k in self.blank):
            return f'waiting for joint states with positions: none came of {blank}'
        if not (missing and self.foreign):
            return ''
        lacking = ', '.join(some([self._names[k] for k in missing]))
        others = ', '.join(some([name for name in self.foreign if name not in self._names]))
        if not others:
            return f'waiting for joint states of {lacking}'
        return f'waiting for joint states, set joint_names? Received {others}, not {lacking}'
