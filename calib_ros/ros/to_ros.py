# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Results as ROS messages.

Jazzy's messages do not check their fields, and an int or a numpy number instead of a float arrives
as garbage: everything is converted to plain Python values here.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Transform, Vector3
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Float64MultiArray, MultiArrayDimension
from visualization_msgs.msg import Marker, MarkerArray

from calib_ros.decision.residuals import residuals
from calib_ros.decision.result import Identification
from calib_ros.errors import MOST_ENTRIES
from calib_ros.identification.records import Owner
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray, invert, to_quat

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""For topics whose last message late subscribers receive."""


def in_hand(owners: Mapping[str, Owner]) -> bool:
    """Tell whether the device is a camera on the flange, so that its target is the world."""
    return 'base' in owners and owners['base'][1]


def dh_parameters(chain: Chain) -> Float64MultiArray:
    """Return the DH table, joint by joint."""
    rows, columns = chain.table.shape
    message = Float64MultiArray()
    message.layout.dim = [
        MultiArrayDimension(label='joint', size=rows, stride=rows * columns),
        MultiArrayDimension(label=','.join(chain.columns), size=columns, stride=columns),
    ]
    message.data = chain.table.ravel().tolist()
    return message


def pose(chain: Chain, joints: Sequence[float], stamp_ns: int, frame_id: str) -> PoseStamped:
    """Return the pose of the target at joint values (n)."""
    matrix = chain.forward(np.array([joints]))[0]
    message = PoseStamped()
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    message.header.stamp = Time(sec=seconds, nanosec=nanoseconds)
    message.header.frame_id = frame_id
    message.pose.position = Point(**dict(zip('xyz', matrix[:3, 3].tolist(), strict=True)))
    message.pose.orientation = transform_of(matrix).rotation
    return message


def transform_of(matrix: FloatArray) -> Transform:
    """Return a matrix (4, 4) as a message."""
    x, y, z, w = to_quat(matrix[:3, :3]).tolist()
    shift = dict(zip('xyz', matrix[:3, 3].tolist(), strict=True))
    return Transform(translation=Vector3(**shift), rotation=Quaternion(x=x, y=y, z=z, w=w))


def joints(names: Sequence[str], values: FloatArray, stamp: Any) -> JointState:
    """Return joint values (n,) by name."""
    message = JointState(name=list(names), position=values.tolist())
    message.header.stamp = stamp
    return message


def cloud(fields: Sequence[str], rows: FloatArray, frame_id: str, stamp: Any) -> PointCloud2:
    """Return rows (N, C) as points with named fields of single precision."""
    data = np.ascontiguousarray(rows, dtype='<f4')
    message = PointCloud2(height=1, width=len(data), is_dense=bool(np.isfinite(data).all()))
    message.header.stamp, message.header.frame_id = stamp, frame_id
    message.fields = [
        PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
        for k, name in enumerate(fields)
    ]
    message.point_step = 4 * len(fields)
    message.row_step = data.nbytes
    message.data = array('B', data.tobytes())
    return message


def residual_markers(
    result: Identification, scale: float, frame_id: str, stamp: Any
) -> MarkerArray:
    """Return the residual at each measured position, enlarged `scale` times.

    A line from the measured position towards the predicted one: green if small, red from three
    times the RMS.
    """
    lines = Marker(ns='residuals', id=0, type=Marker.LINE_LIST, action=Marker.ADD)
    lines.header.stamp = stamp
    lines.header.frame_id = frame_id
    lines.pose.orientation.w = 1.0
    lines.scale.x = 0.002
    base = result.chain.frame('base').matrix
    for each in result.problem.sets:
        if each.distances is not None or each.points is not None:
            continue
        left = residuals(result.chain, each).position
        size = np.linalg.norm(left, axis=1)
        share = np.clip(size / max(3.0 * float(np.sqrt(np.mean(size**2))), 1e-12), 0.0, 1.0)
        world = base @ invert(result.chain.frame(each.base).matrix)
        begins = each.positions @ world[:3, :3].T + world[:3, 3]
        ends = begins - scale * left @ world[:3, :3].T
        for k in range(max(0, len(each) - MOST_ENTRIES), len(each)):
            color = ColorRGBA(r=float(share[k]), g=float(1.0 - share[k]), b=0.0, a=1.0)
            for x, y, z in (begins[k].tolist(), ends[k].tolist()):
                lines.points.append(Point(x=x, y=y, z=z))
                lines.colors.append(color)
    return MarkerArray(markers=[lines])
