# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The list of the node's parameters.

No ROS is imported here, so that launch files and node share it.
"""

from __future__ import annotations

import math
from ast import literal_eval
from dataclasses import dataclass, fields
from typing import Any

from calib_ros.settings import EXCEPTION, STARTUP, Settings


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
BESIDE_A_JOURNAL = (
    *('base_link', 'tip_link', 'serial', 'socket', 'largest_loss'),
    *('base_frame', 'flange_frame', 'target_frame'),
)
"""Parameters of the session that are no `Settings`."""


def described(parameter: NodeParameter) -> str:
    """Return the description of a parameter, with its default."""
    default = parameter.default
    if isinstance(default, bool):
        return f'{parameter.text}; default: {str(default).lower()}'
    if default in ('', ()):
        return parameter.text
    return f'{parameter.text}; default: {default}'
