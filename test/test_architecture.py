# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Who may import whom, as docs/architecture.md says."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / 'calib_ros'
MODULES = sorted(path.stem for path in PACKAGE.glob('*.py') if path.stem != '__init__')

ORDER = [
    {'errors'},
    {'escapes', 'files', 'mcap', 'progress', 'se3', 'texts'},
    {'effects', 'values'},
    {'description'},
    {'chain', 'settings'},
    {'arguments', 'urdf'},
    {'config', 'differential', 'observations'},
    {'identifiability', 'inverse', 'leastsquares', 'messages', 'samples', 'track'},
    {'cdr', 'correlation', 'dwells', 'delays', 'simulation', 'sources', 'tables', 'trimmed'},
    {'account', 'following', 'names', 'robust', 'strays', 'transforms', 'waypoints'},
    {'collector', 'export', 'frames', 'journal'},
    {'archive', 'problem', 'vendors'},
    {'chance', 'evidence', 'live', 'noise'},
    {'misfits', 'region', 'rounding', 'steps'},
    {'compensation', 'suspicions', 'validation'},
    {'programs'},
    {'identification'},
    {'calibration', 'design', 'salvage', 'selection', 'workspace'},
    {'candidates', 'placement', 'verification'},
    {'planning', 'plots', 'session', 'testposes'},
    {'intake', 'report'},
    {'topics'},
    {'replay'},
    {'deferred', 'inputs', 'options', 'outgoing', 'parameters'},
    {'broadcast', 'commands', 'diagnostics', 'guide'},
    {'keeper'},
    {'cli', 'node'},
]
LEVEL = {name: level for level, names in enumerate(ORDER) for name in names}
ROS = {
    'node',
    'broadcast',
    'deferred',
    'diagnostics',
    'guide',
    'inputs',
    'keeper',
    'outgoing',
    'parameters',
}
ONLY = {
    'rclpy': ROS,
    'sensor_msgs': ROS,
    'tf2_msgs': ROS,
    'geometry_msgs': ROS,
    'trajectory_msgs': ROS,
    'rosbags': {'replay'},
    'matplotlib': {'plots'},
    'yaml': {'arguments', 'config', 'export', 'programs', 'texts', 'vendors'},
}


def imports(module):
    """Return the names that a module imports, those inside functions included.

    Imports for type checking alone do not count.
    """
    found = set()
    tree = ast.parse((PACKAGE / f'{module}.py').read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and getattr(node.test, 'id', '') == 'TYPE_CHECKING':
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module == 'calib_ros':
            found |= {f'calib_ros.{alias.name}' for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module)
    return found


def test_every_module_has_its_place():
    assert set(MODULES) == set(LEVEL)


@pytest.mark.parametrize('module', MODULES)
def test_modules_import_only_from_below(module):
    for name in imports(module):
        package, _, inner = name.partition('.')
        if package == 'calib_ros' and inner in LEVEL:
            assert LEVEL[inner] < LEVEL[module], f'{module} imports {inner}'
        assert module in ONLY.get(package, {module}), f'{module} imports {package}'


def test_the_core_needs_neither_ros_nor_yaml_nor_matplotlib():
    blocked = ['rclpy', 'sensor_msgs', 'rosbags', 'yaml', 'matplotlib']
    core = [name for name in MODULES if name not in (*ROS, 'replay', 'plots')]
    lines = ['import sys', *(f'sys.modules[{name!r}] = None' for name in blocked)]
    lines += [f'import calib_ros.{name}' for name in core]
    subprocess.run([sys.executable, '-c', '\n'.join(lines)], check=True)
