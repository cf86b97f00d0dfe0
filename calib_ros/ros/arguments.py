# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Launch arguments made from the node's parameters.

Launch arguments are strings. `ros_arguments` converts them to command line arguments of a node by
the type of each parameter: `serial:=0012` stays text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from calib_ros.atomic import given_path
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.ros.command_line import quoted
from calib_ros.ros.parameter_list import PARAMETERS, NodeParameter, described
from calib_ros.values import parse_like

NODE = 'calibration_node'
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
    texts = {each.name: described(each) for each in PARAMETERS.values()}
    return {**texts, **PLACED, **REMAPPED}


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
    return str(yaml.safe_dump(document, sort_keys=False))


def _as_yaml(parameter: NodeParameter, text: str) -> str:
    value = _value(parameter, text)
    if isinstance(value, tuple):
        return f'[{", ".join(map(quoted, value))}]'
    return quoted(value) if isinstance(value, str) else str(value).lower()


def _value(parameter: NodeParameter, text: str) -> Any:
    given: object = text
    with suppress(yaml.YAMLError):  # such as *.a=0.001, an alias without an anchor
        loaded = yaml.safe_load(text)
        given = loaded if isinstance(loaded, bool | list) else text
    given = text if isinstance(parameter.default, str) else given
    return parse_like(parameter.default, given, f'launch argument "{parameter.name}"')
