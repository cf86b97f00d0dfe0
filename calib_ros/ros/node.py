# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node: topics in, services, corrected parameters out. `docs/node.md` describes it.

A timer takes the messages that wait (`inputs.py`) by the batch: the executor does not wake for
each of them. An identification runs on a thread of its own, on a snapshot of the samples, and its
answer is sent when it has ended.
"""

from __future__ import annotations

import os
import signal
import sys
import textwrap
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

# Small matrices only: a second BLAS thread costs more than it gives, on a busy cell above all.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.time_source import CLOCK_TOPIC
from rclpy.utilities import remove_ros_args
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from calib_ros.errors import CalibrationError, advice_on
from calib_ros.files.archive import Archive
from calib_ros.files.cameras import cameras_of
from calib_ros.files.waypoints import read_joints
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import Identification, Outlier
from calib_ros.identification.model_choice import identify_model
from calib_ros.identification.problem import Problem
from calib_ros.identification.recalibration import recalibrate, years_since
from calib_ros.progress import Progress
from calib_ros.report import words
from calib_ros.ros import to_ros
from calib_ros.ros.advisor import Guide
from calib_ros.ros.arguments import NODE, typed, usage
from calib_ros.ros.deferred import DeferredTrigger
from calib_ros.ros.diagnostics import Diagnostics
from calib_ros.ros.filer import Filer
from calib_ros.ros.inputs import Inputs, deserialised
from calib_ros.ros.outputs import Exportable, Keeper, Published
from calib_ros.ros.parameters import changed, declare_all, load_robot, refuse_unknown
from calib_ros.sampling.intake import Stream, feed, measured
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.problems import check_settings
from calib_ros.sampling.sample import Sample, named
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.sources import STANDARD, parse_sources

TAKING_PERIOD = 0.1
"""Time [s] between two times at which the messages that have come are taken, all at once: one at
a time, each in a cold cache, they cost three times as much."""
DIAGNOSTICS_PERIOD = 1.0
JOIN_TIMEOUT = 1.0
STATUS_LENGTH = 120
"""Most characters of the status: `ros2 topic echo` cuts texts at 128."""


class Snapshot(NamedTuple):
    """What an identification works on, and what it was called with."""

    problem: Problem
    model: str
    samples: tuple[Sample, ...]
    numbers: dict[Sample, int]
    origin: dict[str, Any]
    configuration: str
    warnings: tuple[str, ...]

    def numbers_of(self, outliers: Sequence[Outlier]) -> dict[Outlier, int]:
        """Return the numbers by which the operator knows the samples that are outliers."""
        frames = named(self.samples)
        known = {(each.stamp_ns, *frames.of(each)): self.numbers[each] for each in self.samples}
        sets = self.problem.sets
        return {
            each: known[each.stamp_ns, sets[each.set].base, sets[each.set].tool]
            for each in outliers
        }


class CalibrationNode(Node):  # type: ignore[misc]  # see pyproject.toml
    """Calibrates one robot from its joint states and measurements."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('calibration_node', **node_options)
        given = declare_all(self)
        home = Path(os.environ.get('ROS_HOME', '~/.ros')).expanduser()
        chain, urdf = load_robot(self, given)
        self._given = given
        self._archive = Archive(
            given.data_dir or home / 'calib_ros',
            f'{chain.name}_{given.serial}' if given.serial else chain.name,
            len(chain.joints),
            self._configuration,
        )
        self.session = CalibrationSession(
            chain, given.settings, self._on_sample, self._archive.remove
        )
        self.session.socket_distance = given.socket_distance
        self.session.pictures.cameras = cameras_of(given.settings.sources)
        self._filer = Filer(given.history, given.serial, chain)
        self._last = 'nothing identified yet'
        self._progress = Progress('identifying')
        self._observability = ''
        self._status_text = ''
        self.lost = ''
        """Why samples were lost at the end; empty when none were."""
        streams = self._streams()
        if given.resume:
            self._resume()
        self._inputs = Inputs(self, streams, self._guarded)
        refuse_unknown(self)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)
        latched = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._keeper = Keeper(self, self.session, self._archive, given, urdf, latched)
        self._status = self.create_publisher(String, '~/status', latched)
        self._residuals = self.create_publisher(MarkerArray, '~/residuals', latched)
        self._diagnostics = Diagnostics(
            self, self.session, self._archive, self._inputs, given.serial, self._answers
        )
        self._guide = Guide(
            self,
            self.session,
            latched,
            self._guarded,
            read_joints(given.candidates, chain) if given.candidates else None,
        )
        self._identify = DeferredTrigger(
            self, '~/identify', self._answer, self._snapshot, self._run
        )
        self._export = DeferredTrigger(
            self, '~/export', self._answer, self._to_export, self._keeper.export
        )
        self._save = DeferredTrigger(self, '~/save', self._answer, self._to_save, self._on_save)
        self._check = DeferredTrigger(
            self, '~/check', self._answer, self._to_check, self._on_check
        )
        for kind, name, callback in (
            (Trigger, '~/cancel', self._on_cancel),
            (Trigger, '~/capture', self._on_capture),
            (Trigger, '~/remove_last', self._on_remove_last),
            (Trigger, '~/validate', self._on_validate),
            (Trigger, '~/clear', self._on_clear),
            (Trigger, '~/load', self._on_load),
            (SetBool, '~/record', self._on_record),
        ):
            self.create_service(kind, name, self._answering(name, callback))
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # ROS time stands still, and jumps
        for period, work in (
            (DIAGNOSTICS_PERIOD, self._on_second),
            (TAKING_PERIOD, self._on_tick),
        ):
            self.create_timer(period, self._guarded(work), clock=steady)
        self._load_at_start()

    def announce(self) -> None:
        """Say that the node is ready, once an executor serves it."""
        self.get_logger().info(
            f'ready to calibrate {self.session.chain.name}: joints '
            f'{", ".join(self.session.joint_names)}; samples are kept in {self._archive.folder}'
        )

    def close(self) -> bool:
        """Stop; return False when an identification still runs and must not be waited for."""
        working = (self._identify, self._save, self._export, self._check, self._guide)
        ended = [each.join(JOIN_TIMEOUT) for each in working]
        self._take_messages()
        self.session.finish()
        self._archive.close()
        self.lost = self._archive.error
        if self.lost:
            self.get_logger().error(f'samples are lost: {self.lost}')
        self.destroy_node()
        return all(ended)

    # Parameters

    def _configuration(self) -> str:
        """Return what this node is set to as a parameter file."""
        given = self._given
        more = {name: str(link) for name, link in given.links.items() if link}
        if given.serial:
            more['serial'] = given.serial
        return words.configuration_yaml(given.chain, self.session.settings, **more)

    def _check_parameters(self, changes: Sequence[Any]) -> SetParametersResult:
        """Refuse settings that no identification could use."""
        try:
            check_settings(self.session.chain, changed(self.session.settings, changes))
        except CalibrationError as err:
            return SetParametersResult(successful=False, reason=str(err))
        return SetParametersResult(successful=True)

    def _take_parameters(self, changes: Sequence[Any]) -> None:
        """Take over settings that have changed while the node runs."""
        self._take_messages()
        settings = changed(self.session.settings, changes)
        if settings != self.session.settings:
            self.session.change(settings)

    # Topics in

    def _streams(self) -> list[Stream]:
        """Return what is heard: joint states and measurements."""
        settings = self.session.settings
        streams = [
            Stream(topic, JOINT_STATE) for topic in settings.joint_topics or ('joint_states',)
        ]
        sources = parse_sources(settings.sources) or STANDARD
        return streams + measured(
            sources, {source.topic: 'geometry_msgs/msg/PoseStamped' for source in sources}
        )

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Return the subscriptions that an executor serves: not the inputs, which a timer does."""
        inputs = getattr(self, '_inputs', ())  # rclpy asks while it makes the node
        return (each for each in super().subscriptions if each not in inputs)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., None], *args: Any, **more: Any
    ) -> Subscription:
        """Subscribe; a time that cannot be must not end the node."""
        if topic == CLOCK_TOPIC:
            callback = self._of_times(callback)
        return super().create_subscription(msg_type, topic, callback, *args, **more)

    def _of_times(self, callback: Callable[..., None]) -> Callable[..., None]:
        def checked(message: Any) -> None:
            if message.clock.sec < 0:
                words = f'negative times on {CLOCK_TOPIC} are not used, {message.clock.sec} s say'
                self.get_logger().warning(words, once=True)
            else:
                callback(message)

        return checked

    def _take_messages(self) -> None:
        """Take what has come in the order in which it came."""
        for problem in feed(self.session, self._inputs.take(), deserialised):
            self.get_logger().error(problem)

    # The journal

    def _on_sample(self, sample: Sample) -> None:
        before = self._archive.error
        self._archive.add(sample)
        if self._archive.error and not before:
            self.get_logger().error(f'samples are kept in memory only: {self._archive.error}')

    def _resume(self) -> None:
        """Go on with the newest journal of this robot."""
        samples, warnings = self._archive.resume()
        self.session.restore(samples)
        for warning in warnings:
            self.get_logger().warning(warning)
        if self._archive.journal is not None:
            self.get_logger().info(f'resumed {len(samples)} samples of {self._archive.journal}')

    def _load_at_start(self) -> None:
        """Publish the calibration of before if that is wanted, or say that there is one."""
        path, wanted = self._keeper.at_start()
        log = self.get_logger()
        if wanted:
            try:
                log.info(f'{self._on_load(None)[1]}: it is published')
            except Exception as err:  # whatever is wrong with a file, samples can be taken
                self._last = f'no calibration is published at the start: {err}'
                log.error(self._last)
        elif path is not None:
            log.info(
                f'no calibration is published yet. There is {path}: call ~/load, or start with '
                'autoload:=true'
            )
        elif self._given.autoload:
            log.info(f'autoload: there is no saved calibration in {self._archive.folder} yet')

    # Services

    def _snapshot(self) -> Snapshot:
        """Return the problem and all that goes with it, as they are now."""
        self._take_messages()
        problem = self.session.problem()
        samples = tuple(self.session.usable)
        origin = {
            'robot_serial': self._given.serial,
            'topics': self._inputs.topics,
            'first_stamp_ns': min(sample.stamp_ns for sample in samples),
            'last_stamp_ns': max(sample.stamp_ns for sample in samples),
            'samples': len(samples),
            'journal': str(self._archive.journal or ''),
        }
        model = self.session.settings.model
        numbers = {sample: k + 1 for k, sample in enumerate(self.session.samples)}
        warnings = self.session.warnings
        found = Snapshot(problem, model, samples, numbers, origin, self._configuration(), warnings)
        self._progress.begin()
        return found

    def _run(self, given: Snapshot) -> tuple[bool, str]:
        """Identify, on a thread of its own; publish only what is accepted."""
        with self._progress.running():
            result = identify_model(given.problem, given.model, self._progress)
        numbers = given.numbers_of(result.outliers)
        self._last = words.summary(result, numbers, given.warnings)
        self._observability = words.observability_in_words(result)
        self._residuals.publish(
            to_ros.residual_markers(
                result,
                given.problem.sets,
                self.get_parameter('marker_scale').value,
                self.get_clock().now().to_msg(),
            )
        )
        if result.accepted:
            found = Calibration.of(result, given.origin, named(given.samples).owners)
            page = partial(self._page, given, result)
            published = Published(found.dump(), given.configuration, page)
            self._keeper.adopt(found, published, given.samples)
            self._guide.show(found)
        elif self.session.calibration is not None:
            self._last += '; the last good calibration stays'
        self._last += self._filer.identified(given.problem, result, self.session.settings)
        return result.accepted, self._last

    def _page(self, given: Snapshot, result: Identification) -> str | None:
        """Return the report of an identification, None where its extra is missing."""
        from calib_ros.report.page import Origin, inputs_of, render
        from calib_ros.report.poses import poses_of
        from calib_ros.report.reports import identification_report

        journal = given.origin['journal']
        files = inputs_of([Path(journal)] if journal else [])
        origin = Origin(files, serial=self._given.serial, settings=given.configuration)
        poses = poses_of(given.problem, result)
        return render(identification_report(given.problem, result, poses, origin))

    def _on_cancel(self, request: Any) -> tuple[bool, str]:
        return self._progress.cancel()

    def _on_capture(self, request: Any) -> tuple[bool, str]:
        socket = self.get_parameter('socket').value
        count, why = self.session.capture(socket)
        if not count:
            return False, f'no sample taken: {why}'
        if socket:
            return True, f'sample {len(self.session.samples)} taken: ball in socket {socket}'
        taken = self.session.samples[-count:]
        words = ', '.join(
            f'{each.count} measurements, spread {1e3 * each.spread:.3f} mm' for each in taken
        )
        return True, f'sample {len(self.session.samples)} taken ({words})'

    def _on_remove_last(self, request: Any) -> tuple[bool, str]:
        self.session.remove_last()
        return True, f'sample {len(self.session.samples) + 1} removed'

    def _on_validate(self, request: Any) -> tuple[bool, str]:
        figures = self.session.validate()
        calibration = self.session.calibration
        assert calibration is not None  # else there was nothing to judge
        holds, text = words.verdict(calibration, *figures)
        return holds, text + self._filer.validated(self.session, figures, holds)

    def _to_check(self) -> tuple[Calibration, Problem]:
        self._take_messages()
        return self.session.recent()

    def _on_check(self, found: tuple[Calibration, Problem]) -> tuple[bool, str]:
        calibration, problem = found
        return words.checked(recalibrate(calibration, problem, years_since(calibration.record)))

    def _on_clear(self, request: Any) -> tuple[bool, str]:
        count = len(self.session.samples)
        old = self._archive.begin_anew()
        self.session.clear()
        kept = f'; they stay in {old}' if old else ''
        return True, f'{count} samples cleared{kept}; the calibration stays'

    def _on_record(self, request: Any) -> tuple[bool, str]:
        self.session.recording = bool(request.data)
        return True, 'recording' if request.data else 'not recording: messages are not used'

    def _to_save(self) -> Published:
        self._take_messages()
        return self._keeper.published

    def _on_save(self, published: Published) -> tuple[bool, str]:
        return True, f'saved to {", ".join(map(str, self._keeper.save(published)))}'

    def _on_load(self, request: Any) -> tuple[bool, str]:
        self._last = f'loaded {self._keeper.load()}'
        if self.session.calibration is not None:
            self._guide.show(self.session.calibration)
        return True, self._last

    def _to_export(self) -> Exportable:
        self._take_messages()
        return self._keeper.exportable()

    # Topics out

    def _on_tick(self) -> None:
        self._diagnostics.tried('taking messages', self._take_messages)
        self._diagnostics.tried('the corrected pose', self._keeper.publish_pose)

    def _on_second(self) -> None:
        """Do what is due once a second; a part that fails does not keep the others from it."""
        tried = self._diagnostics.tried
        tried('taking messages', self._take_messages)
        tried('the journal', self._archive.write)
        status = tried('the status', self._publish_status) or ''
        tried('the next pose', self._guide.advise)
        self._diagnostics.publish(status)

    def _publish_status(self) -> str:
        """Return how the session goes; its first words are published when they have changed."""
        words = self.session.status(str(self._progress))
        trouble = textwrap.shorten(self._archive.trouble, STATUS_LENGTH // 2, placeholder=' ...; ')
        text = textwrap.shorten(f'{trouble} {words}', STATUS_LENGTH, placeholder=' ...')
        if text != self._status_text:
            self._status_text = text
            self._status.publish(String(data=text))
        return words

    def _answers(self) -> dict[str, Any]:
        """Return for the diagnostics what came of calls and requests."""
        return {
            'last identification': self._last,
            'observability': self._observability,
            **self._guide.figures(),
        }

    # One boundary around every callback: an exception would end the spinning

    def _guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except InvalidHandle:  # the node was ended meanwhile: nobody hears any more
                return
            except Exception:
                self.get_logger().error(f'internal error: {traceback.format_exc()}')

        return guarded

    def _answering(
        self, name: str, callback: Callable[[Any], tuple[bool, str]]
    ) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            def work() -> tuple[bool, str]:
                self._take_messages()
                return callback(request)

            response.success, response.message = self._answer(name, work)
            return response

        return answer

    def _answer(self, name: str, work: Callable[[], tuple[bool, str]]) -> tuple[bool, str]:
        """Run the work of a service; an error is its answer. Who reads the log sees it, too."""
        try:
            success, text = work()
        except CalibrationError as err:
            success, text = False, str(err)
        except OSError as err:
            success, text = False, '; '.join(filter(None, (str(err), advice_on(err))))
        except Exception as err:
            self.get_logger().error(f'internal error: {traceback.format_exc()}')
            success, text = False, f'internal error, see the log: {err!r}'
        if not success:
            self.get_logger().warning(f'{name}: {text}')
        elif text:
            self.get_logger().info(f'{name}: {text}')
        return bool(success), str(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit status.

    rclpy must not see the signals: its handler invalidates the context while messages are taken.
    """
    command = typed(sys.argv if arguments is None else [NODE, *arguments])
    parser = usage(NODE)
    try:
        parser.parse_args(remove_ros_args(command)[1:])
    except rclpy_implementation.UnknownROSArgsError as err:
        parser.error(f'unknown ROS arguments: {err}')
    except rclpy_implementation.RCLInvalidROSArgsError as err:
        parser.error(str(err))
    stop = threading.Event()

    def on_signal(number: int, frame: Any) -> None:
        stop.set()

    def handle_signals(handler: Any) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, handler)

    handle_signals(on_signal)
    node: CalibrationNode | None = None
    executor: Any = None
    status, finished = 0, True
    try:
        rclpy.init(args=command, signal_handler_options=SignalHandlerOptions.NO)
        node = CalibrationNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.announce()
        while not stop.is_set() and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
    except ExternalShutdownException:
        pass
    except (CalibrationError, ParameterException, rclpy_implementation.RCLError) as err:
        print(f'calibration_node: {err}', file=sys.stderr)
        status = 1
    finally:
        handle_signals(signal.SIG_IGN)  # a second one must not interrupt the clean-up
        if node is not None:
            finished = node.close()
            status = 1 if node.lost else status
        if executor is not None:
            executor.shutdown()
        rclpy.try_shutdown()
    if not finished:  # the interpreter cannot end while a thread computes
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


if __name__ == '__main__':
    sys.exit(main())
