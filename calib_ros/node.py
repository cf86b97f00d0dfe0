# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node: topics in, services, corrected parameters out. `docs/node.md` describes it.

Messages wait in the queues of their subscriptions, and a timer takes them by the batch,
serialised: the executor does not wake for each of them. An identification runs on a thread of its
own, on a snapshot of the samples, and its answer is sent when it has ended.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

# Small matrices only: a second BLAS thread costs more than it gives, on a busy cell above all.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy._rclpy_pybind11 import RCLError  # has no public name in Jazzy
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from calib_ros import outgoing, report
from calib_ros.archive import Archive
from calib_ros.chain import Chain
from calib_ros.config import (
    STARTUP,
    URDF_SUFFIXES,
    Settings,
    calibration_record,
    load_chain,
    parse_calibration,
    read_text,
)
from calib_ros.deferred import DeferredTrigger
from calib_ros.errors import CalibrationError, ConfigError, InputError, UnknownNameError
from calib_ros.export import exports
from calib_ros.guide import Guide
from calib_ros.intake import Stream, feed
from calib_ros.messages import JOINT_STATE
from calib_ros.problem import Problem
from calib_ros.samples import Sample
from calib_ros.selection import identify_model
from calib_ros.session import Account, CalibrationSession, check_settings
from calib_ros.sources import STANDARD, parse_sources
from calib_ros.urdf import chain_from_urdf, corrected_urdf
from calib_ros.waypoints import read_joints

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an rclpy from before it had one
    EventsExecutor = None

INPUT_QUEUE = 2000
"""Messages of a topic that may wait while the node is busy; what comes on top is lost."""
TAKING_PERIOD = 0.1
"""Time [s] between two times at which the messages that have come are taken, all at once: one at
a time, each in a cold cache, they cost three times as much."""
DIAGNOSTICS_PERIOD = 1.0
JOIN_TIMEOUT = 1.0
DESCRIPTION_WAIT = 10.0
"""Time [s] for which the node waits for the robot's description."""
SILENCE = 5.0
"""A source that has been heard before and is silent for so long [s] is reported."""


@dataclass
class Hearing:
    """What has been heard on one topic; times [s] are those of the monotonic clock."""

    count: int = 0
    before: int = 0
    rate: float = 0.0
    last: float | None = None
    deaf: bool = False
    """True when a publisher offers a QoS that is not asked for."""
    lost: int = 0
    """Messages that got lost on the way, as DDS tells by their numbers."""
    full: int = 0
    """How often the queue was found full, so that messages may be lost."""
    lost_before: int = 0
    losing: bool = False
    """True when either has grown between the last two looks."""

    def look(self, now: float, span: float) -> None:
        """Note how many messages came in the last `span`."""
        fresh, self.before = self.count - self.before, self.count
        self.rate = fresh / span
        lost, before = self.lost + self.full, self.lost_before
        self.losing, self.lost_before = lost > before, lost
        if fresh:
            self.last = now

    @property
    def silent(self) -> bool:
        """Tell whether it has been heard before and is not any more."""
        return self.last is not None and time.monotonic() - self.last > SILENCE


class Snapshot(NamedTuple):
    """What an identification works on, and what it was called with."""

    problem: Problem
    model: str
    samples: tuple[Sample, ...]
    origin: dict[str, Any]
    configuration: str


class Published(NamedTuple):
    """A calibration as the text of a file, and by which configuration it was made, if known."""

    text: str
    configuration: str


