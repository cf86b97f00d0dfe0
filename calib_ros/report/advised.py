# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The advice on a refused result: what is known of its measurements, and of its arm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.apply.confidence import interval_of
from calib_ros.decision.reasons import Rule
from calib_ros.decision.result import Identification
from calib_ros.decision.rounding import error_by_rounding
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.problem import Problem
from calib_ros.report import words
from calib_ros.report.advice import BRINGS, ENOUGH, Situation, advice
from calib_ros.report.refusals import GOOD_ARM, GOOD_HERE, Advice


def advice_of(problem: Problem, result: Identification) -> tuple[Advice, ...]:
    """Return why a result was refused, in plain words, and what to do.

    What the fit left, by its ratio to the stated noise, is that noise in the same figure. A fit of
    few poses leaves less, and does not show that an arm is good.
    """
    if result.accepted:
        return ()
    judged, noise = result.validation, result.noise.position
    told = {each.rule for each in result.refusals}
    if judged is not None and told - BRINGS[Rule.GAIN] == {Rule.GAIN}:
        lower, upper = interval_of(judged, 0)
        if upper < np.inf and 1e3 * lower * noise <= result.fitted.figures[1].rms_mm:
            known = words.sigma_over_range(result)['median'] < judged.figures[0].rms_mm
            good = GOOD_ARM if known else GOOD_HERE
            return (replace(good, refusal='; '.join(result.refusals)),)
    held_out = () if judged is None or judged.repeated is None else (judged,)
    numbers = (each.after.configurations for each in (result.fitted, *held_out))
    poses = sum(map(count_distinct, numbers))
    sigma = None if result.images else result.noise.given.get('sigma_position')
    contradicted = bool(held_out) and bool(result.surprise)
    wires = any(each.of_wire for each in problem.all_sets)
    limits = (problem.largest_length, problem.largest_angle)
    far = [p.name for p in result.parameters if p.beyond(*limits)]
    zeros = all(name.kind == 'theta' for name in far)
    marks = {'auto': result.verdicts, 'table': not problem.of_messages, 'no_wires': not wires}
    marks |= {'images': result.images, 'no_images': not result.images}
    sockets = [each.socket for each in problem.all_sets]
    alone = all(each.socket or each.pixels is not None for each in problem.all_sets)
    marks |= {'no_sockets': not any(sockets), 'no_device': alone}
    marks |= {'no_linear': all(joint.driven.unit == 'rad' for joint in problem.chain.joints)}
    marks |= {'zeros': zeros, 'lengths': not zeros, 'many': poses >= ENOUGH}
    needless = tuple(mark for mark, holds in marks.items() if holds)
    remains = result.comparison.figures[1].rms_mm
    rounded_by = 1e3 * error_by_rounding(problem, result.chain)
    rounding = rounded_by if 2.0 * rounded_by > remains else 0.0
    about = words.drifts(result.noise), len(result.outliers), contradicted, needless, rounding
    return advice(result.refusals, Situation(poses, noise, sigma, *about))
