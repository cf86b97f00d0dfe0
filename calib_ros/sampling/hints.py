# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hints at what looks wrong in the messages and stops, as text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from calib_ros.estimation.configurations import SCATTER
from calib_ros.estimation.levels import FEW
from calib_ros.sampling.account import Cause, lost
from calib_ros.sampling.live import START
from calib_ros.sampling.slices import JOINTS, NO_ACCIDENT, POSES
from calib_ros.settings import EXCEPTION


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


def restless(needed: float, still: float, above_all: str) -> Hint:
    """Report joints at rest that hardly ever stay within `still`; `needed` is in rad or m.

    Beyond the distance of configurations this is no encoder noise: two arms publish.
    """
    if needed > SCATTER:
        return by_turns(needed)
    return Hint(
        f'joints hardly ever rest within still: set still to {needed:.2g}',
        f'the joints hardly ever rest within still ({still:g}){above_all}, though the arm is at '
        f'rest: their values are noisy; set still to {needed:.2g}, 6 x their noise',
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


def unstopped(stops: int, moving: int) -> list[Hint]:
    """Tell that a motion had hardly any stop, but `moving` measurements."""
    if stops >= FEW or moving < NO_ACCIDENT:
        return []
    words = f'{moving} measurements came in motion, hardly any at a stop: stop at each pose'
    return [Hint(words, f'{words}, or set mode to continuous (--mode continuous)')]


def losses(received: Mapping[str, int], dropped: Mapping[Cause, int]) -> list[Hint]:
    """Report a large share of lost messages, and the main cause."""
    found = []
    for kind in (JOINTS, POSES):
        share, words = lost(kind, received[kind], dropped)
        if share > EXCEPTION and share * received[kind] >= NO_ACCIDENT:
            found.append(Hint(words, words))
    return found
