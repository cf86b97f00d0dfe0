# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The mean of what was measured while the arm stood.

An arm vibrates after its joints have stopped. So the mean begins where the measurements have come
as close to the later ones as their noise allows, and a stop whose measurements still spread more
than that is refused: something moved that no joint reports. The noise is the sigma given or the
one that successive differences show (von Neumann 1941), whichever is larger: a slow motion is in
the spread, but hardly in the differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray

SPIKE = 6.0
"""A single measurement further from the median [noise] is left out of the mean."""
MOST_SPIKES = 0.3
SETTLED = 4.0
"""Distance [noise] to the later half within which a measurement is taken to have settled."""
MOST_SPREAD = 2.0
"""Largest spread [noise] of measurements and joints at a stop: a motion is in the spread alone."""
FEW = 4
"""With fewer measurements nothing can be said about their spread."""


class RestlessError(Exception):
    """A stop whose measurements spread more than their noise."""


@dataclass(frozen=True, eq=False)
class Mean:
    """Which of the measurements (N,) make the mean, their mean, and their spread about it.

    `spread` is the RMS of one coordinate [m].
    """

    used: NDArray[np.bool_]
    value: FloatArray
    rotation: FloatArray | None
    spread: float


def average(values: FloatArray, rotations: FloatArray | None, sigma: float) -> Mean:
    """Average measurements in the order of their stamps.

    Parameters
    ----------
    values : (N, 3) or (N, 1)
        Positions or distances [m].
    rotations : (N, 3, 3), optional
        Where orientations were measured.
    sigma : float
        Standard deviation [m] of one coordinate that is expected.

    Raises
    ------
    RestlessError
        When they spread more than their noise; the text says by how much.

    """
    count = len(values)
    noise = max(sigma, _noise(values))
    used = np.ones(count, dtype=bool)
    if count >= FEW:
        reach = noise * np.sqrt(values.shape[1])
        used[: _settled(values, reach)] = False
        spikes = _distance(values, np.median(values[used], axis=0)) > SPIKE * reach
        if (spikes & used).sum() > MOST_SPIKES * used.sum():
            raise RestlessError(_words(values[used], noise))
        used &= ~spikes
    mean = values[used].mean(axis=0)
    spread = float(np.sqrt(((values[used] - mean) ** 2).mean()))
    if count >= FEW and spread > MOST_SPREAD * noise:
        raise RestlessError(_words(values[used], noise))
    rotation = None
    if rotations is not None:  # the chordal mean (Moakher 2002)
        rotation = se3.nearest_rotation(rotations[used].sum(axis=0))
    return Mean(used, mean, rotation, spread)


def _noise(values: FloatArray) -> float:
    """Return the standard deviation of one coordinate from successive differences."""
    if len(values) < FEW:
        return 0.0
    steps = np.abs(np.diff(values, axis=0))
    return float(1.4826 * np.median(steps) / np.sqrt(2.0))  # the median: spikes do not count


def _settled(values: FloatArray, reach: float) -> int:
    """Return how many measurements come before all of them stay near the later half."""
    half = len(values) // 2
    far = _distance(values[:half], np.median(values[half:], axis=0)) > SETTLED * reach
    # A spike among settled ones is no vibration: two of three in a row must be far.
    pairs = far & (np.append(far[1:], False) | np.append(far[2:], [False, False]))
    last = np.flatnonzero(pairs)
    return int(last[-1]) + 2 if last.size else 0


def _distance(values: FloatArray, point: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(values - point, axis=1))


def _words(values: FloatArray, noise: float) -> str:
    spread = np.sqrt(((values - np.median(values, axis=0)) ** 2).mean())
    return (
        f'the measurements of this stop spread by {1e3 * spread:.3f} mm, their noise is '
        f'{1e3 * noise:.3f} mm'
    )
