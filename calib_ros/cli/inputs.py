# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements from a bag or a table, as what is fitted or judged."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calib_ros.cli.options import foreign_of, sessions_of
from calib_ros.cli.screen import Screen
from calib_ros.files.bags import Replayed, replay
from calib_ros.files.tables import Table, read_table
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason
from calib_ros.identification.records import Owner
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.sample import named
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings


@dataclass(frozen=True, eq=False)
class Loaded:
    """A problem, and what became of the input.

    `samples` are the counts of it, `read` says them in words; `lines` tells that stamps are the
    lines of a table, `refusals` why a result must not be accepted whatever it is, `instead` that
    these stand instead of its own; `owners` whose frame each is, of a bag.
    """

    problem: Problem
    samples: dict[str, Any]
    warnings: tuple[str, ...] = ()
    read: str = ''
    lines: bool = False
    refusals: tuple[Reason, ...] = ()
    instead: bool = False
    owners: Mapping[str, Owner] = field(default_factory=dict)


def replayed(
    path: Path, chain: Chain, settings: Settings, screen: Screen
) -> tuple[CalibrationSession, Replayed]:
    """Return a session that has taken a bag."""
    session = CalibrationSession(chain, settings)
    with screen.work(f'reading {path.name}') as work:
        return session, replay(path, session, lambda share: work(share=share))


def of_bag(
    path: Path, chain: Chain, settings: Settings, screen: Screen, largest_loss: float = 1.0
) -> Loaded:
    """Return what is to be fitted of a bag, of which no more than a share may be lost."""
    session, read = replayed(path, chain, settings, screen)
    problem = session.problem()
    account = session.account()
    samples = {'recorded': read.recorded, 'read': read.read, **account.as_document()}
    refusals = read.refusals(account, largest_loss)
    words, owners = f'{read}; {account}', named(session.usable).owners
    return Loaded(problem, samples, read.warnings, words, refusals=refusals, owners=owners)


def table(
    options: argparse.Namespace,
    path: Path,
    chain: Chain,
    settings: Settings,
    screen: Screen,
    eye_in_hand: bool = False,
) -> Table:
    """Return a table of measurements, laid out as the options say."""
    sigmas = (settings.sigma_position, settings.sigma_orientation)
    foreign = foreign_of(options, chain)
    with screen.work(f'reading {path.name}'):
        return read_table(
            path, len(chain.joints), sessions_of(options), sigmas, eye_in_hand, foreign
        )


def of_table(
    options: argparse.Namespace, chain: Chain, settings: Settings, screen: Screen
) -> Loaded:
    """Return what is to be fitted of a table."""
    found = table(options, options.csv, chain, settings, screen, options.eye_in_hand)
    given = {'sockets': options.socket_distance, 'sigma_touch': options.sigma_touch}
    given = {name: value for name, value in given.items() if value is not None}
    problem = found.problem(chain, **given, **settings.for_problem())
    samples = {
        'samples': sum(map(len, found.fitted)),
        'held_out': sum(map(len, found.held_out)),
        'sets': len(found.fitted),
    }
    return Loaded(problem, samples, found.warnings, lines=found.by_line)
