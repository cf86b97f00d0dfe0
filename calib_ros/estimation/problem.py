# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The input of an identification."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from calib_ros.annotated import Fraction, Limit, Positive, Several, check_fields
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.estimation.configurations import SCATTER
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.pixels import samples_of
from calib_ros.estimation.system import Prior, System
from calib_ros.estimation.visits import numbered
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.lens import require_lens
from calib_ros.kinematics.parameter import DELAY, LENS_KINDS, Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.settings import Loss, Settings
from calib_ros.shown import Shown

NOISE_FIELDS = ('sigma_position', 'sigma_orientation', 'sigma_pixel', 'sigma_touch')
TOOL = 1.0  # largest length [m] of a target on a flange, assumed


@dataclass(frozen=True)
class Learned:
    """Sizes of errors [m, rad] by parameter, and of the noise [sigma given], from a first fit."""

    priors: Mapping[str, float]
    noise: float = 1.0


@dataclass(frozen=True, eq=False, repr=False)
class Problem(Shown):
    """The input of an identification."""

    chain: Chain
    """The nominal chain. Frames that it does not fix are fitted."""
    observations: Observations
    """Pairs to fit."""
    held_out: Observations | Sequence[Observations] | None = None
    """Pairs that judge the result and are never fitted. Without them it is judged by
    cross-validation over whole configurations."""
    sigma_position: Positive = Settings.sigma_position
    sigma_orientation: Positive = Settings.sigma_orientation
    """Standard deviations [m, rad] of measurements without a covariance. Their ratio weights
    position against orientation; the size of the noise is estimated."""
    fixed: Sequence[str] = ()
    """Parameters to hold at their nominal values; `*` and `?` match as in file names."""
    folds: Several = Settings.folds
    """Number of cross-validation folds."""
    largest_length: Limit = Settings.largest_length
    largest_angle: Limit = Settings.largest_angle
    """Largest accepted offsets [m, rad], beyond any fault of the right robot."""
    largest_error: Limit = Settings.largest_error
    """Largest accepted RMS position error [m] on held-out poses."""
    loss: Loss = Settings.loss
    """Treatment of gross errors (`robust.py`): redescending, huber or none."""
    priors: Mapping[str, Positive] = field(default_factory=dict)
    """Standard deviations [m, rad] of parameters about their nominal values, by name or pattern
    such as `*.a`; the first match applies."""
    effects: Sequence[str] = ()
    """Non-geometric effects to fit, by name or by group (`effects.py`)."""
    more: Sequence[Observations] = ()
    """Further sets in the same fit: other sessions or targets with their own frames, other kinds
    of measurement."""
    world_frame: str = ''
    """Frame of the measured poses, for the record."""
    separations: Sequence[tuple[str, str, Positive]] = ()
    """Pairs of base frames whose origins are a known distance [m] apart: sockets of a ball on the
    flange. Their worlds are parallel to the arm's base."""
    learned: Learned | None = None
    """Priors estimated from the data, for parameters without one (`evidence.py`)."""
    sigma_pixel: Positive = Settings.sigma_pixel
    sigma_touch: Positive = Settings.sigma_position
    """Standard deviations [px] of image coordinates of a board point, and [m] of heights over a
    plane."""
    sigma_scale: Fraction = 0.0
    """Standard deviation of the scale of the measuring device [1], if checked with a known
    length; otherwise 0."""
    of_messages: bool = False
    """True if the samples were messages, to which table options do not apply."""

    def __post_init__(self) -> None:
        check_fields(self)
        self._check_sets()
        if not self.free:
            raise ConfigError('every parameter is fixed: nothing is left to identify')
        self._check_patterns()
        self._check_effects()

    def _check_sets(self) -> None:
        joints = len(self.chain.joints)
        for observations in self.all_sets:
            if observations.joints.shape[1:] != (joints,):
                raise InputError(
                    f'observations have {observations.joints.shape[1:]} joint values, chain '
                    f'"{self.chain.name}" has {joints} joints'
                )
            self._check_held(observations)
            if observations.distances is not None:
                self._check_distances(observations.distances, observations.joints)
            if observations.pixels is not None:
                require_lens(self.model.frame(observations.camera).lens, observations.camera)
        sockets = {each.base for each in self.sets if each.socket}
        for *pair, _ in self.separations:
            for base in pair:
                if base not in sockets:
                    raise UnknownNameError('socket that is a known distance away', base, sockets)

    def _check_held(self, observations: Observations) -> None:
        """Refuse values of joints that cannot move: equal limits may be none at all."""
        free = effects.coupled(self.chain)
        for k, value in self.chain.held.items():
            name, joint = self.chain.joint_names[k], observations.joints[:, k]
            if k not in free and (np.abs(joint - value) > SCATTER).any():
                raise InputError(
                    f'{name} was at {joint.min():.4g} to {joint.max():.4g}, but both its limits '
                    f'are {value:.4g} in the chain file, and no coupling moves it'
                )

    def _check_distances(self, distances: FloatArray, joints: FloatArray) -> None:
        """Refuse distances that vary by more than the flange can move, and turns of many joints.

        By their quartiles: some may be gross errors, or of an endless axis.
        """
        beyond = self.beyond_reach(distances[:, np.newaxis])
        doubts = [f'the distances {beyond}: are they in metres (--length)?'] if beyond else []
        turns = np.abs(joints[:, [joint.type != 'prismatic' for joint in self.chain.joints]])
        if turns.size and np.median(np.percentile(turns, 75.0, axis=0)) > 2.0 * np.pi:
            doubts.append(
                'many joint values are beyond a whole turn: are they in degrees '
                '(--joint-angle deg)?'
            )
        if doubts:
            raise InputError(' Also, '.join(doubts))

    def beyond_reach(self, values: FloatArray) -> str:
        """Return that most values (N, K) [m] vary by more than the flange can move, or nothing."""
        reach = sum(joint.apart + abs(joint.d) for joint in self.chain.joints)
        for joint in self.chain.joints:
            if joint.type == 'prismatic':
                ends = joint.lower, joint.upper
                reach += max(np.inf if end is None else abs(end) for end in ends)
        spread = (
            np.ptp(np.percentile(values, (25.0, 75.0), axis=0), axis=0).max()
            if len(values)
            else 0.0
        )
        return bool(spread > 2.0 * (reach + TOOL)) * (
            f'vary by {spread:,.4g} m, more than an arm of {reach:.3g} m can cause'
        )

    def _check_patterns(self) -> None:
        for pattern in (*self.fixed, *self.priors):
            own = fnmatch.filter(self.model.all_parameters, pattern)
            if not own:  # b only of some arms
                raise UnknownNameError('parameter', pattern, self.model.parameter_names)
            of_frames = [self.model.owns_frame(n) and not Parameter(n).of_lens for n in own]
            # priors in a wider pattern pass frames by
            if all(of_frames) or (pattern in self.fixed and any(of_frames)):
                raise ConfigError(
                    'a frame is known or unknown as a whole, without a prior, and its delay is '
                    'always fitted: if it is known, give it in the chain file with "fixed: true" '
                    f'instead of "{pattern}"'
                )

    def _check_effects(self) -> None:
        for name in self.effects:
            groups = {effects.group_of(each) for each in effects.resolve(self.chain, name)}
            if not groups:
                raise ConfigError(
                    f'this chain has nothing to fit in "{name}" (gear needs the gear_ratio of '
                    'joints in the chain file)'
                )
            if 'compliance' in groups and not any(joint.mass for joint in self.chain.joints):
                raise ConfigError('compliance needs the masses of the links in the chain file')
            if 'backlash' in groups and all(each.approach is None for each in self.sets):
                raise ConfigError('backlash needs the signs of the last moves (s1 ... sn)')

    @cached_property
    def sets(self) -> tuple[Observations, ...]:
        """Return all sets to fit."""
        return (self.observations, *self.more)

    def with_sets(self, sets: Iterable[Observations], **changes: Any) -> Problem:
        """Return the problem with other sets to fit, and other changed fields."""
        first, *more = sets
        return replace(self, observations=first, more=more, **changes)

    @cached_property
    def judging(self) -> tuple[Observations, ...]:
        """Return the held-out sets that are not empty."""
        held_out = self.held_out or ()
        sets = (held_out,) if isinstance(held_out, Observations) else held_out
        return tuple(each for each in sets if len(each))

    @property
    def all_sets(self) -> tuple[Observations, ...]:
        """Return the sets to fit, then the held-out ones."""
        return (*self.sets, *self.judging)

    @cached_property
    def configurations(self) -> tuple[Index, ...]:
        """Return the configuration numbers (N,) of each set to fit, counted over all sets."""
        return numbered(self.sets)

    @cached_property
    def model(self) -> Chain:
        """Return the nominal chain with all frames and effects to fit."""
        chain = self.chain
        added = {n for each in self.sets for n in (each.base, each.tool)} - set(chain.frame_names)
        if added:  # else it keeps what it knows of itself
            new = ((name, None) for name in sorted(added))
            chain = replace(chain, frames=(*chain.frames, *new))
        for each in self.sets:
            device = chain.frame(each.base)
            if each.moving and device.delay is None:
                start = 0.0 if each.delay is None else float(np.median(each.delay))
                chain = chain.with_frame(each.base, replace(device, delay=start))
        wanted = [each for name in self.effects for each in effects.resolve(chain, name)]
        return chain.with_effects(wanted)

    @property
    def sigmas(self) -> dict[str, float]:
        """Return the sigmas of the measurements [m, rad, px, m] by name."""
        return {name: getattr(self, name) for name in NOISE_FIELDS}

    @cached_property
    def prior_sigmas(self) -> Mapping[str, float]:
        """Return the standard deviations [m, rad] of all priors.

        Frames have none; effects always have one.
        """
        sigmas = {**(self.learned.priors if self.learned else {}), **self.given}
        for name, _ in self.model.effects:
            sigmas.setdefault(name, effects.expected(name))
        return sigmas

    @cached_property
    def given(self) -> Mapping[str, float]:
        """Return the standard deviations [m, rad] of the given priors by name."""
        sigmas: dict[str, float] = {}
        for name in self.free:
            fits = [x for pattern, x in self.priors.items() if fnmatch.fnmatchcase(name, pattern)]
            if fits and (name.of_lens or not self.model.owns_frame(name)):
                sigmas[name] = fits[0]
        return sigmas

    def common_sense(self, name: str) -> float:
        """Return a third of the largest offset [m, rad] of a faulty robot."""
        return (self.largest_length if Parameter(name).is_length else self.largest_angle) / 3.0

    def system(self, sets: Sequence[Observations]) -> System:
        """Return sets and priors for the solver."""
        sigmas = self.prior_sigmas
        noise = 1.0 if self.learned is None else self.learned.noise
        prior = Prior(self.model, sigmas, noise) if sigmas else None
        samples = []
        for each in sets:
            position = self.sigma_touch if each.plane else self.sigma_position
            samples.append(samples_of(each, (position, self.sigma_orientation), self.sigma_pixel))
        present = {each.base for each in sets}
        apart = tuple(s for s in self.separations if {s[0], s[1]} <= present)
        return System(tuple(samples), prior, apart, self.sigma_scale)

    @cached_property
    def free(self) -> tuple[Parameter, ...]:
        """Return the parameters to fit, by priority.

        Of parameters that trade off against each other, the last are kept nominal: effects, and
        before them lengths d, which become absurd between nearly parallel axes.
        """
        model = self.model
        used = {name for each in self.sets for name in (each.base, each.tool)}
        held: set[str] = set()
        for key in model.frame_names:
            frame = model.frame(key)
            if frame.fixed or key not in used:
                held.update(parameters_of(key))
            if key not in used:
                held.add(Parameter(key, DELAY))
            if frame.lens is None or frame.lens.fixed or key not in used:
                held.update(parameters_of(key, LENS_KINDS))
        for each in self.sets:
            held.update(parameters_of(each.base)[3:] if each.socket else ())
        for pattern in self.fixed:
            held.update(fnmatch.filter(model.parameter_names, pattern))
        known = dict(model.effects)
        names = [name for name in model.parameter_names if name not in held]
        return tuple(sorted(names, key=lambda name: 2 * (name in known) + (name.kind == 'd')))
