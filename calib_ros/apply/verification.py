# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Is the corrected arm accurate enough? A verdict from new measurements.

Errors are those of `both_arms.py`, and the verdict that of `judgement.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib_ros.annotated import Confidence, InMetres, Positive, as_annotated
from calib_ros.apply.both_arms import by_both_arms
from calib_ros.apply.confidence import limits_of, moments_of
from calib_ros.apply.iso_9283 import TILTED
from calib_ros.apply.judgement import Judgement, judge
from calib_ros.apply.verified import Verification
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.visits import frames_of_sets
from calib_ros.estimation.weights import OUTLIER
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.orientations import with_known_turns
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.joint import Frame
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray, Index
from calib_ros.progress import Notify, quiet

NEEDED = 1 + len(TILTED)  # configurations without those for fitted frames: as in ISO 9283


@as_annotated
def verify(
    arm: Calibration,
    sets: Sequence[Observations],
    tolerance: InMetres | None = None,
    confidence: Confidence = CONFIDENT,
    new_base: bool = False,
    commanded: FloatArray | None = None,
    new_tool: bool = False,
    progress: Notify = quiet,
    sigma_position: Positive | None = None,
) -> Verification:
    """Judge a calibrated arm on measurements that were not used for it.

    `sets` are new measurements of poses or positions, in the frames of the calibration. Without a
    `tolerance`, the largest acceptable RMS position error [m], the verdict is whether the
    calibration holds, by `Calibration.limit`; `sigma_position` [m] is the noise of positions
    without a covariance, None as in `judge`. `progress` receives the share done.

    With `new_base` the measuring devices were moved, with `new_tool` the targets replaced. Fitting
    a frame absorbs the errors of two configurations, or of one (on the flange: of one, or two).

    `commanded` (M, n) are joint values [rad or m] of the uncorrected program: the nominal arm
    defines the wanted poses there. Each measurement belongs to one of them, as it is or corrected.

    Raises InputError for too few poses, distances, unknown frames, or poses far from all commands.
    """
    fitted = frames_of_sets(sets, new_base, new_tool)
    _check(arm, sets, fitted)
    sets = with_known_turns(arm, sets, fitted)
    comparison, left, uncorrected, chain = by_both_arms(arm, sets, commanded, fitted)
    progress(2 / 3)
    whole = 'tool' if all(each.seen for each in sets) else 'base'
    lost = len(fitted) + sum(name.startswith(whole) for name in fitted)
    if (count := count_distinct(comparison.before.configurations)) - lost < NEEDED:
        were, more = 'pose was' if count == 1 else 'poses were', NEEDED + lost
        of_frames = f', {lost} of them for the refitted frames' if lost else ''
        raise InputError(f'{count} {were} measured; at least {more} are needed{of_frames}')
    given = comparison, tolerance, confidence, lost
    found = judge(arm, sets, *given, sigma_position=sigma_position, chain=chain)
    own = ((name, Frame() if name[:4] == 'base' else each) for name, each in chain.frames)
    return Verification(
        **vars(found),
        tolerance=tolerance,
        common=1.0 if new_base or np.isinf(left) else left / found.rms,
        by_program=commanded is not None,
        chain=replace(chain, base=Frame(), frames=tuple(own)),
        fitted=fitted,
        outside=arm.outside(sets),
        uncorrected=uncorrected,
        odd=() if found.limit is None else _odd(found, found.limit, lost),
        step=arm.step(sets) if found.failed else None,
        unseen=_unseen(arm, sets, found) if found.verdict in ('PASS', 'holds') else None,
    )


def _unseen(arm: Calibration, sets: Sequence[Observations], found: Judgement) -> float:
    """Return the largest error [m] by one parameter that fits the interval beside the usual error.

    The parameter moves the target most somewhere in the joint range, and less at these poses.
    """
    chain = arm.chain
    names = [name for name in chain.parameter_names if name.of_dh]
    models = [ErrorModel(chain, names, each.base, each.tool) for each in sets]
    pairs = zip(models, sets, strict=True)
    seen = np.concatenate([model.jacobian(each.spread().joints)[:, :3] for model, each in pairs])
    here = np.sqrt((seen**2).sum(axis=1).mean(axis=0))
    joints = chain.random_joints(SOME_POSES, np.random.default_rng(0))
    there = np.linalg.norm(models[0].jacobian(joints)[:, :3], axis=1).max(axis=0)
    ratios = there / np.maximum(here, HALF_THE_DIGITS)
    usual = min(arm.residual or 0.0, found.lower)
    return float(ratios.max(initial=1.0) * np.sqrt(found.upper**2 - usual**2))


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
    if not any(map(len, sets)):
        raise InputError('no pose was measured')
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
