# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a calibrated arm on /tf_static."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from calib_ros.errors import ConfigError
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.ros import to_ros
from calib_ros.ros.parameters import NodeValues


class Broadcast:
    """Publishes the frames of the arm's base and of the target on its flange.

    Base and flange are the links of the URDF that the chain connects, if it is from a URDF; else
    the frames before and after the DH table. With the device on the flange (`in_hand`) the base
    leads to the fixed target, and the tool to the camera.
    """

    def __init__(self, node: Node, given: NodeValues, urdf: str) -> None:
        self._node, self._publisher = node, None
        self._names = given.base_frame, given.flange_frame, given.target_frame
        if not given.base_frame and not given.flange_frame:
            return
        if len({*self._names}) < len(self._names):
            names = 'base_frame, flange_frame and target_frame'
            raise ConfigError(f'{names} must be different, not {", ".join(self._names)}')
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError as err:
            needs = f'base_frame and flange_frame need tf2_msgs ({err})'
            raise ConfigError(f'{needs}: apt install ros-jazzy-tf2-msgs') from err
        self._type = TFMessage
        self._publisher = node.create_publisher(TFMessage, '/tf_static', to_ros.LATCHED)
        self._base = self._tool = np.eye(4)
        if urdf:
            described = chain_from_urdf(urdf, **given.links)
            self._base = described.frame('base').matrix
            self._tool = described.frame('tool').matrix

    def publish(self, calibration: Calibration) -> None:
        """Publish the frames of a calibration; those outdated are left out."""
        if self._publisher is None:
            return
        chain, world = calibration.chain, calibration.world_frame
        in_hand = to_ros.in_hand(calibration.owners)
        base, flange, target = self._names
        stands, moves = (target, world) if in_hand else (world, target)
        found = {
            'base': (stands, base, chain.frame('base').matrix @ se3.invert(self._base)),
            'tool': (flange, moves, se3.invert(self._tool) @ chain.frame('tool').matrix),
        }
        if world in ('', *self._names):  # a loop, or two parents of one frame
            del found['tool' if in_hand else 'base']
            found = {} if world == target else found
            self._node.get_logger().warning(
                f'the measurements come in frame "{world}": /tf_static lacks it; give it a name '
                'other than base_frame, flange_frame and target_frame'
            )
        known = {frame: each for frame, each in found.items() if frame not in calibration.outdated}
        kept = [each for each in known.values() if all(each[:2])]
        transforms = [self._transform(*each) for each in kept]
        self._publisher.publish(self._type(transforms=transforms))

    def _transform(self, parent: str, child: str, matrix: FloatArray) -> TransformStamped:
        message = TransformStamped(child_frame_id=child, transform=to_ros.transform_of(matrix))
        message.header.frame_id = parent
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message
