# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The one path from messages to a calibration, for live topics and for recordings."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from calib_ros import messages
from calib_ros.chain import Chain
from calib_ros.config import Settings
from calib_ros.errors import ConfigError, InputError, TooFewObservationsError
from calib_ros.identification import Identification
from calib_ros.observations import Pairing
from calib_ros.problem import Problem
from calib_ros.se3 import FloatArray
from calib_ros.selection import identify_model

MOST_FRAMES = 10
"""Frames of measurements that are told apart."""


@dataclass(frozen=True)
class Account:
    """What became of the messages: how many came, how many pairs they made, what was dropped."""

    joint_states: int
    poses: int
    pairs: int
    held_out: int
    configurations: int
    dropped: dict[str, int]
    notes: dict[str, int]
    foreign_names: tuple[str, ...]

    def as_document(self) -> dict[str, Any]:
        """Return the account as plain values."""
        return asdict(self)

    def __str__(self) -> str:
        """Return the account in words."""
        text = f'{self.joint_states} joint states and {self.poses} poses gave {self.pairs} pairs'
        if self.held_out:
            text += f' to fit and {self.held_out} held out'
        text += f' in {self.configurations} configurations'
        for label, counts in (('dropped', self.dropped), ('note', self.notes)):
            if counts:
                parts = ', '.join(f'{count} x {cause}' for cause, count in counts.items())
                text += f'; {label}: {parts}'
        if self.foreign_names:
            text += (
                f'; joint states name {", ".join(self.foreign_names)}: if these are the joints of '
                'the chain by other names, set joint_names (--joint-names)'
            )
        return text


class CalibrationSession:
    """Takes messages, keeps the matched pairs, identifies, and keeps the last good result.

    Parameters
    ----------
    chain : Chain
        The nominal chain.
    settings : Settings

    """

    def __init__(self, chain: Chain, settings: Settings | None = None) -> None:
        self.chain = chain
        self.settings = settings or Settings()
        self.joint_names = self.settings.joint_names or chain.joint_names
        count = len(chain.joints)
        if len(self.joint_names) != count or len(set(self.joint_names)) != count:
            raise ConfigError(
                f'joint_names must be {count} different names, one for each of '
                f'{", ".join(chain.joint_names)}; not {", ".join(self.joint_names)}'
            )
        self.recording = True
        self.calibration: Identification | None = None
        """The last result that was accepted."""
        self.clear()

    def clear(self) -> None:
        """Forget all samples and counts; the last good calibration stays."""
        self._pairing = Pairing(
            [joint.type == 'revolute' for joint in self.chain.joints],
            max_gap=self.settings.max_gap,
            joint_capacity=self.settings.joint_buffer,
            pose_capacity=self.settings.pose_buffer,
        )
        self.received: Counter[str] = Counter()
        """Messages that came so far, by stream."""
        self._dropped: Counter[str] = Counter()
        self._notes: Counter[str] = Counter()
        self._newest = {'joints': 0, 'poses': 0}
        self._frame_ids: list[str] = []
        self._names: list[str] | None = None
        self._foreign_names: list[str] = []
        self._index: list[int] = []

    def take_joints(self, message: Any) -> FloatArray | None:
        """Take a JointState; return its values (n,) in the order of the chain if it is usable."""
        self.received['joints'] += 1
        try:
            reading = messages.joint_state(message)
            values = self._ordered(reading)
        except messages.MessageError as err:
            self._dropped[f'joints: {err}'] += 1
            return None
        if self.recording:
            self._watch_order('joints', reading.stamp_ns)
            self._pairing.add_joints(reading.stamp_ns, values)
        else:
            self._dropped['joints: not recording'] += 1
        return values

    def take_pose(self, msgtype: str, message: Any, held_out: bool = False) -> None:
        """Take a measurement of the type named; a held-out one judges and is never fitted."""
        self.received['poses'] += 1
        if not self.recording:
            self._dropped['poses: not recording'] += 1
            return
        try:
            reading = messages.POSE_DECODERS[msgtype](message)
        except messages.MessageError as err:
            self._dropped[f'poses: {err}'] += 1
            return
        self._watch_order('poses', reading.stamp_ns)
        if reading.frame_id not in self._frame_ids and len(self._frame_ids) < MOST_FRAMES:
            self._frame_ids.append(reading.frame_id)
        self._pairing.add_pose(
            reading.stamp_ns, reading.position, reading.quat_xyzw, reading.covariance, held_out
        )

    def account(self) -> Account:
        """Return what became of the messages so far."""
        pairs, held_out, configurations, dropped = self._pairing.tally()
        notes = self._notes.copy()
        notes['joint samples let go after use, the joint buffer was full'] = self._pairing.let_go
        return Account(
            self.received['joints'],
            self.received['poses'],
            pairs,
            held_out,
            configurations,
            dict(sorted((self._dropped + dropped).items())),
            dict(sorted((+notes).items())),
            tuple(self._foreign_names),
        )

    def problem(self) -> Problem:
        """Return a snapshot of the pairs as a problem; later messages do not change it.

        Raises
        ------
        InputError
            Without any pair, or when poses came in different frames.

        """
        if len(self._frame_ids) > 1:
            raise InputError(
                f'poses came in different frames ({", ".join(sorted(self._frame_ids))}), one is '
                'needed: remap or record only the measuring device to use, then clear and '
                'measure again'
            )
        fitted, held_out, _ = self._pairing.match()
        if not len(fitted):
            raise InputError(f'no matched pairs: {self.account()}')
        return Problem(
            self.chain,
            fitted,
            held_out,
            world_frame=self._frame_ids[0],
            **self.settings.for_problem(),
        )

    def identify(self) -> Identification:
        """Identify on the pairs so far and keep the result if it is accepted."""
        problem = self.problem()
        try:
            result = identify_model(problem, self.settings.model)
        except TooFewObservationsError as err:
            raise InputError(f'{err} ({self.account()})') from err
        self.adopt(result)
        return result

    def adopt(self, result: Identification) -> None:
        """Keep a result as the calibration if it is accepted, else the last good one stays."""
        if result.accepted:
            self.calibration = result

    def _ordered(self, reading: messages.JointReading) -> FloatArray:
        """Return the joint values in the order of the chain."""
        if reading.names != self._names:
            index = []
            for name in self.joint_names:
                if name not in reading.names:
                    self._foreign_names = list(reading.names)
                    raise messages.MessageError(f'joint "{name}" not in the message')
                index.append(reading.names.index(name))
            self._names, self._index = list(reading.names), index
        values = reading.values[self._index]
        if not np.isfinite(values).all():
            raise messages.MessageError('NaN or infinite joint value')
        return values

    def _watch_order(self, stream: str, stamp_ns: int) -> None:
        """Note stamps that go backwards; pairing goes by stamps, so nothing is lost by it."""
        if stamp_ns < self._newest[stream]:
            self._notes[f'{stream} with a stamp older than the one before'] += 1
        self._newest[stream] = max(stamp_ns, self._newest[stream])
