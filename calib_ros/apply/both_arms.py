# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The errors of new measurements by the arm before and after its correction.

A controller corrected by a calibration C stands at joint values q where C predicts the wanted
pose, so its error is measured - C(q); uncorrected it would be measured - N(q). Both follow from
the joint values that the controller reports. If the uncorrected program is known, the wanted pose
is N(q_commanded), and a missing correction shows as well.

On request, frames of the new measurements are fitted to both arms: the base if the device was
moved, the tool if the target was changed or remounted. The change of any other frame counts as an
error of the arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from calib_ros.apply.compensator import Compensator
from calib_ros.apply.confidence import moments_of, rms_of
from calib_ros.decision.comparison import Comparison, along_base, compare
from calib_ros.decision.residuals import axes_of, by_axes
from calib_ros.errors import InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import residual_arrays
from calib_ros.estimation.start import in_new_frames, reframed
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.effects import coupled
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.shown import are_lines, rows_in_words


def by_both_arms(
    arm: Calibration,
    sets: Sequence[Observations],
    commanded: FloatArray | None,
    fitted: tuple[str, ...],
) -> tuple[Comparison, float, bool, Chain]:
    """Return the residuals, and their RMS [m] over configurations without a common motion.

    The latter is infinite for pixels, which have no positions. And whether all were measured at
    the `commanded` joint values (M, n), not at corrected ones, and the calibrated arm in fitted
    frames.
    """
    before, after = arm.before, arm.chain
    wanted, uncorrected = sets, False
    if commanded is not None:
        commanded = before.joint_values(commanded)
        after = replace(before, base=after.base, tool=after.tool, frames=after.frames)
        arms = arm.before, arm.chain
        found = [_match_commands(*arms, each, commanded) for each in sets]
        wanted = [replace(s, joints=q) for s, (q, _) in zip(sets, found, strict=True)]
        uncorrected = not any(corrected.any() for _, corrected in found)
    before, after = _in_new_frames(before, sets, fitted), _in_new_frames(after, wanted, fitted)
    pair = replace(compare(before, after, sets), after=compare(before, after, wanted).after)
    left = np.inf
    if all(each.pixels is None for each in sets):
        shaped = compare(before, _rebased(after, wanted), wanted).after
        left = rms_of(moments_of(shaped.position, pair.before.configurations), IN_A_FRAME // 3)
    chain = replace(arm.chain, base=after.base, tool=after.tool, frames=after.frames)
    return along_base(pair, after, sets), left, uncorrected, chain


def _in_new_frames(chain: Chain, sets: Sequence[Observations], fitted: tuple[str, ...]) -> Chain:
    """Return the chain with frames fitted to positions.

    A new tool gets its rotation from the orientations, if measured. If these hardly vary, the tool
    keeps its translation: the base absorbs the change.
    """
    if not fitted:
        return chain
    chain = reframed(chain, fitted, fixed=False)
    plain = [replace(s.without_orientations(), covariance=None) for s in sets]
    problem = Problem(chain, plain[0], more=plain[1:], loss='none')
    chain = in_new_frames(problem, chain, fitted, problem.system(plain), needed=False)
    for tool in (name for name in fitted if name in {each.tool for each in sets}):
        turns = np.zeros((3, 3))
        for each in (each for each in sets if each.tool == tool):
            now = chain.forward(each.joints, each.approach, each.base, tool)[each.oriented]
            turns += np.einsum('nji,njk->ik', now[:, :3, :3], each.rotations[each.oriented])
        if turns.any():
            frame = chain.frame(tool)
            turn = se3.transform(se3.nearest_rotation(turns), np.zeros(3))
            chain = chain.with_frame(tool, replace(frame, matrix=frame.matrix @ turn))
    return chain


def _rebased(chain: Chain, sets: Sequence[Observations]) -> Chain:
    for base in dict.fromkeys(each.base for each in sets):
        own = [each for each in sets if each.base == base]
        wanted = np.concatenate([each.positions for each in own])
        left = [by_axes(residual_arrays(chain, each)[0], axes_of(chain, each)) for each in own]
        found = wanted - np.concatenate(left) @ chain.frame(base).matrix[:3, :3].T
        middle, goal = found.mean(axis=0), wanted.mean(axis=0)
        turn = se3.nearest_rotation((wanted - goal).T @ (found - middle))
        motion = se3.transform(turn, goal - turn @ middle)
        frame = chain.frame(base)
        chain = chain.with_frame(base, replace(frame, matrix=motion @ frame.matrix))
    return chain


def _match_commands(
    nominal: Chain, calibrated: Chain, seen: Observations, commanded: FloatArray
) -> tuple[FloatArray, Index]:
    """Return the commanded joint values (N, n) [rad or m] that belong to N measured ones.

    The nearest of the program (M, n), as it is or corrected by the calibration, and which (N,)
    were nearer to it corrected (1) or as it is (0). If points of a path are closer than the
    correction, corrected ones are nearer to other points than to their own. Measurements further
    from the program than any correction raise an InputError.
    """
    own = [k for k in range(commanded.shape[1]) if k not in coupled(nominal)]
    joints = seen.joints[:, own]
    far, _ = cKDTree(commanded[:, own]).query(joints, p=np.inf)
    lost = np.flatnonzero(far > Compensator.largest_turn)
    if lost.size:
        name = rows_in_words(lost[:1].tolist(), seen.stamps_ns, not are_lines(seen.stamps_ns))
        raise InputError(
            f'{name} was taken {far[lost[0]]:.3g} rad or m from the nearest '
            'commanded joint values: was that program run, and is no joint a full turn away?'
        )
    change = Compensator(nominal, calibrated).follower.solve(commanded).change
    both = np.concatenate([commanded, commanded + change])
    _, nearest = cKDTree(both[:, own]).query(joints, p=np.inf)
    corrected, point = np.divmod(nearest, len(commanded))
    return commanded[point], corrected
