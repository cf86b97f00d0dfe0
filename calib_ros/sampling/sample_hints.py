# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hints at samples that look wrong: of a changed lens, of two places, of a frozen device."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.errors import InputError
from calib_ros.estimation.configurations import configurations, count_distinct
from calib_ros.sampling.dataset import lenses_by_frame
from calib_ros.sampling.hints import Hint
from calib_ros.sampling.live import START
from calib_ros.sampling.sample import Sample, named
from calib_ros.settings import EXCEPTION, Settings


def unseen(images: int, samples: Sequence[Sample], reason: str) -> list[Hint]:
    """Report that the images of many stops are not used, and why the last of them is not."""
    stops = images + sum(each.view is not None for each in samples)
    if not reason or images <= EXCEPTION * stops:
        return []
    words = f'at {images} of {stops} stops the images are not used, the last: {reason}'
    return [Hint('', words, explains=False)]


def spoilt(samples: Sequence[Sample], known: Sequence[Hint]) -> list[Hint]:
    """Report samples of a lens that changed, or of two places.

    If a `known` hint explains motion at stops, that may be their scatter.
    """
    moved = any(hint.explains for hint in known)
    return [*_refocused(samples), *([] if moved else _scattered(samples))]


def _refocused(samples: Sequence[Sample]) -> list[Hint]:
    """Report a lens that changed between samples: no calibration may have several."""
    seen = {
        (each.view.lens, each.session, each.device, each.target, each.eye_in_hand): each
        for each in samples
        if each.view is not None
    }.values()  # one of each, whatever their number
    try:
        lenses_by_frame(seen, named(seen))
    except InputError as err:
        return [Hint(str(err), str(err), explains=False)]
    return []


def _scattered(samples: Sequence[Sample]) -> list[Hint]:
    """Report stops whose measurements scatter by more than any arm is off: of two places.

    Noise of positions in mm is small beside these.
    """
    far = [
        each.spread
        for each in samples
        if each.spread > Settings.largest_error
        and each.position is not None
        and each.spread > 1e-3 * np.abs(each.position).max()
    ]
    return of_two_places(far, EXCEPTION * len(samples))


def of_two_places(spreads: Sequence[float], usual: float) -> list[Hint]:
    """Report stops in two places, if more than is usual, with their spreads [m]."""
    if len(spreads) < START or len(spreads) <= usual:
        return []
    size = float(f'{1e3 * np.median(spreads):.2g}')
    words = f'measurements at {len(spreads)} stops scatter by {size:g} mm'
    words += ': do two devices or targets publish on a topic?'
    remedy = 'Give each its own source, and measure again (node: ~/clear first)'
    return [Hint(words, f'{words} {remedy}')]


def frozen(samples: Sequence[Sample]) -> Hint | None:
    """Report a device that repeats positions, to the nanometre, wherever the arm is.

    A device that repeats its last position without a target shows no scatter at these stops.
    """
    measured = [each for each in samples if each.position is not None and not each.socket]
    places: dict[tuple[object, ...], list[Sample]] = {}
    for each in measured:
        assert each.position is not None
        key = (each.session, each.device, each.target, *each.position.round(9).tolist())
        places.setdefault(key, []).append(each)
    repeated = {
        id(each)
        for some in places.values()
        if some[1:]
        and count_distinct(configurations(np.array([each.joints for each in some]))) > 1
        for each in some
    }
    several = [each for each in measured if each.count > 1]
    still = {id(each) for each in several if not round(each.spread, 12) and _fine(each)}
    if START <= len(still) <= len(several) - START:  # else a simulation
        repeated |= still
    if len(repeated) < START:
        return None
    where = ', '.join(f'{value:g}' for value in max(places, key=lambda key: len(places[key]))[3:])
    return Hint(
        f'{len(repeated)} poses repeat a position: is the device frozen?',
        f'{len(repeated)} poses repeat a position to the last digit, such as {where} m (does the '
        'device see the target and send live data?): measure again (node: ~/clear first)',
    )


def _fine(each: Sample) -> bool:
    """Tell whether a position has digits beyond 10 um: else noise may not show."""
    assert each.position is not None
    return bool((each.position.round(9) != each.position.round(5)).any())
