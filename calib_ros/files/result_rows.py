# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How an identification or a verification becomes a row of the history."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from calib_ros.apply.confidence import interval_of
from calib_ros.apply.judgement import Judgement
from calib_ros.decision.residuals import ErrorFigures
from calib_ros.decision.result import Identification
from calib_ros.files.rows import Filing, Row
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import chain_document


def result_row(result: Identification, about: Filing, warnings: Sequence[str] = ()) -> Row:
    """Return the row of an identification; `warnings` are of the measurements."""
    offsets = {str(each.name): each.offset for each in result.parameters}
    names = tuple(map(str, result.names))
    which = result.comparison
    freedom = result.uncertainty.overall
    return Row(
        **asdict(about),
        **_judged(result.chain, which.figures, interval_of(which, 1)),
        kind='identify',
        verdict='accepted' if result.accepted else 'refused',
        reasons=tuple(map(str, result.refusals)),
        remarks=tuple(map(str, (*warnings, *result.remarks))),
        freedom=freedom if np.isfinite(freedom) else None,
        names=names,
        offsets=np.array([offsets[name] for name in names]),
        covariance=result.covariance,
        tilt=result.posterior.unmodelled.waves,
        tilts=np.asarray(result.posterior.unmodelled.followed, dtype='f4'),
    )


def verification_row(chain: Chain, found: Judgement, about: Filing, kind: str = 'verify') -> Row:
    """Return the row of a verdict on later poses; without freedom (in no chart) of unfit ones."""
    before, after = found.comparison.figures
    figures = before, replace(after, rms_mm=1e3 * found.rms)
    limits = found.lower, found.upper
    freedom = None if found.reused or found.mistake else found.freedom
    more = _judged(chain, figures, limits)
    return Row(**asdict(about), **more, kind=kind, verdict=found.verdict, rms_freedom=freedom)


def _judged(
    chain: Chain, figures: tuple[ErrorFigures, ErrorFigures], limits: tuple[float, float]
) -> dict[str, Any]:
    """Return the columns of an arm, and of its errors before and after with their interval [m]."""
    before, after = figures
    found: dict[str, Any] = {'model': chain.name, 'chain': json.dumps(chain_document(chain))}
    found |= {'poses': after.count, 'rms_before_mm': before.rms_mm}
    found |= {name: getattr(after, name) for name in ('rms_mm', 'mean_mm', 'max_mm', 'rms_mrad')}
    if np.isfinite(limits).all():
        found |= {'lower_mm': 1e3 * limits[0], 'upper_mm': 1e3 * limits[1]}
    return found
