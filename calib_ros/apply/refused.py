# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples that cannot be corrected within the limits, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.apply.compensator import Compensation, Compensator, Refusal
from calib_ros.kinematics.limits import a_turn_away, beyond, limits
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.settings import EXACT, TURN_IN_PART
from calib_ros.shown import rounded


def outside(compensator: Compensator, result: Compensation) -> list[Refusal]:
    """Return the samples outside the region of the calibration."""
    region = compensator.region
    if region is None:
        return []
    never = beyond(result.command, compensator.nominal).any(axis=1)  # told by `unreached`
    far = np.flatnonzero(~(region.covers(result.command) | never))
    share = 100.0 * len(far) / len(result.command)
    where = f'the calibration is not valid in {share:.0f} % of the program, as here'
    found, joints = [], result.command[far]
    every = zip(far.tolist(), region.known(joints), beyond(joints, region.chain), strict=True)
    for k, error, which in every:
        why = (
            f'the expected error by its parameters, {rounded(1e3 * error)} mm, exceeds the limit '
            f'of {rounded(1e3 * region.limit)} mm'
        )
        if which.any():
            i = int(which.argmax())
            lower, upper = (end[i] for end in limits(region.chain))
            why = (
                f'{result.command[k, i]:.6g} of {compensator.nominal.joint_names[i]} is beyond '
                f'the limits for which it was identified, {lower:.6g} to {upper:.6g}'
            )
        found.append(Refusal(k, f'{where}: {why}; identify again with poses near it'))
    return found


def unreached(compensator: Compensator, result: Compensation) -> list[Refusal]:
    """Return the samples whose pose is not reached, or only by too large a correction."""
    follower, names = compensator.follower, compensator.nominal.joint_names
    tolerated = compensator.largest_orientation_error
    if tolerated is None:
        tolerated = EXACT if follower.complete else TURN_IN_PART
    command, correction = result.command, result.correction
    apart, most = result.position, compensator.largest_position_error
    if most is None:
        apart, most = result.reachable, EXACT
    outer = (command < follower.lower - EXACT) | (command > follower.upper + EXACT)
    too_large = np.abs(correction) > compensator.largest
    remaining = (apart > most) | (result.orientation > tolerated)
    # a redundant arm may oscillate among solutions, all correct, one in part among orientations
    away = (result.reachable > EXACT) | (follower.complete & (result.orientation > EXACT))
    astray = ~result.converged & away
    wrong = outer.any(axis=1) | too_large.any(axis=1) | remaining | astray
    largest = f'{compensator.largest_turn:g} rad or {compensator.largest_shift:g} m'
    found = []
    for k in np.flatnonzero(wrong).tolist():
        left = f'{1e3 * result.position[k]:.4f} mm and {1e3 * result.orientation[k]:.4f} mrad'
        if outer[k].any():
            i = int(outer[k].argmax())
            reason = (
                f'the command {command[k, i]:.6g} of {names[i]} is beyond its limits '
                f'{follower.lower[i]:.6g} to {follower.upper[i]:.6g} (rad or m, not degrees; a '
                'table has degrees in q1 [deg])'
                + a_turn_away(compensator.nominal.joints[i], float(command[k, i]))
            )
        elif result.limited[k].any():
            held = [name for name, at in zip(names, result.limited[k], strict=True) if at]
            reason = f'{", ".join(held)} would go beyond a limit; held there, {left} remain'
        elif result.damped[k] and remaining[k]:
            reason = (
                f'near a singularity, or the calibration of another robot: corrections within '
                f'{largest} leave {left}'
            )
        elif too_large[k].any():
            i = int(too_large[k].argmax())
            size = f'a correction of {correction[k, i]:.6g}'
            reason = f'{names[i]} would need {size}, more than {largest}'
        elif result.converged[k] and not follower.complete:
            reason = (
                f'this arm cannot reach every pose: {left} remain, more than {1e3 * most:g} mm '
                f'or {1e3 * tolerated:g} mrad (--largest-orientation-error)'
            )
        else:
            how = '' if result.converged[k] else ', without convergence'
            reason = f'at the end of the reach, or near a singularity: {left} remain{how}'
        found.append(Refusal(k, reason))
    return found


def too_fast(
    compensator: Compensator, changes: FloatArray, moves: FloatArray, words: str, first: int = 0
) -> list[Refusal]:
    """Return the samples, from `first` on, whose correction changes too much.

    `changes` (N, n) of the correction are compared with `moves` (N, n) of the joints, both
    positive; `words` have places for change and move.
    """
    shares = (changes - EXACT) / compensator.largest
    allowed = compensator.largest_change * (moves / compensator.largest).max(axis=1)
    names, found = compensator.nominal.joint_names, []
    for k in np.flatnonzero(shares.max(axis=1) > allowed).tolist():
        i = int(shares[k].argmax())
        excess = words.format(changes[k, i], moves[k].max())
        found.append(Refusal(first + k, f'the correction of {names[i]} {excess}'))
    return found


def add_refusals(result: Compensation, more: Sequence[Refusal]) -> Compensation:
    """Return the result with further samples refused, their joint values NaN."""
    joints = result.joints.copy()
    joints[[refusal.sample for refusal in more]] = np.nan
    known = {refusal.sample for refusal in result.refusals}
    new = [refusal for refusal in more if refusal.sample not in known]
    refusals = sorted([*result.refusals, *new], key=lambda refusal: refusal.sample)
    return replace(result, joints=joints, refusals=tuple(refusals))
