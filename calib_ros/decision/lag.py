# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses measured before the target had come to rest: each lies towards the previous stop.

A device that smooths, late stamps or a creeping arm shows joint values q_i - w (q_i - q_i-1): a
delay w with the last move as velocity. The arm imitates what depends on q_i alone, and may become
worse; the rest is most of the residuals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.decision.steps import EXPLAINED
from calib_ros.decision.suspicions import explained, imitated
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.parameter import DELAY, Parameter


def remarked(problem: Problem, result: Identification) -> Identification:
    """Return the result with the lag that explains most of its residuals, refused if it harms."""
    known = {each.rule for each in result.refusals} & {Rule.MISTAKE, Rule.ENCODER, Rule.MOVED}
    first, *more = map(_with_moves, problem.sets)
    stands = all(
        each.velocity is None and each.pixels is None and not each.socket and not each.plane
        for each in problem.sets
    )
    bases = {each.base for each in (first, *more) if each.moving}
    if result.noise.position <= 1.0 or known or not stands or not bases:
        return result
    late, chain = replace(problem, observations=first, more=more, held_out=()), result.chain
    for name in bases:
        chain = chain.with_frame(name, replace(chain.frame(name), delay=0.0))
    delays = [Parameter(name, DELAY) for name in sorted(bases)]
    share = explained(late, chain, result.names, delays)
    if share < EXPLAINED:
        return result
    text = (
        f'poses lie towards the previous stop, which explains {100.0 * share:.0f} % of the '
        'residuals: the device smooths, stamps are late, or the arm creeps. Set settle to the '
        'time until measurements rest, and stop for longer'
    )
    if imitated(late, result):
        return replace(result, refusals=(Reason(Rule.LAG, text), *result.refusals))
    return replace(result, remarks=(*result.remarks, text))


def _with_moves(each: Observations) -> Observations:
    """Return poses with the move from the previous stop (N, n) as velocity."""
    order = np.argsort(each.stamps_ns, kind='stable')
    moves = np.zeros_like(each.joints)
    moves[order[1:]] = np.diff(each.joints[order], axis=0)
    return replace(each, velocity=moves, delay=np.zeros(len(each)))
