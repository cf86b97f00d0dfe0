# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the node finds, filed in a history."""

from __future__ import annotations

from collections.abc import Callable

from calib_ros.errors import CalibrationError, ConfigError
from calib_ros.files.history import (
    Filing,
    History,
    Row,
    identified,
    judged,
    measured_at,
    samples_hash,
    settings_hash,
)
from calib_ros.identification.identification import Identification
from calib_ros.identification.problem import Problem
from calib_ros.identification.validation import ErrorFigures
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings


class Filer:
    """Files results of one robot, by its serial number, in a folder or URL; without one nothing.

    Identifications begin with the `nominal` chain.
    """

    def __init__(self, place: str, serial: str, nominal: Chain) -> None:
        self._history = History(place) if place else None
        self._serial, self._nominal = serial, nominal
        if place and not serial:
            raise ConfigError('a history needs the serial number of the robot: set serial as well')

    def identified(self, problem: Problem, result: Identification, settings: Settings) -> str:
        """File an identification; return in words why that was not possible."""
        return self._file(lambda: identified(result, self._about(problem, settings)))

    def validated(
        self, session: CalibrationSession, figures: tuple[ErrorFigures, ErrorFigures], holds: bool
    ) -> str:
        """File how a session's calibration does on its samples, as `identified` does."""
        calibration = session.calibration
        assert calibration is not None  # else there were no figures
        chain, verdict = calibration.chain, 'holds' if holds else 'does not hold'

        def row() -> Row:
            about = self._about(session.problem(), session.settings, table_hash(chain))
            return judged(chain, figures[1], figures[0], verdict, about)

        return self._file(row)

    def _about(self, problem: Problem, settings: Settings, *more: str) -> Filing:
        sets = (*problem.sets, *problem.judging)
        hashed = settings_hash(self._nominal, settings, *more)
        return Filing(self._serial, measured_at(sets), samples_hash(sets), hashed)

    def _file(self, row: Callable[[], Row]) -> str:
        try:
            if self._history is not None:
                self._history.file(row())
        except (CalibrationError, OSError) as err:
            return f'; not filed in the history: {err}'
        return ''
