# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The one path from messages to a calibration, for live topics and for recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.errors import ConfigError, InputError, TooFewObservationsError
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import Identification
from calib_ros.identification.model_choice import identify_model
from calib_ros.identification.observations import Observations, configurations
from calib_ros.identification.problem import Problem
from calib_ros.identification.validation import ErrorFigures, compare
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.account import Account
from calib_ros.sampling.clocks import Clocks
from calib_ros.sampling.collector import Collector
from calib_ros.sampling.delay import Delay
from calib_ros.sampling.entry import Entry, Part
from calib_ros.sampling.hints import Hint, restless, sparse
from calib_ros.sampling.live import Estimate, LiveEstimate
from calib_ros.sampling.names import FrameNames, JointNames, strange
from calib_ros.sampling.progress import progress
from calib_ros.sampling.sample import (
    SOCKETS,
    Frames,
    Sample,
    collect,
    named,
    socket_pairs,
    socket_place,
)
from calib_ros.sampling.slices import JOINTS, POSES, Piece, Slice
from calib_ros.sampling.strays import STRAY, Gate
from calib_ros.sampling.track import APART
from calib_ros.settings import Settings

SILENT_NS = 5_000_000_000
"""Time after which joints of which nothing is heard, while others are, count as silent."""
ONE_FRAME = (
    'one is needed: set frame_id (--frame-id) to the one to use, or start again with a device of '
    'its own for each source'
)
LEAST_FAR = 1.0
"""Least time [s] by which a stray stamp is off. One ahead by more than `lateness` would settle
what has not come yet; joint states up to `max_gap` apart belong together."""


def check_settings(chain: Chain, settings: Settings) -> None:
    """Refuse settings that no identification of a chain could use, before anything is measured.

    Raises
    ------
    ConfigError
        When a name is unknown to this chain, say.

    """
    nothing = np.zeros((0, len(chain.joints)))
    empty = replace(Observations.from_arrays(nothing, np.zeros((0, 3))), approach=nothing)
    Problem(chain, empty, **settings.for_problem())


