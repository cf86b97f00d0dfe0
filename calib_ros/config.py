# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings, and chain files: YAML to chain and back.

One schema for nominal and corrected chains, so that an output is an input. `docs/formats.md`
describes it.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.chain import DH_KINDS, Chain, Frame, Joint
from calib_ros.errors import ConfigError, UnknownNameError

CHAIN_KEYS = ('name', 'convention', 'joints', 'parallel', 'base', 'tool', 'calibration')
FRAME_KEYS = ('xyz', 'quat_xyzw', 'fixed')
JOINT_KEYS = ('name', 'type', *DH_KINDS, 'sign', 'lower', 'upper')
QUATERNION_TOLERANCE = 1e-3
"""A quaternion whose length differs from 1 by more is refused as not being one."""


def _setting(default: Any, text: str, lower: float | None = None) -> Any:
    """Declare a setting with what a node parameter and a command line option need to know."""
    if isinstance(default, tuple):
        return field(default=default, metadata={'text': text})
    return field(default=default, metadata={'text': text, 'lower': lower})


@dataclass(frozen=True)
class Settings:
    """Everything that can be set besides the chain; same names in the node and the CLI."""

    sigma_position: float = _setting(
        1e-4, 'standard deviation of a measured position without its own covariance [m]', 1e-9
    )
    sigma_orientation: float = _setting(
        1e-4 / 0.3,
        'standard deviation of a measured orientation without its own covariance [rad]',
        1e-9,
    )
    max_gap: float = _setting(
        0.1, 'longest time between the two joint samples that bracket a pose [s]', 0.0
    )
    joint_buffer: int = _setting(
        200_000, 'joint samples kept; older ones are let go when it is full', 2
    )
    pose_buffer: int = _setting(50_000, 'poses kept; new ones are dropped when it is full', 1)
    folds: int = _setting(5, 'parts of the cross-validation', 2)
    joint_names: tuple[str, ...] = _setting(
        (), "names of the chain's joints in JointState, in its order; default: those of the chain"
    )
    fixed: tuple[str, ...] = _setting(
        (), 'parameters held at their nominal values, for example joint_2.a or *.alpha'
    )

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        for item in fields(self):
            lower = item.metadata.get('lower')
            value = getattr(self, item.name)
            if lower is not None and not (lower <= value < math.inf):
                raise ConfigError(f'{item.name} must be at least {lower}, not {value}')


def load_chain(name_or_path: str | os.PathLike[str]) -> Chain:
    """Read a chain file, or a robot that calib_ros ships by its name, for example "ur10e"."""
    path = Path(name_or_path)
    if not path.suffix and not path.exists():
        robots = shipped_robots()
        if path.name not in robots:
            raise UnknownNameError('robot', str(name_or_path), robots)
        path = robots[path.name]
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f'cannot read chain file {path}: {err}') from err
    return parse_chain(text, str(path))


def shipped_robots() -> dict[str, Path]:
    """Return the chain files that come with calib_ros, by name.

    Looked for in the share folders of the ROS workspaces in use, in that of the Python
    environment, and in the source tree.
    """
    prefixes = [Path(p) for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    shares = [prefix / 'share' / 'calib_ros' for prefix in (*prefixes, Path(sys.prefix))]
    for share in (*shares, Path(__file__).parents[1]):
        found = sorted((share / 'config' / 'robots').glob('*.yaml'))
        if found:
            return {path.stem: path for path in found}
    return {}


def parse_chain(text: str, where: str = 'chain file') -> Chain:
    """Turn the text of a chain file into a chain; `where` names it in errors."""
    import yaml

    try:
        document = yaml.safe_load(text)
    except yaml.YAMLError as err:
        raise ConfigError(f'{where} is not valid YAML: {err}') from err
    content = _mapping(document, CHAIN_KEYS, where)
    for key in ('convention', 'joints'):
        if key not in content:
            raise ConfigError(f'{where}: key "{key}" is missing')
    rows = content['joints']
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f'{where}: "joints" must be a list with one entry a joint')
    parallel = content.get('parallel')
    if parallel is not None and not (
        isinstance(parallel, list) and all(isinstance(name, str) for name in parallel)
    ):
        raise ConfigError(f'{where}: "parallel" must be a list of joint names, not {parallel!r}')
    try:
        return Chain(
            name=str(content.get('name', Path(where).stem)),
            convention=content['convention'],
            joints=tuple(_joint(row, f'{where}: joint {k + 1}') for k, row in enumerate(rows)),
            parallel=None if parallel is None else tuple(parallel),
            base=_frame(content.get('base'), f'{where}: base'),
            tool=_frame(content.get('tool'), f'{where}: tool'),
        )
    except ConfigError as err:
        if str(err).startswith(where):
            raise
        raise ConfigError(f'{where}: {err}') from err


