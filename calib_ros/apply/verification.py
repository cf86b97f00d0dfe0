# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Is the corrected arm accurate enough? A verdict from new measurements.

A controller corrected by a calibration C stands at joint values q where C predicts the wanted
pose, so its error is measured - C(q); uncorrected it would be measured - N(q). Both follow from
the joint values that the controller reports. If the uncorrected program is known, the wanted pose
is N(q_commanded), and a missing correction shows as well.

The verdict is that of `judgement.py`. On request, frames of the new measurements are fitted to
both arms: the base if the device was moved, the tool if the target was changed or remounted. The
change of any other frame counts as an error of the arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from calib_ros.annotated import Confidence, InMetres, as_annotated
from calib_ros.apply.compensation import Compensator
from calib_ros.apply.confidence import limits_of, moments_of, rms_of
from calib_ros.apply.iso_9283 import TILTED
from calib_ros.apply.judgement import Judgement, judge
from calib_ros.decision.comparison import Comparison, along_base, compare
from calib_ros.decision.moved import Step
from calib_ros.decision.residuals import axes_of, by_axes
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.estimation.observations import Observations, frames_of_sets
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import residual_arrays
from calib_ros.estimation.start import in_new_frames, released
from calib_ros.estimation.weights import OUTLIER
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.effects import coupled
from calib_ros.kinematics.joint import Frame
from calib_ros.kinematics.parameter import IN_A_FRAME
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.shown import LISTED, Shown, as_html, rounded

NEEDED = 1 + len(TILTED)  # configurations without those for fitted frames: as in ISO 9283


class Attained(NamedTuple):
    """Accuracy before and after [mm] and repeatability [mm] of a configuration (ISO 9283)."""

    cycles: int
    before: float
    after: float
    repeatability: float | None

    @classmethod
    def of(cls, before: FloatArray, after: FloatArray) -> Attained:
        """Return the figures of errors (N, 3) [mm]."""
        first, last = (float(np.linalg.norm(each.mean(axis=0))) for each in (before, after))
        apart = np.linalg.norm(after - after.mean(axis=0), axis=1)
        again = float(apart.mean() + 3.0 * apart.std(ddof=1)) if len(after) > 1 else None
        return cls(len(after), first, last, again)


@dataclass(frozen=True, eq=False, repr=False)
class Verification(Judgement, Shown):
    """A judgement of a calibrated arm, and what explains the errors."""

    tolerance: float | None
    """Wanted RMS position error [m]."""
    common: float
    """Share of the RMS error that remains without one common shift and turn of all positions."""
    by_program: bool
    """Whether the wanted poses are those of the uncorrected program."""
    chain: Chain
    """The calibrated arm in the frame of its base, with fitted tools."""
    fitted: tuple[str, ...] = ()
    """Frames fitted to the new measurements."""
    outside: float = 0.0
    """Share of the measurements outside the region of the calibration."""
    uncorrected: bool = False
    """Whether all measurements were taken at the joint values of the program as it was given."""
    odd: tuple[int, ...] = ()
    """Configurations without which the others would be within the limit."""
    step: Step | None = None
    """What moved during the measurement, if the arm exceeds the limit."""

    def _repr_html_(self) -> str:
        before, after = self.comparison.figures
        ends = ' to '.join(rounded(1e3 * each) for each in (self.lower, self.upper))
        like = f'RMS over poses like these ({100 * self.confidence:g} %: {ends})'
        rows = (
            ('position error [mm]', 'before', 'after'),
            ('RMS', rounded(before.rms_mm), rounded(after.rms_mm)),
            ('largest', rounded(before.max_mm), rounded(after.max_mm)),
            (like, '', rounded(1e3 * self.rms)),
            ('limit', '', '' if self.limit is None else rounded(1e3 * self.limit)),
        )
        return as_html(self.verdict, (), rows)

    @property
    def each(self) -> tuple[Attained, ...]:
        """Return the accuracy at each configuration; empty beyond LISTED of them."""
        if self.configurations > LISTED:
            return ()
        both = (self.comparison.before.position, self.comparison.after.position)
        return tuple(
            Attained.of(*(1e3 * errors[self.group == k] for errors in both))
            for k in range(self.configurations)
        )


