# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Implausible results with good figures: one sentence each, and what to do.

docs/model.md (Suspicions) explains them. An arm that imitates a wrong lens or a lag is another
arm, not just a less accurate one, so the result is refused.
"""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import replace

import numpy as np

from calib_ros.decision.delays import other_delay, uneven, unsteady
from calib_ros.decision.lost_rows import computed_rows
from calib_ros.decision.misfits import explained_share, loose_target
from calib_ros.decision.printed_board import stretched
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.decision.risk import SHELL
from calib_ros.decision.scale import scale_reasons
from calib_ros.decision.steps import EXPLAINED
from calib_ros.errors import CalibrationError, InputError
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.gauges import best_imitation
from calib_ros.estimation.gross_errors import SUSPICIOUS
from calib_ros.estimation.identifiability import DEGENERATE
from calib_ros.estimation.levels import ALIKE, CLEARLY, NEARER, SURE, TELLING, chance_of
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.sizes import TYPICAL
from calib_ros.estimation.start import fit_to_arm, reframed
from calib_ros.estimation.weights import OUTLIER
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.inverse import Aim
from calib_ros.kinematics.parameter import DELAY, IN_A_FRAME, LENS_KINDS, Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray, norms
from calib_ros.settings import EXACT, EXCEPTION, LEVER, Settings
from calib_ros.shown import some, two_digits

LEAST_NOISE = NEARER * EXCEPTION
"""Residuals in units of the given sigmas below which these are wrong: clearly less than a
tenth, the ratio of a device's repeatability to its accuracy; mm would be thousandths."""
SIMULATED = EXACT  # residuals [m or rad] too small for any device
COUPLED = (
    'couplings of the last joints explain most of the residuals: are the joint values those '
    'of the motors? If so, add the effects "coupling"'
)
UNEXPECTED = (
    '(stated errors are larger accordingly): are device, target and arm the same, unmoved and '
    'true to scale?'
)


def add_remarks(problem: Problem, result: Identification, another: bool = True) -> Identification:
    """Return the result with what is suspicious in it, refused if it cannot be right.

    `another` is false if a mistake is already named, which comes first.
    """
    if all(each.socket or each.plane for each in problem.sets):  # shows only the scale of a bar
        refused = scale_reasons(problem, result) if problem.separations else []
        return replace(result, refusals=(*result.refusals, *refused))
    result = _lag(problem, result)
    late = any(each.rule is Rule.LAG for each in result.refusals)
    lens, imitated = _lens(problem, result) if another and not late else ('', False)
    board = '' if lens else stretched(problem, result)
    refusals = [*result.refusals, *scale_reasons(problem, result)]
    if board and all(each.pixels is not None for each in problem.sets):
        refusals.insert(0, Reason(Rule.SCALE, board))  # before what follows for its size
        board = ''
    if imitated or (lens and refusals):
        refusals.append(Reason(Rule.MISTAKE, lens))
        lens = ''
    if another and (several := _sessions(problem, result)):
        refusals.insert(0, Reason(Rule.MISTAKE, several))  # before a move between them
    sigmas = _sigmas(problem, result)
    if sigmas and refusals:
        refusals.append(Reason(Rule.MISTAKE, sigmas))
        sigmas = ''
    coupled, motion = COUPLED if result.coupled else '', _motion(problem, result)
    level, other = _level_hand(problem, result), _another_type(problem, result) if another else ''
    told = any(each.rule is Rule.SCALE for each in refusals) or late or not another
    strain = '' if told else result.strain
    judged = f'{result.contradiction} {UNEXPECTED}' if another and result.contradiction else ''
    loose, order = loose_target(problem.sets), _order(problem)
    found = (other, lens, board, strain, judged, coupled, level, loose, motion, order, sigmas)
    remarks = (*result.remarks, *(each for each in found if each))
    return replace(result, remarks=remarks, refusals=tuple(refusals))


def _arm_distance(chain: Chain, found: Chain, joints: FloatArray) -> float:
    """Return the RMS distance [m] of two arms at (N, n), in the best base and tool.

    Like arms need four steps; unlike ones, whose distance does not matter, hundreds.
    """
    start = replace(chain, base=found.frame('base'), tool=found.frame('tool'), frames=())
    names = [*parameters_of('base'), *parameters_of('tool')]
    return fit_to_arm(start, names, found, joints, iterations=12)[1]


