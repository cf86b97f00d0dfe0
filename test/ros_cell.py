# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot cell: nodes under test and a peer that publishes, listens and calls.

The nodes run in the test's process, in a context of their own, or in a child process.
"""

import fcntl
import itertools
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import contextmanager

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    PointStamped,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from recorded import stamp_ns
from sensor_msgs.msg import JointState, Range
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from calib_ros.apply.simulation import Cell as SimulatedCell, drive, faulty, measure
from calib_ros.files.recording import Recording
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.ros import advisor as advisor_module, inputs as inputs_module, node as node_module
from calib_ros.ros.inputs import deserialised
from calib_ros.ros.node import CalibrationNode
from calib_ros.sampling.batches import feed
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.sources import STANDARD
from calib_ros.sampling.streams import Stream
from calib_ros.settings import Settings

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
inputs_module.SILENCE = 1e6  # a busy machine may be silent for long
node_module.TAKING_PERIOD = 0.02  # a wake-up costs more than what it takes
node_module.DIAGNOSTICS_PERIOD = 0.1  # who waits for a report does not wait long
node_module.JOIN_TIMEOUT = 120.0  # what was begun ends, however busy the machine is
advisor_module.CLOUD = 500  # a cloud costs more than the identification before it
BURST_NS = 900_000_000
"""Time of the stamps that are published at once; less than measurements may be late."""
START = 1_700_000_000_000_000_000
STOPS = 24
PATIENCE = 120.0
"""Time [s] after which nothing more is waited for: a busy machine takes its own."""


class Cell:
    """A peer, and the nodes under test if any; the test's thread spins them all.

    With parameters the first node is started at once.
    """

    def __init__(self, **parameters):
        self._lock, self.domain = free_domain()
        self.context = rclpy.Context()
        none = SignalHandlerOptions.NO
        given = {'args': [], 'domain_id': self.domain, 'signal_handler_options': none}
        rclpy.init(context=self.context, **given)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.peer = Node('peer', context=self.context)
        self.executor.add_node(self.peer)
        self.nodes = []
        self._publishers = {}
        self.node = self.start(**parameters) if parameters else None

    def start(self, remap=(), namespace=None, **parameters):
        """Start a node in this process; `remap` holds rules such as a:=b."""
        rules = [word for rule in remap for word in ('-r', rule)]
        node = CalibrationNode(
            context=self.context,
            namespace=namespace,
            cli_args=['--ros-args', *rules],
            parameter_overrides=[Parameter(name, value=v) for name, v in parameters.items()],
        )
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def close(self):
        for node in (*self.nodes, self.peer):
            self.executor.remove_node(node)
        self.executor.shutdown()
        ended = [node.close() for node in self.nodes]
        assert all(ended)
        self.peer.destroy_node()
        self.context.try_shutdown()
        self._lock.close()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def spin_until(self, predicate, timeout=PATIENCE):
        end = time.monotonic() + timeout
        while not predicate():
            assert time.monotonic() < end, 'timed out'
            self.executor.spin_once(timeout_sec=0.02)

    @contextmanager
    def _without_reports(self):
        """Let the nodes here neither report nor advise: it costs more than what is asked."""
        period = round(1e9 * node_module.DIAGNOSTICS_PERIOD)
        reports = [t for node in self.nodes for t in node.timers if t.timer_period_ns == period]
        for timer in reports:
            timer.cancel()
        yield
        for timer in reports:
            timer.reset()

    def start_call(self, name, request=None, node='/calibration_node'):
        """Call a service of a node; return the future answer."""
        kind = {Trigger.Request: Trigger, SetBool.Request: SetBool}.get(type(request), Trigger)
        client = self.peer.create_client(kind, f'{node}/{name}')
        self.spin_until(client.service_is_ready)
        return client.call_async(request or Trigger.Request())

    def call(self, name, request=None, node='/calibration_node'):
        """Call a service of a node; return what the client receives."""
        with self._without_reports():
            future = self.start_call(name, request, node)
            self.spin_until(future.done)
        return future.result()

    def done(self, *call, **more):
        """Call a service that does what it is asked for; return its answer."""
        answer = self.call(*call, **more)
        assert answer.success, answer.message
        return answer

    def refused(self, *call, **more):
        """Call a service that does not do what it is asked for; return its answer."""
        answer = self.call(*call, **more)
        assert not answer.success, answer.message
        return answer

    def in_full(self, answer):
        """Return an answer of ~/identify in full: what stands beside the journal if it was cut."""
        _, cut, name = answer.message.partition(' ... full text: ')
        folder = self.node._archive.folder
        text = (folder / name).with_suffix('.txt')
        return text.read_text().rstrip() if cut else answer.message

    def set_parameters(self, values, node='/calibration_node'):
        """Set parameters of a node; return the results that the client receives."""
        client = AsyncParameterClient(self.peer, node)
        self.spin_until(client.services_are_ready)
        future = client.set_parameters([Parameter(name, value=v) for name, v in values.items()])
        self.spin_until(future.done)
        return future.result().results

    def listen(self, kind, topic, qos=LATCHED):
        heard = []
        self.peer.create_subscription(kind, topic, heard.append, qos)
        return heard

    def log(self):
        """Return what nodes log, also before they are discovered."""
        qos = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return self.listen(Log, '/rosout', qos)

    def publisher(self, kind, topic, reliability=ReliabilityPolicy.RELIABLE):
        """Return a publisher that somebody listens to."""
        key = topic, reliability
        if key not in self._publishers:
            qos = QoSProfile(depth=10_000, reliability=reliability)  # a child may be slow
            publisher = self.peer.create_publisher(kind, topic, qos)
            self.spin_until(lambda: publisher.get_subscription_count() > 0)
            self._publishers[key] = publisher
        return self._publishers[key]

    def play(self, streams, reliability=ReliabilityPolicy.RELIABLE, node=None):
        """Publish messages by topic in the order of their stamps, as a bag or a robot does.

        Returns when the node has taken all; a node in a child process is not waited for.
        """
        node = node or self.node
        queue = []
        for topic, messages in streams.items():
            publisher = self.publisher(type(messages[0]), topic, reliability)
            stream = 'joints' if isinstance(messages[0], JointState) else 'measurements'
            queue += [(stamp_ns(m), stream, publisher, m) for m in messages]
        queue.sort(key=lambda item: item[0])
        with self._without_reports():
            for _, burst in itertools.groupby(queue, key=lambda item: item[0] // BURST_NS):
                wanted = node.session.received.copy() if node else Counter()
                for _, stream, publisher, message in burst:
                    publisher.publish(message)
                    wanted[stream] += 1
                self.spin_until(lambda end=wanted: not node or node.session.received >= end)


NODE = f"""
from calib_ros.ros import node
node.DIAGNOSTICS_PERIOD = {node_module.DIAGNOSTICS_PERIOD}
raise SystemExit(node.main())
"""


class Child:
    """The node in a process of its own, and what it prints."""

    def __init__(self, *arguments, domain=None, command=('-c', NODE), **parameters):
        environment = {
            name: value
            for name, value in os.environ.items()
            if name not in ('LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE')
        }
        self._lock, domain = free_domain() if domain is None else (None, domain)
        given = [word for name, v in parameters.items() for word in ('-p', f'{name}:={v}')]
        self.process = subprocess.Popen(
            [sys.executable, *command, '--ros-args', *arguments, *given],
            env=environment | {'ROS_DOMAIN_ID': str(domain), 'PYTHONUNBUFFERED': '1'},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        self.output = ''

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()
        if self._lock is not None:
            self._lock.close()

    def wait_for(self, text, timeout=PATIENCE):
        """Wait until it has printed a text; return all that it has printed."""
        end = time.monotonic() + timeout
        while text not in self.output:
            ready, _, _ = select.select([self.process.stdout], [], [], end - time.monotonic())
            part = os.read(self.process.stdout.fileno(), 1 << 16) if ready else b''
            assert part, f'it never said "{text}" but: {self.output}'
            self.output += part.decode()
        return self.output

    def end(self, number=None, timeout=PATIENCE):
        """Send a signal and wait for the end; return the exit status."""
        if number is not None:
            self.process.send_signal(number)
        output, _ = self.process.communicate(timeout=timeout)
        self.output += output.decode()
        return self.process.returncode

    def kill(self):
        assert self.end(signal.SIGKILL) == -signal.SIGKILL


def free_domain():
    """Return a domain that no other test on this machine uses, and the lock that keeps it."""
    first = random.SystemRandom().randrange(101)
    for k in range(101):
        domain = 1 + (first + k) % 101
        path = os.path.join(tempfile.gettempdir(), f'calib_ros_domain_{domain}')
        lock = open(path, 'w')  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
        else:
            return lock, domain
    raise AssertionError('no ROS domain is free')


def header(stamp_ns, frame_id=''):
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def joint_messages(recording, names=None):
    names = list(names or recording.joint_names)
    return [
        JointState(header=header(stamp), name=names, position=values.tolist())
        for stamp, values in zip(recording.joint_stamps_ns, recording.joints, strict=True)
    ]


def pose_messages(
    observations, kind=PoseStamped, covariance=None, frame_id='tracker', child='', distances=None
):
    quats = se3.to_quat(observations.rotations)
    messages = []
    for k, (x, y, z) in enumerate(observations.positions.tolist()):
        head = header(observations.stamps_ns[k], frame_id)
        turn = Quaternion(**dict(zip('xyzw', quats[k].tolist(), strict=True)))
        pose = Pose(position=Point(x=x, y=y, z=z), orientation=turn)
        if kind is PoseStamped:
            message = PoseStamped(header=head, pose=pose)
        elif kind is PointStamped:
            message = PointStamped(header=head, point=pose.position)
        elif kind is TransformStamped:
            moved = Transform(translation=Vector3(x=x, y=y, z=z), rotation=turn)
            message = TransformStamped(header=head, child_frame_id=child, transform=moved)
        elif kind is Range:
            message = Range(header=head, range=float(distances[k]))
        else:
            with_covariance = PoseWithCovariance(pose=pose, covariance=covariance)
            message = kind(header=head, pose=with_covariance)
            if kind is Odometry:
                message.child_frame_id = child
        messages.append(message)
    return messages


KINDS = {
    'measured_pose': PoseStamped,
    'measured_pose_with_covariance': PoseWithCovarianceStamped,
    'measured_point': PointStamped,
    'measured_transform': TransformStamped,
    'measured_odometry': Odometry,
    'measured_distance': Range,
}


def true_arm():
    return faulty(load_chain('ur10e'), SimulatedCell(), np.random.default_rng(1))


def shift(truth, joint_rate=50.0):
    """Return a recording: the arm moves to 24 configurations and is measured at each."""
    cell = SimulatedCell(joint_rate=joint_rate, move=0.4, dwell=0.6, poses_per_dwell=4)
    rng = np.random.default_rng(2)
    configurations = truth.random_joints(STOPS, rng)
    stamps, joints, pose_stamps = drive(configurations, cell, START)
    poses = measure(truth, np.repeat(configurations, 4, axis=0), rng, 2e-5, 1e-4).at(pose_stamps)
    return Recording(truth.joint_names, stamps, joints, poses, np.zeros(len(poses), bool))


def assert_same(first, second):
    for name in ('stamps_ns', 'joints', 'positions', 'oriented', 'approach', 'delay'):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    np.testing.assert_allclose(first.rotations, second.rotations, rtol=0, atol=1e-15)


def direct(recording, **settings):
    """Return a session that has taken a recording without ROS."""
    session = CalibrationSession(load_chain('ur10e'), Settings(**settings))
    messages = [*joint_messages(recording), *pose_messages(recording.poses)]
    pose, joints = Stream('poses', STANDARD[0].type, STANDARD[0]), Stream('joints', JOINT_STATE)
    batch = [
        (pose if isinstance(message, PoseStamped) else joints, serialize_message(message))
        for message in sorted(messages, key=stamp_ns)
    ]
    assert feed(session, batch, deserialised) == []
    return session


def topics(recording, **more):
    """Return the messages of a recording by topic."""
    joints, poses = joint_messages(recording), pose_messages(recording.poses)
    return {'joint_states': joints, 'measured_pose': poses, **more}


def part(recording, first, last):
    """Return the messages of a time [s] by topic."""
    return {
        topic: [m for m in messages if first <= (stamp_ns(m) - START) * 1e-9 < last]
        for topic, messages in topics(recording).items()
    }


def values_of(message):
    return {item.key: item.value for item in message.status[0].values}
