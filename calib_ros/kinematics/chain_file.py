# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Chain files and calibrations (docs/formats.md): YAML to chain and back.

Nominal and corrected chains share one schema, so an output can be an input.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import texts
from calib_ros.annotated import as_annotated
from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Convention, Frame, Joint
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.parameter import IN_PIXELS, LENS_KINDS, ROW_KINDS
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.texts import dump_yaml, parse_yaml
from calib_ros.values import (
    LARGEST,
    MOST_NAMES,
    ROUNDED,
    parse_like,
    parse_mapping,
    parse_name,
    parse_number,
    parse_numbers,
)

CHAIN_KEYS = (
    *('name', 'convention', 'joints', 'parallel', 'base', 'tool', 'frames', 'effects', 'gravity'),
    'calibration',
)
FRAME_NAME = re.compile(r'(base|tool)_[^.]*')
FRAME_KEYS = ('xyz', 'quat_xyzw', 'fixed', 'delay', 'lens')
JOINT_KEYS = ('name', 'type', *ROW_KINDS, 'sign', 'lower', 'upper', 'mass', 'com', 'gear_ratio')
TWO_TURNS = 4.0 * math.pi
"""Largest angle of a table [rad]; tables in degrees exceed it."""
EXAMPLE = 'calib_ros chain ur10e prints one to edit'
URDF_SUFFIXES = ('.urdf', '.xml', '.xacro')


@as_annotated
def load_chain(name_or_path: str | os.PathLike[str]) -> Chain:
    """Read a chain file, a URDF, or a supplied robot by name, such as "ur10e" or "UR10e".

    Base and tool of a URDF are omitted: they lead to its links, not to the measuring device and
    its target.
    """
    path = Path(name_or_path)
    if path.suffix.lower() in URDF_SUFFIXES:
        return replace(read_urdf(path), base=None, tool=None)
    if not path.suffix and not path.is_file():
        robots = shipped_robots()
        if (name := str(name_or_path).lower()) not in robots:
            another = f'another arm needs a URDF or a chain file ({EXAMPLE})'  # a UR5 is no UR5e
            if path.is_dir():
                raise ConfigError(
                    f'{path} is a folder, no arm: give the name of a robot, a URDF or a chain '
                    'file; of a result, the calibration.yaml in it is one'
                )
            raise UnknownNameError('robot', str(name_or_path), robots, another)
        path = robots[name]
    try:
        chain = parse_chain(chain_text(path), str(path))
    except ConfigError as err:
        if path.suffix.lower() in ('', '.yaml', '.yml', '.json') or not path.is_file():
            raise
        raise ConfigError(
            f'{path} is no chain file (.yaml) or URDF: give the arm, by its file or name, as '
            f'--chain ({EXAMPLE}), and measurements without an option'
        ) from err
    _refuse_other_units(chain, str(path))
    return chain


def too_long(chain: Chain, most: float = 100.0) -> float:
    """Return the length [m] of the links together if it is over `most`, else 0.

    Over 100 m it is in mm: no arm is as long, or smaller than 0.1 m.
    """
    along = sum(each.d for each in chain.joints)  # parallel axes share any d, with signs
    length = sum(abs(each.a) for each in chain.joints) + abs(along)
    return length if length > most else 0.0


def _refuse_other_units(chain: Chain, where: str) -> None:
    """Refuse limits in degrees and lengths in millimetres.

    Joint values in degrees would pass for radians between such limits, and plans and programs have
    no measured lengths to compare.
    """
    if length := too_long(chain):
        raise ConfigError(
            f'{where}: its links are {length:.0f} m long: lengths must be in metres, 300 mm as 0.3'
        )
    for k, joint in enumerate(chain.joints, 1):
        for key in ('lower', 'upper'):
            limit = float(getattr(joint, key) or 0.0)
            if joint.type == 'prismatic':
                wrong, unit, other, value = abs(limit) > 100.0, 'metres', 'mm', limit / 1e3
            else:
                wrong = abs(limit) > TWO_TURNS and limit.is_integer()
                unit, other, value = 'radians', 'degrees', math.radians(limit)
            if wrong:
                raise ConfigError(
                    f'{where}: joint {k}: {key} must be in {unit}, not {limit:g}: write {other} '
                    f'as {value:.9g}, or leave it out if there is no limit'
                )


def read_urdf(
    path: Path,
    base_link: str | None = None,
    tip_link: str | None = None,
    convention: Convention = 'standard',
) -> Chain:
    """Read the chain between two links of a URDF, with its frames (`urdf.chain_from_urdf`)."""
    chain = chain_from_urdf(chain_text(path), base_link, tip_link, convention)
    _refuse_other_units(chain, str(path))
    return chain


def chain_text(path: Path) -> str:
    """Return the text of a chain file or a URDF."""
    what = 'URDF ' if path.suffix.lower() in URDF_SUFFIXES else 'chain file '
    return texts.read_text(path, what=what)


def shipped_robots() -> dict[str, Path]:
    """Return the supplied chain files by name."""
    return shared_files('robots')


