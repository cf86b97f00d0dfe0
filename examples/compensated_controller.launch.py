# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Put the node between a planner and ros2_control's JointTrajectoryController.

    ros2 launch examples/compensated_controller.launch.py chain:=ur10e
    ros2 service call /calibration_node/load std_srvs/srv/Trigger
    ros2 topic pub --once /planned_trajectory trajectory_msgs/msg/JointTrajectory ...
    ros2 topic echo --once /compensated_trajectory

Nothing moves so far. When the corrected trajectories are what you expect, start it again with
`execute:=true`: they go to the controller, and the arm moves as soon as one is sent.

What has no calibration, a point that cannot be corrected, or a correction that is too large is
not passed on, and nothing else is in its place: the arm stays where it is, and the log and the
diagnostics say why. The first point is corrected, too: give it a time_from_start in which the arm
can get there, for the controller interpolates from where the arm is. No other publisher
may send to the controller meanwhile; the action interface (MoveIt uses it) goes past the node.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node

from calib_ros.ros.arguments import node_options, switched

ARGUMENTS = {
    'chain': ('', 'robot of the calibration, as for the node'),
    'calibration': ('', 'calibration for ~/load; empty: the newest in data_dir'),
    'planned': ('/planned_trajectory', 'topic of planned trajectories'),
    'reviewed': (
        '/compensated_trajectory',
        'topic of corrected trajectories unless execute is true',
    ),
    'controller': ('/joint_trajectory_controller', 'name of the controller'),
    'execute': ('false', 'true: the arm moves'),
}


def start(context: LaunchContext) -> list[Node]:
    """Return the node; its answers reach the controller only when that was asked for."""
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    target = given['reviewed']
    if switched(given, 'execute'):
        target = f'{given["controller"]}/joint_trajectory'
    words = {'chain': given['chain']}
    if given['calibration']:
        path = Path(given['calibration']).expanduser().absolute()
        words |= {'calibration_filename': str(path), 'allowed_folders': str(path.parent)}
    node = Node(
        **node_options(words),
        remappings=[
            ('~/joint_trajectory', given['planned']),
            ('~/compensated_joint_trajectory', target),
        ],
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the node."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
