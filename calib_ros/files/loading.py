# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From a bag or a table to what is identified, and its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from calib_ros.errors import CalibrationError, ColumnsError, TooFewObservationsError
from calib_ros.files.bags import Replayed, replay
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout
from calib_ros.files.tables import Table, read_table
from calib_ros.identification.model_choice import identify_model
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason
from calib_ros.identification.records import Owner
from calib_ros.identification.result import Identification
from calib_ros.kinematics.chain import Chain
from calib_ros.progress import Told, nobody
from calib_ros.sampling.sample import named
from calib_ros.sampling.session import CalibrationSession, too_few
from calib_ros.settings import Settings

TABLES = ('.csv', '.tsv', '.txt', '.xlsx', '.log', '.dat')
"""Endings of tables, in small letters."""


@dataclass(frozen=True, eq=False)
class Loaded:
    """A problem, and what became of the input."""

    problem: Problem
    samples: dict[str, Any]  # counts of the input
    warnings: tuple[str, ...] = ()
    read: str = ''  # these counts in words
    lines: bool = False  # stamps are the lines of a table
    images: Mapping[int, str] = field(default_factory=dict)  # names by line
    refusals: tuple[Reason, ...] = ()  # why a result must not be accepted, whatever it is
    instead: bool = False  # the refusals stand instead of those of the result
    owners: Mapping[str, Owner] = field(default_factory=dict)  # whose frame each is

    def between(self, names: Mapping[str, str]) -> Problem:
        """Return the problem between the frames that have these names now."""
        problem = self.problem
        first, *more = (each.between(names) for each in problem.sets)
        return replace(
            problem,
            observations=first,
            more=more,
            held_out=[each.between(names) for each in problem.judging],
            separations=[
                (names.get(a, a), names.get(b, b), apart) for a, b, apart in problem.separations
            ],
        )

    def identified(self, model: str, told: Told = nobody) -> Identification:
        """Identify, and refuse the result where too much of the input is lost."""
        try:
            result = identify_model(self.problem, model, told)
        except TooFewObservationsError as err:
            if self.read:
                raise too_few(err, '; '.join((self.read, *self.warnings))) from err
            raise
        own = () if self.instead else result.refusals
        return replace(result, refusals=(*own, *self.refusals))


def replayed(
    path: Path, chain: Chain, settings: Settings, told: Told = nobody
) -> tuple[CalibrationSession, Replayed]:
    """Return a session that has taken a bag."""
    session = CalibrationSession(chain, settings)
    return session, replay(path, session, told)


def of_bag(session: CalibrationSession, read: Replayed, largest_loss: float = 1.0) -> Loaded:
    """Return what to fit from a bag, of which only a share may be lost."""
    problem, account = session.problem(), session.account()
    samples = {'recorded': read.recorded, 'read': read.read, **asdict(account)}
    refusals = read.refusals(account, largest_loss)
    words, owners = f'{read}; {account}', named(session.usable).owners
    return Loaded(problem, samples, read.warnings, words, refusals=refusals, owners=owners)


def table(
    path: Path,
    chain: Chain,
    settings: Settings,
    sessions: Sequence[str] = (),
    eye_in_hand: bool = False,
    foreign: Foreign | None = None,
    told: Told = nobody,
) -> Table:
    """Return a table of measurements of a chain.

    If nothing is said about its layout and its columns are not ours, their names may be those of
    the joints, and its separator another: what is guessed is among the warnings.
    """
    sigmas = (settings.sigma_position, settings.sigma_orientation)
    given = path, len(chain.joints), sessions, sigmas, eye_in_hand
    try:
        return read_table(*given, foreign, told)
    except ColumnsError:
        if foreign is None:
            with suppress(CalibrationError):  # the first error tells what was expected
                return read_table(*given, Foreign(Layout(), chain), told)
        raise


def of_table(found: Table, chain: Chain, settings: Settings, **given: float) -> Loaded:
    """Return what is to be fitted of a table; what is `given` goes to the problem."""
    problem = found.problem(chain, settings.socket_distance, **given, **settings.for_problem())
    fitted, held_out = (sum(map(len, sets)) for sets in (found.fitted, found.held_out))
    samples = {'samples': fitted, 'held_out': held_out, 'sets': len(found.fitted)}
    by_line, owners = found.by_line, found.owners
    return Loaded(problem, samples, found.warnings, lines=by_line, owners=owners)
