# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Results for programs: result.json, the verdict of verify, and settings as a parameter file."""

from __future__ import annotations

import math
import platform
from dataclasses import asdict
from typing import Any

import numpy as np

import calib_ros
from calib_ros.apply.verified import Verification
from calib_ros.decision.comparison import Comparison
from calib_ros.decision.result import Identification
from calib_ros.estimation.fitted import ParameterRow
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.report import words
from calib_ros.report.remarks import remarks
from calib_ros.settings import Settings
from calib_ros.texts import dump_yaml


def as_document(result: Identification, samples: dict[str, Any]) -> dict[str, Any]:
    """Return the result as a JSON document; `samples` is the account of the input."""

    def comparison(which: Comparison) -> dict[str, Any]:
        found = figures_document(which, which is judged) | {'outliers': which.outliers}
        return found | {'after_with_outliers': asdict(which.figures_of_all[1])}

    def parameter(p: ParameterRow) -> dict[str, Any]:
        offset = None if result.chain.owns_frame(p.name) else p.offset
        found = {'value': p.value, 'offset': offset, 'std': p.std}
        found['half_width_95'] = p.half_width()
        return found | {'unit': p.name.unit, 'status': p.status}

    judged, region = result.validation, result.region
    limit = None if region is None or region.whole else 1e3 * region.limit
    by = {'by': result.validated_by}
    lower = [row[: k + 1] for k, row in enumerate(result.covariance.tolist())]
    return {
        'converged': result.converged,
        'accepted': result.accepted,
        'refusals': list(result.refusals),
        'rules': [each.rule.name for each in result.refusals],
        'remarks': list(result.remarks),
        'rank': result.rank,
        'unidentifiable': list(result.unidentifiable),
        'not_excited': list(result.not_excited),
        'weakly_determined': list(words.weakly_determined(result)),
        'held_near_nominal': list(result.weak),
        'parameters': {p.name: parameter(p) for p in result.parameters},
        'fitted': comparison(result.fitted),
        'validation': None if judged is None else by | comparison(judged),
        'before_is': words.BEFORE_IS,
        'noise_in_sigma': asdict(result.noise),
        'chance_of_gain': result.chance,
        'outliers': [asdict(outlier) for outlier in result.outliers],
        'gauges': result.gauges,
        'covariance': {
            'names': list(result.names),
            'lower': [[float(f'{x:.9e}') for x in row] for row in lower],
        },
        'correlated': [list(pair) for pair in result.correlated()],
        'observability': result.observability,
        'predicted_sigma_mm': words.sigma_over_range(result),
        'sizes': dict(result.posterior.sizes),
        'unmodelled': result.posterior.unmodelled.sizes,
        'region': region and {'whole': region.whole, 'share': region.share, 'limit_mm': limit},
        'priors': result.priors,
        'effects': dict(result.chain.effects),
        'verdicts': [asdict(verdict) for verdict in result.verdicts],
        'step': None if result.step is None else asdict(result.step),
        'samples': samples,
        'robot': result.chain.name,
        'table_sha256': table_hash(result.chain) if result.accepted else None,
        'versions': {
            'calib_ros': calib_ros.__version__,
            'python': platform.python_version(),
            'numpy': np.__version__,
        },
    }


def figures_document(which: Comparison, intervals: bool = True) -> dict[str, Any]:
    """Return the figures before and after, with the intervals of the RMS if wanted."""
    found = dict(zip(('before', 'after'), map(asdict, which.figures), strict=True))
    for when, rms in enumerate(found.values() if intervals else ()):
        rms['rms_lower_mm'], rms['rms_upper_mm'] = words.limits_mm(which, when) or (None, None)
    return found


def configuration_yaml(chain: str, settings: Settings, **more: Any) -> str:
    """Return settings and `more` as a parameter file that repeats the run in a node."""
    parameters: dict[str, Any] = {'chain': chain, **more}
    for name, value in asdict(settings).items():
        parameters[name] = (list(value) or ['']) if isinstance(value, tuple) else value
    return dump_yaml({'/**': {'ros__parameters': parameters}})


def verification_document(found: Verification) -> dict[str, Any]:
    """Return a verdict and its figures as plain values."""
    names = ('tolerance', 'limit', 'unseen', 'rms', 'lower', 'upper')  # last of poses like these
    lengths = {f'{name}_mm': getattr(found, name) for name in names}
    return {
        'verdict': found.verdict,
        **{k: 1e3 * m if m is not None and m < math.inf else None for k, m in lengths.items()},
        'confidence': found.confidence,
        'poses': found.configurations,
        'poses_needed': found.needed,
        **figures_document(found.comparison),
        'by_pose': [
            {'measured': each.cycles, 'before_mm': each.before, 'after_mm': each.after}
            | {'repeatability_mm': each.repeatability}
            for each in found.each
        ],
        'by_program': found.by_program,
        'refitted': list(found.fitted),
        'reused': found.reused,
        'remarks': list(remarks(found)),
    }
