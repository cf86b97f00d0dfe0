# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The path from messages to a calibration, for live topics and recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from calib_ros.annotated import as_annotated
from calib_ros.decision.result import Identification
from calib_ros.errors import InputError, TooFewObservationsError
from calib_ros.estimation.configurations import configurations, count_distinct
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics.chain import Chain, refuse_other_joints
from calib_ros.sampling.account import Account, Cause
from calib_ros.sampling.dataset import Dataset, check_settings, dataset_of
from calib_ros.sampling.delay import Delay
from calib_ros.sampling.estimate import Estimate
from calib_ros.sampling.forecast import progress
from calib_ros.sampling.frame_names import FrameNames
from calib_ros.sampling.hints import Hint, losses, unheard
from calib_ros.sampling.joint_names import JointNames
from calib_ros.sampling.live import LiveEstimate
from calib_ros.sampling.message_filter import MessageFilter
from calib_ros.sampling.messages import frame_name
from calib_ros.sampling.pictures import Pictures
from calib_ros.sampling.pipeline import Pipeline
from calib_ros.sampling.sample import Frames, Sample, named, socket_place
from calib_ros.sampling.sample_hints import frozen, spoilt, unseen
from calib_ros.sampling.sets import collect
from calib_ros.sampling.slices import JOINTS, NO_ACCIDENT, POSES, Part
from calib_ros.settings import Settings
from calib_ros.shown import some

NOT_RECORDING = 'not recording: call ~/record with true'
ONE_FRAME = 'only one may be used: set frame_id (--frame-id), or give each source its own device'


