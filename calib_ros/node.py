# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node: topics in, services, corrected parameters out. `docs/node.md` describes it.

Messages are taken on the executor's thread. An identification runs on a thread of its own, on a
snapshot of the pairs, and its answer is sent when it has ended.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import fields
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

# Small matrices only: a second BLAS thread costs more than it gives, on a busy cell above all.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy._rclpy_pybind11 import RCLError  # has no public name in Jazzy
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
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, String
from std_srvs.srv import SetBool, Trigger

from calib_ros import report
from calib_ros.chain import DH_KINDS
from calib_ros.config import Settings, load_chain
from calib_ros.errors import CalibrationError, ConfigError, UnknownNameError
from calib_ros.files import write_file
from calib_ros.identification import Identification
from calib_ros.problem import Problem
from calib_ros.se3 import to_quat
from calib_ros.selection import identify_model
from calib_ros.session import CalibrationSession

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an rclpy from before it had one
    EventsExecutor = None

INPUT_QUEUE = 200
CORRECTED_POSE_PERIOD = 0.1
DIAGNOSTICS_PERIOD = 1.0
JOIN_TIMEOUT = 1.0


class CalibrationNode(Node):
    """Calibrates one robot from its joint states and measured poses."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__('calibration_node', **node_options)
        chain_name = self._declare(
            'chain', '', 'chain file or URDF of the robot, or the name of one that calib_ros ships'
        )
        self._target = self._declare(
            'target_filename', '', 'file that ~/save writes; default: a new one under ROS_HOME'
        )
        self._declare('executor', 'events', 'events or single_threaded: how messages are taken')
        settings = Settings(
            **{item.name: self._declare_setting(item) for item in fields(Settings)}
        )
        self._refuse_unknown_parameters()
        if not chain_name:
            raise ConfigError(
                'parameter "chain" is not set: give the chain file of the robot, for example '
                '--ros-args -p chain:=ur10e'
            )
        self.session = CalibrationSession(load_chain(chain_name), settings)
        self._last = 'nothing identified yet'
        self._calibration_text = ''
        self._dropped_before = 0
        self._joints: tuple[Any, Any] | None = None
        self._subscribe()
        latched = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._dh_parameters = self.create_publisher(Float64MultiArray, '~/dh_parameters', latched)
        self._calibration = self.create_publisher(String, '~/calibration', latched)
        self._corrected_pose = self.create_publisher(PoseStamped, '~/corrected_pose', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._identify = DeferredTrigger(self, '~/identify', self._snapshot, self._run)
        for kind, name, callback in (
            (Trigger, '~/clear', self._on_clear),
            (Trigger, '~/save', self._on_save),
            (SetBool, '~/record', self._on_record),
        ):
            self.create_service(kind, name, self._answering(callback))
        self.create_timer(DIAGNOSTICS_PERIOD, self._guarded(self._publish_diagnostics))
        self.create_timer(CORRECTED_POSE_PERIOD, self._guarded(self._publish_corrected_pose))
        self.get_logger().info(
            f'ready to calibrate {self.session.chain.name}: joints '
            f'{", ".join(self.session.joint_names)}'
        )

    def close(self) -> bool:
        """Stop; return False when an identification still runs and must not be waited for."""
        finished = self._identify.join(JOIN_TIMEOUT)
        self.destroy_node()
        return finished

    # Parameters

    def _declare(self, name: str, default: Any, text: str, **ranges: Any) -> Any:
        descriptor = ParameterDescriptor(description=text, read_only=True, **ranges)
        return self.declare_parameter(name, default, descriptor).value

    def _declare_setting(self, item: Any) -> Any:
        text, lower = item.metadata['text'], item.metadata.get('lower')
        if isinstance(item.default, tuple):  # an empty list has no type in ROS, [''] has one
            return tuple(name for name in self._declare(item.name, [''], text) or () if name)
        if isinstance(item.default, str):
            return self._declare(item.name, item.default, text)
        if isinstance(item.default, int):
            span = IntegerRange(from_value=int(lower), to_value=2**31 - 1)
            return self._declare(item.name, item.default, text, integer_range=[span])
        # Declared with any type first, so that "max_gap: 1" is taken as 1.0.
        loose = ParameterDescriptor(dynamic_typing=True)
        value = self.declare_parameter(item.name, item.default, loose).value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f'parameter "{item.name}" must be a number, not {value!r}')
        self.undeclare_parameter(item.name)
        span = FloatingPointRange(from_value=float(lower), to_value=1e9)
        descriptor = ParameterDescriptor(
            description=text, read_only=True, floating_point_range=[span]
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

    # Topics in

    def _subscribe(self) -> None:
        qos = QoSProfile(
            depth=INPUT_QUEUE,
            reliability=qos_profile_sensor_data.reliability,
            durability=qos_profile_sensor_data.durability,
        )
        overriding = QoSOverridingOptions(
            (QoSPolicyKind.RELIABILITY, QoSPolicyKind.DEPTH, QoSPolicyKind.HISTORY)
        )
        taking: list[tuple[Any, str, Callable[[Any], None]]] = [
            (JointState, 'joint_states', self._on_joint_state)
        ]
        for kind, topic in (
            (PoseStamped, 'measured_pose'),
            (PoseWithCovarianceStamped, 'measured_pose_with_covariance'),
            (PointStamped, 'measured_point'),
            (TransformStamped, 'measured_transform'),
        ):
            taking.append((kind, topic, self._taking(kind, held_out=False)))
        for kind, topic in ((PoseStamped, 'validation_pose'), (PointStamped, 'validation_point')):
            taking.append((kind, topic, self._taking(kind, held_out=True)))
        for kind, topic, callback in taking:
            self.create_subscription(
                kind, topic, self._guarded(callback), qos, qos_overriding_options=overriding
            )

    def _on_joint_state(self, message: JointState) -> None:
        values = self.session.take_joints(message)
        if values is not None:
            self._joints = (message.header.stamp, values)

    def _taking(self, kind: Any, held_out: bool) -> Callable[[Any], None]:
        name = f'geometry_msgs/msg/{kind.__name__}'

        def take(message: Any) -> None:
            self.session.take_pose(name, message, held_out)

        return take

    # Services

    def _snapshot(self) -> Problem:
        return self.session.problem()

    def _run(self, problem: Problem) -> tuple[bool, str]:
        """Identify, on a thread of its own; publish only what is accepted."""
        result = identify_model(problem, self.session.settings.model)
        self._last = report.summary(result)
        if result.accepted:
            self.session.adopt(result)
            self._publish_calibration(result)
        elif self.session.calibration is not None:
            self._last += '; the last good calibration stays'
        return result.accepted, self._last

    def _on_clear(self, request: Any) -> tuple[bool, str]:
        account = self.session.account()
        self.session.clear()
        return True, f'{account.pairs + account.held_out} pairs cleared; the calibration stays'

    def _on_record(self, request: Any) -> tuple[bool, str]:
        self.session.recording = bool(request.data)
        return True, 'recording' if request.data else 'not recording: messages are dropped'

    def _on_save(self, request: Any) -> tuple[bool, str]:
        if not self._calibration_text:
            return False, 'there is no accepted calibration to save: call ~/identify first'
        if self._target:
            path = Path(self._target).expanduser()
        else:
            home = Path(os.environ.get('ROS_HOME', '~/.ros')).expanduser()
            moment = datetime.now(timezone.utc).strftime('%Y%m%dT%H%M%S%fZ')
            path = home / 'calib_ros' / f'{self.session.chain.name}_{moment}.yaml'
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, self._calibration_text)
        return True, f'saved to {path}'

    # Topics out

    def _publish_calibration(self, result: Identification) -> None:
        table = result.chain.table
        array = Float64MultiArray()
        rows, columns = table.shape
        array.layout.dim = [
            MultiArrayDimension(label='joint', size=rows, stride=rows * columns),
            MultiArrayDimension(label=','.join(DH_KINDS), size=columns, stride=columns),
        ]
        array.data = table.ravel().tolist()
        self._dh_parameters.publish(array)
        self._calibration_text = report.calibration_yaml(result)
        self._calibration.publish(String(data=self._calibration_text))

    def _publish_corrected_pose(self) -> None:
        result = self.session.calibration
        if result is None or self._joints is None:
            return
        stamp, values = self._joints
        self._joints = None
        pose = result.chain.forward(values[np.newaxis])[0]
        message = PoseStamped()
        message.header.stamp = stamp
        message.header.frame_id = result.world_frame
        point, turn = message.pose.position, message.pose.orientation
        point.x, point.y, point.z = pose[:3, 3].tolist()
        turn.x, turn.y, turn.z, turn.w = to_quat(pose[:3, :3]).tolist()
        self._corrected_pose.publish(message)

    def _publish_diagnostics(self) -> None:
        account = self.session.account()
        status = DiagnosticStatus(name=f'{self.get_name()}: calibration', hardware_id='')
        dropped = sum(account.dropped.values())
        fresh = dropped > self._dropped_before
        self._dropped_before = dropped
        status.level = DiagnosticStatus.WARN if fresh else DiagnosticStatus.OK
        status.message = str(account)
        values = {
            'robot': self.session.chain.name,
            'recording': self.session.recording,
            'calibrated': self.session.calibration is not None,
            'last identification': self._last,
            'joint states': account.joint_states,
            'poses': account.poses,
            'pairs': account.pairs,
            'held-out pairs': account.held_out,
            'configurations': account.configurations,
            **{f'dropped {cause}': count for cause, count in account.dropped.items()},
            **{f'note {cause}': count for cause, count in account.notes.items()},
        }
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)

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
            response.success, response.message = self.answer(lambda: callback(request))
            return response

        return answer

    def answer(self, work: Callable[[], tuple[bool, str]]) -> tuple[bool, str]:
        """Run the work of a service; an error is its answer."""
        try:
            success, text = work()
        except (CalibrationError, OSError) as err:
            return False, str(err)
        except Exception as err:
            self.get_logger().error(f'internal error: {traceback.format_exc()}')
            return False, f'internal error, see the log: {err!r}'
        return bool(success), str(text)


class DeferredTrigger:
    """A Trigger service whose work runs on a thread of its own.

    Jazzy's executors send the answer through the service's `send_response` right after the
    callback, on the same thread. It is replaced here by one that holds the answer of an accepted
    call back until its work has ended; an async callback would do, but the events executor takes
    none. A call that comes meanwhile is refused at once.

    Parameters
    ----------
    node : CalibrationNode
    name : str
    prepare : callable
        Runs on the executor's thread; returns the snapshot to work on.
    work : callable
        Takes the snapshot, returns success and message.

    """

    def __init__(
        self,
        node: CalibrationNode,
        name: str,
        prepare: Callable[[], Any],
        work: Callable[[Any], tuple[bool, str]],
    ) -> None:
        self._node, self._prepare, self._work = node, prepare, work
        self._thread: threading.Thread | None = None
        self._running = threading.Event()
        self._snapshot: list[Any] = []
        self._service = node.create_service(Trigger, name, self._on_call)
        self._send = self._service.send_response
        self._service.send_response = self._send_unless_deferred

    def join(self, timeout: float) -> bool:
        """Wait for the work [s]; return whether it has ended."""
        if self._thread is not None:
            self._thread.join(timeout)
        return self._thread is None or not self._thread.is_alive()

    def _on_call(self, request: Any, response: Any) -> Any:
        if self._running.is_set():
            response.success = False
            response.message = 'refused: an identification is running, wait for its answer'
            return response

        def prepare() -> tuple[bool, str]:
            self._snapshot = [self._prepare()]
            return True, ''

        response.success, response.message = self._node.answer(prepare)
        return response

    def _send_unless_deferred(self, response: Any, header: Any) -> None:
        if not self._snapshot:
            self._send(response, header)
            return
        snapshot = self._snapshot.pop()
        self._running.set()
        self._thread = threading.Thread(
            target=self._run, args=(snapshot, response, header), daemon=True
        )
        self._thread.start()

    def _run(self, snapshot: Any, response: Any, header: Any) -> None:
        response.success, response.message = self._node.answer(lambda: self._work(snapshot))
        self._running.clear()  # before the answer: the caller may call again at once
        try:
            self._send(response, header)
        except Exception:  # the node is gone meanwhile, and with it the one who asked
            return


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
