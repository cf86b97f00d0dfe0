# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Loading of bags and tables as problems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.errors import ColumnsError, InputError, TooFewObservationsError
from calib_ros.estimation.problem import Problem
from calib_ros.files.bags import Replayed
from calib_ros.files.foreign import Foreign
from calib_ros.files.journal import refuse_other_joints_than
from calib_ros.files.layouts import Layout
from calib_ros.files.tables import read_table
from calib_ros.identification.model_choice import identify_model
from calib_ros.identification.records import Owner
from calib_ros.kinematics.chain import Chain
from calib_ros.progress import Notify, quiet
from calib_ros.sampling.dataset import Dataset
from calib_ros.sampling.sample import named
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings

MEASURED = (Rule.MISTAKE, Rule.LARGEST_ERROR, Rule.CONVERGENCE, Rule.SCALE)
"""What makes frames wrong, too, if there is no arm to judge."""
TABLES = ('.csv', '.tsv', '.txt', '.xlsx', '.log', '.dat')  # suffixes of tables, lower case


@dataclass(frozen=True, eq=False)
class Loaded:
    """A problem, with counts and warnings of its input."""

    problem: Problem
    samples: dict[str, Any]  # counts of the input
    warnings: tuple[str, ...] = ()
    read: str = ''  # these counts as text
    by_line: bool = False  # stamps are the lines of a table
    images: Mapping[int, str] = field(default_factory=dict)  # names by line
    refusals: tuple[Reason, ...] = ()  # reasons not to accept any result
    instead: bool = False  # the refusals replace those of the result about the arm
    owners: Mapping[str, Owner] = field(default_factory=dict)  # whose frame each is

    def between(self, names: Mapping[str, str]) -> Problem:
        """Return the problem with renamed frames."""
        problem = self.problem
        return problem.with_sets(
            [each.between(names) for each in problem.sets],
            held_out=[each.between(names) for each in problem.judging],
            separations=[(names.get(a, a), names.get(b, b), d) for a, b, d in problem.separations],
        )

    def identified(self, model: str, progress: Notify = quiet) -> Identification:
        """Identify, and refuse the result if too much of the input is lost."""
        try:
            result = identify_model(self.problem, model, progress)
        except TooFewObservationsError as err:
            if self.read:
                raise err.after('; '.join((self.read, *self.warnings))) from err
            raise
        own = [e for e in result.refusals if not self.instead or e.rule in MEASURED]
        return replace(result, refusals=(*own, *self.refusals))


def load_bag(session: CalibrationSession, read: Replayed, largest_loss: float = 1.0) -> Loaded:
    """Return the problem of a bag, of which only a share may be lost."""
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
    progress: Notify = quiet,
) -> Dataset:
    """Return a table of measurements of a chain.

    Without a given layout, a table with other columns is read with the joints' names and another
    separator; guesses are among the warnings.
    """
    given = path, len(chain.joints), sessions, settings.sigmas, eye_in_hand
    if foreign is None:
        refuse_other_joints_than(chain.joint_names, path)
        try:
            return read_table(*given, progress=progress)
        except ColumnsError as err:
            if not path.is_file():
                raise InputError(
                    f'{err}; a pipe is read once, so nothing is guessed: save it as a file, or '
                    'give an option for tables, such as --separator'
                ) from err
        foreign = Foreign(Layout(), chain)
    return read_table(*given, foreign, progress)


def load_table(
    found: Dataset, chain: Chain, settings: Settings, sigma_touch: float | None = None
) -> Loaded:
    """Return the problem of a table, with the sigma of touched planes [m] if not the usual one."""
    given = {} if sigma_touch is None else {'sigma_touch': sigma_touch}
    problem = found.problem(chain, settings, **given)
    fitted, held_out = (sum(map(len, sets)) for sets in (found.fitted, found.held_out))
    samples = {'samples': fitted, 'held_out': held_out, 'sets': len(found.fitted)}
    by_line, owners = found.by_line, found.owners
    return Loaded(problem, samples, found.warnings, by_line=by_line, owners=owners)