def _sessions(problem: Problem, result: Identification) -> str:
    """Return that sessions with frames of their own, or some rows, fit far better alone."""
    if result.noise.consistent:
        return ''
    if len(problem.sets) == 1:
        many = len(result.outliers) > EXCEPTION * len(problem.observations)
        return computed_rows(problem) if many or result.noise.position > SUSPICIOUS else ''
    sessions: list[list[Observations]] = []
    for each in problem.sets:
        mine = [s for s in sessions if any(each.base == o.base or each.tool == o.tool for o in s)]
        sessions = [s for s in sessions if s not in mine]
        sessions.append([o for s in mine for o in s] + [each])
    explained = result.step is not None and result.step.share > 1.0 - EXCEPTION**2
    if len(sessions) < 2 or explained:
        return ''
    worst = 0.0
    for session in sessions:
        try:
            alone = fit(problem.with_sets(map(Observations.some_images, session), held_out=()))
        except (CalibrationError, np.linalg.LinAlgError):
            return ''  # too few to tell, or without what an effect needs
        worst = max(worst, alone.noise.position)
    if worst > NEARER * result.noise.position:
        return ''
    return (
        'one arm does not fit all sessions or devices: alone each fits '
        f'{result.noise.position / worst:.1f} times as well or better '
        f'({", ".join(session[0].base for session in sessions)}). Is it the same robot, did '
        'nothing happen to it in between, and are the devices true to scale? Identify each alone '
        '(--session, or only its rows or topic) and compare them'
    )


def _another_type(problem: Problem, result: Identification) -> str:
    """Return that lengths differ more than those of one type do; a linear joint's zero may."""
    most = problem.largest_length / 5.0
    zeros = {joint.driven for joint in problem.chain.joints}
    far = [p.name for p in result.parameters if p.beyond(most, np.inf) and p.name not in zeros]
    return bool(far) * (
        f'{", ".join(some(far))} further than {1e3 * most:g} mm from nominal: does the chain '
        'match the arm (type, size and generation)?'
    )


def _level_hand(problem: Problem, result: Identification) -> str:
    """Return that a hand which stays level hides an unknown place of the target, if that counts.

    A target LEVER off is further off than the remaining error by the tilts of the hand.
    """
    known, hidden = problem.chain.all_frames, set[Parameter]()
    places = (p.name for p in result.parameters if p.status == 'gauge' and p.name.is_length)
    for name in filter(problem.model.owns_frame, places):
        every = map(Parameter, (name, *result.gauges[name]))
        tools = {n for n in every if n.owner.startswith('tool') and n.is_length}
        if name in tools:
            tools = {n for n in tools if n.kind == name.kind}
        hidden |= tools if all(known.get(n.owner) is None for n in tools) else set()
    if not hidden:
        return ''
    ends = [*parameters_of('base'), *parameters_of('tool')]
    along = [name for name in ends if name in {f'tool.{n.kind}' for n in hidden}]
    frames = [n for n in ends if n not in along]
    joints = np.concatenate([each.spread().joints for each in problem.sets])
    *_, tilted = best_imitation(result.chain, frames, along, joints, 0.0)
    off = LEVER * np.linalg.norm(tilted) / np.sqrt(len(joints))
    left = 1e-3 * result.comparison.figures[1].rms_mm
    if off < max(left, SIMULATED):
        return ''
    there = [f'{n}, taken as {round(result.chain.value(n), 3) + 0.0:g}' for n in sorted(hidden)]
    return (
        f'a hand that stays level hides {", and ".join(there)}, but tilts by errors of the arm: '
        f'tool points {LEVER:g} m from there are {two_digits(1e3 * off)} mm off. Give '
        f'{min(hidden).owner} in the chain file, to a centimetre'
    )


def _motion(problem: Problem, result: Identification) -> str:
    """Return that residuals are larger where the arm is faster or accelerates more."""
    if result.noise.position <= 1.0:
        return ''
    for each, far in zip(problem.sets, result.distances, strict=True):
        for what, rates in (('speed', each.velocity), ('acceleration', each.acceleration)):
            if rates is None or len(rates) < SOME_POSES:  # few do by chance
                continue
            size = np.linalg.norm(rates, axis=1)
            low, high = np.quantile(size, [1.0 / 3.0, 2.0 / 3.0])
            slow, fast = np.median(far[size <= low]), np.median(far[size >= high])
            if fast > ALIKE * slow:
                return (
                    f'errors grow with the {what} of the arm: stamps jitter, clocks drift, or the '
                    'device or the joint states are smoothed. Stop at each pose (mode dwell)'
                )
    return ''


def _order(problem: Problem) -> str:
    """Return that joints turned steadily in the order of the poses."""
    for each in problem.sets:
        first = np.sort(np.unique(each.configurations, return_index=True)[1])
        q, time = each.joints[first], np.arange(len(first)) - 0.5 * (len(first) - 1)
        q = q - q.mean(axis=0)
        alike = np.abs(time @ q) / np.maximum(np.linalg.norm(time) * norms(q.T), 1e-300)
        steady = np.flatnonzero(alike > 1.0 - EXCEPTION)
        if len(first) >= TELLING and len(steady):
            names = ', '.join(problem.chain.joint_names[k] for k in steady)
            return (
                f'drift of the device looks like an error of {names}, moved in one direction from '
                'the first pose to the last: measure the first pose again, to see whether the '
                'device drifts, and next time mix the order of the poses'
            )
    return ''