@cache
def shipped_chains() -> tuple[Chain, ...]:
    """Return the supplied chains."""
    return tuple(load_chain(name) for name in shipped_robots())


def shared_files(folder: str) -> dict[str, Path]:
    """Return the supplied YAML files in a folder of `config`, by name.

    Searched in the share folders of the ROS workspaces, in that of the Python environment, and in
    the source tree.
    """
    prefixes = [Path(p) for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    shares = [prefix / 'share' / 'calib_ros' for prefix in (*prefixes, Path(sys.prefix))]
    for share in (*shares, Path(__file__).parents[2]):
        found = sorted((share / 'config' / folder).glob('*.yaml'))
        if found:
            return {path.stem: path for path in found}
    return {}


def parse_chain(text: str, where: str = 'chain file') -> Chain:
    """Parse the text of a chain file; errors name it `where`."""
    document = parse_yaml(text, where)
    for key in document if isinstance(document, dict) else ():
        if str(key).lower() in ('unit', 'units'):
            fixed = 'lengths are in metres, angles in radians'
            raise UnknownNameError(f'{where}: key', key, CHAIN_KEYS, fixed)
    content = parse_mapping(document, CHAIN_KEYS, where, ('joints',))
    if content.get('convention') is None:
        raise ConfigError(f'{where}: key "convention" is missing: standard or modified')
    rows = content['joints']
    if not isinstance(rows, list) or not rows:
        raise ConfigError(
            f'{where}: "joints" must be a list with one entry per joint, such as '
            '- {name: A1, a: 0, alpha: 1.5708, d: 0.4, theta: 0}'
        )
    if len(rows) > MOST_NAMES:
        raise ConfigError(f'{where}: {len(rows)} joints are more than {MOST_NAMES}')
    parallel = content.get('parallel')
    if parallel is not None and not (isinstance(parallel, list) and _texts(parallel)):
        raise ConfigError(
            f'{where}: "parallel" must be a list of joint names, not {parallel!r:.80}'
        )
    gravity = content.get('gravity')
    gravity = list(Chain.gravity) if gravity is None else gravity
    x, y, z = parse_numbers(gravity, 3, f'{where}: gravity').tolist()
    try:
        return Chain(
            name=parse_name(content.get('name', Path(where).stem), f'{where}: name'),
            convention=content['convention'],
            joints=tuple(_joint(row, f'{where}: joint {k + 1}') for k, row in enumerate(rows)),
            parallel=None if parallel is None else tuple(parallel),
            **parse_frames(content, where),
            gravity=(x, y, z),
        ).with_effect_values(
            {
                name: parse_number(value, f'{where}: effects: {name}')
                for name, value in dictionary(content.get('effects'), f'{where}: effects').items()
            }
        )
    except UnknownNameError as err:
        what = err.what if where in err.what else f'{where}: {err.what}'
        raise UnknownNameError(what, err.name, err.alternatives) from err
    except ConfigError as err:
        text = str(err)
        raise ConfigError(text if text.startswith(where) else f'{where}: {text}') from err


def parse_frames(content: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the frame arguments of a chain; errors name them `where`."""
    others = dictionary(content.get('frames'), f'{where}: frames')
    for name in others:
        if not FRAME_NAME.fullmatch(name):
            raise ConfigError(
                f'{where}: frames: names are base_... or tool_... without dots, not "{name:.100}"'
            )
    return {
        'base': _frame(content.get('base'), f'{where}: base'),
        'tool': _frame(content.get('tool'), f'{where}: tool'),
        'frames': tuple(
            (parse_name(name, f'{where}: frames'), _frame(frame, f'{where}: frames.{name}'))
            for name, frame in others.items()
        ),
    }


def calibration_record(text: str) -> dict[str, Any]:
    """Return the record of a chain file: the origin of its numbers."""
    record = parse_yaml(text, 'chain file').get('calibration')
    return record if isinstance(record, dict) else {}


def table_hash(chain: Chain) -> str:
    """Return the SHA-256 of the table and effects, which identifies files of a chain.

    Existing files hold it, so its input must never change.
    """
    rows = [
        [joint.name, joint.type, joint.sign, *row]
        for joint, row in zip(chain.joints, chain.table.tolist(), strict=True)
    ]
    content = [str(chain.convention), rows, [[name, float(x)] for name, x in chain.effects]]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def chain_document(chain: Chain) -> dict[str, Any]:
    """Return the content of a chain file as plain Python values."""
    joints = []
    for joint in chain.joints:
        row: dict[str, Any] = {'name': joint.name, 'type': joint.type}
        row |= {kind: float(getattr(joint, kind)) for kind in chain.columns} | {'sign': joint.sign}
        ends = {'lower': joint.lower, 'upper': joint.upper}
        row |= {key: float(end) for key, end in ends.items() if end is not None}
        if joint.mass or any(joint.com):
            row |= {'mass': float(joint.mass), 'com': [float(part) for part in joint.com]}
        if joint.gear_ratio:
            row['gear_ratio'] = float(joint.gear_ratio)
        joints.append(row)
    document: dict[str, Any] = {
        'name': chain.name,
        'convention': chain.convention,
        'joints': joints,
        'parallel': list(chain.parallel or ()),
    }
    document |= frames_document(chain)
    if chain.effects:
        document['effects'] = {name: float(value) for name, value in chain.effects}
    if chain.gravity != Chain.gravity:
        document['gravity'] = [float(part) for part in chain.gravity]
    return document


def frames_document(chain: Chain) -> dict[str, Any]:
    """Return the frames of a chain file as plain Python values."""
    ends = (('base', chain.base), ('tool', chain.tool))
    document: dict[str, Any] = {k: _frame_document(f) for k, f in ends if f is not None}
    others = {name: _frame_document(frame) for name, frame in chain.frames if frame is not None}
    return document | ({'frames': others} if others else {})


def _frame_document(frame: Frame) -> dict[str, Any]:
    document: dict[str, Any] = {
        'xyz': frame.matrix[:3, 3].tolist(),
        'quat_xyzw': se3.to_quat(frame.matrix[:3, :3]).tolist(),
        'fixed': frame.fixed,
    }
    if frame.delay is not None:
        document['delay'] = frame.delay
    if frame.lens is not None:
        document['lens'] = frame.lens.values | {'fixed': frame.lens.fixed}
    return document


@as_annotated
def dump_chain(chain: Chain, calibration: Mapping[str, Any] | None = None) -> str:
    """Return the text of a chain file; `calibration` is the origin of its numbers.

    The hash of its table ends it: a file that was cut off has none.
    """
    document = chain_document(chain)
    if calibration is not None:
        ordered = sorted(calibration.items(), key=lambda each: each[0] == 'table_sha256')
        document['calibration'] = dict(ordered)
    return dump_yaml(document)


def _texts(values: Iterable[object]) -> bool:
    return all(isinstance(value, str) for value in values)


def dictionary(value: object, where: str) -> dict[str, Any]:
    """Return a mapping of names, empty for none; errors name it `where`."""
    if value is None:
        return {}
    if not isinstance(value, dict) or not _texts(value):
        raise ConfigError(f'{where} must be a mapping of names, not {value!r:.100}')
    return value


def _joint(row: object, where: str) -> Joint:
    content = parse_mapping(row, JOINT_KEYS, where, ('name', 'a', 'alpha', 'd', 'theta'))
    numbers = {
        key: parse_number(content[key], f'{where}: {key}')
        for key in (*ROW_KINDS, 'sign', 'mass', 'gear_ratio')
        if content.get(key) is not None
    }
    for key in ('alpha', 'theta', 'beta'):
        if abs(numbers.get(key, 0.0)) > TWO_TURNS:
            raise ConfigError(
                f'{where}: {key} must be in radians, not {numbers[key]:g}: write degrees as '
                f'{math.radians(numbers[key]):.9g}'
            )
    for key in ('lower', 'upper'):
        if content.get(key) is not None:
            limit = parse_number(content[key], f'{where}: {key}', largest=math.inf)
            if abs(limit) < 0.09 * LARGEST:  # larger ones, as 99999, mean none
                numbers[key] = limit
    sign = numbers.pop('sign', 1.0)
    x, y, z = parse_numbers(content.get('com', [0.0, 0.0, 0.0]), 3, f'{where}: com').tolist()
    if sign not in (1.0, -1.0):
        raise ConfigError(f'{where}: sign must be 1 or -1, not {sign:g}')
    return Joint(
        name=parse_name(content['name'], f'{where}: name'),
        type=content.get('type', 'revolute'),
        sign=int(sign),
        com=(x, y, z),
        **numbers,
    )


def _frame(value: object, where: str) -> Frame | None:
    if value is None:
        return None
    content = parse_mapping(value, FRAME_KEYS, where)
    xyz = parse_numbers(content.get('xyz', [0.0, 0.0, 0.0]), 3, f'{where}.xyz')
    quat = parse_numbers(content.get('quat_xyzw', [0.0, 0.0, 0.0, 1.0]), 4, f'{where}.quat_xyzw')
    length = float(np.linalg.norm(quat))
    if abs(length - 1.0) > ROUNDED:
        raise ConfigError(f'{where}.quat_xyzw must have length 1 (x, y, z, w), not {length:.6g}')
    delay = content.get('delay')
    return Frame(
        se3.transform(se3.from_quat(quat), xyz),
        parse_like(False, content.get('fixed', False), f'{where}.fixed'),
        None if delay is None else parse_number(delay, f'{where}.delay'),
        None if content.get('lens') is None else _lens(content['lens'], f'{where}.lens'),
    )


def _lens(value: object, where: str) -> Lens:
    content = parse_mapping(value, (*LENS_KINDS, 'fixed'), where, IN_PIXELS)
    given = [kind for kind in LENS_KINDS if kind in content]
    numbers = {kind: parse_number(content[kind], f'{where}.{kind}') for kind in given}
    fixed = parse_like(True, content.get('fixed', True), f'{where}.fixed')
    return Lens(**numbers, fixed=fixed)
