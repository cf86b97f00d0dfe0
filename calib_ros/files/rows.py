# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The row that is filed of a result in the history."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from typing import Any
from urllib.parse import quote

import numpy as np

import calib_ros
from calib_ros.apply.confidence import interval_of
from calib_ros.apply.judgement import Judgement
from calib_ros.decision.residuals import ErrorFigures
from calib_ros.decision.result import Identification
from calib_ros.errors import LONGEST_NAME, ConfigError
from calib_ros.files.hashes import digest
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import chain_document, parse_chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown
from calib_ros.values import parse_name


@dataclass(frozen=True, eq=False)
class Filing:
    """Robot, time and source of a filed result."""

    serial: str
    time: datetime
    inputs: str  # a hash
    settings: str  # a hash
    source: str = ''
    fingerprint: str = ''  # cheap test that the source is unchanged

    def __post_init__(self) -> None:
        parse_serial(self.serial, 'the serial number')


def parse_serial(value: object, where: str) -> str:
    """Return a serial number that can name a folder; errors name it `where`."""
    if not isinstance(value, str) or value in ('', '.', '..'):
        raise ConfigError(f'{where} must be text ("0042" in quotes), not {value!r}')
    if len(quote(parse_name(value, where), safe='')) > LONGEST_NAME:
        raise ConfigError(f'{where} is too long to name a folder: {value}')
    return value


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Row(Shown, Filing):
    """A filed result; docs/fleet.md describes the columns.

    Figures are in mm and mrad; offsets and covariance (P, P) of the parameters `names` in m and
    rad; the parameters follow T waves of wobble of size `tilt` by `tilts` (P, T).
    """

    kind: str
    verdict: str
    software: str = calib_ros.__version__
    filed: datetime = field(default_factory=lambda: datetime.now(timezone.utc))
    model: str = ''
    reasons: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    poses: int = 0
    rms_before_mm: float | None = None
    rms_mm: float | None = None
    lower_mm: float | None = None
    upper_mm: float | None = None
    mean_mm: float | None = None
    max_mm: float | None = None
    rms_mrad: float | None = None
    rms_freedom: float | None = None
    freedom: float | None = None
    names: tuple[str, ...] = ()
    offsets: FloatArray = field(default_factory=lambda: np.zeros(0))
    covariance: FloatArray = field(default_factory=lambda: np.zeros(0))
    tilt: float | None = None
    tilts: FloatArray = field(default_factory=lambda: np.zeros(0))
    chain: str = ''

    @property
    def key(self) -> str:
        """Return the name of the result: the same for the same work."""
        return digest([self.serial, self.kind, self.inputs, self.settings, self.software])

    @property
    def accepted(self) -> bool:
        """Tell whether it is an accepted identification."""
        return self.verdict == 'accepted'

    def corrected(self) -> Chain:
        """Return the corrected chain with its frames."""
        return parse_chain(self.chain, f'the chain of {self.serial} in the history')


def result_row(result: Identification, about: Filing, warnings: Sequence[str] = ()) -> Row:
    """Return the row of an identification; `warnings` are of the measurements."""
    offsets = {str(each.name): each.offset for each in result.parameters}
    names = tuple(map(str, result.names))
    which = result.validation or result.fitted
    freedom = result.uncertainty.overall
    return _row(
        about,
        'identify',
        result.chain,
        'accepted' if result.accepted else 'refused',
        which.figures,
        interval_of(which, 1),
        reasons=tuple(map(str, result.refusals)),
        remarks=tuple(map(str, (*warnings, *result.remarks))),
        freedom=freedom if np.isfinite(freedom) else None,
        names=names,
        offsets=np.array([offsets[name] for name in names]),
        covariance=result.covariance,
        tilt=result.posterior.unmodelled.waves,
        tilts=np.float32(result.posterior.unmodelled.followed),
    )


def verification_row(chain: Chain, found: Judgement, about: Filing, kind: str = 'verify') -> Row:
    """Return the row of a verdict on later poses; without freedom (in no chart) of unfit ones."""
    before, after = found.comparison.figures
    figures = before, replace(after, rms_mm=1e3 * found.rms)
    limits = found.lower, found.upper
    freedom = None if found.reused or found.mistake else found.freedom
    return _row(about, kind, chain, found.verdict, figures, limits, rms_freedom=freedom)


def _row(
    about: Filing,
    kind: str,
    chain: Chain,
    verdict: str,
    figures: tuple[ErrorFigures, ErrorFigures],
    limits: tuple[float, float],
    **more: Any,
) -> Row:
    before, after = figures
    more |= {name: getattr(after, name) for name in ('rms_mm', 'mean_mm', 'max_mm', 'rms_mrad')}
    if np.isfinite(limits).all():
        more |= {'lower_mm': 1e3 * limits[0], 'upper_mm': 1e3 * limits[1]}
    return Row(
        **asdict(about),
        kind=kind,
        model=chain.name,
        chain=json.dumps(chain_document(chain)),
        verdict=verdict,
        poses=after.count,
        rms_before_mm=before.rms_mm,
        **more,
    )
