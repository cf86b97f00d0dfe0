# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Who may import whom, as docs/architecture.md says."""

import ast
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from statistics import median

from calib_ros.cli.commands import COMMANDS

PACKAGE = Path(__file__).parents[1] / 'calib_ros'
ORDER = (
    'kinematics < estimation < decision < identification < sampling < apply < files < report < '
    'fleet < ros, cli'
)
LEVEL = {name: k for k, names in enumerate(ORDER.split(' < ')) for name in names.split(', ')}
MODULES = {
    '.'.join(path.relative_to(PACKAGE).with_suffix('').parts): path
    for path in sorted(PACKAGE.rglob('*.py'))
    if not path.stem.startswith('__')
}
ROS = {'rclpy', 'sensor_msgs', 'tf2_msgs', 'geometry_msgs', 'trajectory_msgs', 'std_srvs'}
ONLY = {
    **dict.fromkeys(ROS, ('ros.',)),
    'rosbags': ('files.bags', 'files.stored'),
    'matplotlib': ('report.plots', 'report.drawing'),
    **dict.fromkeys(('jinja2', 'plotly'), ('report.page',)),
    'weasyprint': ('report.page',),
    'cv2': ('files.detector',),
    'pyarrow': ('files.history',),
    'fsspec': ('files.history', 'fleet.'),
    **dict.fromkeys(('dask', 'distributed'), ('fleet.',)),
    'rich': ('fleet.', 'cli.screen', 'cli.terminal'),
    'argcomplete': ('cli.main',),
    'yaml': ('texts', 'ros.arguments', 'ros.command_line'),
}


@cache
def parsed(path):
    return ast.parse(path.read_text())


@cache
def imports(path):
    """Return the names that a module imports, inside functions and for type checking as well."""
    found = set()
    waiting = [parsed(path)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.expr):
            continue
        waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f'{node.module}.{alias.name}' for alias in node.names}
    return found


def inner(name):
    """Return the module of this package that an imported name belongs to, or None."""
    package, _, rest = name.partition('.')
    parts = rest.split('.')
    ways = ('.'.join(parts[:count]) for count in (2, 1))
    return next((way for way in ways if package == 'calib_ros' and way in MODULES), None)


def test_every_folder_has_its_place():
    assert {path.parent.name for path in PACKAGE.glob('*/__init__.py')} == set(LEVEL)


def test_the_page_names_modules_that_exist():
    text = (PACKAGE.parent / 'docs/architecture.md').read_text()
    rows = ' '.join(line for line in text.splitlines() if line.startswith('|'))
    folder, named = '', re.findall(r'`(?:(\w+)/)?(\w+)\.py`', rows)
    assert named
    for given, name in named:  # without a folder: in that of the one before, or at the root
        folder = given or folder
        assert f'{folder}.{name}' in MODULES or (not given and name in MODULES), name


def test_modules_import_only_from_the_folders_before():
    for module, path in MODULES.items():
        folder = module.rpartition('.')[0]
        for name in imports(path):
            package = name.partition('.')[0]
            assert module.startswith(ONLY.get(package, ('',))), f'{module} imports {package}'
            other = inner(name)
            if other is None:
                continue
            there = other.rpartition('.')[0]
            below = LEVEL.get(there, -1) < LEVEL.get(folder, -1)
            assert there == folder or below, f'{module} imports {other}'


def test_modules_and_functions_are_small():
    for module, path in MODULES.items():
        assert path.read_text().count('\n') <= 400, module
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 60, f'{module}.{node.name}'


def test_half_of_the_modules_are_read_at_a_glance():
    assert median(path.read_text().count('\n') for path in MODULES.values()) <= 150


def test_few_numbers_are_tuned():
    tuned = [
        f'{name}.{node.targets[0].id}'
        for name, path in MODULES.items()
        for node in parsed(path).body
        if isinstance(node, ast.Assign)
        if isinstance(node.value, ast.Constant) and type(node.value.value) in (int, float)
    ]
    assert len(tuned) <= 60, tuned


def defined(path):
    """Return the public names that a module defines at its top level."""
    found = set()
    for node in parsed(path).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = [node.target] if isinstance(node, ast.AnnAssign) else node.targets
            names = [n for each in targets for n in ast.walk(each) if isinstance(n, ast.Name)]
            found |= {n.id for n in names if isinstance(n.ctx, ast.Store)}
    return {name for name in found if not name.startswith('_')}


def test_no_name_means_two_things():
    parallel = {'main', 'show'}  # entry points; what a command prints of its result
    counts = Counter(name for path in MODULES.values() for name in defined(path))
    assert {name for name, count in counts.items() if count > 1} == parallel


def test_no_two_modules_import_each_other():
    graph = {module: {inner(n) for n in imports(p)} - {None} for module, p in MODULES.items()}
    TopologicalSorter(graph).prepare()


def test_the_core_needs_neither_ros_nor_yaml_nor_matplotlib():
    blocked = [*ROS, 'rosbags', 'yaml', 'matplotlib', 'jinja2', 'plotly', 'weasyprint', 'cv2']
    blocked += ['pyarrow', 'fsspec', 'dask', 'distributed', 'rich']
    apart = ('ros.', 'files.bags', 'report.plots', 'report.drawing')
    core = [name for name in MODULES if not name.startswith(apart)]
    lines = ['import sys', *(f'sys.modules[{name!r}] = None' for name in blocked)]
    lines += [f'import calib_ros.{name}' for name in core]
    subprocess.run([sys.executable, '-c', '\n'.join(lines)], check=True)


def test_no_help_loads_anything_slow():
    heavy = ['numpy', 'scipy', 'yaml', 'rich', 'argcomplete', 'difflib']
    heavy += [f'calib_ros.{folder}' for folder in LEVEL if folder != 'cli']
    lines = ['import sys', *(f'sys.modules[{name!r}] = None' for name in heavy)]
    lines += ['from contextlib import suppress', 'from calib_ros.cli.main import main']
    for arguments in (['--help'], *([name, '--help'] for name in COMMANDS)):
        lines.append(f'with suppress(SystemExit): main({arguments})')
    ran = subprocess.run([sys.executable, '-c', '\n'.join(lines)], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (0, '')
    assert ran.stdout.count('usage: calib_ros') == len(COMMANDS)
