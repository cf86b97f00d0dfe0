# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the calibration node: `ros2 launch calib_ros calibration.launch.py chain:=ur10e`.

Every parameter of the node is an argument (`--show-args`); what is not given is not passed.
"""

import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from calib_ros.ros.arguments import launch_arguments, node_options, refuse_unknown

ARGUMENTS = launch_arguments()


def start(context: LaunchContext) -> list[Node]:
    """Return the node with what was given."""
    refuse_unknown(sys.argv, Path(__file__).name, [*ARGUMENTS])
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    return [Node(**node_options(given))]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the node."""
    declared = [
        DeclareLaunchArgument(name, default_value='', description=text)
        for name, text in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
