# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Delays in motion that are not one constant: an arm imitates them along its path.

The delay of each device is fitted. Clocks that drift apart make one that changes, and stamps that
jitter one of each measurement: errors along its velocity, which are told from those across and
taken into account. Joints that are not read at one moment have delays of their own: a delay d
moves a joint by -d times its speed, as play with the speed for the sign of the approach. Where
speeds are not known, joints measured in motion seem to be off at random.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import TypeAlias

import numpy as np
from scipy import special

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.decision.rounding import rounded_joints
from calib_ros.decision.steps import EXPLAINED
from calib_ros.errors import CalibrationError
from calib_ros.estimation.fitted import Fitted
from calib_ros.estimation.fitting import SOME, fit
from calib_ros.estimation.gain import gain_share, gain_shares
from calib_ros.estimation.levels import ALIKE, NEARER, SEVERAL, SURE, TELLING, chance_of
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.sizes import TYPICAL
from calib_ros.estimation.system import stacked
from calib_ros.estimation.weights import weights_of
from calib_ros.kinematics import effects
from calib_ros.kinematics.joint import small_units
from calib_ros.kinematics.parameter import DELAY, Parameter
from calib_ros.kinematics.se3 import ROUNDING, FloatArray, norms
from calib_ros.settings import EXCEPTION, Settings
from calib_ros.shown import two_digits

Look: TypeAlias = Callable[[Problem], tuple[Fitted, list[FloatArray]]]


def timed(problem: Problem) -> tuple[Problem, tuple[str, ...]]:
    """Return the problem with measurements in motion as their stamps allow, and what they tell.

    Joints are moved to where a changing delay saw them. Of stamps that jitter, errors along the
    velocity count for less.
    """
    told, rows_of = list[str](), cache(_rows)
    remedy = 'Stamp everything as it is measured, by one clock, or stop at each pose (mode dwell)'
    bases = sorted({each.base for each in problem.sets if _in_motion(each)})
    try:
        problem, changes = _without_drift(problem, bases, rows_of)
        for base, change in zip(bases, changes, strict=True):
            if change:
                told.append(
                    f'{base}.delay changes by {two_digits(1e3 * change)} ms over the session: '
                    f'clocks drift apart or jump. Joint values are corrected for it. {remedy}'
                )
        for base in bases:
            problem, jitter = _without_jitter(problem, base, rows_of)
            if jitter:
                told.append(
                    f'measurements of {base} are early or late by {two_digits(1e3 * jitter)} ms '
                    'at random: stamps jitter, or the device or the joint states are smoothed. '
                    f'Figures are for the arm at rest. {remedy}'
                )
    except (CalibrationError, np.linalg.LinAlgError):  # told by the whole fit
        pass
    return problem, tuple(told)


def _in_motion(each: Observations) -> bool:
    return each.moving and each.distances is None and each.pixels is None


def _lacking(fitted: Fitted) -> bool:
    return fitted.noise.position > 1.0 or bool(fitted.robust.outliers.mean() > EXCEPTION)


def _changed(
    problem: Problem, bases: Sequence[str], change: Callable[[Observations], Observations]
) -> Problem:
    """Return the problem with other measurements in motion by some devices."""
    fitted, judging = (
        [change(e) if e.base in bases and _in_motion(e) else e for e in sets]
        for sets in (problem.sets, problem.judging)
    )
    return problem.with_sets(fitted, held_out=judging)


