# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node's parameters, and the launch arguments made from them.

Launch arguments are strings. `ros_arguments` converts them to command line arguments of a node by
the type of each parameter: `serial:=0012` stays text. No ROS is imported here, so that launch
files and node share one list.
"""

from __future__ import annotations

import argparse
import math
import re
import textwrap
from ast import literal_eval
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from calib_ros.atomic import given_path
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.settings import EXCEPTION, STARTUP, Settings
from calib_ros.shown import some
from calib_ros.values import parse_like

NODE = 'calibration_node'


@dataclass(frozen=True)
class NodeParameter:
    """A parameter: default, description, whether it can change, smallest and largest value."""

    name: str
    default: Any
    text: str
    fixed: bool = True
    lower: float | None = None
    upper: float = math.inf


BESIDE_SETTINGS = f"""
chain ''  chain file, URDF or name (calib_ros robots) of the robot, or robot_description: the \
URDF on that topic
base_link ''  first link of the arm in a URDF; default: its root
tip_link ''  last link of the arm in a URDF; default: tool0, flange or its only end
serial ''  serial number of the robot
data_dir ''  folder of journals and calibrations; default: one under ROS_HOME
history ''  folder or URL for the results of ~/identify and ~/validate, by serial; default: none
resume False  continue the newest journal of this robot
allowed_folders ()  folders besides data_dir that ~/save and ~/load may use; default: none
autoload False  publish the newest saved calibration of this robot at startup
target_filename* ''  file that ~/save writes, in data_dir or allowed_folders; default: a new one
calibration_filename* ''  file to publish at startup and on ~/load, in the same folders; default: \
the newest, by autoload or ~/load
socket* ''  LOCATION/SOCKET, such as A/1, that holds the ball when ~/capture is called; default: \
none, a measurement is taken
largest_loss* {EXCEPTION} 1  largest share of joint states or measurements dropped because of \
stamps or full buffers
marker_scale* 200.0  enlargement of the residual vectors
candidates ''  table of poses (q1 ... qn) that ~/next_pose chooses from; default: any pose
base_frame ''  name under which the arm's base is published on /tf_static, in the frame of the \
measurements; default: not published
flange_frame ''  flange frame in which the target is published on /tf_static; default: not \
published
target_frame 'target'  frame name of the target on /tf_static
"""
"""Name, `*` if it can change, default, largest value if any, description; none is negative."""


def _written(line: str) -> NodeParameter:
    head, text = line.split('  ', 1)
    name, default, *most = head.split(' ')
    value = literal_eval(default)
    lower = 0.0 if isinstance(value, float) else None
    upper = max(map(float, most), default=math.inf)
    return NodeParameter(name.rstrip('*'), value, text, not name.endswith('*'), lower, upper)


PARAMETERS = {
    each.name: each
    for each in (
        *map(_written, BESIDE_SETTINGS.strip().splitlines()),
        *(
            NodeParameter(each.name, each.default, fixed=each.name in STARTUP, **each.metadata)
            for each in fields(Settings)
        ),
        NodeParameter('use_sim_time', False, 'use the time of /clock', False),
    )
}
"""All parameters of the node by name, in order of declaration."""
REMAPPED = {
    'joint_states': 'joint state topic; default: joint_states',
    'measured_pose': 'measured pose topic; default: measured_pose',
}
"""Launch arguments that remap a topic of the same name."""
PLACED = {
    'namespace': 'namespace of the node and of its topics',
    'params_file': 'parameter file of the node; arguments given here override it',
}


def launch_arguments() -> dict[str, str]:
    """Return the launch arguments of the node with their descriptions.

    All are empty by default, and then not passed, so that the parameter file and the node's
    defaults apply.
    """
    texts = {each.name: _described(each) for each in PARAMETERS.values()}
    return {**texts, **PLACED, **REMAPPED}


def usage(program: str) -> argparse.ArgumentParser:
    """Return a parser of the non-ROS arguments: only --help, which lists the parameters."""
    lines = ['parameters:']
    for each in PARAMETERS.values():
        text = textwrap.indent(textwrap.fill(_described(each), 74), ' ' * 6)
        lines += [f'  {each.name}{"" if each.fixed else " *"}', text]
    changes = f'can change while the node runs: ros2 param set /{program} NAME VALUE'
    lines += ['', 'from a file: --params-file FILE', f'* {changes}']
    return argparse.ArgumentParser(
        prog=program,
        usage='%(prog)s --ros-args -p chain:=ur10e [-p NAME:=VALUE ...]',
        description='Calibrate a robot from its joint states and measured poses (docs/node.md).',
        epilog='\n'.join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def ros_arguments(given: Mapping[str, str]) -> list[str]:
    """Return ROS arguments of the node for the non-empty launch arguments.

    The parameter file comes first, because ROS takes the later of two values. A value of the wrong
    type raises ConfigError.
    """
    words = []
    if given.get('params_file'):
        path = given_path(given['params_file'])
        if not path.is_file():
            raise InputError(f'params_file: there is no file {path}')
        words = ['--params-file', str(path)]
    for parameter in PARAMETERS.values():
        text = given.get(parameter.name, '')
        if text:
            words += ['-p', f'{parameter.name}:={_as_yaml(parameter, text)}']
    for topic in REMAPPED:
        if given.get(topic):
            words += ['-r', f'{topic}:={given[topic]}']
    _refuse_unheard(given)
    return words


def _refuse_unheard(given: Mapping[str, str]) -> None:
    poses, above = given.get('measured_pose', ''), given.get('namespace', '')

    def whole(name: str) -> str:
        return (name if name.startswith('/') else f'{above}/{name}').strip('/')

    listed = _value(PARAMETERS['sources'], given.get('sources', ''))
    names = {whole(word) for each in listed for word in each.split()[:1]}
    if poses and names and names.isdisjoint((whole('measured_pose'), whole(poses))):
        raise ConfigError(
            f'measured_pose:={poses} would not be heard, since sources names other topics only: '
            'name it there too'
        )


def node_options(given: Mapping[str, str]) -> dict[str, Any]:
    """Return the node options of launch arguments."""
    return {
        'package': 'calib_ros',
        'executable': NODE,
        'name': NODE,
        'namespace': given.get('namespace') or None,
        'ros_arguments': ros_arguments(given),
        'output': 'screen',
    }


def typed(command: Sequence[str]) -> list[str]:
    """Return a command line of the node on which ROS keeps text as typed.

    ROS reads `-p serial:=0012` as the number 10, and `-p serial:=yes` as true.
    """
    words = list(command)
    for k in range(1, len(words)):
        name, given, value = words[k].partition(':=')
        parameter = PARAMETERS.get(name.rpartition(':')[2])  # NODE:NAME is for one node only
        if not given or parameter is None or words[k - 1] not in ('-p', '--param'):
            continue
        if isinstance(parameter.default, str) and value[:1] not in ('"', "'", '!'):
            words[k] = f'{name}:={_quoted(value)}'
    return words


def refuse_ignored_files(command: Sequence[str], node: str) -> None:
    """Refuse parameter files with no key for a node, by its full name: ROS ignores them."""

    def applies(key: str) -> bool:  # * is one name, /** any number of them
        names = re.escape(key).replace(r'/\*\*', r'(/\w+)*').replace(r'\*', r'\w+')
        return bool(re.fullmatch(names, node))

    paths, keys = _files(command), [key for key, _ in _sections(command)]
    if keys and not any(map(applies, keys)):
        raise ConfigError(
            f'{" and ".join(paths)} has no parameters of {node}, but of {", ".join(some(keys))}: '
            'use the key /**, which matches every node'
        )


def shared_names(command: Sequence[str]) -> set[str]:
    """Return the parameters that files give to all nodes, if they name some node besides."""
    found = [('*' in key.rpartition('/')[2], names) for key, names in _sections(command)]
    if all(wild for wild, _ in found):
        return set()
    return {name for wild, names in found if wild for name in names}


def _files(command: Sequence[str]) -> list[str]:
    return [path for flag, path in pairwise(command) if flag == '--params-file']


def _sections(command: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return the keys in parameter files, and the names of the parameters under each."""

    def leaves(content: Mapping[str, Any], above: str) -> Iterator[str]:
        for key, below in content.items():
            name = f'{above}{key}'
            yield from leaves(below, f'{name}.') if isinstance(below, dict) else (name,)

    def nodes(content: Mapping[str, Any], above: str) -> Iterator[tuple[str, list[str]]]:
        for key, below in content.items():
            name, given = f'{above}/{key.strip("/")}', below.get('ros__parameters', below)
            own = [] if given is below else [(name, [*leaves(given or {}, '')])]
            yield from own or nodes(below, name)

    found = (yaml.safe_load(Path(path).read_bytes()) or {} for path in _files(command))
    return [each for content in found for each in nodes(content, '')]


