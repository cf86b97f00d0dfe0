# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Everything that can be set besides the chain."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeAlias, get_args

from calib_ros.errors import MOST_ENTRIES, ConfigError, UnknownNameError

Criterion: TypeAlias = Literal['d', 'o2', 'o3', 'o4', 'o5', 'task']
CRITERIA: tuple[Criterion, ...] = get_args(Criterion)
"""By which poses are chosen."""
Aim: TypeAlias = Literal['mean', 'worst']
AIMS: tuple[Aim, ...] = get_args(Aim)
"""What a placement is to make small."""
Model: TypeAlias = Literal['corrected', 'nominal']
MODELS: tuple[Model, ...] = get_args(Model)
"""By which an arm is commanded."""
STORAGES = ('mcap', 'sqlite3')
"""Of bags."""
EXCEPTION = 0.1
"""Share of a whole up to which it is the exception. So many samples fewer, at random, make
standard deviations 5 % larger, less than their own uncertainty; more may be a part of the
workspace."""
LEVER = 0.3
"""Length [m] at which a turn counts as much as a shift; a convention."""
LEVER_IN_PART, TURN_IN_PART = 1e-3, 0.02
"""The same of arms that cannot reach every orientation, and the error [rad] that may remain of
theirs; conventions."""
EXACT = 1e-6
"""Error [m or rad] that may remain of what is reached exactly: no device sees it."""
GROWTH = 2e-5
"""Growth of a length [m] per root of a year, if nothing else is said."""
MODES = ('dwell', 'continuous', 'triggered')
"""How samples are taken."""
STARTUP = (
    *('max_gap', 'joint_buffer', 'pose_buffer', 'mode', 'lateness', 'delay', 'sources'),
    *('joint_topics', 'joint_names'),
)
"""Settings that a running node cannot change."""


def _setting(default: Any, text: str, lower: float | None = None) -> Any:
    """Declare a setting with what a node parameter and a command line option need to know."""
    return field(default=default, metadata={'text': text, 'lower': lower})


@dataclass(frozen=True, kw_only=True)
class Limits:
    """How far a correction of joint commands may go."""

    largest_turn: float = _setting(0.1, 'largest correction of a revolute joint [rad]')
    largest_shift: float = _setting(0.05, 'largest correction of a prismatic joint [m]')
    largest_position_error: float | None = _setting(
        None,
        'position error that may remain [m]; if not given 1e-6 in the directions in which the '
        'joints can move the target, and any in others',
    )
    largest_orientation_error: float | None = _setting(
        None,
        f'orientation error that may remain [rad]; if not given 1e-6, or {TURN_IN_PART} for arms '
        'that cannot reach every orientation',
    )
    orientation_weight: float | None = _setting(
        None,
        'position error that counts as much as one radian, where both cannot vanish [m/rad]; if '
        f'not given {LEVER}, or {LEVER_IN_PART} for arms that cannot reach every orientation',
    )
    largest_change: float = _setting(
        0.5, 'largest change of the correction between successive samples, relative to the move'
    )


