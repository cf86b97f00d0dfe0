# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node (docs/node.md): topics in, services, corrected parameters out.

A timer takes waiting messages (`inputs.py`) in batches, so the executor does not wake for each. An
identification runs on a separate thread, on a snapshot of the samples, and answers when it ends.
"""

from __future__ import annotations

import os
import sys
import textwrap
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

# matrices are small: a second BLAS thread costs more than it gives, especially on a busy cell
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from calib_ros.apply.judgement import judge
from calib_ros.atomic import given_path
from calib_ros.errors import CalibrationError, ConfigError, InputError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.files.archive import Archive
from calib_ros.files.cameras import cameras_of
from calib_ros.files.programs import read_joints
from calib_ros.files.result_rows import verification_row
from calib_ros.identification.age import years_since
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.recalibration import recalibrate
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.report import documents, words
from calib_ros.ros.advisor import Guide
from calib_ros.ros.boundary import Answer, Boundary, Job
from calib_ros.ros.calls import InOrder
from calib_ros.ros.deferred import DeferredTrigger
from calib_ros.ros.diagnostics import Diagnostics
from calib_ros.ros.identifying import Filer, Identifying
from calib_ros.ros.inputs import Batched, Inputs, deserialised
from calib_ros.ros.outputs import FILENAMES, UNSAVED, Keeper
from calib_ros.ros.parameter_list import BESIDE_A_JOURNAL, PARAMETERS
from calib_ros.ros.parameters import changed, declare_all, load_robot, refuse_unknown_names
from calib_ros.ros.running import run_node
from calib_ros.ros.to_ros import LATCHED
from calib_ros.sampling.batches import feed
from calib_ros.sampling.dataset import check_settings
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.sample import Sample, socket_place
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.source_texts import parse_sources
from calib_ros.sampling.sources import STANDARD
from calib_ros.sampling.streams import Stream, source_streams
from calib_ros.shown import counted, rounded

DIAGNOSTICS_PERIOD = 1.0  # time [s] between two reports on /diagnostics, the usual one
TAKING_PERIOD = DIAGNOSTICS_PERIOD / 10.0
"""Time [s] between two batches of messages: taken one by one, each in a cold cache, they cost
three times as much."""
JOIN_TIMEOUT = DIAGNOSTICS_PERIOD  # time [s] for which the shutdown waits for running work
WRITING = {'~/export', '~/save'}  # whose work is not cut off, since it writes files
STATUS_LENGTH = 120  # characters of the status: `ros2 topic echo` cuts texts at 128


class CalibrationNode(Batched):
    """Calibrates one robot from its joint states and measurements."""

    def __init__(self, shared: Collection[str] = (), **node_options: Any) -> None:
        try:
            super().__init__(
                'calibration_node',
                automatically_declare_parameters_from_overrides=True,  # see `parameters.py`
                **node_options,
            )
        except ValueError as err:  # [] has no type in ROS
            raise ConfigError(
                f"a parameter file has an empty list []: write [''] or leave it out ({err})"
            ) from err
        given, names = declare_all(self, shared)
        home = os.environ.get('ROS_HOME', '~/.ros')
        chain, urdf = load_robot(self, given)
        self._given = given
        self._boundary = Boundary(self.get_logger())
        folder = given_path(given.data_dir or f'{home}/calib_ros')
        robot = f'{chain.name}/{given.serial or self.get_namespace()[1:]}'.rstrip('/')
        named = folder, robot, chain.joint_names
        self._archive = Archive(*named, self._configuration, given.tip_link)
        kept = (partial(self._keep, each) for each in (self._archive.add, self._archive.remove))
        self.session = CalibrationSession(chain, given.settings, *kept)
        self.session.pictures.cameras = cameras_of(given.settings.sources)
        self._filer, self._status_text = Filer(given.history, given.serial, chain), ''
        self.lost = ''
        """Samples not kept in data_dir at the end, and why; empty if all were."""
        if given.resume:
            self._resume()
        else:
            self._archive.begin(self.get_logger())
        self._inputs = Inputs(self, self._streams())
        refuse_unknown_names(self, names)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)
        candidates = None
        if given.candidates:
            candidates = read_joints(given_path(given.candidates), chain)
        self._guide = Guide(self, self.session, self._boundary.guarded, candidates)
        self._keeper = Keeper(self, self.session, self._archive, given, urdf, self._guide.show)
        self._identifying = Identifying(
            self, self.session, self._archive, self._filer, self._configuration, self._keeper.adopt
        )
        self._status = self.create_publisher(String, '~/status', LATCHED)
        self._diagnostics = Diagnostics(
            self, self.session, self._archive, self._inputs, self._boundary, given.serial
        )
        self._working = self._serve()
        self._calls = InOrder(self)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # ROS time may stop and jump
        timed = (DIAGNOSTICS_PERIOD, self._on_second), (TAKING_PERIOD, self._on_tick)
        for period, work in timed:
            self.create_timer(period, self._boundary.guarded(work), clock=steady)
        self._load_at_start()

    def _serve(self) -> dict[str, DeferredTrigger]:
        for kind, name, callback in (
            (Trigger, '~/cancel', lambda request: self._identifying.progress.cancel()),
            (Trigger, '~/capture', self._on_capture),
            (Trigger, '~/remove_last', self._on_remove_last),
            (Trigger, '~/clear', self._on_clear),
            (Trigger, '~/load', self._on_load),
            (SetBool, '~/record', self._on_record),
        ):
            self.create_service(kind, name, self._answering(name, callback))
        identify, keeper = self._identifying, self._keeper
        slow: dict[str, Callable[[], Job]] = {
            '~/identify': lambda: partial(identify.run, identify.snapshot(self._inputs)),
            '~/export': keeper.export,
            '~/save': keeper.save,
            '~/check': lambda: partial(self._on_check, *self.session.recent()),
            '~/validate': self._to_validate,
        }
        return {
            name: DeferredTrigger(self, name, self._answer, partial(self._prepared, name, begin))
            for name, begin in slow.items()
        }

    def announce(self) -> None:
        """Log that the node is ready, once an executor serves it."""
        self.get_logger().info(
            f'ready to calibrate {self.session.chain.name}: joints '
            f'{", ".join(self.session.joint_names)}; poses are kept in {self._archive.folder}'
        )

    def close(self) -> bool:
        """Stop; return False if an identification still runs and must not be waited for."""
        log, working = self.get_logger(), self._working
        late = [name for name, each in working.items() if not each.join(JOIN_TIMEOUT)]
        helped = self._guide.join(JOIN_TIMEOUT)
        self._take_messages()
        self.session.finish()
        self.lost = self._archive.close()
        if self.lost:
            log.error(self.lost)
        for name in {*late} & WRITING:
            log.info(f'waiting for {name}')
            working[name].join(None)
        running = [name for name in late if not working[name].join(0.0)]
        for name in running:  # the caller hears no more
            log.warning(f'ended before the answer of {name}')
        if self._keeper.unsaved:
            log.warning(UNSAVED)
        self.destroy_node()
        return helped and not running

    # Parameters

    def _configuration(self) -> str:
        more = {name: self.get_parameter(name).value for name in BESIDE_A_JOURNAL}
        more = {name: v for name, v in more.items() if v != PARAMETERS[name].default}
        return documents.configuration_yaml(self._given.chain, self.session.settings, **more)

    def _check_parameters(self, changes: Sequence[Any]) -> SetParametersResult:
        """Refuse settings that no identification could use, forbidden files, and sockets."""
        try:
            for each in changes:
                if each.name in FILENAMES:
                    self._keeper.file_of(each.name, each.value)
                if each.name == 'socket' and each.value:
                    socket_place(each.value)
            check_settings(self.session.chain, changed(self.session.settings, changes))
        except CalibrationError as err:
            return SetParametersResult(successful=False, reason=str(err))
        return SetParametersResult(successful=True)

    def _take_parameters(self, changes: Sequence[Any]) -> None:
        self._take_messages()
        settings = changed(self.session.settings, changes)
        if settings != self.session.settings:
            self.session.change(settings)

    # Topics in

    def _streams(self) -> list[Stream]:
        settings = self.session.settings
        topics = settings.joint_topics or ('joint_states',)
        sources = parse_sources(settings.sources) or STANDARD
        types = {source.topic: 'geometry_msgs/msg/PoseStamped' for source in sources}
        return [*(Stream(topic, JOINT_STATE) for topic in topics), *source_streams(sources, types)]

    def _take_messages(self) -> None:
        for problem in feed(self.session, self._inputs.take(), deserialised):
            self.get_logger().error(problem)

    # The journal

    def _keep(self, write: Callable[..., None], *samples: Sample) -> None:
        archive = self._archive
        error, journal = archive.error, archive.journal
        write(*samples)
        if archive.error and not error:
            self.get_logger().error(f'poses are kept in memory only: {archive.error}')
        if journal not in (None, archive.journal):
            self.get_logger().warning(
                f'{journal} was deleted, moved or changed by another program: all poses of this '
                f'session continue in {archive.journal}'
            )

    def _resume(self) -> None:
        samples, warnings = self._archive.resume()
        self.session.restore(samples)
        for warning in warnings:
            self.get_logger().warning(warning)
        if self._archive.journal is not None:
            self.get_logger().info(f'resumed {len(samples)} poses of {self._archive.journal}')

    def _load_at_start(self) -> None:
        """Publish an earlier calibration if wanted, or report that there is one."""
        path, wanted = self._keeper.at_start()
        log = self.get_logger()
        if wanted:
            try:
                log.info(f'{self._on_load(None)[1]}: it is published')
            except Exception as err:  # samples can be taken without it
                self._diagnostics.unloaded = f'no calibration is published at startup: {err}'
                log.error(self._diagnostics.unloaded)
        elif path is not None:
            log.info(
                f'no calibration is published yet: for {path} call ~/load, or set autoload:=true'
            )
        elif self._given.autoload:
            log.info(f'autoload: there is no saved calibration in {self._archive.folder} yet')

    # Services

    def _refuse_if_busy(self) -> None:
        if self._working['~/identify'].busy:
            raise InputError(
                'refused: an identification is running, and may replace the calibration in use: '
                'wait for its answer, or call ~/cancel'
            )

    def _prepared(self, name: str, begin: Callable[[], Job]) -> Job:
        """Return the work of a service; it says first if it uses an earlier calibration."""
        self._take_messages()
        if name in WRITING:
            self._refuse_if_busy()
        earlier, work = '' if name == '~/identify' else self._identifying.earlier, begin()

        def told() -> Answer:
            success, text = work()
            return success, earlier + text

        return told

    def _on_capture(self, request: Any) -> Answer:
        socket = self.get_parameter('socket').value
        count, why = self.session.capture(socket)
        if not count:
            return False, f'no pose taken: {why}'
        number = f'{self._archive.trouble}pose {len(self.session.samples)}'
        if socket:
            return True, f'{number} taken: ball in socket {socket}'
        told = (
            f'{each.count} measurements, spread {rounded(1e3 * each.spread)} mm'
            for each in self.session.samples[-count:]
        )
        return True, f'{number} taken ({", ".join(told)})'

    def _on_remove_last(self, request: Any) -> Answer:
        self.session.remove_last()
        return True, f'{self._archive.trouble}pose {len(self.session.samples) + 1} removed'

    def _to_validate(self) -> Job:
        session = self.session
        judged, problem = session.since(), partial(session.problem_of, session.usable)
        file = partial(self._filer.file, problem, session.settings)
        return partial(self._on_validate, file, *judged)

    def _on_validate(
        self, file: Callable[..., str], calibration: Calibration, sets: list[Observations]
    ) -> Answer:
        sigma = self.session.settings.given_sigma
        found = judge(calibration, sets, of_messages=True, sigma_position=sigma)
        row = partial(verification_row, calibration.chain, found, kind='validate')
        text = words.verdict_in_words(found) + file(row, table_hash(calibration.chain))
        return found.verdict == 'holds', text

    def _on_check(self, calibration: Calibration, problem: Problem) -> Answer:
        years = years_since(calibration.record, problem.all_sets)
        updated = recalibrate(calibration, problem, years)
        sets, sigma = problem.all_sets, self.session.settings.given_sigma
        now = judge(calibration, sets, of_messages=True, sigma_position=sigma)
        return words.still_holds(updated, now)

    def _on_clear(self, request: Any) -> Answer:
        count = len(self.session.samples)
        old = self._archive.start_new()
        self.session.clear()
        told, kept = f'{counted(count, "pose")} cleared', f'; kept in {old}'
        told += kept * bool(old and count)
        return True, told + '; the calibration stays' * (self.session.calibration is not None)

    def _on_record(self, request: Any) -> Answer:
        self.session.recording = bool(request.data)
        return True, 'recording' if request.data else 'not recording: messages are not used'

    def _on_load(self, request: Any) -> Answer:
        self._refuse_if_busy()
        return self._identifying.loaded(self._keeper.load())

    # Topics out

    def _on_tick(self) -> None:
        self._boundary.tried('the time', self.take_time)
        self._boundary.tried('taking messages', self._take_messages)
        self._boundary.tried('the corrected pose', self._keeper.publish_pose)

    def _on_second(self) -> None:
        """Do the work of each second; a failing part does not stop the others."""
        tried = self._boundary.tried
        tried('taking messages', self._take_messages)
        tried('the journal', partial(self._keep, self._archive.write))
        status = tried('the status', self._publish_status) or ''
        tried('expected accuracy or next pose', self._guide.advise)
        self._diagnostics.publish(status, self._answers)

    def _publish_status(self) -> str:
        """Return the status; publish its first words when they change."""
        state, *rest = told = self.session.told(str(self._identifying.progress))
        trouble = textwrap.shorten(self._archive.trouble, STATUS_LENGTH // 2, placeholder=' ...; ')
        if self._inputs.failures:  # which may explain it
            state = textwrap.shorten(state, STATUS_LENGTH // 2, placeholder=' ...')
        text = '; '.join((f'{trouble} {state}', *self._inputs.failures, *rest))
        text = textwrap.shorten(text, STATUS_LENGTH, placeholder=' ...')
        if text != self._status_text:
            self._status_text = text
            self._status.publish(String(data=text))
        return '; '.join(told)

    def _answers(self) -> dict[str, Any]:
        last, observability = self._identifying.last, self._identifying.observability
        answers = {'last identification': last, 'observability': observability}
        return answers | self._guide.figures()

    def _answer(self, name: str, work: Job) -> Answer:
        answer = self._boundary.answer(name, work)
        return self._identifying.shortened(answer) if name == '~/identify' else answer

    def _answering(
        self, name: str, callback: Callable[[Any], Answer]
    ) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            def work() -> Answer:
                self._take_messages()
                return callback(request)

            response.success, response.message = self._boundary.answer(name, work)
            return response

        return answer


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until a signal ends it; return the exit status."""
    return run_node(CalibrationNode, arguments)


if __name__ == '__main__':
    sys.exit(main())
