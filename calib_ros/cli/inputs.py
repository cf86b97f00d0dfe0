# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags and tables as the options say, with a sign of life while they are read."""

from __future__ import annotations

import argparse
from pathlib import Path

from calib_ros.cli import given, options as common
from calib_ros.cli.screen import Screen
from calib_ros.files import loading
from calib_ros.files.bags import Replayed
from calib_ros.files.tables import Table
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings


def replayed(
    path: Path, chain: Chain, settings: Settings, screen: Screen
) -> tuple[CalibrationSession, Replayed]:
    """Return a session that has taken a bag."""
    with screen.work(f'reading {path.name}') as work:
        return loading.replayed(path, chain, settings, work)


def table(
    options: argparse.Namespace,
    path: Path,
    chain: Chain,
    settings: Settings,
    screen: Screen,
    eye_in_hand: bool = False,
) -> Table:
    """Return a table of measurements, laid out as the options say."""
    foreign = given.foreign_of(options, chain)
    sessions = common.sessions_of(options)
    with screen.work(f'reading {path.name}') as work:
        return loading.table(path, chain, settings, sessions, eye_in_hand, foreign, work)
