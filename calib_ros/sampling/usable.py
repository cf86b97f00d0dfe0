# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which messages can be used: by their stamps and numbers."""

from __future__ import annotations

from collections import Counter

import numpy as np

from calib_ros.covariances import covariance_faults
from calib_ros.kinematics.se3 import Flags
from calib_ros.sampling.account import Lost
from calib_ros.sampling.slices import Part
from calib_ros.values import LARGEST, ROUNDED

NO_STAMP = Lost('zero stamp (fill header.stamp where it is published)')
UNSEEN = 'NaN or infinite position (does the device see the target?)'
NOT_UNIT = 'quaternion not of length 1 (normalise it where it is published)'


def usable(found: Part, joints: bool = False) -> tuple[Flags, Counter[str]]:
    """Return which messages (N,) can be used, of joints or measurements, and why others not."""
    numbers, causes = found.numbers, Counter[str]()
    good = np.ones(len(numbers), dtype=bool)

    def refuse(wrong: np.bool_ | Flags, cause: str) -> None:
        count = int((good & wrong).sum())
        if count:
            causes[cause] += count
            good[wrong] = False

    refuse(found.stamps == 0, NO_STAMP)
    refuse(found.stamps < 0, Lost('negative stamp (is the clock set?)'))
    if joints:
        for name, value in zip(found.strings[1:], numbers.T, strict=True):
            refuse(~np.isfinite(value), f'NaN or infinite joint value ({name})')
            refuse(np.abs(value) > LARGEST, f'joint value beyond 1e6 ({name})')
        return good, causes
    if found.source and found.source.board:
        return good, causes
    width = numbers.shape[1]
    if width == 1:
        far = numbers[:, 0]
        refuse(~((far > 0.0) & (far < np.inf)), 'distance not a positive number')
        refuse(far > LARGEST, 'distance beyond 1000 km')
    else:
        at = numbers[:, :3]
        refuse(~np.isfinite(at).all(axis=1), UNSEEN)
        refuse((np.abs(at) > LARGEST).any(axis=1), 'position beyond 1000 km')
    if width >= 7:
        with np.errstate(over='ignore'):  # refused anyway
            length = np.sqrt((numbers[:, 3:7] ** 2).sum(axis=1))
        refuse(~(np.abs(length - 1.0) <= ROUNDED), NOT_UNIT)
    if width > 7:
        rows = numbers[:, 7:]
        fresh = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))  # most devices repeat one
        faults = covariance_faults(rows[fresh].reshape(-1, 6, 6))[np.cumsum(fresh) - 1]
        for fault in dict.fromkeys(faults.tolist()):
            if fault:
                refuse(faults == fault, f'{fault} (leave it zero if it is not known)')
    if not found.child.isprintable():  # it is written to tables
        refuse(good.copy(), 'child frame whose name cannot be printed')
    return good, causes