class CalibrationSession:
    """Takes messages, keeps samples, identifies, and keeps the last good result.

    `on_sample` is called with every new sample, `on_removed` with every removed one. Impossible
    requests raise InputError, impossible settings ConfigError.
    """

    @as_annotated
    def __init__(
        self,
        chain: Chain,
        settings: Settings | None = None,
        on_sample: Callable[[Sample], None] | None = None,
        on_removed: Callable[[Sample], None] | None = None,
    ) -> None:
        self.chain = chain
        self.settings = settings or Settings()
        self.pictures = Pictures(lambda: self.settings.sigma_pixel)
        self.on_sample = on_sample or (lambda sample: None)
        self.on_removed = on_removed or (lambda sample: None)
        self.joint_names = self.settings.joint_names or chain.joint_names
        check_settings(chain, self.settings)
        self.recording = True
        self.calibration: Calibration | None = None  # the last one accepted or loaded
        self._known: frozenset[Sample] = frozenset()  # those it must not be judged by
        self.clear()

    def clear(self) -> None:
        """Forget all samples and counts, not the last good calibration."""
        settings = self.settings
        self.made = 0  # samples, without restored ones
        self._pipeline = Pipeline(self.chain, settings, self._take)
        self._collector, self._clocks = self._pipeline.collector, self._pipeline.clocks
        self._frames = FrameNames(frame_name(settings.frame_id))
        self._names = JointNames(self.joint_names, self.chain.held)
        self._filter = MessageFilter(self._names, self._frames, len(self.chain.joints))
        self.received = self._filter.received  # messages by kind
        self._relearn()
        self.pictures.clear()
        self.samples: list[Sample] = []

    def change(self, settings: Settings) -> None:
        """Continue with other settings; buffers and samples stay.

        Settings that no identification could use change nothing.
        """
        check_settings(self.chain, settings)
        self.settings = settings
        self._collector.settings = self._clocks.settings = settings
        if self._frames.wanted != frame_name(settings.frame_id):
            self._frames.wanted = frame_name(settings.frame_id)
            self._filter.refused.pop(POSES, None)
        self._relearn()

    def _relearn(self) -> None:
        self._live = LiveEstimate(partial(self.problem_of, posed=True))

    def take(self, parts: Sequence[Part]) -> None:
        """Take messages, in the order of their `places` in the batch."""
        try:
            self._pipeline.take(self._filter.pieces(parts, self.recording))
        finally:
            self._settle()

    def miss(self, kind: str, count: int, cause: str) -> None:
        """Count received messages that cannot be used."""
        self._filter.miss(kind, count, cause)

    def finish(self) -> None:
        """Make samples of all waiting messages; no more will arrive."""
        self._pipeline.finish()
        self._settle(wait=True)

    @property
    def latest(self) -> tuple[int, Sequence[float]] | None:
        """Return stamp [ns] and values of the last joint state with all joints."""
        return self._filter.latest

    # Samples

    def capture(self, socket: str = '') -> tuple[int, str]:
        """Take one sample of each source now; return their number, and the reason if none.

        With a `socket` LOCATION/SOCKET only the ball in it is sampled.
        """
        if not self.recording:
            return 0, NOT_RECORDING
        count, why = self._collector.capture(socket_place(socket) if socket else '')
        fresh, before = self._collector.sampler.fresh, len(self.samples)
        asked = {each.stamp_ns for each in fresh[len(fresh) - count :]}  # others: earlier stops
        self._pipeline.hand_over()
        self._settle(wait=True)
        taken = sum(each.stamp_ns in asked for each in self.samples[before:])
        why = self.state if JOINTS in self._filter.refused else why
        return taken, why if taken or not count else self.pictures.refused

    def remove_last(self) -> Sample:
        """Remove the last sample."""
        if not self.samples:
            raise InputError('there is no pose to remove')
        sample = self.samples.pop()
        self._filter.unused[Cause(POSES, 'of a removed pose')] += sample.count
        self._collector.forget(sample)
        if sample.frame_id:
            self._frames.note(sample.device, sample.frame_id, -sample.count)
        self.on_removed(sample)
        return sample

    def restore(self, samples: Sequence[Sample]) -> None:
        """Continue with earlier samples."""
        for sample in samples:
            if sample.joints.shape != (len(self.chain.joints),):
                raise InputError(
                    f'poses to resume have {len(sample.joints)} joint values, chain '
                    f'"{self.chain.name}" has {len(self.chain.joints)} joints'
                )
            if sample.frame_id:
                self._frames.note(sample.device, sample.frame_id, sample.count)
        self._collector.sampler.remember(samples)
        self.samples[:0] = samples

    @property
    def usable(self) -> list[Sample]:
        """Return the samples for identification, in the frame of their device.

        Targets measured once are left out beside others: they constrain nothing, but take minutes.
        """
        frames = {name: self._frames.main(name) for name in {each.device for each in self.samples}}
        found = [each for each in self.samples if each.frame_id in ('', frames[each.device])]
        counts = Counter((each.device, each.target) for each in found if not each.validation)
        once = {key for key, count in counts.items() if count == 1}
        if len(once) == len(counts):
            return found
        return [each for each in found if (each.device, each.target) not in once]

    @property
    def _different(self) -> str:
        """Return that one device measured in different frames, or only in others than wanted."""
        frames = ', '.join(some([name or 'one without name' for name in self._frames.different]))
        wanted = self._frames.wanted
        which = f'frames other than frame_id "{wanted}"' if wanted else 'different frames'
        return frames and f'poses came in {which} ({frames})'

    @property
    def state(self) -> str:
        """Return the state of sampling, for display."""
        if not self.recording:
            return NOT_RECORDING
        track = self._collector.track
        for hint in self._names.silent_ones(track.silent()):
            return hint.status
        if missing := self._names.why_missing(track.missing):
            return missing
        if why := self._filter.refused.get(JOINTS):
            return f'nothing can be sampled: joint states are refused, {why}'
        return self._collector.state()

    def __repr__(self) -> str:
        """Return the arm and what became of the messages."""
        return f'<CalibrationSession of {self.chain.name}: {self.account()}>'

    def account(self) -> Account:
        """Return the account of the messages so far."""
        fitted = [sample.joints for sample in self.samples if not sample.validation]
        usable, distinct = self.usable, len(fitted)
        if self.settings.mode != 'continuous' and fitted:
            distinct = count_distinct(configurations(np.array(fitted)))
        collector = self._collector
        notes = collector.notes.copy()
        if left_out := len(self.samples) - len(usable):
            notes['poses left out, in another frame or of a target measured once'] += left_out
        if missed := self._names.extra_joints:
            names = ', '.join(some(missed))
            notes[f'joint that moves but is not in the chain: {names}'] = len(missed)
        return Account(
            joint_states=self.received[JOINTS],
            poses=self.received[POSES],
            waiting=collector.waiting.count + self._pipeline.gate.held(POSES),
            samples=len(fitted),
            held_out=len(self.samples) - len(fitted),
            configurations=distinct,
            unused=dict(sorted((self._filter.unused + collector.unused).items())),
            dropped=dict(sorted(self._dropped.items())),
            notes=dict(sorted(notes.items())),
            foreign_names=self._names.foreign,
            never_named=self._names.never,
        )

    @property
    def _dropped(self) -> Counter[Cause]:
        gate, images = self._pipeline.gate.dropped, self.pictures.dropped
        return self._filter.dropped + self._collector.dropped + images + gate

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings about the measurements."""
        return tuple(hint.text for hint in self._hints(frozen(self.samples)))

    @property
    def last_hints(self) -> list[Hint]:
        """Return what looks wrong in a motion that has ended; before it may still stop."""
        return self._hints(frozen(self.samples)) or self._pipeline.unstopped(len(self.samples))

    @property
    def hints(self) -> list[Hint]:
        """Return what looks wrong in the received messages; of a frozen device, if it is now."""
        return self._hints(frozen(self.samples[-NO_ACCIDENT:]) and frozen(self.samples))

    def _hints(self, stuck: Hint | None) -> list[Hint]:
        in_sockets = self.settings.mode == 'triggered' and self.received  # perhaps: not measured
        found = [] if self.samples or in_sockets else unheard(self.received)
        if words := self._different:
            found.append(Hint(f'{words}: set frame_id', f'{words}, {ONE_FRAME}', explains=False))
        found += [stuck] if stuck else []
        found += self._names.silent_ones(self._collector.track.silent())
        found += self._pipeline.hints(self.received[POSES])
        found += spoilt(self.samples, found)
        found += unseen(self.pictures.dropped.total(), self.samples, self.pictures.reason)
        if any(hint.explains for hint in found):
            return found
        return found + (losses(self.received, self._dropped) or self._pipeline.unsettled())

    @property
    def doubtful(self) -> bool:
        """Tell whether the status says that messages are refused, or something looks wrong."""
        missing = self._names.why_missing(self._collector.track.missing)
        wrong = self._filter.refused, self.pictures.refused, missing, self._live.known.refused
        far = self.estimate and self.estimate.astray(self.settings.largest_error)
        return bool(any(wrong) or far or any(hint.status for hint in self.hints))

    @property
    def delay(self) -> Delay | None:
        """Return the delay of the measurement stamps, if the motion shows it."""
        return self._clocks.delay

    @property
    def summary(self) -> str:
        """Return the warnings, then the account of the messages as text."""
        return '; '.join((*(hint.text for hint in self.last_hints), str(self.account())))

    @property
    def estimate(self) -> Estimate | None:
        """Return the estimate by its last update; None with too few samples."""
        return self._live.known.estimate

    def learning(self) -> Callable[[], object]:
        """Return an update of the estimate by the samples so far.

        It may take seconds, and may run on another thread, one at a time.
        """
        return partial(self._live.update, self.usable)

    def status(self, work: str = '') -> str:
        """Return what is `told`, as text; the estimate is updated before."""
        self._live.update(self.usable)
        return '; '.join(self.told(work))

    def told(self, work: str = '') -> list[str]:
        """Return arm state, other `work`, warnings and progress in words, what is urgent first."""
        parts = [self.state, work]
        if why := self._filter.refused.get(POSES):
            parts.append(f'measurements are refused, {why}')
        parts += [hint.status for hint in self.hints]
        if self.pictures.refused:
            parts.append(f'the last image is not used: {self.pictures.refused}')
        estimate, refused, suspicious = self._live.known
        parts.append(refused)
        if suspicious and suspicious[-1] in self.samples:
            number = self.samples.index(suspicious[-1]) + 1
            parts.append(f'pose {number} does not fit the others, was the target moved?')
        fitted = [sample.joints for sample in self.usable if not sample.validation]
        parts += progress(self.chain, fitted, estimate, self.settings)
        return list(dict.fromkeys(filter(None, parts)))

    # Identification

    def problem(self) -> Problem:
        """Return a snapshot of the samples as a problem."""
        self._clocks.find(self._collector, None)
        self._flush()
        if self._different:
            raise InputError(f'{self._different}, {ONE_FRAME}')
        return self.problem_of(self.usable)

    def problem_of(self, samples: Sequence[Sample], posed: bool = False) -> Problem:
        """Return samples as a problem; with `posed` boards as poses, not corners."""
        if all(sample.validation for sample in samples):
            told = f'all {len(samples)} came on topics for validation, measure on others too; '
            raise InputError(f'no poses to fit: {told * bool(samples)}{self.summary}')
        found = dataset_of(samples, self.settings.sigmas, posed)
        return found.problem(self.chain, self.settings, of_messages=True)

    def identify(self) -> Identification:
        """Identify from the samples so far, and keep the result if accepted."""
        problem = self.problem()
        try:
            result = identify_model(problem, self.settings.model)
        except TooFewObservationsError as err:
            raise err.after(self.summary) from err
        if result.accepted:
            owners = named(self.samples).owners
            self.adopt(Calibration.of(result, owners=owners, fitted=problem.sets), self.samples)
        return result

    def adopt(self, calibration: Calibration, samples: Sequence[Sample] | None = None) -> None:
        """Use a calibration from now on.

        `samples` (default: all) must not be used to judge it.
        """
        theirs = 'the calibration', calibration.chain
        refuse_other_joints(*theirs, 'the robot', self.chain, InputError)
        self._known = frozenset(self.samples if samples is None else samples)
        self.calibration = calibration

    def recent(self) -> tuple[Calibration, Problem]:
        """Return the calibration, and the last stops since then as a problem."""
        calibration, sets = self.since(NO_ACCIDENT)
        cameras = {each.camera for each in sets if each.pixels is not None}
        seen = {name: lens for name in cameras if (lens := calibration.chain.frame(name).lens)}
        problem = Dataset(sets, lenses=seen).problem(self.chain, self.settings, of_messages=True)
        return calibration, problem

    def since(self, most: int = 0) -> tuple[Calibration, list[Observations]]:
        """Return the calibration, and the samples since then in its frames, the last `most`."""
        if (calibration := self.calibration) is None:
            raise InputError('there is no calibration to judge: identify or load one first')
        self._flush()
        since = [each for each in self.usable if each not in self._known][-most:]
        # without owners, the first device and target have the frames
        frames = Frames(calibration.owners) if calibration.owners else named(self.usable)
        sets = [each for _, each in collect(since, self.settings.sigmas, frames)]
        if not sets:
            told = next((each.status for each in self.last_hints if each.status), self.state)
            text = 'no poses since the calibration came into use: measure some new ones'
            raise InputError(f'{text}; {told}')
        known = calibration.chain.frame_names
        if not all(each.base in known and each.tool in known for each in sets):
            raise InputError('the new poses are of a device or target unknown to the calibration')
        return calibration, sets

    def _flush(self) -> None:
        self._pipeline.flush()
        self._settle(wait=True)

    def _settle(self, wait: bool = False) -> None:
        self._take((), wait)
        self.pictures.keep_only(self._collector.waiting.images | self._pipeline.gate.images)

    def _take(self, made: Sequence[Sample], wait: bool = False) -> int:
        fresh = self.pictures.through(made, wait)
        self.samples += fresh
        self.made += len(fresh)
        for sample in fresh:
            self.on_sample(sample)
        return len(self.samples)
