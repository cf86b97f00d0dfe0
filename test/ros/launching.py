# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A stand-in of launch, which is not on PyPI, and what launch files do by it."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import rclpy
from rclpy.node import Node

from calib_ros.ros.parameter_list import PARAMETERS

ROOT = Path(__file__).parents[2]


class Action:
    """What a launch file returns, with the arguments that it was made with."""

    def __init__(self, *args, **kwargs):
        for name in kwargs:
            assert name in self.KEYWORDS, f'{type(self).__name__} takes no {name}'
        self.args, self.kwargs = args, kwargs


NODE = 'package executable name namespace parameters remappings ros_arguments arguments output'
KEYWORDS = {
    'launch': {},
    'launch.actions': {
        'DeclareLaunchArgument': 'default_value description',
        'LogInfo': 'msg',
        'OpaqueFunction': 'function',
        'RegisterEventHandler': '',
        'TimerAction': 'period actions',
    },
    'launch.event_handlers': {'OnProcessExit': 'target_action on_exit'},
    'launch_ros': {},
    'launch_ros.actions': {'Node': NODE},
    'launch_ros.parameter_descriptions': {'ParameterValue': 'value_type'},
}
ACTIONS = {
    module: {name: type(name, (Action,), {'KEYWORDS': k.split()}) for name, k in actions.items()}
    for module, actions in KEYWORDS.items()
}
ACTIONS['launch'] = {'LaunchContext': object, 'LaunchDescription': list}
ACTIONS['launch'] |= {'LaunchDescriptionEntity': Action}


def launch(monkeypatch, name, **arguments):
    """Evaluate a launch file; return its actions and its context."""
    for module, content in ACTIONS.items():
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
        sys.modules[module].__dict__.update(content)
    path = ROOT / name if '/' in name else ROOT / 'launch' / name
    words = [f'{key}:={value}' for key, value in arguments.items()]
    monkeypatch.setattr(sys, 'argv', ['ros2', 'launch', 'calib_ros', name, *words])
    space = {'__file__': str(path), '__name__': 'launched'}
    exec(compile(path.read_text(), path, 'exec'), space)
    *declared, start = space['generate_launch_description']()
    defaults = {each.args[0]: each.kwargs['default_value'] for each in declared}
    assert all(each.kwargs['description'] for each in declared)
    context = SimpleNamespace(launch_configurations=defaults | arguments, is_shutdown=False)
    return start.kwargs['function'](context), context


def nodes(actions):
    return {one.kwargs['executable']: one.kwargs for one in actions if 'executable' in one.kwargs}


def parameters_of(words):
    """Return the parameters that a real node gets by ROS arguments."""
    context = rclpy.Context()
    rclpy.init(context=context, args=[])
    node = Node(
        'calibration_node',
        context=context,
        cli_args=['--ros-args', *words, '--'],
        automatically_declare_parameters_from_overrides=True,
        start_parameter_services=False,
    )
    try:
        found = {key: each.value for key, each in node.get_parameters_by_prefix('').items()}
        return {
            key: list(value) if isinstance(PARAMETERS.get(key, node).default, tuple) else value
            for key, value in found.items()
            if key in PARAMETERS
        }
    finally:
        node.destroy_node()
        context.try_shutdown()
