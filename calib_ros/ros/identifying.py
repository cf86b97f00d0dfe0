# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An identification on a snapshot of the node's samples, in its own thread."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from calib_ros.apply.confidence import interval_of
from calib_ros.decision.comparison import compare
from calib_ros.decision.misfits import Outlier
from calib_ros.decision.moved import IN_THE_CELL, Step
from calib_ros.decision.reasons import Rule
from calib_ros.decision.result import Identification
from calib_ros.errors import (
    LONGEST,
    ConfigError,
    InputError,
    TooFewObservationsError,
    shortened,
    trouble,
)
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.files.archive import Archive
from calib_ros.files.hashes import inputs_of, samples_hash, settings_hash
from calib_ros.files.history import History
from calib_ros.files.loading import Loaded
from calib_ros.files.result_rows import result_row
from calib_ros.files.rows import Filing, Row
from calib_ros.identification.age import measured_at
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain import Chain
from calib_ros.progress import Progress
from calib_ros.report import words
from calib_ros.report.advised import advice_of
from calib_ros.ros import to_ros
from calib_ros.ros.boundary import Answer
from calib_ros.ros.inputs import Inputs
from calib_ros.ros.outputs import Published
from calib_ros.sampling.account import too_much_lost
from calib_ros.sampling.hints import Hint
from calib_ros.sampling.sample import Sample, named
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings
from calib_ros.shown import rounded, sentence


class Filer:
    """Files results of one robot, by serial number, in a folder or URL, or nowhere without one.

    Identifications start from the `nominal` chain.
    """

    def __init__(self, place: str, serial: str, nominal: Chain) -> None:
        self._history = History(place) if place else None
        self.serial, self._nominal = serial, nominal
        if place and not serial:
            raise ConfigError('a history needs the serial number of the robot: set serial as well')

    def file(
        self,
        problem: Callable[[], Problem],
        settings: Settings,
        row: Callable[[Filing], Row],
        *judged: str,
    ) -> str:
        """File the row of a result; return why that was not possible, or empty text."""
        try:
            if self._history is not None:
                sets = problem().all_sets
                hashed = settings_hash(self._nominal, settings, *judged)
                about = Filing(self.serial, measured_at(sets), samples_hash(sets), hashed)
                self._history.file(row(about))
        except Exception as err:  # of the network too: the result is told all the same
            return f'{NOT_FILED} in the history: {trouble(err)}'
        return ''


ANSWER_LENGTH = LONGEST // 2
"""Characters of an answer: a few terminal lines; the rest is in a file and the log."""
KEEP = '; to keep it call ~/save'
NOT_FILED = '; not filed'
ONE_BEFORE = 'the last ~/identify gave no calibration, so the one before: '
TELLING_RULES = {Rule.MISTAKE, Rule.DROPPED}
"""Rules whose advice says nothing without the refusal."""


class Snapshot(NamedTuple):
    """The input of an identification, and its settings."""

    loaded: Loaded
    settings: Settings
    samples: tuple[Sample, ...]
    numbers: dict[tuple[int, str, str], int]  # the operator's, by stamp, base and tool
    origin: dict[str, Any]
    configuration: str
    hints: list[Hint]  # what looks wrong in the messages
    since: tuple[Calibration, list[Observations]] | None  # the calibration in use, and new poses

    @property
    def cause(self) -> Hint | None:
        """Return what looks wrong in the messages and may explain a bad fit."""
        return next((each for each in self.hints if each.explains), None)

    def number_of(self, one: Outlier | Step) -> int:
        """Return the operator's number of an outlier, or of the first sample after a step."""
        of = self.loaded.problem.sets[one.set]
        return self.numbers[(one.stamp_ns, of.base, of.tool)]