def chain_document(chain: Chain) -> dict[str, Any]:
    """Return the content of a chain file as plain Python values."""
    joints = []
    for joint in chain.joints:
        row: dict[str, Any] = {'name': joint.name, 'type': joint.type}
        row |= {kind: float(getattr(joint, kind)) for kind in DH_KINDS}
        row['sign'] = joint.sign
        row |= {k: getattr(joint, k) for k in ('lower', 'upper') if getattr(joint, k) is not None}
        joints.append(row)
    document: dict[str, Any] = {
        'name': chain.name,
        'convention': chain.convention,
        'joints': joints,
        'parallel': list(chain.parallel or ()),
    }
    for key in ('base', 'tool'):
        frame = getattr(chain, key)
        if frame is not None:
            document[key] = {
                'xyz': frame.matrix[:3, 3].tolist(),
                'quat_xyzw': se3.to_quat(frame.matrix[:3, :3]).tolist(),
                'fixed': frame.fixed,
            }
    return document


def dump_chain(chain: Chain, calibration: Mapping[str, Any] | None = None) -> str:
    """Return the text of a chain file; `calibration` says where the numbers come from."""
    import yaml

    document = chain_document(chain)
    if calibration is not None:
        document['calibration'] = dict(calibration)
    return str(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000))


def _mapping(value: object, keys: tuple[str, ...], where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f'{where} must be a mapping with the keys {", ".join(keys)}')
    for key in value:
        if key not in keys:
            raise UnknownNameError(f'key in {where}', str(key), keys)
    return value


def _number(value: object, where: str) -> float:
    try:  # YAML 1.1 reads 1e-3, without a dot, as a string
        number = float(value) if isinstance(value, int | float | str) else math.nan
    except ValueError:
        number = math.nan
    if isinstance(value, bool) or not math.isfinite(number):
        raise ConfigError(f'{where} must be a finite number, not {value!r}')
    return number


def _numbers(value: object, count: int, where: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    if not isinstance(value, list) or len(value) != count:
        raise ConfigError(f'{where} must be a list of {count} numbers, not {value!r}')
    return np.array([_number(item, where) for item in value])


def _joint(row: object, where: str) -> Joint:
    content = _mapping(row, JOINT_KEYS, where)
    for key in ('name', 'a', 'alpha', 'd', 'theta'):
        if key not in content:
            raise ConfigError(f'{where}: key "{key}" is missing')
    numbers = {
        key: _number(content[key], f'{where}: {key}')
        for key in (*DH_KINDS, 'sign', 'lower', 'upper')
        if content.get(key) is not None
    }
    sign = numbers.pop('sign', 1.0)
    if sign not in (1.0, -1.0):
        raise ConfigError(f'{where}: sign must be 1 or -1, not {sign:g}')
    return Joint(
        name=str(content['name']),
        type=content.get('type', 'revolute'),
        sign=int(sign),
        **numbers,
    )


def _frame(value: object, where: str) -> Frame | None:
    if value is None:
        return None
    content = _mapping(value, FRAME_KEYS, where)
    xyz = _numbers(content.get('xyz', [0.0, 0.0, 0.0]), 3, f'{where}.xyz')
    quat = _numbers(content.get('quat_xyzw', [0.0, 0.0, 0.0, 1.0]), 4, f'{where}.quat_xyzw')
    length = float(np.linalg.norm(quat))
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise ConfigError(f'{where}.quat_xyzw must have length 1 (x, y, z, w), not {length:.6g}')
    fixed = content.get('fixed', False)
    if not isinstance(fixed, bool):
        raise ConfigError(f'{where}.fixed must be true or false, not {fixed!r}')
    return Frame(se3.transform(se3.from_quat(quat), xyz), fixed)
