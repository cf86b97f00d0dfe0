# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The program point to which each measurement belongs.

An arm stands at the joint values of the program if that was not corrected, else at those that the
correction makes of them. Along a path with points closer than the correction, the corrected ones
are nearer to those of other points than to their own.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from calib_ros.apply.compensation import Compensator
from calib_ros.errors import InputError
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray


def meant(
    nominal: Chain, calibrated: Chain, joints: FloatArray, commanded: FloatArray
) -> FloatArray:
    """Return the commanded joint values (N, n) [rad or m] that belong to measured ones (N, n).

    Those are the nearest of the program (M, n), as it is or corrected by the calibration.

    Raises
    ------
    InputError
        For measurements further from all of the program than anything is corrected.

    """
    far, _ = cKDTree(commanded).query(joints, p=np.inf)
    lost = np.flatnonzero(far > Compensator.largest_turn)
    if lost.size:
        raise InputError(
            f'measurement {lost[0] + 1} was taken {far[lost[0]]:.3g} rad or m from '
            'the nearest commanded joint values: does it belong to that program?'
        )
    change = Compensator(nominal, calibrated).follower.solve(commanded).change
    both = np.concatenate([commanded, commanded + change])
    _, nearest = cKDTree(both).query(joints, p=np.inf)
    return np.asarray(commanded[nearest % len(commanded)])