def _without_drift(
    given: Problem, bases: Sequence[str], rows_of: Look
) -> tuple[Problem, list[float]]:
    """Return a problem with joints where they were seen, and how much the delays change [s].

    By functions of time of the delays, fitted together beside all parameters: a device whose delay
    still changes would bend the arm for the others. Clocks mostly drift evenly or jump once, and
    the fewer functions there are, the less they imitate errors of the arm along its path:
    polynomials are used only where they leave less than half of what a line or a step leaves.
    """
    stamps = {b: np.concatenate([e.stamps_ns for e in given.sets if e.base == b]) for b in bases}
    steps = np.linspace(-1.0, 1.0, TELLING**2 + 1)[1:-1]
    one = TELLING + len(steps)
    every = one * np.arange(len(bases))[:, np.newaxis]
    even = (every + range(TELLING)).ravel()
    simple = [every.ravel(), *(every + range(TELLING, one)).reshape(-1, 1)]
    problem, sizes = given, np.zeros(one * len(bases))

    def waves(each: Observations) -> FloatArray:  # (N, one D)
        own = stamps.get(each.base, each.stamps_ns)
        times = 2.0 * (each.stamps_ns - own.min()) / max(np.ptp(own), 1) - 1.0
        found = np.polynomial.legendre.legvander(np.clip(times, -1.0, 1.0), TELLING)[:, 1:]
        found = np.concatenate([found, np.sign(times[:, np.newaxis] - steps)], axis=1)
        return np.asarray(np.kron([float(each.base == base) for base in bases], found))

    def moved(each: Observations) -> Observations:
        read = np.zeros(len(each)) if each.delay is None else each.delay
        return replace(each.earlier(read + waves(each) @ sizes), delay=each.delay)

    for _ in range(SEVERAL * bool(bases)):
        fitted, rows = rows_of(problem)
        if not _lacking(fitted):
            break
        count, beside = len(rows[0]) - 2, list[FloatArray]()
        for each, own in zip(fitted.problem.sets, rows, strict=True):
            added = own[count] * waves(each).T[:, np.newaxis]
            beside.append(np.concatenate([own[:count], added, own[-1:]]))
        matrix, poses = stacked(beside), sum(each.shape[-1] for each in rows)
        groups = even, *simple
        shares = gain_shares(matrix, count, groups)
        best = 1 + int(np.argmax(shares[1:]))
        best = best if 1.0 - shares[0] > EXPLAINED * (1.0 - shares[best]) else 0
        share, near = shares[best], matrix[:, [*range(count), *(count + groups[best]), -1]]
        by = np.linalg.lstsq(near[:, :-1], near[:, -1], rcond=None)[0]
        left = np.sqrt(np.mean((near[:, -1] - near[:, :-1] @ by) ** 2))
        many, free = len(groups[best]), poses - len(groups[best])
        # late poses have all their errors together
        chance = chance_of(share / max(1.0 - share, ROUNDING) * free, many, free) * len(groups)
        enough = EXCEPTION if left < ALIKE else NEARER
        if not (share > enough and chance < 1.0 - SURE):
            break
        sizes[groups[best]] += by[count:]
        problem = _changed(given, bases, moved)
    moves = [[waves(e) @ sizes for e in given.sets if e.base == base] for base in bases]
    return problem, [float(np.ptp(np.concatenate(each))) for each in moves]


def _without_jitter(problem: Problem, base: str, rows_of: Look) -> tuple[Problem, float]:
    """Return a problem with larger covariances along the velocity, and the jitter [s].

    Told by errors along it that are larger than those across. A fit to these is nearer to the arm,
    and tells more.
    """
    mine = [k for k, e in enumerate(problem.sets) if e.base == base and _in_motion(e)]
    found = across = 0.0
    for _ in range(SEVERAL):
        fitted, rows = rows_of(problem)
        if not (found > 0.0 or _lacking(fitted)):
            break
        matrix = stacked(rows)
        late = np.append(-np.linalg.lstsq(matrix[:, :-1], matrix[:, -1], rcond=None)[0], 1.0)
        few = np.concatenate([rows[k][:, :3] for k in mine], axis=2)
        speed, errors = few[-2].T, np.tensordot(late, few, 1).T
        squares = np.maximum((speed**2).sum(axis=1), 1e-300)
        along = np.einsum('nc,nc->n', speed, errors) ** 2 / squares
        across = np.median(norms(errors) ** 2 - along) / special.chdtri(2, 0.5)
        jitter = np.median((along / special.chdtri(1, 0.5) - across) / squares)  # squared
        if jitter * np.median(squares) <= across:
            break
        ratio = jitter / max(across, 1e-300)
        found += ratio
        problem = _changed(problem, [base], partial(_widened, fitted, ratio))
    return problem, float(np.sqrt(found * across))


def _widened(fitted: Fitted, jitter: float, each: Observations) -> Observations:
    """Return measurements whose delay has a variance (of `jitter`, in that of the noise)."""
    every = np.ones_like(each.oriented)
    plain = Samples(each.changed(covariance=None, oriented=every), 1.0, 1.0)
    moved = plain.rows_of(fitted.chain, [Parameter(each.base, DELAY)])[0].T
    moved[~each.oriented, 3:] = 0.0
    problem = fitted.problem
    given = each.covariances((problem.sigma_position, problem.sigma_orientation))
    wide = given + jitter * np.einsum('ni,nj->nij', moved, moved)
    kept = given if each.punctual is None else each.punctual @ given
    return replace(each, covariance=wide, punctual=kept @ np.linalg.inv(wide))


def _rows(problem: Problem) -> tuple[Fitted, list[FloatArray]]:
    """Return a fit to some samples, and their rows (P, c, N): of its delay, then the residual.

    Those of delays and play of single joints, and of their ratios, are before them. Gross errors
    count for less: a part of the session may seem to be some.
    """
    fitted = fit(problem.with_sets(each.spread(SOME) for each in problem.sets))
    lags, sets = effects.members(fitted.chain, 'backlash'), fitted.problem.sets
    rivals = [*lags, *effects.members(fitted.chain, 'ratio')]
    names, chain = [*dict.fromkeys([*fitted.names, *rivals])], fitted.chain.with_effects(rivals)
    weights = [weights_of(each, 'huber') for each in fitted.robust.distances]
    speeds = [replace(each, approach=each.velocity) for each in sets]
    own, late = (problem.system(each).weighted(weights).sets for each in (sets, speeds))
    return fitted, [
        np.concatenate(
            [
                by_speed.rows_of(chain, lags)[:-1],
                samples.rows_of(chain, [*names, Parameter(each.base, DELAY)]),
            ]
        )
        for by_speed, samples, each in zip(late, own, sets, strict=True)
    ]


