# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The package as colcon builds it, and what its files promise each other."""

import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import yaml
from test_architecture import MODULES, imports

import calib_ros
from calib_ros.ros.parameter_list import PARAMETERS

ROOT = Path(__file__).parents[1]
JAZZY = {
    *('builtin_interfaces', 'diagnostic_aggregator', 'diagnostic_msgs', 'geometry_msgs', 'launch'),
    *('launch_ros', 'nav_msgs', 'rcl_interfaces', 'rclpy', 'robot_state_publisher', 'rviz2'),
    *('sensor_msgs', 'std_msgs', 'std_srvs', 'tf2_msgs', 'trajectory_msgs', 'visualization_msgs'),
}
"""Packages of Jazzy: rosdep installs their Debian packages, ros-jazzy-NAME."""
INSTALLED = tuple(f'config/{name}' for name in ('calibration_node.yaml', 'calibration.rviz'))
INSTALLED += ('config/diagnostics.yaml', 'config/foxglove_layout.json')
INSTALLED += ('launch/calibration.launch.py', 'launch/cell.launch.py')
INSTALLED += ('security/policy.xml',)


def test_colcon_build_puts_everything_where_ros2_looks(tmp_path):
    environment = os.environ | {'AMENT_PREFIX_PATH': '', 'COLCON_LOG_PATH': str(tmp_path / 'log')}
    colcon = Path(sys.executable).with_name('colcon')
    bases = [part for name in ('build', 'install') for part in (f'--{name}-base', tmp_path / name)]
    built = subprocess.run(
        [sys.executable, colcon, 'build', '--base-paths', ROOT, *bases],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    prefix = tmp_path / 'install' / 'calib_ros'
    share = prefix / 'share' / 'calib_ros'
    assert (prefix / 'share/ament_index/resource_index/packages/calib_ros').is_file()
    for name in ('package.xml', *INSTALLED):
        assert (share / name).is_file()
    robots = {path.name for path in (ROOT / 'config/robots').iterdir()}
    assert {path.name for path in (share / 'config/robots').iterdir()} == robots
    library = next(prefix.glob('lib/python*/site-packages'))
    for name in ('calib_ros', 'calibration_node'):
        assert os.access(prefix / 'lib' / 'calib_ros' / name, os.X_OK)
    shown = subprocess.run(
        [prefix / 'lib/calib_ros/calib_ros', '--version'],
        env=environment | {'PYTHONPATH': str(library)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert calib_ros.__version__ in shown.stdout


def test_versions_agree():
    package = ET.parse(ROOT / 'package.xml').getroot()
    version = re.search(r"version='([^']+)'", (ROOT / 'setup.py').read_text()).group(1)
    assert package.findtext('version') == version == calib_ros.__version__


def test_package_xml_names_everything_that_is_imported():
    package = ET.parse(ROOT / 'package.xml').getroot()
    declared = {element.text for element in package.iter('exec_depend')}
    # Extras of pip, imported only where they are used (setup.py).
    declared |= {'rosbags', 'openpyxl', 'cv2', 'dask', 'distributed', 'fsspec', 'pyarrow'}
    declared |= {'argcomplete', 'pandas', 'plotly', 'rich', 'weasyprint'}
    keys = {'yaml': 'python3-yaml'}
    keys |= {name: f'python3-{name}' for name in ('jinja2', 'matplotlib', 'numpy', 'scipy')}
    for source in [*MODULES.values(), *(ROOT / 'launch').glob('*.py')]:
        for name in imports(source):
            top = name.partition('.')[0]
            if top not in sys.stdlib_module_names and top != 'calib_ros':
                assert keys.get(top, top) in declared, f'{source.name} imports {top}'


def test_rosdep_finds_everything_on_ubuntu():
    """rosdep refuses keys that it would have to install by pip (PEP 668), and unknown ones.

    python3-plotly is unknown: https://github.com/ros/rosdistro/pull/53994
    """
    package = ET.parse(ROOT / 'package.xml').getroot()
    keys = {each.text for each in package if each.tag.endswith('depend')}
    apt = ('hypothesis', 'jinja2', 'matplotlib', 'numpy', 'pytest', 'scipy', 'yaml')
    assert keys - JAZZY == {f'python3-{name}' for name in apt}


def test_the_oldest_versions_are_those_that_pip_may_install():
    text = (ROOT / 'setup.py').read_text()
    bounds = dict(re.findall(r"'(\w+)>=([\d.]+)'", text))
    oldest = (ROOT / 'test/oldest.txt').read_text()
    pins = re.findall(r'^(\w+)==([\d.]+)(?:; python_version (\S+))?', oldest, re.MULTILINE)
    assert {name: pin for name, pin, marker in pins if marker in ('', '<')} == bounds
    assert [name for name, _, marker in pins if marker == '>='] == ['matplotlib']


ROOMS = ('node', 'identifying', 'advisor', 'outputs')
NODE = ''.join((ROOT / f'calib_ros/ros/{name}.py').read_text() for name in ROOMS)


def test_foxglove_shows_what_the_node_has():
    layout = json.loads((ROOT / 'config/foxglove_layout.json').read_text())
    panels = layout['configById']
    names = {*re.findall('/calibration_node/([a-z_]+)', json.dumps(panels))}
    assert {'identify', 'residuals', 'status'} <= names
    for name in names:
        assert f"'~/{name}'" in NODE
    assert {*re.findall(r'"([A-Za-z0-9]+![a-z]+)"', json.dumps(layout['layout']))} == {*panels}


def test_rviz_shows_what_the_node_publishes():
    content = yaml.safe_load((ROOT / 'config/calibration.rviz').read_text())
    manager = content['Visualization Manager']
    topics = {d['Class']: d['Topic'] for d in manager['Displays'] if 'Topic' in d}
    for topic in topics.values():
        assert f"'{topic['Value'].replace('/calibration_node', '~')}'" in NODE
    # These are published once: a display that comes later must ask for the last ones.
    for kind in ('MarkerArray', 'PointCloud2'):
        latched = topics[f'rviz_default_plugins/{kind}']
        assert latched['Durability Policy'] == 'Transient Local'


def test_the_document_of_the_node_lists_every_parameter():
    text = (ROOT / 'docs/node.md').read_text()
    for name in PARAMETERS:
        assert f'`{name}`' in text, name