@as_annotated
def verify(
    arm: Calibration,
    sets: Sequence[Observations],
    tolerance: InMetres | None,
    confidence: Confidence = CONFIDENT,
    new_base: bool = False,
    commanded: FloatArray | None = None,
    new_tool: bool = False,
    progress: Notify = quiet,
) -> Verification:
    """Judge a calibrated arm on measurements that were not used for it.

    `sets` are new measurements of poses or positions, in the frames of the calibration. Without a
    `tolerance`, the largest acceptable RMS position error [m], the verdict is whether the
    calibration holds, by `Calibration.limit`. `progress` receives the share done.

    With `new_base` the measuring devices were moved, with `new_tool` the targets replaced. Fitting
    a frame absorbs the errors of two configurations, or of one (on the flange: of one, or two).

    `commanded` (M, n) are joint values [rad or m] of the uncorrected program: the nominal arm
    defines the wanted poses there. Each measurement belongs to one of them, as it is or corrected.

    Raises InputError for too few poses, distances, unknown frames, or poses far from all commands.
    """
    fitted = frames_of_sets(sets, new_base, new_tool)
    _check(arm, sets, fitted)
    comparison, left, uncorrected, chain = _compared(arm, sets, commanded, fitted)
    progress(2 / 3)
    whole = 'tool' if all(each.seen for each in sets) else 'base'
    lost = len(fitted) + sum(name.startswith(whole) for name in fitted)
    if (count := count_distinct(comparison.before.configurations)) - lost < NEEDED:
        were, more = 'pose was' if count == 1 else 'poses were', NEEDED + lost
        of_frames = f', {lost} of them for the refitted frames' if lost else ''
        raise InputError(f'{count} {were} measured; at least {more} are needed{of_frames}')
    found = judge(arm, sets, comparison, tolerance, confidence, lost)
    return Verification(
        **vars(found),
        tolerance=tolerance,
        common=1.0 if new_base or np.isinf(left) else left / found.rms,
        by_program=commanded is not None,
        chain=chain,
        fitted=fitted,
        outside=arm.outside(sets),
        uncorrected=uncorrected,
        odd=() if found.limit is None else _odd(found, found.limit, lost),
        step=arm.step(sets) if found.failed else None,
    )


