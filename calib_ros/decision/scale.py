# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A device out of scale: whether it may do harm, and in words."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import special

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.estimation.levels import CERTAIN, LARGEST_SCALE, SCALE
from calib_ros.estimation.problem import Problem
from calib_ros.settings import EXCEPTION


def scale_reasons(problem: Problem, result: Identification) -> Iterator[Reason]:
    """Yield that a device out of scale does harm or is too likely to, if nothing else refuses.

    One in ten is too likely (benchmarks/scale.py). Also if its scale was checked, but almost
    certainly is not what `sigma_scale` states.
    """
    region, found = result.region, result.posterior
    if result.refusals or region is None:
        return
    certain = problem.sigma_scale and found.rival and special.expit(found.rival[0]) > CERTAIN
    if region.by_scale >= EXCEPTION or certain:
        length = stated_length(problem)
        text = out_of_scale(found.scale, length, strain=found.strain)
        if problem.sigma_scale:
            again = f'measure {f"the {length}" if length else "a known length"} again'
            text = f'{_grown(found.scale, found.strain)}, more than sigma_scale allows: {again}'
        yield Reason.with_remedy(Rule.SCALE, result.strain or text)


def stated_length(problem: Problem) -> str:
    """Return the stated length that gives the scale, empty if the device does."""
    if all(each.pixels is not None for each in problem.sets):
        return 'size of the board'
    touched = all(each.socket or each.plane for each in problem.sets)
    return 'distance of the sockets' * touched


def out_of_scale(scale: float, length: str = '', stated: float = 0.0, strain: float = 0.0) -> str:
    """Return that a scale of the device, given minus one, may make the calibrated arm worse.

    It may be that of a stated `length`, and `stated` to be known to that.
    Linear joints imitate a `strain`, by which it differs with the direction.
    """
    grown, size = _grown(scale, strain), 'large' if scale > 0.0 else 'small'
    steel, way = 1e5 * abs(scale), 'warmer' if scale > 0.0 else 'colder'  # 10 ppm a degree
    warmth = f', or the arm {steel / 2.3:.0f} to {steel:.0f} degrees {way}'  # aluminium: 23 ppm
    warmth *= abs(scale) <= LARGEST_SCALE
    text = f'{grown}, as if the measuring device were out of scale{warmth}; then'
    check, what, usual = 'If a known length shows that its scale', 'scale of the device', SCALE
    if length:
        check, what, usual = f'Measure the {length}; if it', length, LARGEST_SCALE
        text = f'{grown}, as if the {length} were stated too {size}; then'
    if abs(scale) < usual or stated:  # as devices have, or arms
        text = f'the {what} is not known well enough:'
    if strain > abs(scale):
        text = f'{grown}, by the linear joints or by the measuring device; if by the device,'
    harm = f'{text} the correction may make the arm worse'
    if stated:
        return (
            f'{harm}, at sigma_scale {percent(stated)} %: measure poses all over the workspace, '
            'or the scale more accurately'
        )
    if strain > abs(scale):
        return (
            f'{harm}. Check its scale along each linear joint with a known length: if it is '
            'right, set sigma_scale (--sigma-scale) to its accuracy, and fit the scale of the '
            'joints (model auto)'
        )
    return f'{harm}. {check} is right, set sigma_scale (--sigma-scale) to its accuracy'


def _grown(scale: float, strain: float) -> str:
    """Return by how much lengths are off, in one direction more than in another or alike."""
    if strain > abs(scale):
        return f'lengths come out {percent(strain)} % longer in one direction than in another'
    way = 'grow' if scale > 0.0 else 'shrink'
    return f'all lengths of the arm {way} alike, by {percent(abs(scale))} %'


def percent(share: float) -> str:
    """Return a small share in percent, with two digits."""
    return np.format_float_positional(100.0 * share, 2, fractional=False, trim='-')