class Identifying:
    """Identifies, reports the result, and hands over an `accepted` one.

    `configuration` returns the node's settings as a parameter file.
    """

    def __init__(
        self,
        node: Node,
        session: CalibrationSession,
        archive: Archive,
        filer: Filer,
        configuration: Callable[[], str],
        accepted: Callable[[Calibration, Published, Sequence[Sample]], None],
    ) -> None:
        self._node, self._session, self._archive, self._filer = node, session, archive, filer
        self._configuration, self._accepted = configuration, accepted
        self._residuals = node.create_publisher(MarkerArray, '~/residuals', to_ros.LATCHED)
        self.progress = Progress('identifying')
        self.last = 'nothing identified yet'  # result of the last identification or ~/load
        self.earlier = ''  # what to say of the calibration in use, if it is not of the last one
        self.observability = ''
        self._short = '', '', ''
        """Of the last answer the beginning, advice, and an end that is not cut."""
        self._report: Path | None = None  # of the last identification, if it was refused
        self._journal = archive.path  # of the poses of the last identification

    def snapshot(self, inputs: Inputs) -> Snapshot:
        """Return the current problem and its context."""
        session, self._short, self._report = self._session, ('', '', ''), None
        self._journal = self._archive.path
        try:
            problem = session.problem()
        except InputError as err:
            if session.samples:
                self._failed(err, '')
                raise
            why = inputs.failures
            hints = session.last_hints
            hint = next((each.status for each in hints), session.state)
            told_already = why or hints or session.account().foreign_names
            parts = (*why, str(err), '' if told_already else hint)
            told = InputError('; '.join(filter(None, parts)))
            self._failed(told, '; '.join(('no poses to fit', *why)), '' if why else hint)
            raise told from err
        samples = tuple(session.usable)
        origin = {
            'robot_serial': self._filer.serial,
            'topics': inputs.topics,
            'first_stamp_ns': min(sample.stamp_ns for sample in samples),
            'last_stamp_ns': max(sample.stamp_ns for sample in samples),
            'samples': len(samples),
            'journal': str(self._archive.journal or ''),
        }
        frames, number = named(samples), {each: k for k, each in enumerate(session.samples, 1)}
        numbers = {(each.stamp_ns, *frames.of(each)): number[each] for each in samples}
        account, largest_loss = session.account(), self._node.get_parameter('largest_loss').value
        lost = tuple(too_much_lost(account, largest_loss)) if session.made else ()
        texts, owners = (session.warnings, str(account)), frames.owners
        loaded = Loaded(problem, asdict(account), *texts, refusals=lost, owners=owners)
        since = None
        with suppress(InputError):
            since = session.since()
        known = numbers, origin, self._configuration(), session.last_hints, since
        found = Snapshot(loaded, session.settings, samples, *known)
        self.progress.begin()
        return found

    def run(self, given: Snapshot) -> Answer:
        """Identify; publish only an accepted result."""
        try:
            with self.progress.running():
                result = given.loaded.identified(given.settings.model, self.progress)
            return self._judged(given, result)
        except Exception as err:
            self._failed(err, str(err), next((each.status for each in given.hints), ''))
            raise

    def _failed(self, err: Exception, said: str, advice: str = '') -> None:
        self.earlier, self.last = ONE_BEFORE, f'no result: {trouble(err)}'
        if isinstance(err, TooFewObservationsError):
            said, advice = err.brief, advice or err.advice
        self._short = said, advice, ''

    def _judged(self, given: Snapshot, result: Identification) -> Answer:
        loaded = given.loaded
        steps = (step for reason in advice_of(loaded.problem, result) for step in reason.steps)
        telling = next((each.short for each in result.refusals if each.rule in TELLING_RULES), '')
        first = brief = next(steps, '')
        if given.cause and not telling:
            first, brief = sentence(given.cause.text), given.cause.status
        numbers = {each: given.number_of(each) for each in result.outliers}
        hint = next(iter((*loaded.warnings, *result.remarks)), '')
        moved, nearer = _moved(result, given), _nearer(result, given.since)
        self.last = words.summary(result, numbers, loaded.warnings, first)
        if moved and not (result.step and result.step.slow):  # else told already
            self.last += f'; {moved}'
        said, advice = words.verdict(result), moved or nearer or brief or hint
        if telling or (moved and not result.accepted):
            said, advice = f'{words.REFUSED}: {telling or moved}', ''
        self.observability = words.observability_in_words(result)
        scale = self._node.get_parameter('marker_scale').value
        now = self._node.get_clock().now().to_msg()
        seen = to_ros.in_hand(loaded.owners)
        given_frame = self._node.get_parameter('target_frame').value
        world = given_frame if seen else loaded.problem.world_frame
        markers = to_ros.residual_markers(result, scale, world, now)
        self._residuals.publish(markers)
        page = partial(_page, given, result)
        if result.accepted:
            found = Calibration.of(result, given.origin, loaded.owners, loaded.problem.sets)
            published = Published(found.dump(), given.configuration, page)
            self._accepted(found, published, given.samples)
            self.earlier = ''
            self.last += f'; {nearer}' * bool(nearer) + KEEP
        else:
            self.earlier = ONE_BEFORE
            used = self._session.calibration is not None
            kept = 'the last good calibration stays in use' if used else 'nothing is published'
            self.last += f'; {kept}'
            self._keep_report(page)
        row = partial(result_row, result, warnings=loaded.warnings)
        unfiled = self._filer.file(lambda: loaded.problem, given.settings, row)
        self._short = said, advice, KEEP * result.accepted + NOT_FILED * bool(unfiled)
        self.last += unfiled
        return result.accepted, self.last

    def loaded(self, which: str) -> Answer:
        """Note which calibration is in use instead; return the answer."""
        self.earlier, self.last = '', f'loaded {which}'
        return True, self.last

    def _keep_report(self, page: Callable[[], str | None]) -> None:
        try:
            text = page()
            self._report = (text and self._archive.note(text, self._journal, '.html')) or None
        except Exception as err:  # the answer is sent without the page
            self._node.get_logger().warning(
                f'the report of the refusal is not written: {trouble(err)}'
            )
        if self._report:
            self.last += f'; report: {self._report}'

    def shortened(self, answer: Answer) -> Answer:
        """Return an answer cut to a few lines: the verdict, and what to do first.

        The whole is in the log, and beside the journal.
        """
        success, text = answer
        if len(text) > ANSWER_LENGTH:
            path = self._archive.note(f'{text}\n', self._journal)
            path = self._report or path
            said, advice, end = self._short
            end += f' ... full text: {path.name if path else "in the log"}'
            longest = (ANSWER_LENGTH - len(end)) * 3 // 4
            advice = advice and f' ... {_cut(advice, longest)}'
            room = ANSWER_LENGTH - len(advice + end)
            if success or advice:
                gap = ' ...' * (len(said) > room and not advice)
                said = _cut(said, room - len(gap)) + gap
            text = shortened(said or text, room) + advice + end
        return success, text


