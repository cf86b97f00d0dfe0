# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The row that is filed of a result in the history."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime, timezone
from urllib.parse import quote

import numpy as np

import calib_ros
from calib_ros.errors import LONGEST_NAME, ConfigError
from calib_ros.files.hashes import digest
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import parse_chain
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
        return parse_chain(self.chain, f'the chain in {self.key}.parquet of the history')
