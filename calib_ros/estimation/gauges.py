# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Gauges: parameters that others imitate exactly, and which of them are held."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calib_ros.estimation.arbitrary import A_POSE
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import ROUNDING, FloatArray


def identifiable_and_held(
    chain: Chain,
    names: Sequence[str],
    sets: Sequence[Observations],
    extra: Callable[[Chain, Sequence[str]], tuple[FloatArray, FloatArray]] | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the structurally identifiable parameters, and those that only positions determine.

    Sockets and planes alone fit a larger arm in a larger cell as well, and planes a gantry with
    skewed axes. Such parameters of the arm are held at nominal; if the size is one, by the longest
    length, which distorts it least. `extra` returns further equations (R, P) at a chain.
    """
    found = structurally_independent(chain, names, sets, extra)
    if not all(each.width == 1 or each.socket for each in sets):
        return found, ()
    base, tool = sets[0].base, sets[0].tool
    arm = {name for name in names if not chain.owns_frame(name)}
    every = [*parameters_of(base), *parameters_of(tool), *(name for name in names if name in arm)]
    place = A_POSE.changed(oriented=np.zeros(1, dtype=bool), base=base, tool=tool)
    seen = structurally_independent(chain, every, (place,))
    visible = [Parameter(name) for name in seen if name in arm]
    held = [name for name in visible if name not in found]
    sized = not all(each.socket or each.plane for each in sets)
    if not sized and any(name.is_length for name in held):
        lengths = [name for name in visible if name.is_length]
        longest = max(lengths, key=lambda name: abs(chain.value(name)))
        others = [name for name in names if name != longest]
        found = structurally_independent(chain, others, sets, extra)
        held = [longest, *(name for name in visible if name not in (*found, longest))]
    return found, tuple(held)


def best_imitation(
    chain: Chain,
    names: Sequence[str],
    others: Sequence[str],
    joints: FloatArray,
    lever: float,
    approach: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how P named parameters follow a unit of each of K others.

    Their changes (P, K) reproduce the arm's motion by the others best, at joint values (N, n)
    approached with signs `approach` (N, n); a radian counts as `lever` [m]. The motion (6 N, K)
    [m] by the others and its rest follow.
    """
    every = list(dict.fromkeys([*names, *others]))
    rows = ErrorModel(chain, every).jacobian(joints, approach)
    rows[:, 3:] *= lever
    flat = rows.reshape(-1, len(every))
    own, wanted = flat[:, : len(names)], flat[:, [every.index(name) for name in others]]
    scale = np.linalg.norm(own, axis=0)
    scale[scale <= ROUNDING * scale.max(initial=0.0)] = 1.0  # without effect
    found = np.linalg.lstsq(own / scale, wanted, rcond=1e-9)[0] / scale[:, np.newaxis]
    return found, wanted, wanted - own @ found