class CalibrationNode(Node):
    """Calibrates one robot from its joint states and measurements."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('calibration_node', **node_options)
        chain_name = self._declare(
            'chain',
            '',
            'chain file or URDF of the robot, the name of one that calib_ros ships, or '
            'robot_description: the URDF on that topic',
        )
        links = {
            name: self._declare(name, '', f'of a URDF: {text}') or None
            for name, text in (
                ('base_link', 'where the arm starts; default: its root'),
                ('tip_link', 'where the arm ends; default: tool0, flange or its only end'),
            )
        }
        self._declare('executor', 'events', 'events or single_threaded: how messages are taken')
        self._serial = self._declare('serial', '', 'serial number of the robot, for the record')
        folder = self._declare(
            'data_dir', '', 'folder of journals and calibrations; default: one under ROS_HOME'
        )
        resume = self._declare('resume', False, 'go on with the newest journal of this robot')
        self._declare(
            'target_filename', '', 'file that ~/save writes; default: a new one in data_dir', False
        )
        self._declare(
            'calibration_filename', '', 'file that ~/load reads; default: the newest saved', False
        )
        self._declare(
            'marker_scale', 200.0, 'residual vectors are drawn so many times as long', False
        )
        candidates = self._declare(
            'candidates', '', 'table of poses (q1 ... qn) for ~/next_pose to choose; default: any'
        )
        settings = Settings(
            **{item.name: self._declare_setting(item) for item in fields(Settings)}
        )
        self._refuse_unknown_parameters()
        if not chain_name:
            raise ConfigError(
                'parameter "chain" is not set: give the chain file of the robot, for example '
                '--ros-args -p chain:=ur10e'
            )
        home = Path(os.environ.get('ROS_HOME', '~/.ros')).expanduser()
        chain, self._urdf = self._load_robot(chain_name, links)
        self._chain_name, self._links = chain_name, links
        self._archive = Archive(
            Path(folder).expanduser() if folder else home / 'calib_ros',
            f'{chain.name}_{self._serial}' if self._serial else chain.name,
            len(chain.joints),
            self._configuration,
        )
        self.session = CalibrationSession(chain, settings, self._on_sample)
        self._last = 'nothing identified yet'
        self._observability = ''
        self._published = Published('', '')
        self._publishing = threading.Lock()
        self._dropped_before: dict[str, int] = {}
        self._heard: dict[str, Hearing] = {}
        self._looked_at = time.monotonic()
        self._status_text = ''
        self._failed: dict[str, str] = {}  # parts of the last second, and how
        self._logged: dict[str, str] = {}
        self._posed: tuple[int, Sequence[float]] | None = None
        self._inputs: dict[Subscription, tuple[Stream, Hearing]] = {}
        self._sources = parse_sources(settings.sources) or STANDARD
        if resume:
            self._resume()
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)
        self._subscribe()
        latched = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._dh_parameters = self.create_publisher(Float64MultiArray, '~/dh_parameters', latched)
        self._calibration = self.create_publisher(String, '~/calibration', latched)
        self._status = self.create_publisher(String, '~/status', latched)
        self._residuals = self.create_publisher(MarkerArray, '~/residuals', latched)
        self._corrected_pose = self.create_publisher(PoseStamped, '~/corrected_pose', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._guide = Guide(
            self,
            self.session,
            latched,
            self._guarded,
            read_joints(Path(candidates).expanduser(), chain) if candidates else None,
        )
        self._identify = DeferredTrigger(
            self, '~/identify', self._answer, self._snapshot, self._run
        )
        self._export = DeferredTrigger(
            self, '~/export', self._answer, self._to_export, self._write_exports
        )
        for kind, name, callback in (
            (Trigger, '~/capture', self._on_capture),
            (Trigger, '~/remove_last', self._on_remove_last),
            (Trigger, '~/validate', self._on_validate),
            (Trigger, '~/clear', self._on_clear),
            (Trigger, '~/save', self._on_save),
            (Trigger, '~/load', self._on_load),
            (SetBool, '~/record', self._on_record),
        ):
            self.create_service(kind, name, self._answering(callback))
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # ROS time stands still, and jumps
        for period, work in (
            (DIAGNOSTICS_PERIOD, self._on_second),
            (TAKING_PERIOD, self._on_tick),
        ):
            self.create_timer(period, self._guarded(work), clock=steady)
        self.get_logger().info(
            f'ready to calibrate {self.session.chain.name}: joints '
            f'{", ".join(self.session.joint_names)}; samples are kept in {self._archive.folder}'
        )

    def close(self) -> bool:
        """Stop; return False when an identification still runs and must not be waited for."""
        working = (self._identify, self._export, self._guide)
        ended = [each.join(JOIN_TIMEOUT) for each in working]
        self._take_messages()
        self.session.finish()
        self._archive.close()
        if self._archive.error:
            self.get_logger().error(f'samples are lost: {self._archive.error}')
        self.destroy_node()
        return all(ended)

    def _load_robot(self, name: str, links: dict[str, str | None]) -> tuple[Chain, str]:
        """Return the nominal chain, and the URDF that it comes from if it does."""
        if name == 'robot_description':
            qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            found, message = wait_for_message(
                String, self, 'robot_description', qos_profile=qos, time_to_wait=DESCRIPTION_WAIT
            )
            if not found:
                raise ConfigError(
                    f'no robot_description has come within {DESCRIPTION_WAIT:g} s: start '
                    'robot_state_publisher first, or set chain to a file'
                )
            text = message.data
        elif Path(name).suffix in URDF_SUFFIXES:
            text = read_text(Path(name))
        elif any(links.values()):
            raise ConfigError('base_link and tip_link are of use with a URDF only')
        else:
            return load_chain(name), ''
        return replace(chain_from_urdf(text, **links), base=None, tool=None), text

    # Parameters

    def _configuration(self) -> str:
        """Return what this node is set to as a parameter file."""
        more = {name: link for name, link in self._links.items() if link}
        if self._serial:
            more['serial'] = self._serial
        return report.configuration_yaml(self._chain_name, self.session.settings, **more)

    def _declare(
        self, name: str, default: Any, text: str, read_only: bool = True, **ranges: Any
    ) -> Any:
        descriptor = ParameterDescriptor(description=text, read_only=read_only, **ranges)
        return self.declare_parameter(name, default, descriptor).value

    def _declare_setting(self, item: Any) -> Any:
        text, lower = item.metadata['text'], item.metadata.get('lower')
        fixed = item.name in STARTUP
        if isinstance(item.default, tuple):  # an empty list has no type in ROS, [''] has one
            return _names(self._declare(item.name, [''], text, fixed))
        if isinstance(item.default, str):
            return self._declare(item.name, item.default, text, fixed)
        if isinstance(item.default, int):
            span = IntegerRange(from_value=int(lower), to_value=2**31 - 1)
            return self._declare(item.name, item.default, text, fixed, integer_range=[span])
        # Declared with any type first, so that "max_gap: 1" is taken as 1.0.
        loose = ParameterDescriptor(dynamic_typing=True)
        value = self.declare_parameter(item.name, item.default, loose).value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f'parameter "{item.name}" must be a number, not {value!r}')
        self.undeclare_parameter(item.name)
        span = FloatingPointRange(from_value=float(lower), to_value=1e9)
        descriptor = ParameterDescriptor(
            description=text, read_only=fixed, floating_point_range=[span]
        )
        return self.declare_parameter(
            item.name, float(value), descriptor, ignore_override=True
        ).value

    def _refuse_unknown_parameters(self) -> None:
        """Refuse parameters that were set but do not exist; ROS ignores them."""
        known = [*self._parameters]
        for name in self._parameter_overrides:
            if name not in known and not name.startswith(('qos_overrides.', 'use_sim_time')):
                raise UnknownNameError('parameter', name, known)

    def _check_parameters(self, changes: Sequence[Any]) -> SetParametersResult:
        """Refuse settings that no identification could use."""
        try:
            check_settings(self.session.chain, self._changed(changes))
        except CalibrationError as err:
            return SetParametersResult(successful=False, reason=str(err))
        return SetParametersResult(successful=True)

    def _take_parameters(self, changes: Sequence[Any]) -> None:
        """Take over settings that have changed while the node runs."""
        self._take_messages()
        settings = self._changed(changes)
        if settings != self.session.settings:
            self.session.change(settings)

    def _changed(self, changes: Sequence[Any]) -> Settings:
        known = {item.name: item.default for item in fields(Settings)}
        values = {
            each.name: _names(each.value) if isinstance(known[each.name], tuple) else each.value
            for each in changes
            if each.name in known
        }
        return replace(self.session.settings, **values)

    # Topics in

    def _subscribe(self) -> None:
        overriding = QoSOverridingOptions(
            (QoSPolicyKind.RELIABILITY, QoSPolicyKind.DEPTH, QoSPolicyKind.HISTORY)
        )
        streams = [
            Stream(topic, JOINT_STATE)
            for topic in self.session.settings.joint_topics or ('joint_states',)
        ]
        streams += [
            Stream(source.topic, source.type or 'geometry_msgs/msg/PoseStamped', source)
            for source in self._sources
        ]
        for stream in streams:
            heard = self._heard.setdefault(self.resolve_topic_name(stream.topic), Hearing())
            try:
                subscription = self.create_subscription(
                    _message_type(stream.type),
                    stream.topic,
                    lambda data: None,  # see `subscriptions`
                    QoSProfile(  # one for each: overriding changes it
                        depth=INPUT_QUEUE,
                        reliability=qos_profile_sensor_data.reliability,
                        durability=qos_profile_sensor_data.durability,
                    ),
                    qos_overriding_options=overriding,
                    event_callbacks=self._noting(heard),
                    raw=True,
                )
            except RuntimeError as err:  # what rclpy raises for a policy that there is not
                raise ConfigError(f'topic "{stream.topic}": {err}') from err
            if subscription.qos_profile.depth < 1:
                raise ConfigError(f'the depth of qos_overrides for "{stream.topic}" must be >= 1')
            self._inputs[subscription] = stream, heard

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Return the subscriptions that an executor serves: not the inputs, which a timer does."""
        inputs = getattr(self, '_inputs', {})  # rclpy asks while it makes the node
        return (each for each in super().subscriptions if each not in inputs)

    def _take_messages(self) -> None:
        """Take what has come in the order in which it came."""
        come = []
        for subscription, (stream, heard) in self._inputs.items():
            found = _waiting(subscription)
            heard.count += len(found)
            heard.full += len(found) >= subscription.qos_profile.depth
            come += [(stamp, stream, data) for stamp, data in found]
        come.sort(key=itemgetter(0))
        batch = [(stream, data) for _, stream, data in come]
        for problem in feed(self.session, batch, _deserialised):
            self.get_logger().error(problem)

    def _noting(self, heard: Hearing) -> SubscriptionEventCallbacks:
        def note_deaf(event: Any) -> None:
            heard.deaf = True

        def note_lost(event: Any) -> None:
            heard.lost = event.total_count  # the change leaves out what came with others

        return SubscriptionEventCallbacks(
            incompatible_qos=self._guarded(note_deaf), message_lost=self._guarded(note_lost)
        )

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

    # Services

    def _snapshot(self) -> Snapshot:
        """Return the problem and all that goes with it, as they are now."""
        self._take_messages()
        problem = self.session.problem()
        samples = tuple(self.session.samples)
        origin = {
            'robot_serial': self._serial,
            'topics': [topic for topic, heard in self._heard.items() if heard.count],
            'first_stamp_ns': min(sample.stamp_ns for sample in samples),
            'last_stamp_ns': max(sample.stamp_ns for sample in samples),
            'samples': len(samples),
            'journal': str(self._archive.journal or ''),
        }
        model = self.session.settings.model
        return Snapshot(problem, model, samples, origin, self._configuration())

    def _run(self, given: Snapshot) -> tuple[bool, str]:
        """Identify, on a thread of its own; publish only what is accepted."""
        result = identify_model(given.problem, given.model)
        self._last = report.summary(result)
        self._observability = report.observability_in_words(result)
        self._residuals.publish(
            outgoing.residual_markers(
                result,
                given.problem.sets,
                self.get_parameter('marker_scale').value,
                self.get_clock().now().to_msg(),
            )
        )
        if result.accepted:
            text = report.calibration_yaml(result, given.origin)
            with self._publishing:
                self.session.adopt(result, given.samples)
                self._publish_calibration(result.chain, Published(text, given.configuration))
            self._guide.show(result)
        elif self.session.calibration is not None:
            self._last += '; the last good calibration stays'
        return result.accepted, self._last

    def _on_capture(self, request: Any) -> tuple[bool, str]:
        count, why = self.session.capture()
        if not count:
            return False, f'no sample taken: {why}'
        taken = self.session.samples[-count:]
        words = ', '.join(
            f'{each.count} measurements, spread {1e3 * each.spread:.3f} mm' for each in taken
        )
        return True, f'sample {len(self.session.samples)} taken ({words})'

    def _on_remove_last(self, request: Any) -> tuple[bool, str]:
        self._archive.remove(self.session.remove_last())
        return True, f'sample {len(self.session.samples) + 1} removed'

    def _on_validate(self, request: Any) -> tuple[bool, str]:
        return report.verdict(self.session.calibration, *self.session.validate())

    def _on_clear(self, request: Any) -> tuple[bool, str]:
        count = len(self.session.samples)
        self.session.clear()
        old = self._archive.begin_anew()
        kept = f'; they stay in {old}' if old else ''
        return True, f'{count} samples cleared{kept}; the calibration stays'

    def _on_record(self, request: Any) -> tuple[bool, str]:
        self.session.recording = bool(request.data)
        return True, 'recording' if request.data else 'not recording: messages are not used'

    def _on_save(self, request: Any) -> tuple[bool, str]:
        if not self._published.text:
            return False, 'there is no accepted calibration to save: call ~/identify first'
        target = self.get_parameter('target_filename').value
        path = self._archive.save(*self._published, Path(target).expanduser() if target else None)
        return True, f'saved to {path}'

    def _to_export(self) -> tuple[Chain, str, Any]:
        """Return the calibrated chain, its text, and the joint values (N, n) of the samples."""
        self._take_messages()
        if self.session.calibration is None:
            raise InputError('there is no calibration to export: call ~/identify or ~/load first')
        joints = [sample.joints for sample in self.session.samples]
        with self._publishing:
            return self.session.calibration.chain, self._published.text, joints or None

    def _write_exports(self, given: tuple[Chain, str, Any]) -> tuple[bool, str]:
        """Write a calibration in all forms, on a thread of its own."""
        chain, text, joints = given
        found = exports(chain, self.session.chain, joints, calibration_record(text))
        files = {each.name: each.content for each in found}
        if self._urdf:
            files['corrected.urdf'] = corrected_urdf(self._urdf, chain, **self._links)
        return True, f'exported to {self._archive.export(files)}: {", ".join(files)}'

    def _on_load(self, request: Any) -> tuple[bool, str]:
        name = self.get_parameter('calibration_filename').value
        path = Path(name).expanduser() if name else self._archive.newest_calibration()
        if path is None:
            raise InputError(
                f'there is no saved calibration of {self.session.chain.name} in '
                f'{self._archive.folder}: set calibration_filename'
            )
        text = read_text(path)
        chain, record = parse_calibration(
            text, str(path), self.session.chain, self.session.settings
        )
        serial = record.get('robot_serial')
        if serial and self._serial and serial != self._serial:
            raise InputError(
                f'{path} is the calibration of the robot with serial "{serial}", this is '
                f'"{self._serial}"'
            )
        with self._publishing:
            self.session.load(chain, record.get('rms_mm_after'), record.get('world_frame', ''))
            self._publish_calibration(chain, Published(text, ''))
        self._last = f'loaded {path}'
        return True, self._last

    # Topics out

    def _publish_calibration(self, chain: Chain, published: Published) -> None:
        self._published = published
        self._dh_parameters.publish(outgoing.dh_parameters(chain))
        self._calibration.publish(String(data=published.text))

    def _on_tick(self) -> None:
        self._take_messages()
        self._publish_corrected_pose()

    def _publish_corrected_pose(self) -> None:
        calibration = self.session.calibration
        latest = self.session.latest
        if calibration is None or latest is None or latest is self._posed:
            return
        self._posed = latest
        stamp_ns, values = latest
        self._corrected_pose.publish(
            outgoing.pose(calibration.chain, values, stamp_ns, calibration.world_frame)
        )

    def _on_second(self) -> None:
        """Do what is due once a second; a part that fails does not keep the others from it."""
        self._failed = {}
        self._tried('taking messages', self._take_messages)
        self._tried('the journal', self._archive.write)
        status = self._tried('the status', self._publish_status) or ''
        self._tried('the next pose', self._guide.advise)
        self._tried('the rates', self._look)
        account = self._tried('the account', self.session.account)
        level, words, figures = DiagnosticStatus.OK, '', {}
        if account is not None:
            judged = self._tried('judging', lambda: self._judged(account))
            level, words = judged or (level, words)
            figures = self._tried('the figures', lambda: self._figures(account)) or {}
        if self._failed:
            level = DiagnosticStatus.ERROR
            words = ''.join(f'{text}; ' for text in self._failed.values()) + words
        name = f'{self.get_fully_qualified_name().lstrip("/")}: calibration'
        message = DiagnosticArray(
            status=[outgoing.status(name, self._serial, level, f'{words}{status}', figures)]
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def _tried(self, what: str, work: Callable[[], Any]) -> Any:
        """Return what work returns; None when it fails, which the log and `_failed` tell then."""
        try:
            return work()
        except Exception as err:
            self._failed[what] = f'{what} failed: {err!r}'
            if self._logged.get(what) != str(err):  # not every second
                self._logged[what] = str(err)
                self.get_logger().error(f'internal error: {traceback.format_exc()}')
            return None

    def _publish_status(self) -> str:
        """Return the status, which is published when it has changed."""
        text = self.session.status()
        if text != self._status_text:
            self._status_text = text
            self._status.publish(String(data=text))
        return text

    def _look(self) -> None:
        """Note the rates at which messages come."""
        now = time.monotonic()
        span, self._looked_at = now - self._looked_at, now
        for heard in self._heard.values():
            heard.look(now, span)

    def _judged(self, account: Account) -> tuple[bytes, str]:
        """Return how grave what is wrong is, and what it is in words."""
        wrong = [
            f'nothing is heard on {topic} any more'
            for topic, heard in self._heard.items()
            if heard.silent
        ]
        wrong += [
            f'{topic} is published best effort, but reliable is asked for'
            for topic, heard in self._heard.items()
            if heard.deaf and not heard.count
        ]
        wrong += self._of_other_types()
        losing = [topic for topic, heard in self._heard.items() if heard.losing]
        if losing:
            wrong.append(f'messages get lost on {", ".join(losing)}')
        fresh = {
            cause: count
            for cause, count in account.dropped.items()
            if count > self._dropped_before.get(cause, 0)
        }
        self._dropped_before = account.dropped
        if fresh:
            wrong.append(f'messages are dropped ({", ".join(fresh)})')
        level = DiagnosticStatus.WARN if wrong else DiagnosticStatus.OK
        if self._archive.error:
            wrong.insert(0, f'samples are in memory only: {self._archive.error}')
            level = DiagnosticStatus.ERROR
        return level, ''.join(f'{text}; ' for text in wrong)

    def _of_other_types(self) -> list[str]:
        """Return in words what is published as another type on topics that are not heard."""
        found = {}
        for subscription, (stream, heard) in self._inputs.items():
            topic = subscription.topic_name
            infos = [] if heard.count else self.get_publishers_info_by_topic(topic)
            for kind in {info.topic_type for info in infos} - {stream.type}:
                found[topic, kind] = f'{topic} is published as {kind}, not as {stream.type}'
        return [found[key] for key in sorted(found)]

    def _figures(self, account: Account) -> dict[str, Any]:
        now, delay = time.monotonic(), self.session.delay
        heard = {topic: heard for topic, heard in self._heard.items() if heard.last is not None}
        return {
            'robot': self.session.chain.name,
            'recording': self.session.recording,
            'calibrated': self.session.calibration is not None,
            'last identification': self._last,
            'observability': self._observability,
            **self._guide.figures(),
            'joint states': account.joint_states,
            'poses': account.poses,
            'poses waiting': account.waiting,
            'samples': account.samples,
            'held-out samples': account.held_out,
            'configurations': account.configurations,
            'journal': self._archive.journal or '',
            'delay [s]': 'not known' if delay is None else f'{delay.seconds:.4f}',
            **{f'rate of {topic} [Hz]': f'{each.rate:.1f}' for topic, each in heard.items()},
            **{f'age of {topic} [s]': f'{now - each.last:.1f}' for topic, each in heard.items()},
            **{f'lost on {topic}': each.lost for topic, each in heard.items()},
            **{f'queue of {topic} full': each.full for topic, each in heard.items()},
            **{f'not used {cause}': count for cause, count in account.unused.items()},
            **{f'dropped {cause}': count for cause, count in account.dropped.items()},
            **{f'note {cause}': count for cause, count in account.notes.items()},
        }

    # One boundary around every callback: an exception would end the spinning

    def _guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception:
                self.get_logger().error(f'internal error: {traceback.format_exc()}')

        return guarded

    def _answering(self, callback: Callable[[Any], tuple[bool, str]]) -> Callable[[Any, Any], Any]:
        def answer(request: Any, response: Any) -> Any:
            def work() -> tuple[bool, str]:
                self._take_messages()
                return callback(request)

            response.success, response.message = self._answer(work)
            return response

        return answer

    def _answer(self, work: Callable[[], tuple[bool, str]]) -> tuple[bool, str]:
        """Run the work of a service; an error is its answer."""
        try:
            success, text = work()
        except (CalibrationError, OSError) as err:
            return False, str(err)
        except Exception as err:
            self.get_logger().error(f'internal error: {traceback.format_exc()}')
            return False, f'internal error, see the log: {err!r}'
        return bool(success), str(text)


def _names(values: Sequence[str] | None) -> tuple[str, ...]:
    return tuple(name for name in values or () if name)


def _waiting(subscription: Subscription) -> list[tuple[int, bytes]]:
    """Return the messages that wait, with the times at which they were received [ns]."""
    found = []
    with subscription.handle:
        for _ in range(INPUT_QUEUE):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            found.append((taken[1]['received_timestamp'], taken[0]))
    return found


def _deserialised(data: bytes, name: str) -> Any:
    return deserialize_message(data, _message_type(name))


def _message_type(name: str) -> Any:
    package, _, kind = name.partition('/msg/')
    return getattr(importlib.import_module(f'{package}.msg'), kind)


def _executor(kind: str) -> Executor:
    kinds = {'events': EventsExecutor or SingleThreadedExecutor}
    kinds['single_threaded'] = SingleThreadedExecutor
    if kind not in kinds:
        raise ConfigError(f'parameter "executor" must be one of {", ".join(kinds)}, not "{kind}"')
    executor: Executor = kinds[kind]()
    return executor


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; return the exit status.

    rclpy must not see the signals: its handler invalidates the context while messages are taken.
    """
    stop = threading.Event()

    def on_signal(number: int, frame: Any) -> None:
        stop.set()

    def handle_signals(handler: Any) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, handler)

    handle_signals(on_signal)
    node: CalibrationNode | None = None
    executor: Executor | None = None
    status, finished = 0, True
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = CalibrationNode()
        executor = _executor(node.get_parameter('executor').value)
        handle_signals(on_signal)  # the events executor takes them when it is made
        executor.add_node(node)
        while not stop.is_set() and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
    except ExternalShutdownException:
        pass
    except (CalibrationError, ParameterException, RCLError) as err:
        print(f'calibration_node: {err}', file=sys.stderr)
        status = 1
    finally:
        handle_signals(signal.SIG_IGN)  # a second one must not interrupt the clean-up
        if node is not None:
            finished = node.close()
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
