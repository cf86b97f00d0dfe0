# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot cell in one process: the node under test and its peers, in a context of their own."""

import itertools
import os
import time

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
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from calib_ros import se3
from calib_ros.node import CalibrationNode

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
_count = itertools.count()


class Cell:
    """The node, and a peer that publishes, listens and calls; the test's thread spins both."""

    def __init__(self, executor_type=SingleThreadedExecutor, **parameters):
        self.context = rclpy.Context()
        rclpy.init(
            context=self.context,
            args=[],
            domain_id=1 + (os.getpid() + next(_count)) % 101,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.executor = executor_type(context=self.context)
        self.node = CalibrationNode(
            context=self.context,
            parameter_overrides=[Parameter(name, value=v) for name, v in parameters.items()],
        )
        self.peer = Node('peer', context=self.context)
        for node in (self.node, self.peer):
            self.executor.add_node(node)
        self.heard = {}
        self._publishers = {}

    def close(self):
        for node in (self.node, self.peer):
            self.executor.remove_node(node)
        self.executor.shutdown()
        assert self.node.close()
        self.peer.destroy_node()
        self.context.try_shutdown()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def spin_until(self, predicate, timeout=20.0):
        end = time.monotonic() + timeout
        while not predicate():
            assert time.monotonic() < end, 'timed out'
            self.executor.spin_once(timeout_sec=0.02)

    def start_call(self, name, request=None):
        kind = Trigger if request is None else SetBool
        client = self.peer.create_client(kind, f'calibration_node/{name}')
        self.spin_until(client.service_is_ready)
        return client.call_async(request or Trigger.Request())

    def call(self, name, request=None):
        future = self.start_call(name, request)
        self.spin_until(future.done)
        return future.result()

    def listen(self, kind, topic, qos=LATCHED):
        heard = self.heard.setdefault(topic, [])
        self.peer.create_subscription(kind, topic, heard.append, qos)
        return heard

    def publish(self, topic, messages, reliability=ReliabilityPolicy.RELIABLE, burst=100):
        """Publish messages and wait until the node has taken them all."""
        key = topic, reliability
        if key not in self._publishers:
            qos = QoSProfile(depth=1000, reliability=reliability)
            publisher = self.peer.create_publisher(type(messages[0]), topic, qos)
            self.spin_until(lambda: publisher.get_subscription_count() > 0)
            self._publishers[key] = publisher
        stream = 'joints' if isinstance(messages[0], JointState) else 'poses'
        for start in range(0, len(messages), burst):
            part = messages[start : start + burst]
            wanted = self.node.session.received[stream] + len(part)
            for message in part:
                self._publishers[key].publish(message)
            self.spin_until(lambda end=wanted: self.node.session.received[stream] >= end)


def header(stamp_ns, frame_id=''):
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def joint_messages(recording):
    return [
        JointState(
            header=header(stamp), name=list(recording.joint_names), position=values.tolist()
        )
        for stamp, values in zip(recording.joint_stamps_ns, recording.joints, strict=True)
    ]


def pose_messages(observations, kind=PoseStamped, covariance=None):
    quats = se3.to_quat(observations.rotations)
    messages = []
    for stamp, position, quat in zip(
        observations.stamps_ns, observations.positions.tolist(), quats.tolist(), strict=True
    ):
        head = header(stamp, 'tracker')
        x, y, z = position
        turn = Quaternion(x=quat[0], y=quat[1], z=quat[2], w=quat[3])
        pose = Pose(position=Point(x=x, y=y, z=z), orientation=turn)
        if kind is PoseStamped:
            message = PoseStamped(header=head, pose=pose)
        elif kind is PointStamped:
            message = PointStamped(header=head, point=pose.position)
        elif kind is TransformStamped:
            shift = Vector3(x=x, y=y, z=z)
            message = TransformStamped(
                header=head, transform=Transform(translation=shift, rotation=turn)
            )
        else:
            with_covariance = PoseWithCovariance(pose=pose, covariance=covariance)
            message = PoseWithCovarianceStamped(header=head, pose=with_covariance)
        messages.append(message)
    return messages
