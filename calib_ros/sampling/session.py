# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The one path from messages to a calibration, for live topics and for recordings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError, InputError, TooFewObservationsError
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import Identification
from calib_ros.identification.model_choice import identify_model
from calib_ros.identification.observations import Observations, configurations
from calib_ros.identification.problem import Problem
from calib_ros.identification.validation import ErrorFigures, compare
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.sampling import messages
from calib_ros.sampling.account import Account
from calib_ros.sampling.collector import Collector, StreamKey
from calib_ros.sampling.delay import Delay, Watch
from calib_ros.sampling.hints import Hint, ambiguous, disagreement, moved, restless, sparse
from calib_ros.sampling.live import Estimate, LiveEstimate, barely_moved
from calib_ros.sampling.names import FrameNames, JointNames, strange
from calib_ros.sampling.sample import Frames, Sample, collect, named
from calib_ros.sampling.sources import Source
from calib_ros.sampling.strays import JOINTS, POSES, STRAY, Gate
from calib_ros.sampling.track import APART, Stamps
from calib_ros.settings import Settings

Positions: TypeAlias = NDArray[np.intp]

LOOK_AGAIN_NS = 2_000_000_000
"""Time between two looks for the delay."""
SILENT_NS = 5_000_000_000
"""Time after which joints of which nothing is heard, while others are, count as silent."""
ONE_FRAME = (
    'one is needed: set frame_id (--frame-id) to the one to use, or start again with a device of '
    'its own for each source'
)
NOT_NOISE = 3.0
"""RMS residual [what measurements scatter by] from which it is no noise, and more samples would
average nothing: chance alone does not reach it with the fewest samples of which it is told."""
LEAST_FAR = 1.0
"""Least time [s] by which a stray stamp is off. One ahead by more than `lateness` would settle
what has not come yet; joint states up to `max_gap` apart belong together."""
EARLY = 0.03
"""Time [s] by which measurements of a stop may be stamped too early: as near as positions tell a
delay. Of what then shows the arm leaving, most is left out as spikes; the rest moves the mean by
less than the noise of a measurement."""


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
        self.calibration: Calibration | None = None
        """The last one that was accepted or loaded."""
        self._known: frozenset[Sample] = frozenset()  # that were there by then
        self.clear()

    def clear(self) -> None:
        """Forget all samples and counts; the last good calibration stays."""
        self._collector = Collector(
            [joint.type == 'revolute' for joint in self.chain.joints], self.settings
        )
        continuous = self.settings.mode == 'continuous'
        self._collector.holding = continuous and self.settings.delay == 0.0
        self.samples: list[Sample] = []
        self.received: Counter[str] = Counter()
        """Messages that came so far, by stream."""
        self.latest: tuple[int, Sequence[float]] | None = None
        """Stamp [ns] and values of the last joint state that named all joints."""
        self._watch = Watch(self.chain, sleepless=continuous)
        self._found: Delay | None = None  # in the motion that is sampled
        self._dropped: Counter[str] = Counter()
        self._unused: Counter[str] = Counter()
        self._notes: Counter[str] = Counter()
        self._newest = {JOINTS: 0, POSES: 0}
        self._looked_ns = 0
        far = max(self.settings.lateness + self.settings.max_gap, LEAST_FAR)
        self._gate: Gate[Callable[[], None]] = Gate(far)
        self._delay_ns = round(1e9 * self.settings.delay)
        self._frames = FrameNames()
        self._names = JointNames(self.joint_names)
        self._live = LiveEstimate(self.problem_of)
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
        self._collector.settings = settings
        self._live.restart()

    # Messages

    def take_joints(self, message: Any) -> None:
        """Take a JointState."""
        try:
            reading = messages.joint_state(message)
        except messages.MessageError as err:
            self.received['joints'] += 1
            self._dropped[f'joints: {err}'] += 1
            return
        self.take_joint_reading(reading)

    def take_joint_reading(self, reading: messages.JointReading) -> None:
        """Take decoded joint values."""
        self.received['joints'] += 1
        try:
            columns, pick = self._names.layout(reading.names)
        except messages.MessageError as err:
            self._dropped[f'joints: {err}'] += 1
            return
        values = pick(reading.values)
        if not math.isfinite(sum(values)):
            self._dropped['joints: NaN or infinite joint value'] += 1
            return
        if max(map(abs, values)) > messages.LARGEST:
            self._dropped['joints: joint value beyond 1e6'] += 1
            return
        complete = len(columns) == len(self.chain.joints)
        if complete:
            self.latest = (reading.stamp_ns, values)
        if not self.recording:
            self._unused['joints: not recording'] += 1
            return
        add = partial(self._add_joints, columns, reading.stamp_ns, values)
        self._admit(JOINTS, reading.stamp_ns, add)

    def _add_joints(
        self, columns: tuple[int, ...], stamp_ns: int, values: Sequence[float]
    ) -> None:
        """Keep joint values."""
        self._watch_order(JOINTS, stamp_ns)
        self._look_for_delay(stamp_ns)
        if len(columns) == len(self.chain.joints):
            self._watch.add_joints(stamp_ns, values)
        self._collector.add_joints(columns, stamp_ns, values)
        self._take()

    def _admit(self, kind: str, time_ns: int, add: Callable[[], None]) -> None:
        """Keep what came at a time of the joints' clock, now or when its stamp is known good."""
        if self._gate.passes(kind, time_ns):
            add()
            return
        admitted, moved = self._gate.admit(kind, time_ns, add)
        for each in admitted:
            if moved and each.time_ns < self._collector.track.horizon_ns:
                self._collector.start_anew()
            each.item()

    def uneventful(self, readings: messages.JointReadings, among: int) -> NDArray[np.bool_]:
        """Return (N,) which joint readings would only be kept, until others make more of them.

        `among` counts the messages that may be kept with them, of all streams.
        """
        nothing = np.zeros(len(readings.stamps_ns), dtype=bool)
        if not self.recording:
            return nothing
        try:
            columns, values = self._names.values(readings)
        except messages.MessageError:
            return nothing
        stamps = readings.stamps_ns
        quiet = self._collector.uneventful(columns, stamps, among)
        quiet &= self._gate.quiet(JOINTS, stamps)
        quiet &= (np.abs(values) <= messages.LARGEST).all(axis=1)
        if self._collector.holding:
            since = stamps - self._looked_ns
            quiet &= (since >= 0) & (since < LOOK_AGAIN_NS)
        if len(columns) == len(self.chain.joints):
            quiet &= self._watch.uneventful(stamps)
        return quiet

    def uneventful_poses(self, source: Source, stamps: Stamps) -> NDArray[np.bool_]:
        """Return (N,) which measurements, at stamps (N,), would only be kept."""
        if not self.recording:
            return np.ones(len(stamps), dtype=bool)
        if not (self.settings.frame_id or self._frames.usual(source.device)):
            return np.zeros(len(stamps), dtype=bool)
        return self._gate.quiet(POSES, stamps - self._delay_ns)

    def keep(
        self,
        joints: Sequence[tuple[Positions, messages.JointReadings]],
        measured: Sequence[tuple[Positions, Source, messages.Readings]],
    ) -> None:
        """Take uneventful joint readings, and the measurements between them, all at once.

        Their positions tell in which order they came.
        """
        parts = []
        for where, readings in joints:
            stamps = readings.stamps_ns
            columns, values = self._names.values(readings)
            self.received['joints'] += len(stamps)
            self._collector.extend_joints(columns, stamps, values)
            parts.append((where, stamps, values))
        self._watch_orders(JOINTS, [part[:2] for part in parts])
        whole = [part for part in parts if part[2].shape[1] == len(self.chain.joints)]
        if whole:
            stamps, values = _in_order(whole)
            self.latest = (int(stamps[-1]), values[-1].tolist())
            self._watch.extend_joints(stamps, values)
        used = [(where, s, each) for where, s, each in measured if self._keep_readings(s, each)]
        self._watch_orders(POSES, [(where, each.stamps_ns) for where, _, each in used])
        seen = [
            (where, each.stamps_ns, _padded(each.numbers[:, :7], 7))
            for where, source, each in used
            if not each.distance and not source.eye_in_hand
        ]
        if seen and self._watch.awake:
            self._watch.extend_poses(*_in_order(seen))

    def _keep_readings(self, source: Source, readings: messages.Readings) -> bool:
        """Keep measurements if they can be used."""
        count = len(readings.stamps_ns)
        self.received['poses'] += count
        if not self.recording:
            self._unused['poses: not recording'] += count
            return False
        if not self._is_in_frame(source.device, readings.frame_id, count):
            return False
        key = _stream(source, readings.frame_id, readings.child, readings.distance)
        self._collector.extend(key, readings.stamps_ns, readings.numbers)
        return True

    def take(self, source: Source, msgtype: str, message: Any) -> None:
        """Take a measurement of the message type named."""
        try:
            reading = messages.DECODERS[msgtype](message)
        except messages.MessageError as err:
            self.miss(1, str(err))
            return
        self.take_reading(source, reading)

    def miss(self, count: int, cause: str) -> None:
        """Count measurements that came and cannot be taken."""
        self.received['poses'] += count
        self._dropped[f'poses: {cause}'] += count

    def take_reading(self, source: Source, reading: messages.Reading) -> None:
        """Take a decoded measurement."""
        self.received['poses'] += 1
        if not self.recording:
            self._unused['poses: not recording'] += 1
            return
        if not self._is_in_frame(source.device, reading.frame_id):
            return
        key = _stream(source, reading.frame_id, reading.child, reading.distance is not None)
        self._admit(
            POSES, reading.stamp_ns - self._delay_ns, partial(self._add_pose, key, reading)
        )

    def _add_pose(self, key: StreamKey, reading: messages.Reading) -> None:
        """Keep a measurement."""
        self._watch_order(POSES, reading.stamp_ns)
        if reading.position is not None and not key.eye_in_hand:
            self._watch.add_pose(reading.stamp_ns, reading.position, reading.quat_xyzw)
        self._collector.add(key, reading)

    def _is_in_frame(self, device: str, frame_id: str, count: int = 1) -> bool:
        """Tell whether measurements are in the frame of their device; count them if not."""
        before = self._frames.usual(device)
        try:
            self._frames.check(device, frame_id, self.settings.frame_id, count)
        except messages.MessageError as err:
            self._dropped[f'poses: {err}'] += count
            return False
        if self._frames.usual(device) != before:
            self._leave_out_strange()
        return True

    def finish(self) -> None:
        """Make samples of everything that still waits; nothing more will come."""
        for each in self._gate.release():
            each.item()
        self._look_for_delay(None)
        self._collector.finish()
        self._take()

    # Samples

    def capture(self) -> tuple[int, str]:
        """Take one sample of each source now; return how many, and why none if so."""
        found = self._collector.capture()
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
        self._unused['poses: of a sample that was taken back'] += sample.count
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
        self._collector.remember(samples)
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
            self._dropped[f'poses: {strange(sample.frame_id, frame_id)}'] += sample.count
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
        dropped = self._dropped + collector.dropped + strays
        return Account(
            self.received['joints'],
            self.received['poses'],
            collector.waiting + self._gate.held(POSES),
            len(fitted),
            len(self.samples) - len(fitted),
            distinct,
            dict(sorted((self._unused + collector.unused).items())),
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
        if self._watch.moves:
            found.append(moved(self._watch.moves))
        elif self._disagreement is not None:
            found.append(disagreement(self._disagreement, self.settings.delay))
        continuous = self.settings.mode == 'continuous'
        unclear = self._found if continuous else self._watch.unclear
        if unclear is not None and unclear.rivals and not self.settings.delay:
            delays = (unclear.seconds, *unclear.rivals)
            if continuous or all(map(self._spoils, delays)):
                found.append(ambiguous(delays))
        needed = self._collector.still_needed
        if needed is not None:
            found.append(restless(needed, self.settings.still))
        between = self._collector.dropped[f'poses: {APART}']
        found.append(sparse(between, self.received['poses'], self.settings.max_gap))
        return [hint for hint in found if hint is not None]

    @property
    def delay(self) -> Delay | None:
        """Return how late the measurements are stamped, as far as the motion shows."""
        if self.settings.mode != 'continuous':
            return self._watch.delay
        return None if self._found is None or self._found.rivals else self._found

    @property
    def _came(self) -> str:
        """Return in words what became of the messages, and what looks wrong in them."""
        return '; '.join((str(self.account()), *self.warnings))

    @property
    def _disagreement(self) -> float | None:
        """Return the delay that the motion shows [s], if it spoils stops."""
        if self.delay is None or self.settings.mode == 'continuous':
            return None  # there it is a parameter of the fit
        return self.delay.seconds if self._spoils(self.delay.seconds) else None

    def _spoils(self, delay: float) -> bool:
        """Tell whether a delay [s] spoils stops."""
        return not -EARLY <= delay - self.settings.delay <= self.settings.settle

    @property
    def estimate(self) -> Estimate | None:
        """Return what the samples so far tell; None while they are too few."""
        return self._live.update(self.usable)

    def status(self, work: str = '') -> str:
        """Return in words what the arm does, what else goes on, and how far the samples are.

        What an operator must know or do comes first: who has room for a line only cuts the rest.
        `work` is what goes on besides.
        """
        fitted = [sample for sample in self.usable if not sample.validation]
        estimate = self.estimate
        words = [self.state, work]
        words += [hint.status for hint in self.hints]
        for sample in self._live.suspicious[-1:]:
            number = self.samples.index(sample) + 1
            words.append(f'sample {number} does not fit to the others, was the target moved?')
        counted = f'{len(fitted)} samples'
        if estimate is not None:
            counted += f', {1e3 * estimate.sigma:.3f} mm expected, {self._forecast(estimate)}'
        words.append(counted)
        if fitted:
            still = barely_moved(self.chain, np.array([sample.joints for sample in fitted]))
            if still:
                words.append(f'hardly moved so far: {", ".join(still)}')
        return '; '.join(filter(None, words))

    def _forecast(self, estimate: Estimate) -> str:
        """Return in words what it takes until positions are known as well as wanted."""
        wanted = self.settings.wanted_accuracy
        more = estimate.more_for(wanted)
        if not more:
            return 'enough for the accuracy wanted'
        if estimate.excess is None:
            return 'too few to tell how many it takes'
        if estimate.excess > NOT_NOISE:
            advice = 'is the target firm? More'
            if self.settings.model == 'geometric':
                advice = 'set model to auto, more'
            return f'{advice} will not help: what is left is {estimate.excess:.0f} x noise'
        return f'{more} more expected for {1e3 * wanted:g} mm'

    # Identification

    def problem(self) -> Problem:
        """Return a snapshot of the samples as a problem; later messages do not change it.

        Raises
        ------
        InputError
            Without any sample, or when measurements came in different frames.

        """
        self._look_for_delay(None)
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
        settings = self.settings
        fitted, held_out = collect(samples, (settings.sigma_position, settings.sigma_orientation))
        if not fitted:
            raise InputError(f'no samples to fit: {self._came}')
        return Problem(
            self.chain,
            fitted[0],
            held_out,
            more=fitted[1:],
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
        for sample in self._collector.take():
            if not self._is_strange(sample):
                self.samples.append(sample)
                self.on_sample(sample)
        self._watch.wake(self._collector.unrest, len(self.samples))

    def _watch_order(self, stream: str, stamp_ns: int) -> None:
        """Note stamps that go backwards; samples go by stamps, so nothing is lost by it."""
        if stamp_ns < self._newest[stream]:
            self._notes[f'{stream} with a stamp older than the one before'] += 1
        self._newest[stream] = max(stamp_ns, self._newest[stream])

    def _watch_orders(self, stream: str, parts: Sequence[tuple[Positions, Stamps]]) -> None:
        """Note stamps that go backwards among messages that came at some positions."""
        if not parts:
            return
        (stamps,) = _in_order(parts)
        last = stamps[-1] - (self._delay_ns if stream == POSES else 0)
        self._gate.passed(stream, int(last))
        newest = np.maximum(np.maximum.accumulate(stamps), self._newest[stream])
        back = int((stamps < newest).sum())
        if back:
            self._notes[f'{stream} with a stamp older than the one before'] += back
        self._newest[stream] = int(newest[-1])

    def _look_for_delay(self, now_ns: int | None) -> None:
        """Look for the delay of the measurements after some time of motion, until it shows.

        Nothing is sampled before; at the end (None) what has come must do.
        """
        collector = self._collector
        if not collector.holding:
            return
        if now_ns is not None and 0 <= now_ns - self._looked_ns < LOOK_AGAIN_NS:
            return
        self._looked_ns = now_ns or 0
        self._found = collector.find_delay(self.chain, now_ns)
        collector.holding = self.delay is None and now_ns is not None


def _stream(source: Source, frame_id: str, child: str, distance: bool) -> StreamKey:
    return StreamKey(
        source.device,
        source.target or child,
        source.validation,
        distance,
        source.eye_in_hand,
        frame_id,
    )


def _in_order(parts: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Return stamps, say, and rows of numbers of streams in the order in which they came."""
    if len(parts) == 1:  # in order already
        return parts[0][1:]
    where, *columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(where)
    return tuple(column[order] for column in columns)


def _padded(rows: FloatArray, width: int) -> FloatArray:
    missing = width - rows.shape[1]
    if not missing:
        return rows
    return np.pad(rows, ((0, 0), (0, missing)), constant_values=np.nan)
