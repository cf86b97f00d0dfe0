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
from calib_ros.values import parse_name

EPOCH_NS = 10**17
"""Stamps from which on they are times of this century."""
NONE = np.zeros(0)


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
        if not parse_name(self.serial, 'the serial number'):
            raise ConfigError(
                'give the serial number of the robot (--serial): rows are filed by it'
            )


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
    freedom: float | None = None
    names: tuple[str, ...] = ()
    offsets: FloatArray = field(default_factory=NONE.copy)
    covariance: FloatArray = field(default_factory=NONE.copy)
    chain: str = ''

    @property
    def key(self) -> str:
        """Return the name of the result: the same for the same work."""
        return key_of(self.serial, self.kind, self.inputs, self.settings, self.software)

    @property
    def accepted(self) -> bool:
        """Tell whether nothing speaks against what was found."""
        return self.verdict in ('accepted', 'holds', 'PASS', 'JUDGED')

    def corrected(self) -> Chain:
        """Return the corrected chain with its frames."""
        return parse_chain(self.chain, f'the chain of {self.serial} in the history')


def key_of(serial: str, kind: str, inputs: str, settings: str, software: str = '') -> str:
    """Return the name of a piece of work by what it was done from."""
    return digest([serial, kind, inputs, settings, software or calib_ros.__version__])


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


def measured_at(sets: Sequence[Observations], otherwise: datetime | None = None) -> datetime:
    """Return when the last pose was measured; another time where stamps are no times."""
    last = max((int(each.stamps_ns.max()) for each in sets if len(each)), default=0)
    if last < EPOCH_NS:
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
