# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros robots | chain`: the arms supplied."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib_ros.atomic import write_file
from calib_ros.cli import checks
from calib_ros.cli.screen import Screen
from calib_ros.kinematics import chain_file


def _robots(options: argparse.Namespace, screen: Screen) -> int:
    lines = [f'{"--chain":21}{"joints":>6}  {"DH table":10}{"length":>8}']
    for name in chain_file.shipped_robots():
        chain = chain_file.load_chain(name)
        length = sum(np.hypot(joint.a, joint.d) for joint in chain.joints)
        lines.append(f'{name:21}{len(chain.joints):6}  {chain.convention:10}{length:6.2f} m')
    screen.data('\n'.join(lines))
    screen.say('')
    screen.say('calib_ros chain NAME prints one; any other arm needs a URDF or chain file')
    return 0


def _chain(options: argparse.Namespace, screen: Screen) -> int:
    names = ('base_link', 'tip_link', 'convention')
    given = {name: getattr(options, name) for name in names if getattr(options, name)}
    path = Path(options.robot)
    if path.suffix.lower() in chain_file.URDF_SUFFIXES:
        chain = chain_file.read_urdf(path, **given)
        frames = chain_file.chain_document(chain)
        text = chain_file.dump_chain(replace(chain, base=None, tool=None))
        text += '# From the URDF: uncomment a line if the device measures in the base link,\n'
        text += '# or the tip link itself; otherwise the frame is found from the poses.\n'
        for key in ('base', 'tool'):
            text += f'# {key}: {json.dumps(frames[key] | {"fixed": True})}\n'
    else:
        checks.refuse(options, names, 'applies only to a URDF')
        text = chain_file.dump_chain(chain_file.load_chain(options.robot))
    if options.out is None:
        screen.data(text.rstrip('\n'))
    else:
        write_file(options.out, text)
        screen.say(f'wrote {options.out}')
    return 0
