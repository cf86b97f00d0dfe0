# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples: measurements at one stop of the arm, or at one moment of its motion.

Samples come from the live node, the journal, or the rows of a table. `sets.py` makes observations
of them, `dataset.py` problems.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from calib_ros.errors import ConfigError, InputError
from calib_ros.identification.records import Owner
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown


@dataclass(frozen=True, eq=False)
class View:
    """Corners of a board in an image: points (K, 3) [m] of its frame at pixels (K, 2)."""

    points: FloatArray
    pixels: FloatArray
    lens: Lens


class Flaw(NamedTuple):
    """Why an image is not used: its kind, and what was found in it."""

    cause: str
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class Sample(Shown):
    """One measurement with its joint values (n,) [rad or m].

    Each session and device has its own base frame, each session and target its own tool frame.
    """

    stamp_ns: int
    joints: FloatArray
    approach: FloatArray | None = None  # (n,) signs of the joints' last moves
    position: FloatArray | None = None  # (3,) of the target in the frame of the device [m]
    rotation: FloatArray | None = None  # (3, 3) of the target in the frame of the device
    distance: float | None = None  # from the origin of the device [m], without a position
    covariance: FloatArray | None = None  # (6, 6) of x, y, z [m] and about the device's axes [rad]
    view: View | None = None  # corners of a board; the pose is that of this image alone
    images: tuple[int, ...] = ()  # numbers of the images of a stop, one to be processed
    velocity: FloatArray | None = None  # (n,) of the joints, if the arm was moving
    acceleration: FloatArray | None = None
    session: str = ''
    device: str = ''
    target: str = ''
    frame_id: str = ''  # of the measurement, from its message
    socket: bool = False  # a ball in a socket at an unknown place
    plane: bool = False  # the target touched a plane, the device; the distance is the height
    eye_in_hand: bool = False  # a camera on the flange measured a fixed target
    validation: bool = False  # judges, never fitted
    delay: float = 0.0  # time before the stamp at which the joints had these values [s]
    count: int = 1  # measurements averaged
    spread: float = 0.0  # RMS of one coordinate about the mean [m]


class Frames:
    """Names of the frames of samples.

    The first session, device and target get the frames `base` and `tool`; others append their
    names. `owners` are those of existing frames.
    """

    def __init__(self, owners: Mapping[str, Owner] | None = None) -> None:
        self._sessions: list[str] = []
        self._ends: dict[tuple[str, str], list[tuple[bool, str]]] = {}
        self.owners = dict(owners or {})  # session, device or target of each frame
        for name, (session, eye, socket, label) in self.owners.items():
            if session not in self._sessions:
                self._sessions.append(session)
            if not socket:
                self._end(name.partition('_')[0], session, (eye, label))

    def of(self, sample: Sample) -> tuple[str, str]:
        """Return the names of base and tool of a sample.

        A camera on the flange is the tool, and its target the world.
        """
        eye = sample.eye_in_hand
        base, tool = (sample.target, sample.device) if eye else (sample.device, sample.target)
        if sample.session not in self._sessions:
            self._sessions.append(sample.session)
        first = sample.session == self._sessions[0]
        suffix = '' if first else f'_{plain(sample.session)}'
        if sample.socket or sample.plane:  # none of them is the first
            place = (sample.session, False, True, base)
            end = self._end('tool', sample.session, (False, tool)) if sample.plane else ''
            return self._own(f'base{suffix}_{plain(base)}', place), f'tool{suffix}{end}'
        start = self._end('base', sample.session, (eye, base))
        end = self._end('tool', sample.session, (eye, tool))
        return (
            self._own(f'base{suffix}{start}', (sample.session, eye, False, base)),
            self._own(f'tool{suffix}{end}', (sample.session, eye, False, tool)),
        )

    def _own(self, name: str, owner: Owner) -> str:
        while self.owners.setdefault(name, owner) != owner:
            name += '_'
        return name

    def _end(self, side: str, session: str, label: tuple[bool, str]) -> str:
        known = self._ends.setdefault((side, session), [])
        if label not in known:
            known.append(label)
        number = known.index(label)
        return f'_{plain(label[1]) or number + 1}' if number else ''


def named(samples: Iterable[Sample]) -> Frames:
    """Return the frame names of samples, in order."""
    frames = Frames()
    for sample in samples:
        frames.of(sample)
    return frames


def socket_place(label: str) -> str:
    """Return the device name of a socket LOCATION/SOCKET."""
    location, slash, socket = label.rpartition('/')
    names = location, socket
    if not (slash and all(names)) or '_' in socket or '/' in location or not label.isprintable():
        raise ConfigError(f'socket must be LOCATION/SOCKET (A/1), SOCKET without _, not "{label}"')
    return f'{location}_{socket}'


def socket_pairs(samples: Iterable[Sample], frames: Frames) -> list[tuple[str, str]]:
    """Return the base frames of the two sockets of each location; refuse more."""
    ends: dict[tuple[str, str], dict[str, str]] = {}
    for sample in samples:
        if sample.socket:
            location, _, socket = sample.device.rpartition('_')
            ends.setdefault((sample.session, location), {})[frames.of(sample)[0]] = socket
    for (_, location), found in ends.items():
        if len(found) > 2:
            raise InputError(
                f'location {location} has the sockets {", ".join(found.values())}: the distance '
                'known is that of two (give the others a location of their own)'
            )
    return [(one, other) for one, other in (each for each in ends.values() if len(each) == 2)]


def plain(name: str) -> str:
    """Return a name as part of a frame name, which has no dots."""
    return name.replace('.', '-')