def _compared(
    arm: Calibration,
    sets: Sequence[Observations],
    commanded: FloatArray | None,
    fitted: tuple[str, ...],
) -> tuple[Comparison, float, bool, Chain]:
    """Return the residuals, and their RMS [m] over configurations without a common motion.

    The latter is infinite for pixels, which have no positions. And whether all were measured at
    the commanded joint values, not at corrected ones, and the arm in the frame of its base.
    """
    before, after = arm.before, arm.chain
    wanted, uncorrected = sets, False
    if commanded is not None:
        commanded = before.joint_values(commanded)
        after = replace(before, base=after.base, tool=after.tool, frames=after.frames)
        arms = arm.before, arm.chain
        found = [_match_commands(*arms, each.joints, commanded) for each in sets]
        wanted = [replace(s, joints=q) for s, (q, _) in zip(sets, found, strict=True)]
        uncorrected = not any(corrected.any() for _, corrected in found)
    before, after = _in_new_frames(before, sets, fitted), _in_new_frames(after, wanted, fitted)
    pair = replace(compare(before, after, sets), after=compare(before, after, wanted).after)
    left = np.inf
    if all(each.pixels is None for each in sets):
        shaped = compare(before, _rebased(after, wanted), wanted).after
        left = rms_of(moments_of(shaped.position, pair.before.configurations), IN_A_FRAME // 3)
    own = ((name, Frame() if name[:4] == 'base' else each) for name, each in after.frames)
    chain = replace(arm.chain, base=Frame(), tool=after.tool, frames=tuple(own))
    return along_base(pair, after, sets), left, uncorrected, chain


def _odd(found: Judgement, limit: float, lost: int) -> tuple[int, ...]:
    """Return the configurations without which the others are within a limit exceeded with them.

    Outliers, or all on one side of the moment that best divides errors of two sizes. Without gross
    errors the others need not decide.
    """
    moments = moments_of(found.comparison.after.position, found.group)

    def limits(which: Index) -> tuple[float, float, float]:
        if len(which) - lost < NEEDED:
            return 0.0, np.inf, np.inf
        rms, *_, (lower,), (upper,) = limits_of(moments[which], lost, found.confidence)
        return float(lower), rms, float(upper)

    squares = np.trace(moments, axis1=1, axis2=2)
    every, before = np.arange(len(squares)), np.arange(1, len(squares))
    after, sums = before[::-1], (np.cumsum(squares)[:-1], np.cumsum(squares[::-1])[-2::-1])
    sizes = np.log(sums[0] / before), np.log(sums[1] / after)
    moment = 1 + int(np.argmin(before * sizes[0] + after * sizes[1]))
    outliers = np.flatnonzero(squares > OUTLIER**2 * np.median(squares))
    sides = [each for each in (every[:moment], every[moment:]) if limits(each)[0] > limit]
    for bad, bound in ((outliers, 2), *((side, 2) for side in sides), (outliers, 1)):
        if limits(np.setdiff1d(every, bad))[bound] <= limit < limits(every)[bound]:
            return tuple(bad.tolist())
    return ()


def _check(arm: Calibration, sets: Sequence[Observations], fitted: tuple[str, ...]) -> None:
    chain = arm.chain
    if not sets:
        raise ConfigError('sets must hold at least one set of Observations')
    if any(each.distances is not None or each.socket for each in sets):
        raise InputError(
            'verification needs measured poses or positions: leave out rows of distances, planes '
            'and sockets'
        )
    arm.require_frames(sets)
    for each in sets:
        chain.joint_values(each.joints)
        if fitted and each.pixels is not None:
            raise InputError(
                'images cannot locate a new base or tool: leave both as they were for the '
                'calibration, or measure poses'
            )


def _in_new_frames(chain: Chain, sets: Sequence[Observations], fitted: tuple[str, ...]) -> Chain:
    """Return the chain with frames fitted to positions.

    A new tool gets its rotation from the orientations, if measured. If these hardly vary, the tool
    keeps its translation: the base absorbs the change.
    """
    if not fitted:
        return chain
    chain = released(chain, fitted)
    plain = [replace(s, oriented=np.zeros_like(s.oriented), covariance=None) for s in sets]
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
    nominal: Chain, calibrated: Chain, joints: FloatArray, commanded: FloatArray
) -> tuple[FloatArray, Index]:
    """Return the commanded joint values (N, n) [rad or m] that belong to measured ones (N, n).

    The nearest of the program (M, n), as it is or corrected by the calibration, and which (N,)
    were nearer to it corrected (1) or as it is (0). If points of a path are closer than the
    correction, corrected ones are nearer to other points than to their own. Measurements further
    from the program than any correction raise an InputError.
    """
    own = [k for k in range(joints.shape[1]) if k not in coupled(nominal)]
    far, _ = cKDTree(commanded[:, own]).query(joints[:, own], p=np.inf)
    lost = np.flatnonzero(far > Compensator.largest_turn)
    if lost.size:
        raise InputError(
            f'measurement {lost[0] + 1} was taken {far[lost[0]]:.3g} rad or m from the nearest '
            'commanded joint values: was that program driven, and is no joint a full turn away?'
        )
    change = Compensator(nominal, calibrated).follower.solve(commanded).change
    both = np.concatenate([commanded, commanded + change])
    _, nearest = cKDTree(both[:, own]).query(joints[:, own], p=np.inf)
    corrected, point = np.divmod(nearest, len(commanded))
    return commanded[point], corrected
