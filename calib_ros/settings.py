# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""All settings besides the chain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeAlias, get_args

from calib_ros.annotated import check_fields
from calib_ros.errors import MOST_ENTRIES, ConfigError

Criterion: TypeAlias = Literal['d', 'o2', 'o3', 'o4', 'o5', 'task']
CRITERIA: tuple[Criterion, ...] = get_args(Criterion)
Objective: TypeAlias = Literal['mean', 'worst']
AIMS: tuple[Objective, ...] = get_args(Objective)
Model: TypeAlias = Literal['corrected', 'nominal']
MODELS: tuple[Model, ...] = get_args(Model)
Mode: TypeAlias = Literal['dwell', 'continuous', 'triggered']
Loss: TypeAlias = Literal['redescending', 'huber', 'none']
STORAGES = ('mcap', 'sqlite3')
EXCEPTION = 0.1
"""Share of a whole that is an exception. So many samples fewer, at random, make standard
deviations 5 % larger, less than their own uncertainty; more may be a part of the workspace."""
LEVER = 0.3  # length [m] at which a turn counts as much as a shift; a convention
LEVER_IN_PART, TURN_IN_PART = 1e-3, 0.02
"""The same of arms that cannot reach every orientation, and the error [rad] that may remain of
theirs; conventions."""
EXACT = 1e-6  # negligible error [m or rad], invisible to any device
GROWTH = 2e-5  # default growth of a length [m] per root of a year
STARTUP = (
    *('max_gap', 'joint_buffer', 'pose_buffer', 'mode', 'lateness', 'delay', 'sources'),
    *('joint_topics', 'joint_names'),
)
"""Settings that a running node cannot change."""


def _setting(default: Any, text: str, lower: float | None = None, upper: float = math.inf) -> Any:
    return field(default=default, metadata={'text': text, 'lower': lower, 'upper': upper})


def effects_of(model: str) -> tuple[str, ...]:
    """Return the effects, or groups of them, that a model names."""
    return () if model in ('geometric', 'auto') else tuple(model.split('+'))


