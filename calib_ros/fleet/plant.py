# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""plant.yaml: robots, their measurements and settings."""

from __future__ import annotations

import glob
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import date, datetime, timedelta, timezone
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from calib_ros.errors import MOST_ENTRIES, ConfigError, UnknownNameError
from calib_ros.files.hashes import settings_hash
from calib_ros.files.rows import parse_serial
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.settings import EXCEPTION, Settings
from calib_ros.texts import parse_yaml, read_text
from calib_ros.values import parse_like, parse_mapping, parse_number

COMMON = ('chain', 'settings', 'tolerance', 'largest_loss')  # keys of a group or a robot
KEYS = {
    'the plant': ('groups', 'robots'),
    'a group': COMMON,
    'a robot': ('serial', 'group', 'measured', 'since', *COMMON),
    'measured': ('files', 'session'),
    'settings': tuple(each.name for each in fields(Settings)),
}

Arm: TypeAlias = Chain | ConfigError
"""A nominal chain, or why it cannot be read, which costs only the nights of its robots."""


@dataclass(frozen=True)
class Pattern:
    """Files by a glob pattern, local or at a URL; of tables one session, if named."""

    files: str
    session: str = ''


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot of the plant."""

    serial: str
    arm: Arm
    measured: tuple[Pattern, ...]
    settings: Settings = field(default_factory=Settings)
    tolerance: float | None = None  # wanted RMS position error [mm]
    largest_loss: float = EXCEPTION  # share of a bag's messages that may be lost
    since: datetime | None = None  # earlier measurements are not compared

    @property
    def chain(self) -> Chain:
        """Return the nominal chain; raise ConfigError if it cannot be read."""
        if isinstance(self.arm, ConfigError):
            raise self.arm
        return self.arm

    def compares(self, time: datetime) -> bool:
        """Tell whether measurements at a time are compared with later ones."""
        return self.since is None or time >= self.since

    @cached_property
    def settings_hash(self) -> str:
        """Return the hash of what a result depends on besides the measurements."""
        return settings_hash(self.chain, self.settings, self.largest_loss)


def read_plant(path: Path) -> tuple[Robot, ...]:
    """Read a plant file; names in it are relative to its folder."""
    return parse_plant(read_text(path, what='plant file '), path.parent, str(path))


def parse_plant(text: str, folder: Path, where: str = 'plant file') -> tuple[Robot, ...]:
    """Return the robots in the text of a plant file."""
    content = parse_mapping(parse_yaml(text, where), KEYS['the plant'], where)
    groups = content.get('groups') or {}
    if not isinstance(groups, dict):
        raise ConfigError(f'{where}: groups must be a mapping of names, not {groups!r:.100}')
    groups = {
        str(name): parse_mapping(values, KEYS['a group'], f'{where}: group {name}')
        for name, values in groups.items()
    }
    rows = content.get('robots')
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f'{where}: robots must be a list, each with serial, chain and measured')
    chains: dict[str, Arm] = {}
    robots: dict[str, Robot] = {}
    for number, row in enumerate(rows, 1):
        robot = _robot(row, groups, folder, f'{where}: robot {number}', chains)
        if robot.serial in robots:
            raise ConfigError(f'{where}: there are two robots with the serial {robot.serial}')
        robots[robot.serial] = robot
    return tuple(robots.values())


def _robot(
    row: object, groups: Mapping[str, Any], folder: Path, where: str, chains: dict[str, Arm]
) -> Robot:
    own = parse_mapping(row, KEYS['a robot'], where)
    serial = parse_serial(own.get('serial'), f'{where}: serial')
    where = f'{where} ({serial})'
    group = own.get('group')
    if group is not None and str(group) not in groups:
        raise UnknownNameError(f'{where}: group', str(group), groups)
    shared = {} if group is None else groups[str(group)]
    given = {**shared, **own}
    chosen: dict[str, Any] = {}
    for each in (shared, own):
        chosen |= parse_mapping(each.get('settings') or {}, KEYS['settings'], f'{where}: settings')
    for name, value in chosen.items():
        chosen[name] = parse_like(getattr(Settings, name), value, f'{where}: {name}')
    try:
        settings = Settings(**chosen)
    except ConfigError as err:
        raise ConfigError(f'{where}: {err}') from err
    tolerance = given.get('tolerance')
    if tolerance is not None:
        tolerance = parse_number(tolerance, f'{where}: tolerance')
        if tolerance <= 0.0:
            raise ConfigError(f'{where}: tolerance must be positive, not {tolerance:g}')
    loss = parse_number(given.get('largest_loss', Robot.largest_loss), f'{where}: largest_loss')
    if not 0.0 <= loss <= 1.0:
        raise ConfigError(f'{where}: largest_loss must be from 0 to 1, not {loss:g}')
    arm = _chain(given.get('chain'), folder, where, chains)
    measured = _measured(own.get('measured'), folder, where)
    since = _moment(own.get('since'), f'{where}: since')
    return Robot(serial, arm, measured, settings, tolerance, loss, since)


def _chain(name: object, folder: Path, where: str, chains: dict[str, Arm]) -> Arm:
    if not isinstance(name, str) or not name:
        raise ConfigError(f'{where}: give chain, a file or a robot by its name, or a group')
    if name not in chains:
        path = folder / name
        try:
            chains[name] = load_chain(path if path.suffix or path.is_file() else name)
        except ConfigError as err:
            chains[name] = ConfigError(f'{err}: correct it, or "chain" in the plant file')
    return chains[name]


def _measured(value: object, folder: Path, where: str) -> tuple[Pattern, ...]:
    entries = value if isinstance(value, list) and value else [value]
    found, root = [], Path(glob.escape(str(folder)))  # only what is written there is a pattern
    for entry in entries:
        if not isinstance(entry, dict):
            entry = {'files': entry}
        entry = parse_mapping(entry, KEYS['measured'], f'{where}: measured')
        files = entry.get('files')
        session = parse_like('', entry.get('session', ''), f'{where}: session')
        if not isinstance(files, str) or not files or len(files) > MOST_ENTRIES:
            raise ConfigError(
                f'{where}: measured must be a pattern of bags or tables, a file or URL with *, '
                f'or a list of them, not {files!r:.100}'
            )
        found.append(Pattern(files if '://' in files else str(root / files), session))
    return tuple(found)


def _moment(value: object, where: str) -> datetime | None:
    """Return a date of YAML as a time, in UTC without a zone."""
    if value is None:
        return None
    try:
        text = value.isoformat() if isinstance(value, date) else value
        moment = datetime.fromisoformat(text)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ConfigError(f'{where} must be a date, such as 2026-11-20, not {value!r}') from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
    if moment - datetime.now(timezone.utc) > timedelta(days=1):  # tomorrow in some time zones
        raise ConfigError(f'{where} is in the future, so no night would be compared: {value!s}')
    return moment