def _cut(text: str, longest: int) -> str:
    """Return a text without its last words if too long, nor a bracket that they would close.

    Half of "RMS 2 -> 1 mm" misleads.
    """
    glued = re.sub(r'(?<=\d) | (?=\d)', '\0', text)
    kept = textwrap.shorten(glued, longest, placeholder='').replace('\0', ' ')
    while kept.count('(') > kept.count(')'):
        kept = kept.rpartition('(')[0].rstrip()
    return kept.rstrip(',;:')


def _moved(result: Identification, given: Snapshot) -> str:
    """Tell what moved, if the result is accepted, or refused for that."""
    step, refusals = result.step, result.refusals
    if result.accepted and result.outdated and not (step and step.outdated):
        frames = ' or '.join(result.outdated)
        return f'the last poses do not fit, did {frames} move? Measure again after ~/clear'
    if step is None or (refusals and given.cause and step.kind in IN_THE_CELL):
        return ''
    if refusals and refusals[0].rule not in (Rule.MOVED, Rule.ENCODER):
        return ''
    return step.told(given.number_of(step))


def _nearer(result: Identification, since: tuple[Calibration, list[Observations]] | None) -> str:
    """Tell that the calibration before is clearly nearer to the poses measured since then."""
    if since is None or result.validation is None or not result.accepted:
        return ''
    arm, sets = since
    before = compare(arm.before, arm.chain, sets)
    if arm.reused(sets) or interval_of(before, 1)[1] >= interval_of(result.validation, 1)[0]:
        return ''
    rms = rounded(before.figures[1].rms_mm)
    return f'the calibration before is nearer ({rms} mm): if saved, ~/load brings it back'


def _page(given: Snapshot, result: Identification) -> str | None:
    from calib_ros.report.content import Origin
    from calib_ros.report.page import render
    from calib_ros.report.reports import identification_report

    journal, serial = given.origin['journal'], given.origin['robot_serial']
    files = inputs_of(Path(journal) if journal else None)
    origin = Origin(files, serial=serial, settings=given.configuration)
    return render(identification_report(given.loaded, result, origin))
