# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the calibration node: `ros2 launch calib_ros calibration.launch.py chain:=ur10e`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and start the node."""
    parameters = PathJoinSubstitution(
        [FindPackageShare('calib_ros'), 'config', 'calibration_node.yaml']
    )
    arguments = {
        'chain': ('', 'chain file or URDF of the robot, or the name of one that calib_ros ships'),
        'params_file': (parameters, 'parameter file of the node'),
        'namespace': ('', 'namespace of the node and of its topics'),
        'joint_states': ('joint_states', 'topic of the joint states'),
        'measured_pose': ('measured_pose', 'topic of the measured poses'),
    }
    value = {name: LaunchConfiguration(name) for name in arguments}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in arguments.items()
            ),
            Node(
                package='calib_ros',
                executable='calibration_node',
                name='calibration_node',
                namespace=value['namespace'],
                parameters=[
                    value['params_file'],
                    {'chain': ParameterValue(value['chain'], value_type=str)},
                ],
                remappings=[
                    ('joint_states', value['joint_states']),
                    ('measured_pose', value['measured_pose']),
                ],
                output='screen',
            ),
        ]
    )
