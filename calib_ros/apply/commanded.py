# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Assignment of measurements to program points.

An arm stands at the joint values of the uncorrected program, or at their corrected ones. If points
of a path are closer than the correction, corrected ones are nearer to other points than to their
own.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from calib_ros.apply.compensation import Compensator
from calib_ros.errors import InputError
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, Index


def meant(
    nominal: Chain, calibrated: Chain, joints: FloatArray, commanded: FloatArray
) -> tuple[FloatArray, Index]:
    """Return the commanded joint values (N, n) [rad or m] that belong to measured ones (N, n).

    The nearest of the program (M, n), as it is or corrected by the calibration, and which (N,)
    were nearer to it corrected (1) or as it is (0).

    Raises
    ------
    InputError
        For measurements further from the program than any correction.
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
    corrected, point = np.divmod(nearest, len(commanded))
    return commanded[point], corrected
