# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
r"""Feed the corrected URDF to robot_state_publisher and MoveIt: TF and plans of the real arm.

    ros2 launch examples/corrected_arm.launch.py urdf:=export/robot_corrected.urdf \
        moveit_robot:=ur moveit_package:=ur_moveit_config

Without moveit_package only robot_state_publisher starts. Trajectories that are planned this way
are right as they are: do not send them through ~/joint_trajectory.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from calib_ros.atomic import given_path
from calib_ros.kinematics.chain_file import chain_text

KINEMATICS = Path(__file__).with_name('moveit_kinematics.yaml')
ARGUMENTS = {
    'urdf': (None, 'corrected URDF, from `calib_ros export --urdf` or ~/export'),
    'moveit_robot': ('', 'name of the robot in its MoveIt configuration'),
    'moveit_package': ('', 'MoveIt configuration of the robot; empty: without MoveIt'),
    'kinematics': (str(KINEMATICS), 'parameter file with numeric solvers'),
}


def start(context: LaunchContext) -> list[Node]:
    """Return the nodes; the corrected description comes last, so that it holds."""
    given = {name: context.launch_configurations[name] for name in ARGUMENTS}
    text = chain_text(given_path(given['urdf']))
    described = {'robot_description': ParameterValue(text, value_type=str)}
    nodes = [
        Node(
            package='robot_state_publisher',
            executable='robot_state_publisher',
            parameters=[described],
            output='screen',
        )
    ]
    if given['moveit_package']:
        from moveit_configs_utils import MoveItConfigsBuilder

        configured = MoveItConfigsBuilder(
            given['moveit_robot'], package_name=given['moveit_package']
        ).to_moveit_configs()
        nodes.append(
            Node(
                package='moveit_ros_move_group',
                executable='move_group',
                parameters=[configured.to_dict(), given['kinematics'], described],
                output='screen',
            )
        )
    return nodes


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the nodes."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
