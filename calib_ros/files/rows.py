# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A result as a row of a history: what is kept of it, and the key by which it is known."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime, timezone
from typing import Any
from urllib.parse import quote

import numpy as np

import calib_ros
from calib_ros.apply.confidence import rms_interval
from calib_ros.apply.verification import Verification
from calib_ros.errors import ConfigError
from calib_ros.identification.identification import Identification
from calib_ros.identification.observations import Observations
from calib_ros.identification.validation import Comparison, ErrorFigures
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import chain_document, parse_chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.settings import Settings
from calib_ros.shown import Shown
from calib_ros.values import LONGEST_NAME, parse_name


@dataclass(frozen=True)
class Filing:
    """What is known of a result besides the result: whose it is, when and from what.

    `inputs` and `settings` are hashes; `fingerprint` tells cheaply that the `source` is unchanged.
    """

    serial: str
    time: datetime
    inputs: str
    settings: str
    source: str = ''
    fingerprint: str = ''

    def __post_init__(self) -> None:
        """Refuse a serial number that cannot name a folder."""
        parse_serial(self.serial, 'the serial number')


def parse_serial(value: object, where: str) -> str:
    """Return a serial number that can name a folder; `where` names it in the error."""
    if not isinstance(value, str) or value in ('', '.', '..'):
        raise ConfigError(f'{where} must be text ("0042" in quotes), not {value!r}')
    if len(quote(parse_name(value, where), safe='')) > LONGEST_NAME:
        raise ConfigError(f'{where} is too long to name a folder: {value}')
    return value


@dataclass(frozen=True, eq=False, repr=False)
class Row(Shown):
    """A result as it is filed; docs/fleet.md describes the columns.

    Lengths of figures are in mm, angles in mrad; offsets and their covariance (P, P) in m and rad,
    of the parameters `names`.
    """

    serial: str
    kind: str
    time: datetime
    verdict: str
    inputs: str
    settings: str
    source: str = ''
    fingerprint: str = ''
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
    chain: str = ''

    @property
    def key(self) -> str:
        """Return the name of the result: the same for the same work."""
        return digest([self.serial, self.kind, self.inputs, self.settings, self.software])

    @property
    def accepted(self) -> bool:
        """Tell whether nothing speaks against what was found."""
        return self.verdict in ('accepted', 'holds', 'PASS', 'no verdict')

    def corrected(self) -> Chain:
        """Return the corrected chain with its frames."""
        return parse_chain(self.chain, f'the chain of {self.serial} in the history')


def digest(content: object) -> str:
    """Return the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def settings_hash(nominal: Chain, settings: Settings, *more: object) -> str:
    """Return the hash of all that a result depends on besides the measurements."""
    values = {each.name: getattr(settings, each.name) for each in fields(settings)}
    return digest([chain_document(nominal), values, *more])


def content_hash(files: Sequence[str], session: str = '') -> str:
    """Return the hash of the content of files, by their own hashes, or of a session in them."""
    return digest([session, *sorted(files)])


def samples_hash(sets: Sequence[Observations]) -> str:
    """Return the hash of samples that are in no file."""
    found = hashlib.sha256()
    for each in sets:
        for array in (each.stamps_ns, each.joints, each.positions, each.rotations):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def is_time(stamp_ns: int) -> bool:
    """Tell whether a stamp is a time: of 1973 or later, not since a start or from lines."""
    return stamp_ns >= 10**17


def measured_at(sets: Sequence[Observations], otherwise: datetime | None = None) -> datetime:
    """Return when the last pose was measured; another time where stamps are no times."""
    last = max((int(each.stamps_ns.max()) for each in sets if len(each)), default=0)
    if not is_time(last):
        return otherwise or datetime.now(timezone.utc)
    return datetime.fromtimestamp(last / 1e9, timezone.utc)


def identified(result: Identification, about: Filing, warnings: Sequence[str] = ()) -> Row:
    """Return the row of an identification; `warnings` are of the measurements."""
    offsets = {str(each.name): each.offset for each in result.parameters}
    names = tuple(map(str, result.names))
    which = result.validation or result.fitted
    shown = which.judged & ~np.isnan(which.after.position).any(axis=1)
    errors = which.after
    limits = rms_interval(errors.position[shown], errors.configurations[shown], 0.975)
    freedom = result.uncertainty.overall
    return Row(
        **_common(about, 'identify', result.chain),
        verdict='accepted' if result.accepted else 'refused',
        reasons=tuple(map(str, result.refusals)),
        remarks=tuple(map(str, (*warnings, *result.remarks))),
        **_figures(*which.figures, limits),
        freedom=freedom if np.isfinite(freedom) else None,
        names=names,
        offsets=np.array([offsets[name] for name in names]),
        covariance=result.covariance,
    )


def judged(
    chain: Chain, before: ErrorFigures | None, after: ErrorFigures, verdict: str, about: Filing
) -> Row:
    """Return the row of a validation: a calibration on poses that were measured since."""
    return Row(**_common(about, 'validate', chain), verdict=verdict, **_figures(before, after))


def verified(chain: Chain, found: Verification, about: Filing) -> Row:
    """Return the row of a verification."""
    compared: Comparison = found.comparison
    return Row(
        **_common(about, 'verify', chain),
        verdict=found.verdict,
        **_figures(*compared.figures, (found.lower, found.upper)),
        rms_freedom=found.freedom,
    )


def _common(about: Filing, kind: str, chain: Chain) -> dict[str, Any]:
    given = {each.name: getattr(about, each.name) for each in fields(about)}
    return {**given, 'kind': kind, 'model': chain.name, 'chain': json.dumps(chain_document(chain))}


def _figures(
    before: ErrorFigures | None, after: ErrorFigures, limits: tuple[float, float] | None = None
) -> dict[str, Any]:
    found: dict[str, Any] = {
        'poses': after.count,
        'rms_before_mm': None if before is None else before.rms_mm,
        **{name: getattr(after, name) for name in ('rms_mm', 'mean_mm', 'max_mm', 'rms_mrad')},
    }
    if limits is not None and np.isfinite(limits).all():
        found |= {'lower_mm': 1e3 * limits[0], 'upper_mm': 1e3 * limits[1]}
    return found
