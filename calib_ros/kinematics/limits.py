# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Joint values against the limits of their joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib_ros.errors import ConfigError, InputError
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import TWO_TURNS
from calib_ros.kinematics.effects import coupled
from calib_ros.kinematics.joint import Joint
from calib_ros.kinematics.se3 import Flags, FloatArray


def limits(chain: Chain) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper limits (n,) of the joints [rad or m], infinite if none.

    Values of joints that only couplings move count for nothing, so these have none.
    """
    ends = [(joint.lower, joint.upper) for joint in chain.joints]
    lower, upper = np.array(ends, dtype=np.float64).T  # NaN for None
    lower[[*coupled(chain)]] = upper[[*coupled(chain)]] = np.nan
    return np.where(np.isnan(lower), -np.inf, lower), np.where(np.isnan(upper), np.inf, upper)


def beyond(values: FloatArray, chain: Chain) -> Flags:
    """Tell (N, n) which joint values (N, n) are 1e-3 [rad or m] beyond their limits."""
    lower, upper = limits(chain)
    return (values < lower - 1e-3) | (values > upper + 1e-3)


def narrowed(chain: Chain, other: Chain) -> Chain:
    """Return a chain whose joints keep the limits of another one, too."""
    joints = []
    for joint, its in zip(chain.joints, other.joints, strict=True):
        lower = max((end for end in (joint.lower, its.lower) if end is not None), default=None)
        upper = min((end for end in (joint.upper, its.upper) if end is not None), default=None)
        if lower is not None and upper is not None and lower > upper:
            raise ConfigError(
                f'the limits of {joint.name} in the calibration and in the nominal chain have no '
                f'value in common: it is at least {lower:.6g} in one, at most {upper:.6g} in the '
                'other (rad or m): put the chain right, or identify with its limits'
            )
        joints.append(replace(joint, lower=lower, upper=upper))
    return replace(chain, joints=tuple(joints))


def a_turn_away(joint: Joint, value: float) -> str:
    """Return in words that a value [rad] beyond the limits is within them full turns away."""
    if joint.type == 'prismatic' or abs(value) > TWO_TURNS:  # perhaps degrees
        return ''
    turns = np.round((value - np.mean(joint.range)) / (2.0 * np.pi))
    within = value - 2.0 * np.pi * turns
    inside = joint.range[0] <= within <= joint.range[1]
    return f'; a full turn away, {within:.6g} is within them: give that' * bool(inside)


def check_limits(
    values: FloatArray,
    chain: Chain,
    where: Callable[[int, int], str],
    remedy: Callable[[int], str] = lambda i: ', not degrees',
) -> None:
    """Refuse joint values (N, n) 1e-3 beyond their limits, or as `check_turns`."""
    check_turns(values, chain, where)
    lower, upper = limits(chain)
    for k, i in np.argwhere(beyond(values, chain))[:1].tolist():
        raise InputError(
            f'{where(k, i)}{values[k, i]:.6g} is beyond the limits of {chain.joint_names[i]}, '
            f'{lower[i]:.6g} to {upper[i]:.6g} (rad or m{remedy(i)})'
            + a_turn_away(chain.joints[i], float(values[k, i]))
        )


def check_turns(values: FloatArray, chain: Chain, where: Callable[[int, int], str]) -> None:
    """Refuse joint values (N, n) that may be degrees or millimetres, of joints without limits.

    `where` names a row and a joint.
    """
    free = [None in (joint.lower, joint.upper) for joint in chain.joints]
    for k, i in np.argwhere((np.abs(values) > TWO_TURNS) & free)[:1].tolist():
        joint = chain.joints[i]
        turns = joint.type == 'revolute'
        what = f'two turns of {joint.name}' if turns else f'{TWO_TURNS:.1f} m for {joint.name}'
        raise InputError(
            f'{where(k, i)}{values[k, i]:.6g} is more than {what}, which has no limits: joint '
            f'values must be in {"radians" if turns else "metres"}; if they are, give the joint '
            'limits (lower, upper) in the chain file'
        )