@dataclass(frozen=True)
class Settings:
    """Everything that can be set besides the chain; same names in the node and the CLI."""

    sigma_position: float = _setting(
        1e-4, 'standard deviation of a measured position without its own covariance [m]', 1e-9
    )
    sigma_orientation: float = _setting(
        1e-4 / LEVER,
        'standard deviation of a measured orientation without its own covariance [rad]',
        1e-9,
    )
    sigma_pixel: float = _setting(
        0.3, 'standard deviation of a coordinate of a corner in an image [px]', 1e-6
    )
    sigma_scale: float = _setting(
        0.0,
        'standard deviation of the scale of the measuring device [1], if it was checked with a '
        'known length; 0: it was not',
        0.0,
    )
    socket_distance: float = _setting(0.05, 'between the two sockets of a location [m]', 1e-6)
    max_gap: float = _setting(
        0.1, 'longest time between the two joint states that bracket a measurement [s]', 0.0
    )
    joint_buffer: int = _setting(
        200_000, 'joint states that may wait; the older half is let go when it is full', 2
    )
    pose_buffer: int = _setting(
        50_000, 'measurements that may wait, and poses kept, of each source', 1
    )
    mode: str = _setting(
        'dwell',
        'dwell (each stop of the arm becomes a pose), continuous (each measurement does, moving '
        'or not) or triggered (one by each call of ~/capture)',
    )
    still: float = _setting(
        5e-4, 'the arm stands while no joint leaves its value by more [rad or m]', 0.0
    )
    settle: float = _setting(
        0.1, 'time after a stop in which it is not measured yet: vibration [s]', 0.0
    )
    shortest_stop: float = _setting(0.2, 'a shorter stop is no pose [s]', 0.0)
    longest_stop: float = _setting(5.0, 'of a longer stop only the beginning is used [s]', 0.0)
    lateness: float = _setting(
        1.0, 'how much later than joint states of the same stamp measurements may come [s]', 0.0
    )
    delay: float = _setting(
        0.0,
        'how much later than those of the joints the stamps of measurements are known to be [s]',
        -10.0,
    )
    sources: tuple[str, ...] = _setting(
        (),
        'topics of measurements, each as "TOPIC key=value ..." with the keys type, device, '
        'target, eye_in_hand, validation; of /tf with parent and child; of images with board, '
        'info, lens',
    )
    joint_topics: tuple[str, ...] = _setting((), 'topics of joint states')
    wanted_accuracy: float = _setting(
        1e-4, 'standard deviation of predicted positions that is enough [m]', 1e-9
    )
    frame_id: str = _setting('', 'frame that measurements must be in; default: any one')
    folds: int = _setting(5, 'parts of the cross-validation', 2)
    largest_length: float = _setting(
        0.05, 'a corrected length further from nominal is not accepted: wrong robot? [m]', 0.0
    )
    largest_angle: float = _setting(
        0.1, 'a corrected angle further from nominal is not accepted: wrong robot? [rad]', 0.0
    )
    largest_error: float = _setting(
        0.01, 'a larger RMS error on held-out poses is not accepted: wrong robot? [m]', 0.0
    )
    loss: str = _setting(
        'redescending', 'how gross errors are kept from the fit: redescending, huber or none'
    )
    priors: tuple[str, ...] = _setting(
        (), 'standard deviations about nominal as NAME=SIGMA [m, rad], for example *.a=0.001'
    )
    model: str = _setting(
        'geometric',
        'errors to fit: geometric; auto (adds the non-geometric effects that pay for themselves); '
        'or groups of effects joined by +, for example ratio+eccentricity',
    )
    joint_names: tuple[str, ...] = _setting(
        (), "names of the chain's joints in JointState, in its order; default: those of the chain"
    )
    fixed: tuple[str, ...] = _setting(
        (), 'parameters held at their nominal values, for example joint_2.a or *.alpha'
    )

    def for_problem(self) -> dict[str, Any]:
        """Return what an identification needs to know, by the names of `Problem`."""
        from calib_ros.values import parse_number  # loads numpy, which no `--help` needs

        priors = {}
        for text in self.priors:
            name, _, sigma = text.partition('=')
            priors[name] = parse_number(sigma, f'the SIGMA of prior "{text}" (NAME=SIGMA)')
        names = ['sigma_position', 'sigma_orientation', 'sigma_pixel', 'sigma_scale']
        names += ['fixed', 'folds']
        names += ['largest_length', 'largest_angle', 'largest_error', 'loss']
        named = () if self.model in ('geometric', 'auto') else tuple(self.model.split('+'))
        chosen = {name: getattr(self, name) for name in names}
        return chosen | {'priors': priors, 'effects': named}

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        if self.mode not in MODES:
            raise UnknownNameError('mode', self.mode, MODES)
        for item in fields(self):
            value, lower = getattr(self, item.name), item.metadata['lower']
            if isinstance(item.default, tuple):  # what is done with longer lists takes for ever
                longest = max(map(len, value), default=0)
                for count, what in ((len(value), 'entries'), (longest, 'characters in an entry')):
                    if count > MOST_ENTRIES:
                        raise ConfigError(
                            f'{item.name} has {count} {what}, at most {MOST_ENTRIES} are taken'
                        )
            if lower is not None and not math.isfinite(value):
                raise ConfigError(f'{item.name} must be a finite number, not {value}')
            if lower is not None and value < lower:
                raise ConfigError(f'{item.name} must be at least {lower}, not {value}')
        for name in ('shortest_stop', 'settle'):
            value = getattr(self, name)
            if value >= self.longest_stop:
                raise ConfigError(
                    f'{name} ({value:g} s) must be shorter than longest_stop '
                    f'({self.longest_stop:g} s): else no stop is ever sampled'
                )