def _lag(problem: Problem, result: Identification) -> Identification:
    """Return the result with the lag that explains most of its residuals, refused if it harms."""
    known = {each.rule for each in result.refusals} & {Rule.MISTAKE, Rule.ENCODER, Rule.MOVED}
    still = all(each.velocity is None for each in problem.sets)
    if result.noise.position <= 1.0 or Rule.MISTAKE in known or (known and still):
        return result
    found = _stop_lag(problem, result) if still else uneven(problem, result)
    if known and not (found and isinstance(found[0], Reason)):
        return result  # only a wrong ratio looks like them
    text, harmful = unsteady(problem, result)
    if read := other_delay(problem, result):
        text, harmful = read, bool(result.refusals)
    elif found is not None:
        text, other = found
        if other is not None:
            harmful = _imitated(other, result)
        elif still:  # play at stops is told, not refused
            harmful = False
    if harmful:
        reason = text if isinstance(text, Reason) else Reason.with_remedy(Rule.LAG, text)
        return replace(result, refusals=(*result.refusals, reason))
    return replace(result, remarks=(*result.remarks, *[str(text)] * bool(text)))


def _stop_lag(problem: Problem, result: Identification) -> tuple[str, Problem | None] | None:
    """Return that poses lie towards the previous stop, and the problem with that delay.

    Or that the joints have play, without a problem; None if neither explains most. Sockets and
    planes do not smooth: moves from one touch to the next only show the noise of both.
    """
    bases = sorted({s.base for s in problem.sets if not (s.socket or s.plane)})
    if not bases:
        return None
    chain, names, delays = result.chain, result.names, [Parameter(name, DELAY) for name in bases]
    lens = [name for name in names if Parameter(name).of_lens]
    if lens and not result.converged:  # it diverges first
        with suppress(InputError, np.linalg.LinAlgError):
            given = fit(replace(problem, fixed=(*problem.fixed, *lens)))
            chain, names = given.chain, given.names
    chain = reframed(chain, bases, delay=0.0)
    sets = [*map(_with_moves, problem.sets)]
    few = [each.spread() for each in sets]
    shares = [
        explained_share(problem, chain, names, delays, some)
        for some in (few, [_straight(chain, each) for each in few])
    ]
    if (share := max(shares)) < EXPLAINED:
        return None
    if share > shares[0]:
        sets = [_straight(chain, each) for each in sets]
    late = problem.with_sets(sets)
    play = [name for name in effects.members(chain, 'backlash') if name not in names]
    played = explained_share(late, chain.with_effects(play), names, play)
    if played > share:
        return (
            f'the joints have play, which explains {100.0 * played:.0f} % of the residuals: '
            'fit the play (model auto) with the signs of the last moves (s1 ... sn), or reach '
            'poses from the same side, in use as well'
        ), None
    return (
        f'poses lie towards the previous stop, which explains {100.0 * share:.0f} % of the '
        'residuals: the device smooths, stamps are late, or the arm creeps. Set settle to the '
        'settling time, and stop for longer'
    ), late


def _with_moves(each: Observations) -> Observations:
    """Return poses with the last move (N, n) as velocity, and its sign where unknown."""
    begins = np.flatnonzero(np.diff(each.images, prepend=-1))
    order, joints = np.argsort(each.stamps_ns[begins], kind='stable'), each.joints[begins]
    moves = np.zeros_like(joints)
    moves[order[1:]] = np.diff(joints[order], axis=0)
    moves = moves[each.images]
    signs = np.sign(moves) if each.approach is None else each.approach
    return each.changed(velocity=moves, approach=signs, delay=np.zeros(len(each)))


def _straight(chain: Chain, each: Observations) -> Observations:
    """Return poses whose last moves, as velocity, lead straight back: a smoothed target does."""
    ends, part = (each.base, each.tool), slice(6 if each.oriented.all() else 3)
    there = chain.forward(each.joints - np.asarray(each.velocity), None, *ends)
    place, axes = there[:, :3, 3].T, there[:, :3, :3].transpose(2, 1, 0)
    error, slopes = Aim(chain, *ends).linearise(each.joints.T, None, place, axes, LEVER)
    back = np.linalg.pinv(slopes[:, part].T, DEGENERATE)
    return each.changed(velocity=-np.einsum('bip,pb->bi', back, error[part]))


