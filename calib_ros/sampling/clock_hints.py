# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hints at clocks and delays that look wrong."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from calib_ros.sampling.hints import Hint


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
