# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The node's parameters, and the robot they name.

Every field of `Settings` is a parameter of the same name, with its description and smallest value;
`parameter_list.py` lists the others.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.wait_for_message import wait_for_message
from std_msgs.msg import String

from calib_ros.errors import ConfigError, UnknownNameError, near
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import URDF_SUFFIXES, chain_text, load_chain
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.ros.parameter_list import PARAMETERS, NodeParameter
from calib_ros.ros.to_ros import LATCHED
from calib_ros.sampling.sample import socket_place
from calib_ros.sampling.slices import SILENCE
from calib_ros.settings import Settings
from calib_ros.shown import some
from calib_ros.values import LARGEST_SETTING, parse_like

QOS = 'qos_overrides.'
OF_ROS = ('use_sim_time', 'start_type_description_service')  # parameters declared by rclpy
DESCRIPTION_WAIT = 2.0 * SILENCE  # time [s] to wait for the robot's description


class NodeValues(SimpleNamespace):
    """Parameters by name, and the `settings`, as given at the start.

    Those that can change are read where they are used.
    """

    @property
    def links(self) -> dict[str, Any]:
        """Return the first and last link of the arm in a URDF; None to find them."""
        return {'base_link': self.base_link or None, 'tip_link': self.tip_link or None}


def declare_all(node: Node, shared: Collection[str]) -> tuple[NodeValues, Sequence[str]]:
    """Declare all parameters of the node; return their values, and the names that were set.

    The node declares whatever is set, because rclpy lists it in no other way. Each parameter is
    declared again here with its description. Impossible values raise ConfigError, and unknown
    names that are not `shared` by all nodes.
    """
    given = node.get_parameters_by_prefix('').items()
    overrides = {name: each.value for name, each in given if not name.startswith(OF_ROS)}
    for name in overrides:
        node.undeclare_parameter(name)
    own = {n: _declare(node, overrides, p) for n, p in PARAMETERS.items() if n not in OF_ROS}
    others = [n for n in overrides if n in shared and not (n.startswith(QOS) or n in PARAMETERS)]
    strange = [name for name in others if not near(name, PARAMETERS, 0.8)]  # no typing errors
    if strange:
        told = f'parameters of all nodes that this one does not have: {", ".join(some(strange))}'
        node.get_logger().warning(f'{told}: they are ignored')
        overrides = {name: each for name, each in overrides.items() if name not in strange}
    settings = Settings(**{each.name: own[each.name] for each in fields(Settings)})
    refuse_unknown_names(node, [*overrides], QOS)
    if not own['chain']:
        raise ConfigError(
            'parameter "chain" is not set: give the chain file of the robot, for example '
            '--ros-args -p chain:=ur10e; in a parameter file under the key /**'
        )
    if not own['target_frame']:
        raise ConfigError('parameter "target_frame" must not be empty: name it, or leave it out')
    if own['socket']:
        socket_place(own['socket'])
    return NodeValues(**own, settings=settings), [*overrides]


def changed(settings: Settings, changes: Sequence[Any]) -> Settings:
    """Return settings with changed parameters."""
    values = {
        each.name: parse_like(getattr(Settings, each.name), each.value, each.name)
        for each in changes
        if hasattr(Settings, each.name)
    }
    return replace(settings, **values)


def load_robot(node: Node, given: NodeValues) -> tuple[Chain, str]:
    """Return the nominal chain, and its URDF if it comes from one."""
    name, links = os.path.expanduser(given.chain), given.links
    if name == 'robot_description':
        step = DESCRIPTION_WAIT / 10
        topic = node.resolve_topic_name('robot_description')
        node.get_logger().info(f'waiting up to {DESCRIPTION_WAIT:g} s for {topic}')
        for _ in range(10):  # between them a signal is heard
            found, message = wait_for_message(
                String, node, 'robot_description', qos_profile=LATCHED, time_to_wait=step
            )
            if found:
                break
        else:
            came = f'no robot_description arrived within {DESCRIPTION_WAIT:g} s'
            if node.count_publishers(topic):
                came += f' from the publisher of {topic}, which must latch it (transient local)'
            raise ConfigError(f'{came}: start robot_state_publisher, or set chain to a file')
        text = message.data
    elif Path(name).suffix.lower() in URDF_SUFFIXES:
        text = chain_text(Path(name))
    elif any(links.values()):
        raise ConfigError('base_link and tip_link apply only to a URDF')
    else:
        return load_chain(name), ''
    return replace(chain_from_urdf(text, **links), base=None, tool=None), text


def refuse_unknown_names(node: Node, names: Sequence[str], later: str = f'{QOS}/clock.') -> None:
    """Refuse names of parameters that were set but do not exist; ROS ignores them.

    Names that start with `later` are accepted: their parameters may be declared later.
    """
    known = [*node.get_parameters_by_prefix('')]
    for name in names:
        if name not in known and not name.startswith(later):
            raise UnknownNameError('parameter', name, known)


def _declare(node: Node, overrides: Mapping[str, Any], each: NodeParameter) -> Any:
    descriptor = ParameterDescriptor(description=each.text, read_only=each.fixed)
    if each.lower is not None and isinstance(each.default, int):
        span = IntegerRange(from_value=int(each.lower), to_value=int(LARGEST_SETTING))
        descriptor.integer_range = [span]
    elif each.lower is not None:
        most = min(each.upper, LARGEST_SETTING)
        span = FloatingPointRange(from_value=float(each.lower), to_value=most)
        descriptor.floating_point_range = [span]
    given = overrides.get(each.name, each.default)
    value = parse_like(each.default, given, f'parameter "{each.name}"')
    plain = [*value] or [''] if isinstance(value, tuple) else value  # [] has no type in ROS
    node.declare_parameter(each.name, plain, descriptor, ignore_override=True)
    return value