def _sigmas(problem: Problem, result: Identification) -> str:
    noise, found = result.noise, []
    if noise.consistent or any(each.pixels is not None for each in problem.sets):
        return ''
    sigmas = problem.sigma_position, problem.sigma_orientation
    variances = [np.einsum('nii->ni', s.spread().covariances(sigmas)) for s in problem.sets]
    kinds = (
        ('position', 'm', noise.position, problem.largest_error),
        ('orientation', 'rad', noise.orientation, problem.largest_angle),
    )
    away = np.abs(result.chain.frame(problem.observations.base).matrix - np.eye(4)).max()
    good = result.comparison.figures[0].rms_mm < 1e3 * EXCEPTION * TYPICAL['length']
    computed = good or away < TYPICAL['frame'] / EXCEPTION  # in the controller's own frame
    turned = 0.0 if result.step and result.step.harmful else noise.orientation or 0.0
    wide = turned > 1.0 > CLEARLY * noise.position
    outweighed = wide or turned > CLEARLY * max(noise.position, 1.0)
    for k, (what, unit, size, most) in enumerate(kinds):
        if size is None:
            continue
        each = np.concatenate([part[:, 3 * k : 3 * k + 3] for part in variances])
        given = float(np.sqrt(np.median(each.mean(axis=1))))
        own = not np.isclose(given, sigmas[k])
        usual = getattr(Settings, f'sigma_{what}')
        none_so_good = computed and size * given < LEAST_NOISE * usual
        stated = none_so_good or own or sigmas[k] != usual
        name = f'by the covariances the {what} is known to' if own else f'sigma_{what} is'
        name += f' {given:.2g} {unit}'
        left = f'{1e3 * size * given:.2g} m{unit} are left'
        if stated and SIMULATED < size * given < given and (size < LEAST_NOISE or given > most):
            asked = 'no arm is as good: did its controller compute the poses?'
            asked = asked if none_so_good else f'was m{unit} meant?'
            found.append(f'{name}, and only {left}: {asked}')
        elif outweighed and wide == (k == 0) and size * given < most:
            better = f'{"larger" if k else "smaller"} covariances'
            better = better if own else f'sigma_{what} to {size * given:.2g}'
            found.append(
                f'{name}, {"but" if k else "and only"} {left}: the orientations outweigh the '
                f'positions and spoil them; set {better}'
            )
    return '; '.join(found)


def _lens(problem: Problem, result: Identification) -> tuple[str, bool]:
    """Return that other intrinsics explain the residuals, and whether the arm imitates them.

    They must explain most of the residuals, or more than chance if the arm imitates them: the arm
    fitted with them then differs by as much as it may be nearer to the nominal. The points of an
    image share its pose, so each image counts for six freedoms. Outliers tell nothing: towards the
    plane of the camera, intrinsics move a point without bound.
    """
    seen = any(each.pixels is not None for each in problem.sets)
    if not (seen and result.converged) or (result.step is not None and result.step.harmful):
        return '', False
    images: Counter[str] = Counter()
    pairs = zip(problem.sets, result.distances, strict=True)
    kept = problem.with_sets(each.select(far < OUTLIER) for each, far in pairs)
    for each in kept.sets:
        if each.pixels is not None:
            images[each.camera] += count_distinct(each.images)
    for camera, count in images.items():
        frame, names = problem.chain.frame(camera), parameters_of(camera, LENS_KINDS)
        freedom = IN_A_FRAME * count - len(result.names)
        if frame.lens is None or not frame.lens.fixed or freedom <= len(names):
            continue
        left = 1.0 - explained_share(kept, result.chain, result.names, names)
        rest = freedom - len(names)
        if chance_of((1.0 - left) / max(left, EXACT) * rest, len(names), rest) > 1.0 - SURE:
            continue
        fitted = replace(frame, lens=replace(frame.lens, fixed=False))
        freed = replace(problem, chain=problem.chain.with_frame(camera, fitted))
        imitates = _imitated(freed, result)
        share = 1.0 - left * freedom / rest
        if imitates or share > EXPLAINED:
            lens = 'lens=fitted in sources' if problem.of_messages else '--lens fitted'
            text = f'other intrinsics of the camera than those given explain {100.0 * share:.0f} %'
            text += f' of the residuals: {lens}, or calibrate the camera as it is used'
            return text, imitates
    return '', False


def _imitated(freed: Problem, result: Identification) -> bool:
    """Tell whether a fit with more freedom finds another arm, within the region of this one."""
    try:
        other = fit(freed).chain
    except (InputError, np.linalg.LinAlgError):
        return True
    joints = [each.spread().joints for each in freed.sets]
    if result.region is not None:
        drawn = freed.chain.random_joints(SHELL, np.random.default_rng(0))
        joints.append(drawn[result.region.covers(drawn)])
    before, after = (
        _arm_distance(each, other, np.concatenate(joints))
        for each in (result.before, result.chain)
    )
    return after > NEARER * before
