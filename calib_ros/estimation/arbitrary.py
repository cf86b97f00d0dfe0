# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A chain with arbitrary frames at many poses, to see what measurements of a kind determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.inverse import solve
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import ROUNDING, FloatArray

A_POSE = Observations.from_arrays(np.zeros((1, 0)), np.zeros((1, 3)), np.eye(3)[np.newaxis])


def drawn(
    chain: Chain, names: Sequence[str], sets: Sequence[Observations]
) -> tuple[Chain, list[FloatArray]]:
    """Return a chain with arbitrary frames, and the rows (R, P) of each set at many poses.

    A socket or plane touched by several sets is in one place.
    """
    rng = np.random.default_rng(0)
    joints = chain.random_joints(100, rng)
    frames = [name for name in names if chain.owns_frame(name)]
    places = rng.uniform(0.1, 0.5, len(frames))
    anywhere = chain.with_offsets(dict(zip(frames, places, strict=True)))
    approach = rng.choice(np.array([-1.0, 1.0]), joints.shape)
    velocity = rng.normal(size=joints.shape)
    rows, met = [], set[str]()
    for number, each in enumerate(sets):
        posed = joints
        if each.socket or each.plane:
            rolled, again = np.roll(joints, number, axis=0), each.base in met
            posed, place = _meeting(anywhere, rolled, each, again)
            if again and not len(posed):  # out of reach of another target
                posed, place = _meeting(anywhere, rolled, each, False)
            shift = dict(zip(parameters_of(each.base)[:3], -place, strict=True))
            anywhere = anywhere.with_offsets({n: x for n, x in shift.items() if n in names})
            met |= {name.owner for name in shift if name in names}
        model = ErrorModel(anywhere, names, each.base, each.tool)
        signs, rates = approach[: len(posed)], velocity[: len(posed)] if each.moving else None
        jacobian = model.jacobian(posed, signs, rates, each.seen)
        if each.width == 1:
            line = anywhere.forward(posed, signs, each.base, each.tool)[:, :3, 3]
            if each.plane:
                line[:] = [0.0, 0.0, 1.0]
            line /= np.linalg.norm(line, axis=1, keepdims=True)
            jacobian = np.einsum('nc,ncp->np', line, jacobian[:, :3])
        elif each.width == 3:
            jacobian = jacobian[:, :3]
        rows.append(jacobian.reshape(-1, len(names)))
    return anywhere, rows


def _meeting(
    chain: Chain, joints: FloatArray, each: Observations, again: bool
) -> tuple[FloatArray, FloatArray]:
    """Return joint values (M, n) that bring the target to one place, and that place (3,) [m].

    The place of the first pose, or the median height of a plane; `again` the origin. Poses that do
    not arrive within 20 steps, stretched, are left out.
    """
    places = chain.forward(joints, base=each.base, tool=each.tool)
    place = places[0, :3, 3].copy()
    if each.plane:
        place[:] = 0.0, 0.0, np.median(places[:, 2, 3])
    place *= not again
    places[:, :3, 3] = place
    part = slice(2, 3) if each.plane else slice(3)
    found = solve(chain, places, joints, each.base, each.tool, part, 20, enough=ROUNDING)
    return found.joints[found.converged], place
