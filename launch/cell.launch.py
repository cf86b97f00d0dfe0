# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Start all of a calibration cell beside the robot's own driver.

    ros2 launch calib_ros cell.launch.py urdf:=robot.urdf tracker:=my_driver/tracker_node

The node, robot_state_publisher with the URDF, RViz, an aggregator of diagnostics, and the driver
of the measuring device, whose topic of poses is remapped. A node that was killed is started again
and goes on with its poses; one that ended by itself is not.
"""

import atexit
import sys
import tempfile
from pathlib import Path
from typing import Any

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from calib_ros.atomic import given_path
from calib_ros.errors import ConfigError
from calib_ros.kinematics.chain_file import chain_text
from calib_ros.ros.arguments import (
    NODE,
    launch_arguments,
    node_options,
    refuse_unknown,
    rviz_config,
    switched,
)
from calib_ros.values import parse_like

CONFIG = Path(__file__).parents[1] / 'config'
OURS = {
    'urdf': (
        '',
        'URDF of the robot, for robot_state_publisher; also the chain if no other is named',
    ),
    'tracker': ('', 'driver of the measuring device as PACKAGE/EXECUTABLE; default: none'),
    'tracker_topic': ('pose', 'pose topic of that driver, remapped to measured_pose'),
    'rviz': ('true', 'start RViz'),
    'fixed_frame': ('', 'fixed frame of RViz; default: frame_id, or tracker'),
    'diagnostics': ('true', 'start diagnostic_aggregator'),
    'respawn_delay': ('2.0', 'time before a killed node restarts [s]'),
}
ARGUMENTS = {name: ('', text) for name, text in launch_arguments().items()} | OURS


def calibration(given: dict[str, str]) -> list[LaunchDescriptionEntity]:
    """Return the node, and what starts it again with its samples when it was killed."""
    node = Node(**node_options(given))
    delay = parse_like(0.0, given['respawn_delay'], 'launch argument "respawn_delay"')

    def on_exit(event: Any, context: LaunchContext) -> list[LaunchDescriptionEntity]:
        if event.returncode >= 0 or context.is_shutdown:  # it has said why, or was told to end
            return []
        again = calibration(given | {'resume': 'true'})
        return [
            LogInfo(msg=f'{NODE} was killed (signal {-event.returncode}): restarting'),
            TimerAction(period=delay, actions=again),
        ]

    return [RegisterEventHandler(OnProcessExit(target_action=node, on_exit=on_exit)), node]


def start(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """Return all that belongs to the cell, as given."""
    refuse_unknown(sys.argv, Path(__file__).name, [*ARGUMENTS])
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    namespace = given['namespace'] or None
    joint_states = given['joint_states'] or 'joint_states'
    measured_pose = given['measured_pose'] or 'measured_pose'
    started: list[LaunchDescriptionEntity] = []
    if given['urdf']:
        text = chain_text(given_path(given['urdf']))
        if not given['chain'] and not given['params_file']:
            given['chain'] = 'robot_description'
        started.append(
            Node(
                package='robot_state_publisher',
                executable='robot_state_publisher',
                namespace=namespace,
                parameters=[{'robot_description': ParameterValue(text, value_type=str)}],
                remappings=[('joint_states', joint_states)],
                output='screen',
            )
        )
    if given['tracker']:
        package, _, executable = given['tracker'].partition('/')
        if not executable:
            raise ConfigError(f'tracker must be PACKAGE/EXECUTABLE, not "{given["tracker"]}"')
        given['measured_pose'] = measured_pose  # refused if it would not be heard
        started.append(
            Node(
                package=package,
                executable=executable,
                namespace=namespace,
                remappings=[(given['tracker_topic'], measured_pose)],
                output='screen',
            )
        )
    if switched(given, 'diagnostics'):
        started.append(
            Node(
                package='diagnostic_aggregator',
                executable='aggregator_node',
                namespace=namespace,
                parameters=[str(CONFIG / 'diagnostics.yaml')],
                output='screen',
            )
        )
    if switched(given, 'rviz'):
        shown = rviz_config(
            (CONFIG / 'calibration.rviz').read_text(encoding='utf-8'),
            given['namespace'],
            given['fixed_frame'] or given['frame_id'],
        )
        with tempfile.NamedTemporaryFile(
            'w', suffix='.rviz', encoding='utf-8', delete=False
        ) as file:
            file.write(shown)
        atexit.register(Path(file.name).unlink, missing_ok=True)
        shows = {'namespace': namespace, 'arguments': ['-d', file.name]}
        started.append(Node(package='rviz2', executable='rviz2', **shows))
    return [*started, *calibration(given)]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the cell."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