def wrong_ratio(joint: str, ratio: float, why: str = '') -> str:
    """Return that a joint moves more or less than its values; empty if by less than 1 %.

    Arms that bend seem to.
    """
    if abs(ratio) < EXCEPTION**2:
        return ''
    size = f'{two_digits(100.0 * abs(ratio))} % {"more" if ratio > 0.0 else "less"}'
    remedy = 'correct its gear ratio or the count of its encoder'
    return f'{joint} moves {size} than its values{why}: {remedy}'


def uneven(problem: Problem, result: Identification) -> tuple[str, Problem | None] | None:
    """Return what explains most of the residuals, and the problem without it; None if nothing.

    Joints late by different times, joints out of scale, or, without such a problem, play.
    """
    chain, known = result.chain, set(result.names)
    play, ratios = (effects.members(chain, group) for group in ('backlash', 'ratio'))
    if known & {*play, *ratios}:
        return None
    played, _, _ = _explained(problem, result, play, np.sign)
    scaled, ratio, strong = _explained(problem, result, ratios, np.sign)
    share, delays, late = _explained(problem, result, play, np.positive)
    if (most := max(played, scaled, share)) < EXPLAINED:
        return None
    explain = f'{100.0 * most:.0f} % of the residuals'
    if most == played:
        return (
            f'the joints have play, which explains {explain}: fit the play (model auto), or stop '
            'at each pose (mode dwell) and come from the same side, in use as well'
        ), None
    if most == scaled:
        k = int(np.argmax(strong))
        if not (said := wrong_ratio(ratios[k].owner, ratio[k], f', which explains {explain}')):
            return None
        delays, ratio = 0.0 * delays, ratio * (np.arange(len(ratio)) == k)
        text: str = Reason(Rule.MISTAKE, said)
    else:
        ratio = 0.0 * ratio
        text = (
            f'joints with different delays explain {explain}, above all '
            f'{play[int(np.argmax(late))].owner}: read all joints at once, unfiltered, look '
            'for wrong speeds, or stop at each pose (mode dwell)'
        )
    sets = []
    for each in problem.sets:
        joints = each.joints * (1.0 + ratio)
        if each.velocity is not None:
            joints += each.velocity * delays
        sets.append(replace(each, joints=joints))
    return text, problem.with_sets(sets)


def other_delay(problem: Problem, result: Identification) -> str:
    """Return that a fitted delay is too far from the one at which the joint values were taken."""
    for each in problem.sets:
        found = result.chain.frame(each.base).delay
        if each.velocity is None or each.delay is None or found is None:
            continue
        read = float(np.median(each.delay))
        if abs(found - read) > 0.5 * Settings.max_gap:
            return (
                f'joint values were read for measurements {read:.3f} s late, but these are about '
                f'{found:.3f} s late: set delay to {found:.3f} and sample again, once clocks '
                'neither drift nor jump'
            )
    return ''


def unsteady(problem: Problem, result: Identification) -> tuple[str, bool]:
    """Return that joints seem to be off at random by more than arms are, and whether it is a lag.

    It is if some other reason refuses the result as well, or if that is more than any arm's play
    and the correction lowers the error by less than a third. Rounded values are off like that.
    """
    lacking, typical = result.posterior.unmodelled, TYPICAL['angle']
    steps = rounded_joints(problem).values()
    rounding = np.sqrt(sum(step**2 for step in steps) / 12.0 / len(problem.chain.joints))
    if not (lacking.random and lacking.turns > max(typical, ALIKE * rounding)):
        return '', False
    if result.refusals and lacking.turns > problem.largest_angle:  # something else is wrong
        return '', False
    before, after = result.comparison.figures
    slight = before.rms_mm < ALIKE * after.rms_mm and lacking.turns > typical / NEARER
    unit = small_units(problem.chain.joints)
    text = (
        f'joints seem off by {two_digits(1e3 * lacking.turns)} {unit} at random, from pose to '
        'pose: the arm moved while it was measured, joint values and poses are not simultaneous, '
        'values lack digits, joints have play, or devices or targets lack names. Stop at each '
        'pose, and compare the clocks'
    )
    return text, bool(result.refusals) or slight


def _explained(
    problem: Problem,
    result: Identification,
    lags: Sequence[Parameter],
    rate: Callable[[FloatArray], FloatArray],
) -> tuple[float, FloatArray, FloatArray]:
    """Return the share of the residual squares by L effects, their sizes and effects (L,)."""
    few, count = [each.spread() for each in problem.sets], len(result.names)
    few = [replace(s, approach=None if s.velocity is None else rate(s.velocity)) for s in few]
    chain, names = result.chain.with_effects(lags), [*result.names, *lags]
    matrix = stacked(problem.system(few).rows_of(chain, names))
    delays = np.asarray(np.linalg.lstsq(matrix[:, :-1], matrix[:, -1], rcond=None)[0][count:])
    return gain_share(matrix, count), delays, np.abs(delays) * norms(matrix[:, count:-1].T)