class CalibrationSession:
    """Takes messages, keeps the samples, identifies, and keeps the last good result.

    Parameters
    ----------
    chain : Chain
        The nominal chain.
    settings : Settings
    on_sample : callable, optional
        Called with every sample as soon as it is taken.
    on_removed : callable, optional
        Called with every sample that is taken back.

    """

    def __init__(
        self,
        chain: Chain,
        settings: Settings | None = None,
        on_sample: Callable[[Sample], None] | None = None,
        on_removed: Callable[[Sample], None] | None = None,
    ) -> None:
        self.chain = chain
        self.settings = settings or Settings()
        self.on_sample = on_sample or (lambda sample: None)
        self.on_removed = on_removed or (lambda sample: None)
        self.joint_names = self.settings.joint_names or chain.joint_names
        count = len(chain.joints)
        if len(self.joint_names) != count or len(set(self.joint_names)) != count:
            raise ConfigError(
                f'joint_names must be {count} different names, one for each of '
                f'{", ".join(chain.joint_names)}; not {", ".join(self.joint_names)}'
            )
        check_settings(chain, self.settings)
        self.recording = True
        self.socket_distance = SOCKETS
        """Distance of the two sockets of a location [m]."""
        self.calibration: Calibration | None = None
        """The last one that was accepted or loaded."""
        self._known: frozenset[Sample] = frozenset()  # that were there by then
        self.clear()

    def clear(self) -> None:
        """Forget all samples and counts; the last good calibration stays."""
        settings = self.settings
        self._collector = Collector(
            [joint.type == 'revolute' for joint in self.chain.joints], settings
        )
        self._collector.holding = settings.mode == 'continuous' and settings.delay == 0.0
        self._clocks = Clocks(self.chain, settings)
        self._gate = Gate(max(settings.lateness + settings.max_gap, LEAST_FAR))
        self._frames = FrameNames()
        self._names = JointNames(self.joint_names)
        self._entry = Entry(self._names, self._frames, len(self.chain.joints))
        self._live = LiveEstimate(self.problem_of)
        self.samples: list[Sample] = []
        self._notes: Counter[str] = Counter()
        self._newest = {JOINTS: 0, POSES: 0}
        self._once: set[tuple[str, str]] = set()

    def change(self, settings: Settings) -> None:
        """Go on with other settings; the buffers and samples stay.

        Raises
        ------
        ConfigError
            When no identification could use them; nothing is changed then.

        """
        check_settings(self.chain, settings)
        self.settings = settings
        self._collector.settings = self._clocks.settings = settings
        self._live.restart()

    # Messages

    def take(self, parts: Sequence[Part]) -> None:
        """Take messages in the order of their places.

        They are kept by slices up to a joint state after which there is something to do. An error
        costs the slice that makes it, and none after it.
        """
        settled = self._frames.settled
        pieces = self._entry.pieces(parts, self.recording, self.settings.frame_id)
        if self._frames.settled != settled:
            self._leave_out_strange()
        error: Exception | None = None
        for given in self._slices(pieces):
            try:
                self._keep(given)
            except Exception as err:
                error = error or err
        if error is not None:
            raise error

    def miss(self, kind: str, count: int, cause: str) -> None:
        """Count messages that came and cannot be used."""
        self._entry.miss(kind, count, cause)

    def _slices(self, pieces: Sequence[Piece]) -> Iterator[Slice]:
        """Yield messages up to one that gives something to do, when those before are kept."""
        if not pieces:
            return
        for passed, moved in self._gate.through(Slice.of(pieces, self._collector.stamped_late_ns)):
            if moved and passed.times[0] < self._collector.track.horizon_ns:
                self._collector.start_anew()
            yield from self._up_to_work(passed)

    def _up_to_work(self, given: Slice) -> Iterator[Slice]:
        begin = 0
        while begin < len(given):
            left = given.between(begin, len(given))
            count = self._collector.reach(left)
            yield left.between(0, count)
            begin += count

    def _keep(self, given: Slice) -> None:
        """Keep messages, and do what the last one gives to do."""
        for kind in (JOINTS, POSES):
            times = given.times[given.where(kind)]
            if len(times):
                newest = np.maximum(np.maximum.accumulate(times), self._newest[kind])
                self._newest[kind] = int(newest[-1])
                if back := int((times < newest).sum()):  # nothing is lost by it
                    self._notes[f'{kind} with a stamp older than the one before'] += back
        self._clocks.take(given)
        if self._collector.take(given):
            self._clocks.look(self._collector, int(given.times[given.where(JOINTS)[-1]]))
            self._collector.round()
        self._take()

    def finish(self) -> None:
        """Make samples of everything that still waits; nothing more will come."""
        for held in self._gate.release():
            for given in self._up_to_work(held):
                self._keep(given)
        self._clocks.look(self._collector, None)
        self._collector.finish()
        self._take()

    @property
    def received(self) -> Counter[str]:
        """Return how many messages came so far, by kind."""
        return self._entry.received

    @property
    def latest(self) -> tuple[int, Sequence[float]] | None:
        """Return stamp [ns] and values of the last joint state that named all joints."""
        return self._entry.latest

    # Samples

    def capture(self, socket: str = '') -> tuple[int, str]:
        """Take one sample of each source now; return how many, and why none if so.

        With a `socket` LOCATION/SOCKET the ball at the target sits in it, and only that is taken.
        """
        found = self._collector.capture(socket_place(socket) if socket else '')
        self._take()
        return found

    def remove_last(self) -> Sample:
        """Take back the last sample.

        Raises
        ------
        InputError
            When there is none.

        """
        if not self.samples:
            raise InputError('there is no sample to remove')
        sample = self.samples.pop()
        self._entry.unused['poses: of a sample that was taken back'] += sample.count
        self._collector.forget(sample)
        self._live.restart()
        self.on_removed(sample)
        return sample

    def restore(self, samples: Sequence[Sample]) -> None:
        """Go on with samples taken before."""
        for sample in samples:
            if sample.joints.shape != (len(self.chain.joints),):
                raise InputError(
                    f'samples to go on with have {len(sample.joints)} joint values, chain '
                    f'"{self.chain.name}" has {len(self.chain.joints)} joints'
                )
            if sample.frame_id:
                self._frames.note(sample.device, sample.frame_id, sample.count)
        self._collector.maker.remember(samples)
        self.samples = [*samples, *self.samples]
        self._leave_out_strange()
        self._live.restart()

    @property
    def usable(self) -> list[Sample]:
        """Return the samples in the frame of their device, `frame_id` or the usual one.

        Those of targets that were measured once are left out where others were more often: they
        tell nothing about the arm, and hundreds of them would take minutes.
        """
        wanted = self.settings.frame_id
        found = self.samples
        if wanted or self._frames.several:
            found = [each for each in found if self._frame_of(each, wanted) == each.frame_id]
        counts = Counter((each.device, each.target) for each in found if not each.validation)
        once = {key for key, count in counts.items() if count == 1}
        if once != self._once:  # the list does not only grow
            self._once = once
            self._live.restart()
        if not once or len(once) == len(counts):
            return found
        return [each for each in found if (each.device, each.target) not in once]

    def _frame_of(self, sample: Sample, wanted: str = '') -> str:
        """Return in which frame a sample should be; some do not tell in which they are."""
        return (
            sample.frame_id and (wanted or self._frames.main(sample.device))
        ) or sample.frame_id

    def _leave_out_strange(self) -> None:
        """Take back samples in strange frames, the first ones say, if there are only a few."""
        for sample in tuple(self.samples):
            if self._is_strange(sample):
                self.samples.remove(sample)
                self._live.restart()
                self.on_removed(sample)

    def _is_strange(self, sample: Sample) -> bool:
        """Tell whether a sample is one of a few in a frame of their own; count it if so."""
        if self.settings.frame_id or not self._frames.several or self._frames.different:
            return False
        frame_id = self._frame_of(sample)
        strays = sample.frame_id != frame_id
        if strays:
            self._entry.dropped[f'poses: {strange(sample.frame_id, frame_id)}'] += sample.count
        return strays

    @property
    def _different(self) -> str:
        """Return in words that one device measured in different frames, if it matters."""
        if self.settings.frame_id or not self._frames.different:
            return ''
        return f'poses came in different frames ({", ".join(self._frames.different)})'

    @property
    def state(self) -> str:
        """Return in words what the arm does, as far as samples are concerned."""
        track = self._collector.track
        silent = [self.joint_names[k] for k in track.silent(SILENT_NS)]
        if silent:
            return f'nothing can be sampled: no joint states of {", ".join(silent)} come any more'
        missing = [self.joint_names[k] for k in track.missing]
        if missing and self._names.foreign:
            return (
                f'waiting for joint states, set joint_names? Those that come name '
                f'{", ".join(self._names.foreign)}, not {", ".join(missing)}'
            )
        return self._collector.state()

    def account(self) -> Account:
        """Return what became of the messages so far."""
        fitted = [sample.joints for sample in self.samples if not sample.validation]
        usable = self.usable
        distinct = len(fitted)
        if self.settings.mode != 'continuous' and fitted:
            distinct = len(np.unique(configurations(np.array(fitted))))
        collector = self._collector
        notes = self._notes + collector.notes
        if len(usable) < len(self.samples):
            notes['samples left out, in another frame or of a target measured once'] += len(
                self.samples
            ) - len(usable)
        strays = Counter({f'{kind}: {STRAY}': n for kind, n in self._gate.dropped.items()})
        dropped = self._entry.dropped + collector.dropped + strays
        return Account(
            self.received['joints'],
            self.received['poses'],
            collector.waiting + self._gate.held(POSES),
            len(fitted),
            len(self.samples) - len(fitted),
            distinct,
            dict(sorted((self._entry.unused + collector.unused).items())),
            dict(sorted(dropped.items())),
            dict(sorted(notes.items())),
            self._names.foreign,
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what an engineer should know about the measurements."""
        return tuple(hint.text for hint in self.hints)

    @property
    def hints(self) -> list[Hint]:
        """Return what looks wrong in what is heard."""
        found: list[Hint | None] = []
        if self._different:
            found.append(
                Hint(f'{self._different}: set frame_id', f'{self._different}, {ONE_FRAME}')
            )
        found += self._clocks.hints()
        needed = self._collector.still_needed
        if needed is not None:
            found.append(restless(needed, self.settings.still))
        between = self._collector.dropped[f'poses: {APART}']
        found.append(sparse(between, self.received[POSES], self.settings.max_gap))
        return [hint for hint in found if hint is not None]

    @property
    def delay(self) -> Delay | None:
        """Return how late the measurements are stamped, as far as the motion shows."""
        return self._clocks.delay

    @property
    def _came(self) -> str:
        """Return in words what became of the messages, and what looks wrong in them."""
        return '; '.join((str(self.account()), *self.warnings))

    @property
    def estimate(self) -> Estimate | None:
        """Return what the samples so far tell; None while they are too few."""
        return self._live.update(self.usable)

    def status(self, work: str = '') -> str:
        """Return in words what the arm does, what else goes on, and how far the samples are.

        What an operator must know or do comes first: who has room for a line only cuts the rest.
        `work` is what goes on besides.
        """
        told = [self.state, work, *(hint.status for hint in self.hints)]
        estimate = self.estimate
        for sample in self._live.suspicious[-1:]:
            number = self.samples.index(sample) + 1
            told.append(f'sample {number} does not fit to the others, was the target moved?')
        fitted = [sample.joints for sample in self.usable if not sample.validation]
        told += progress(self.chain, fitted, estimate, self.settings)
        return '; '.join(filter(None, told))

    # Identification

    def problem(self) -> Problem:
        """Return a snapshot of the samples as a problem; later messages do not change it.

        Raises
        ------
        InputError
            Without any sample, or when measurements came in different frames.

        """
        self._clocks.look(self._collector, None)
        self._collector.flush()
        self._take()
        if self._different:
            raise InputError(f'{self._different}, {ONE_FRAME}')
        self._leave_out_strange()
        return self.problem_of(self.usable)

    def problem_of(self, samples: Sequence[Sample]) -> Problem:
        """Return samples as a problem.

        Raises
        ------
        InputError
            When there is none to fit.

        """
        settings, frames = self.settings, Frames()
        sigmas = (settings.sigma_position, settings.sigma_orientation)
        fitted, held_out = collect(samples, sigmas, frames)
        if not fitted:
            raise InputError(f'no samples to fit: {self._came}')
        return Problem(
            self.chain,
            fitted[0],
            held_out,
            more=fitted[1:],
            separations=tuple(
                (*pair, self.socket_distance) for pair in socket_pairs(samples, frames)
            ),
            world_frame=samples[0].frame_id,  # it is the frame of `base`
            **settings.for_problem(),
        )

    def identify(self) -> Identification:
        """Identify on the samples so far and keep the result if it is accepted."""
        problem = self.problem()
        try:
            result = identify_model(problem, self.settings.model)
        except TooFewObservationsError as err:
            raise InputError(f'{err} ({self._came})') from err
        if result.accepted:
            owners = named(self.samples).owners
            self.adopt(Calibration.of(result, owners=owners), self.samples)
        return result

    def adopt(self, calibration: Calibration, samples: Sequence[Sample] | None = None) -> None:
        """Take a calibration as the present one.

        `samples` are those that it may not be judged on, all of now by default.

        Raises
        ------
        InputError
            When it has other joints.

        """
        theirs = calibration.chain.joint_names
        if theirs != self.chain.joint_names:
            raise InputError(
                f'the calibration has the joints {", ".join(theirs)}, the robot has '
                f'{", ".join(self.chain.joint_names)}'
            )
        self._known = frozenset(self.samples if samples is None else samples)
        self.calibration = calibration

    def validate(self) -> tuple[ErrorFigures, ErrorFigures]:
        """Judge the calibration on the samples taken since; nothing is fitted.

        Return the errors of the calibration, and those of the nominal chain in its frames.

        Raises
        ------
        InputError
            Without a calibration, without samples since, or when they are between frames that it
            does not have.

        """
        calibration = self.calibration
        if calibration is None:
            raise InputError('there is no calibration to judge: identify or load one first')
        self._collector.flush()
        self._take()
        settings = self.settings
        sigmas = (settings.sigma_position, settings.sigma_orientation)
        # the first device and target are those of a file that does not name any
        frames = Frames(calibration.owners) if calibration.owners else named(self.usable)
        since = [each for each in self.usable if each not in self._known]
        sets = [each for part in collect(since, sigmas, frames) for each in part]
        if not sets:
            raise InputError('no samples have been taken since: measure some new poses first')
        known = calibration.chain.frame_names
        if not all(each.base in known and each.tool in known for each in sets):
            raise InputError(
                'the samples since were measured by a device or on a target that the '
                'calibration does not know'
            )
        nominal, now = compare(calibration.before, calibration.chain, sets).figures
        return now, nominal

    # Details

    def _take(self) -> None:
        """Keep the samples that the collector has made."""
        fresh = [each for each in self._collector.maker.take() if not self._is_strange(each)]
        self.samples += fresh
        for sample in fresh:
            self.on_sample(sample)
        self._clocks.wake(self._collector.unrest, len(self.samples))
