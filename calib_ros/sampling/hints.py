# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hints at what looks wrong, and the progress of sampling, as text."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calib_ros.errors import InputError
from calib_ros.estimation.configurations import SCATTER, configurations, count_distinct
from calib_ros.estimation.levels import FEW, NEARER
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling.account import Cause, lost
from calib_ros.sampling.dataset import lenses_by_frame
from calib_ros.sampling.live import START, Estimate, barely_moved
from calib_ros.sampling.sample import Sample, named
from calib_ros.sampling.slices import JOINTS, NO_ACCIDENT, POSES
from calib_ros.settings import EXCEPTION, Settings
from calib_ros.shown import counted


class Hint(NamedTuple):
    """One thing that looks wrong, in a few words for the status and in a sentence.

    It may explain losses and stops that seem not to be at rest.
    """

    status: str
    text: str
    explains: bool = True


def unheard(received: Mapping[str, int]) -> list[Hint]:
    """Tell that nothing has come, or only joint states or measurements."""
    if not received or not received[JOINTS]:
        words = 'no joint states received: is the robot on, and its topic in joint_topics?'
        if not received:
            words = 'nothing was received: check joint_topics, sources, their types and QoS'
        return [Hint('', words)]
    if received[POSES] or received[JOINTS] < NO_ACCIDENT:
        return []
    words = 'no measurements received: is the device on, and its topic measured_pose or'
    return [Hint('no measurements received: check sources', f'{words} in sources?')]


def restless(needed: float, still: float) -> Hint:
    """Report joints at rest that hardly ever stay within `still`; `needed` is in rad or m.

    Beyond the distance of configurations this is no encoder noise: two arms publish.
    """
    if needed > SCATTER:
        return by_turns(needed)
    return Hint(
        f'joints hardly ever rest within still: set still to {needed:.2g}',
        f'the joints hardly ever rest within still ({still:g}), though the arm is at rest: their '
        f'values are noisy; set still to {needed:.2g}, 6 x their noise',
    )


def by_turns(size: float) -> Hint:
    """Report joint values that jump back and forth by so much [rad or m]."""
    return Hint(
        'joint values jump back and forth: do two robots publish them?',
        f'the joint values jump back and forth by {size:.2g}: do two robots publish the same '
        'joint names? Give each its own topic, and set joint_topics to the one of this robot',
    )


def sparse(between: int, measurements: int, max_gap: float, shared: int) -> list[Hint]:
    """Report measurements `between` joint states too far apart, if many; some `shared` stamps."""
    if between < NO_ACCIDENT or between <= EXCEPTION * measurements:
        return []
    rate = f'{2.0 / max_gap:g} Hz or more of every joint'
    words = (
        f'{between} of {measurements} measurements lie between joint states further apart than '
        f'max_gap ({max_gap:g} s): {rate} are needed'
    )
    if shared > EXCEPTION * between:
        why = 'joint states share stamps: two publishers, or stamps too coarse?'
        return [Hint(why, f'{words}. {shared} {why}')]
    return [Hint(f'joint states were missing or too rare: {rate} are needed', words)]


def apart(ahead: float) -> Hint:
    """Report clocks too far apart: measurements are `ahead` of the joint states [s]."""
    when, late, instead = 'after', '', ''
    if ahead < 0.0:
        when, late = 'before', ' (if the device sends late, raise lateness)'
        instead = ', or raise lateness'
    words = (
        f'measurements were stamped {abs(ahead):.1f} s {when} the newest joint state{late}: '
        'synchronise the clocks (NTP, PTP) and repeat the poses of that time'
    )
    return Hint(f'stamps disagree by {abs(ahead):.1f} s: synchronise the clocks{instead}', words)


def ended(seconds: float) -> Hint:
    """Report measurements without joint states for some time [s]."""
    words = f'measurements go on for {seconds:.0f} s without joint states'
    return Hint(
        f'{words}: does the driver run?',
        f'{words}: does the driver run, and name the joints as before? Do the clocks agree? Then '
        'repeat these poses',
    )


def unsettled(refused: int, stops: int) -> list[Hint]:
    """Report that many stops are refused because the target still moves."""
    if refused < START or refused <= EXCEPTION * stops:
        return []
    words = (
        f'{refused} of {stops} stops are refused: the target still moves while the joints are at '
        'rest. Stop for longer and set settle to the settling time, turn smoothing in the device '
        'off, and check that the target is firm and the arm does not creep'
    )
    return [Hint(f'{refused} of {stops} stops still move where measured: set settle', words)]


def unmeasured(stops: int, between: int) -> list[Hint]:
    """Report stops in a row without a measurement; `between` are all there are, if any."""
    if stops < FEW:
        return []
    if between:
        words = f'all {between} measurements came between the stops'
        advice = 'synchronise the clocks (NTP, PTP), and stop until the device has measured'
        return [Hint(f'{words}, none at one: do the clocks agree?', f'{words}: {advice}')]
    words = f'no measurements at the last {stops} stops: does the device see the target'
    return [Hint(f'{words}?', f'{words}, and are its frames still named as before?')]


