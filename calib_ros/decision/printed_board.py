# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A printed board is of another size than stated, or of other proportions.

Size. Base and tool change neither the angle of a move nor its shift along the axis of the turn
(screw congruence), so the ratio of the shifts of arm and board is that of their lengths.

Proportions. Residuals at the board, averaged over the images, show the ratio of its sides; the arm
absorbs the scale of both together.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from calib_ros.decision.result import Identification
from calib_ros.decision.scale import percent
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.levels import LARGEST_SCALE, SURE
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.pixels import seen_residuals
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.weights import OUTLIER
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain


def size_of(chain: Chain, seen: Observations) -> float:
    """Return the factor by which measured lengths become those of the arm, 1 if unknown."""
    along = []
    for rotations, places in (
        np.split(chain.forward(seen.joints)[:, :3], [3], axis=2),
        (seen.rotations, seen.positions[:, :, np.newaxis]),
    ):
        turns = rotations[1:] @ np.swapaxes(rotations[:-1], 1, 2)
        shifts = places[1:] - turns @ places[:-1]
        along.append(np.einsum('nk,nk->n', se3.log_rotation(turns), shifts[:, :, 0]))
    far = np.abs(along[1]) >= np.median(np.abs(along[1]))
    with np.errstate(divide='ignore', invalid='ignore'):
        size = float(np.median(along[0][far] / along[1][far]))
    return size if 0.0 < size < np.inf else 1.0


def stretched(problem: Problem, result: Identification) -> str:
    """Return that a board is certainly stretched along one side, in words."""
    for each, far in zip(problem.sets, result.distances, strict=True):
        kept = far < OUTLIER
        if each.pixels is None or count_distinct(each.images[kept]) < 2:
            continue
        seen, points = each.select(kept), np.asarray(each.points)[kept]
        _, shifts = seen_residuals(result.chain, seen)
        if each.on_flange:  # the camera moves instead
            shifts = -shifts
        else:
            poses = result.chain.forward(seen.joints, seen.approach, seen.base, seen.tool)
            shifts = np.einsum('nji,nj->ni', poses[:, :3, :3], shifts)
        _, image = np.unique(seen.images, return_inverse=True)
        count = np.bincount(image)
        sides = []
        for side, shift in zip(points.T[:2], shifts.T, strict=False):
            beside = side - (np.bincount(image, side) / count)[image]
            size = np.bincount(image, beside**2)
            sides.append(np.bincount(image, beside * shift) / np.maximum(size, 1e-300))
        wider = sides[0] - sides[1]
        mean, error = float(wider.mean()), wider.std(ddof=1) / np.sqrt(len(count))
        if abs(mean) > LARGEST_SCALE + special.stdtrit(len(count) - 1, SURE) * error:
            way = 'wider' if mean > 0.0 else 'narrower'
            return (
                f'the board is {percent(abs(mean))} % {way} for its height than stated: print it '
                'unstretched, else the arm becomes as wrong'
            )
    return ''