def refuse_unknown(command: Sequence[str], launch_file: str, known: Sequence[str]) -> None:
    """Refuse unknown launch arguments, which `ros2 launch` ignores.

    Arguments of another launch file that includes this one are not checked.
    """
    names = [Path(word).name for word in command]
    if launch_file not in names:
        return
    for word in command[names.index(launch_file) + 1 :]:
        name, given, _ = word.partition(':=')
        if given and name not in known:
            raise UnknownNameError('launch argument', name, known)


def switched(given: Mapping[str, str], name: str) -> bool:
    """Return the value of a boolean launch argument."""
    return bool(parse_like(False, yaml.safe_load(given[name]), f'launch argument "{name}"'))


def rviz_config(text: str, namespace: str, fixed_frame: str = '') -> str:
    """Return an RViz configuration for the node in a namespace, and another fixed frame."""
    document = yaml.safe_load(text)
    manager = document['Visualization Manager']
    above = ''.join(f'/{part}' for part in namespace.split('/') if part)
    for display in manager['Displays']:
        for key in ('Topic', 'Description Topic'):
            if key in display:
                display[key]['Value'] = above + display[key]['Value']
    if fixed_frame:
        manager['Global Options']['Fixed Frame'] = fixed_frame
    edited: str = yaml.safe_dump(document, sort_keys=False)
    return edited


def _described(parameter: NodeParameter) -> str:
    default = parameter.default
    if isinstance(default, bool):
        return f'{parameter.text}; default: {str(default).lower()}'
    if default in ('', ()):
        return parameter.text
    return f'{parameter.text}; default: {default}'


def _as_yaml(parameter: NodeParameter, text: str) -> str:
    value = _value(parameter, text)
    if isinstance(value, tuple):
        return f'[{", ".join(map(_quoted, value))}]'
    return _quoted(value) if isinstance(value, str) else str(value).lower()


def _value(parameter: NodeParameter, text: str) -> Any:
    given: object = text
    with suppress(yaml.YAMLError):  # such as *.a=0.001, an alias without an anchor
        loaded = yaml.safe_load(text)
        given = loaded if isinstance(loaded, bool | list) else text
    given = text if isinstance(parameter.default, str) else given
    return parse_like(parameter.default, given, f'launch argument "{parameter.name}"')


def _quoted(text: str) -> str:
    quoted: str = yaml.safe_dump(text, default_style='"', allow_unicode=True, width=2**31)
    return quoted.strip()