def unstopped(stops: int, moving: int) -> tuple[str, ...]:
    """Tell that a motion had hardly any stop, but `moving` measurements."""
    if stops >= FEW or moving < NO_ACCIDENT:
        return ()
    words = f'{moving} measurements came in motion, hardly any at a stop: stop at each pose'
    return (f'{words}, or set mode to continuous (--mode continuous)',)


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


def losses(received: Mapping[str, int], dropped: Mapping[Cause, int]) -> list[Hint]:
    """Report a large share of lost messages, and the main cause."""
    found = []
    for kind in (JOINTS, POSES):
        share, cause = lost(kind, received[kind], dropped)
        if share > EXCEPTION and share * received[kind] >= NO_ACCIDENT:
            words = f'{100.0 * share:.0f} % of the {kind} were dropped: {cause}'
            found.append(Hint(f'{100.0 * share:.0f} % of the {kind} are dropped: {cause}', words))
    return found


def disagreement(delay: float, known: float) -> Hint:
    """Report that the `delay` [s] in the motion differs from the `known` one."""
    left = delay - known
    words = f'{left:.3f} s later' if left > 0.0 else f'{-left:.3f} s earlier'
    return Hint(
        f'stamps disagree: set delay to {delay:.3f}',
        f'measurements are stamped {words} than joint states of the same time: set delay to '
        f'{delay:.3f}, or synchronise the clocks',
    )


def ambiguous(delays: Sequence[float]) -> Hint:
    """Report that several delays [s] explain a repetitive motion."""
    words = ' or '.join(f'{round(delay, 2) + 0.0:.2f}' for delay in sorted(delays))
    return Hint(
        f'delay not clear, {words} s: move less regularly',
        f'the measurement delay is ambiguous ({words} s) because the motion repeats itself: none '
        'is used. Move less regularly for 15 s, or set delay',
    )


def clocks_moved(steps: Collection[tuple[float, int]]) -> Hint:
    """Report shifts of the clocks [s], and after how many samples."""
    words = ', '.join(f'by {seconds:+.3f} s after about {count}' for seconds, count in steps)
    return Hint(
        f'clocks shifted after about {max(count for _, count in steps)} poses: synchronise them',
        f'measurement stamps shifted against joint stamps {words} poses: synchronise the clocks, '
        'and repeat the later measurements',
    )


def stuck(seconds: float, still: bool) -> Hint:
    """Report that targets moved for some time [s] while joint states stood, as they `still` do."""
    return Hint(
        'the target moves but no joint does: are joint states frozen?' if still else '',
        f'the target moved for {seconds:.0f} s or more while the joint states stood still: does '
        'the driver of the robot send live data? Restart it, and repeat the poses of that time',
        explains=still,
    )


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
    still = {id(each) for each in measured if each.count > 1 and not round(each.spread, 12)}
    if START <= len(still) <= len(measured) - START:  # else a simulation
        repeated |= still
    if len(repeated) < START:
        return None
    where = ', '.join(f'{value:g}' for value in max(places, key=lambda key: len(places[key]))[3:])
    return Hint(
        f'{len(repeated)} poses repeat a position: is the device frozen?',
        f'{len(repeated)} poses repeat a position to the last digit, such as {where} m (does the '
        'device see the target and send live data?): measure again (node: ~/clear first)',
        explains=False,
    )


def progress(
    chain: Chain, fitted: Sequence[FloatArray], estimate: Estimate | None, settings: Settings
) -> list[str]:
    """Return number and expected accuracy of the samples to fit, and joints that hardly moved.

    `fitted` holds the joint values (n,) of each.
    """
    told = counted(len(fitted), 'pose')
    if estimate is not None and estimate.astray(settings.largest_error):
        apart = f'{1e3 * estimate.rms:.0f} mm from where the joints are'
        if not estimate.excess or estimate.rms <= settings.largest_error:
            apart = 'which do not fit this arm'
        told += f', {apart}: check units, clocks, sigmas and chain'
    elif estimate is not None:
        told += f', {1e3 * estimate.sigma:.3f} mm expected, {_forecast(estimate, settings)}'
    still = barely_moved(chain, np.array(fitted)) if fitted else ()
    return [told, f'hardly moved so far: {", ".join(still)}' if still else '']


def _forecast(estimate: Estimate, settings: Settings) -> str:
    wanted = settings.wanted_accuracy
    if estimate.enough(wanted):
        return 'enough for the accuracy wanted'
    if estimate.excess is None:
        return 'too few to predict how many are needed'
    if estimate.excess * NEARER > 1.0:  # not by chance, even with the fewest samples
        advice = 'is the target firm? More'
        if settings.model == 'geometric':
            advice = 'set model to auto, more'
        return f'{advice} will not help: what is left is {estimate.excess:.0f} x noise'
    more = estimate.more_for(wanted)
    if more > settings.pose_buffer:
        return f'{1e3 * wanted:g} mm is out of reach: are units, sigmas and wanted_accuracy right?'
    return f'about {more} more for {1e3 * wanted:g} mm'
