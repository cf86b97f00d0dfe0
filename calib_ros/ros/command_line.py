# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line of the node, and the parameter files that it names."""

from __future__ import annotations

import argparse
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from calib_ros.errors import ConfigError
from calib_ros.ros.parameter_list import PARAMETERS, described
from calib_ros.shown import some


def usage(program: str) -> argparse.ArgumentParser:
    """Return a parser of the non-ROS arguments: only --help, which lists the parameters."""
    lines = ['parameters:']
    for each in PARAMETERS.values():
        text = textwrap.indent(textwrap.fill(described(each), 74), ' ' * 6)
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
            words[k] = f'{name}:={quoted(value)}'
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


def quoted(text: str) -> str:
    """Return a text in quotes, so that YAML keeps it text."""
    quoted: str = yaml.safe_dump(text, default_style='"', allow_unicode=True, width=2**31)
    return quoted.strip()


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