def refuse_larger(name: str, value: float, setting: Mapping[str, Any]) -> None:
    """Refuse a value above the upper limit of a setting: it is perhaps in another unit."""
    if value > setting['upper']:
        most, what = f'{setting["upper"]:.4g}', setting['text']
        raise ConfigError(f'{name} must be at most {most}, not {value:g} ({what})')


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a correction of joint commands."""

    largest_turn: float = _setting(0.1, 'largest correction of a revolute joint [rad]', upper=3.2)
    largest_shift: float = _setting(0.05, 'largest correction of a prismatic joint [m]', upper=1.0)
    largest_position_error: float | None = _setting(
        None,
        'position error that may remain [m]; default: 1e-6 where the joints can move the target, '
        'any in other directions',
        upper=1.0,
    )
    largest_orientation_error: float | None = _setting(
        None,
        f'orientation error that may remain [rad]; default: 1e-6, or {TURN_IN_PART} for arms '
        'that cannot reach every orientation',
        upper=3.2,
    )
    orientation_weight: float | None = _setting(
        None,
        'position error that weighs as much as one radian where both cannot vanish [m/rad]; '
        f'default: {LEVER}, or {LEVER_IN_PART} for arms that cannot reach every orientation',
    )
    largest_change: float = _setting(
        0.5, 'largest change of the correction between successive samples, relative to the move'
    )


@dataclass(frozen=True)
class Settings:
    """All settings besides the chain; the node and the command line use the same names."""

    sigma_position: float = _setting(
        1e-4, 'standard deviation of positions that come without a covariance [m]', 1e-9, 1.0
    )
    sigma_orientation: float = _setting(
        1e-4 / LEVER,
        'standard deviation of orientations that come without a covariance [rad]',
        1e-9,
        3.2,
    )
    sigma_pixel: float = _setting(
        0.3, 'standard deviation of a corner coordinate in an image [px]', 1e-6
    )
    sigma_scale: float = _setting(
        0.0,
        'standard deviation of the scale of the measuring device [1], if checked with a known '
        'length; 0: not checked',
        0.0,
    )
    socket_distance: float = _setting(
        0.05, 'distance between the two sockets of a location [m]', 1e-6, 1.0
    )
    max_gap: float = _setting(
        0.1, 'longest time between the two joint states that bracket a measurement [s]', 1e-6, 60.0
    )
    joint_buffer: int = _setting(
        200_000, 'joint states kept waiting; when full, the older half is dropped', 2
    )
    pose_buffer: int = _setting(50_000, 'measurements kept waiting, and poses kept, per source', 1)
    mode: Mode = _setting(
        'dwell',
        'dwell (one pose per stop of the arm), continuous (one per measurement, moving or not) '
        'or triggered (one per call of ~/capture)',
    )
    still: float = _setting(
        5e-4, 'the arm stands still while no joint moves by more [rad or m]', 0.0, 0.1
    )
    settle: float = _setting(0.1, 'wait after each stop for vibration to die out [s]', 0.0)
    shortest_stop: float = _setting(0.2, 'shorter stops are ignored [s]', 0.0)
    longest_stop: float = _setting(5.0, 'only this much of a longer stop is used [s]', 0.0)
    lateness: float = _setting(
        1.0,
        'how much later measurements may arrive than joint states of the same stamp [s]',
        0.0,
        600.0,
    )
    delay: float = _setting(
        0.0, 'known delay of measurement stamps after joint stamps [s]', -10.0, 10.0
    )
    sources: tuple[str, ...] = _setting(
        (),
        'measurement topics, each as "TOPIC key=value ..."; keys: type, device, target, '
        'eye_in_hand, validation; /tf also parent and child; images also board, info, lens',
    )
    joint_topics: tuple[str, ...] = _setting((), 'joint state topics')
    wanted_accuracy: float = _setting(
        1e-4, 'wanted standard deviation of predicted positions [m]; 1e-4: 0.1 mm', 1e-9, 0.05
    )
    frame_id: str = _setting('', 'required frame of the measurements; default: any')
    folds: int = _setting(5, 'number of cross-validation folds', 2)
    largest_length: float = _setting(
        0.05, 'a larger change of a length is not accepted: wrong robot? [m]', 1e-9, 1.0
    )
    largest_angle: float = _setting(
        0.1, 'a larger change of an angle is not accepted: wrong robot? [rad]', 1e-9, 3.2
    )
    largest_error: float = _setting(
        0.01, 'a larger RMS error on held-out poses is not accepted: wrong robot? [m]', 1e-9, 1.0
    )
    loss: Loss = _setting('redescending', 'treatment of gross errors: redescending, huber or none')
    priors: tuple[str, ...] = _setting(
        (), 'standard deviations about nominal as NAME=SIGMA [m, rad], for example *.a=0.001'
    )
    model: str = _setting(
        'geometric',
        'errors to fit: geometric; auto (adds the non-geometric effects that reduce the held-out '
        'error); or effect groups joined by +, for example ratio+eccentricity',
    )
    joint_names: tuple[str, ...] = _setting(
        (), 'names of the joints in JointState, in chain order; default: as in the chain'
    )
    fixed: tuple[str, ...] = _setting(
        (), 'parameters held at their nominal values, for example joint_2.a or *.alpha'
    )

    @property
    def sigmas(self) -> tuple[float, float]:
        """Return the standard deviations of positions [m] and orientations [rad]."""
        return self.sigma_position, self.sigma_orientation

    @property
    def given_sigma(self) -> float | None:
        """Return the standard deviation of positions [m], None at its default."""
        return None if self.sigma_position == Settings.sigma_position else self.sigma_position

    def for_problem(self) -> dict[str, Any]:
        """Return the settings of an identification, by the names of `Problem`."""
        from calib_ros.values import parse_number  # loads numpy, not needed by --help

        priors = {}
        for text in self.priors:
            name, _, sigma = text.partition('=')
            priors[name] = parse_number(sigma, f'the SIGMA of prior "{text}" (NAME=SIGMA)')
        names = ['sigma_position', 'sigma_orientation', 'sigma_pixel', 'sigma_scale']
        names += ['fixed', 'folds']
        names += ['largest_length', 'largest_angle', 'largest_error', 'loss']
        chosen = {name: getattr(self, name) for name in names}
        return chosen | {'priors': priors, 'effects': effects_of(self.model)}

    def __post_init__(self) -> None:
        check_fields(self)
        for item in fields(self):
            value, lower = getattr(self, item.name), item.metadata['lower']
            if isinstance(item.default, tuple):  # longer lists would take very long
                longest = max(map(len, value), default=0)
                for count, what in ((len(value), 'entries'), (longest, 'characters in an entry')):
                    if count > MOST_ENTRIES:
                        raise ConfigError(
                            f'{item.name} has {count} {what}; the limit is {MOST_ENTRIES}'
                        )
            if lower is not None and not math.isfinite(value):
                raise ConfigError(f'{item.name} must be a finite number, not {value}')
            if lower is not None and value < lower:
                raise ConfigError(f'{item.name} must be at least {lower}, not {value}')
            if lower is not None:
                refuse_larger(item.name, value, item.metadata)
        for name in ('shortest_stop', 'settle'):
            value = getattr(self, name)
            if value >= self.longest_stop:
                raise ConfigError(
                    f'{name} ({value:g} s) must be shorter than longest_stop '
                    f'({self.longest_stop:g} s), or no stop is ever sampled'
                )
