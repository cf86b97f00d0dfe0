# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Kinematic calibration of industrial arms: DH errors from joint states and measured poses.

What is listed in `__all__` is the public interface (docs/api.md); each name is imported at its
first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib_ros.apply.compensation import Compensator, compensate
    from calib_ros.apply.planning import Plan, plan
    from calib_ros.apply.program import Program
    from calib_ros.apply.verification import Verification, verify
    from calib_ros.errors import CalibrationError
    from calib_ros.files.bags import replay
    from calib_ros.files.tables import read_table
    from calib_ros.identification.calibration import Calibration, load_calibration
    from calib_ros.identification.difference import Difference, difference
    from calib_ros.identification.identification import Identification, identify
    from calib_ros.identification.model_choice import identify_model
    from calib_ros.identification.observations import Observations
    from calib_ros.identification.problem import Problem
    from calib_ros.identification.recalibration import Recalibration, recalibrate
    from calib_ros.kinematics.chain import Chain
    from calib_ros.kinematics.chain_file import dump_chain, load_chain
    from calib_ros.kinematics.urdf import chain_from_urdf, corrected_urdf
    from calib_ros.sampling.session import CalibrationSession
    from calib_ros.settings import Settings

__version__ = '0.1.0'

__all__ = [
    'Calibration',
    'CalibrationError',
    'CalibrationSession',
    'Chain',
    'Compensator',
    'Difference',
    'Identification',
    'Observations',
    'Plan',
    'Problem',
    'Program',
    'Recalibration',
    'Settings',
    'Verification',
    'chain_from_urdf',
    'compensate',
    'corrected_urdf',
    'difference',
    'dump_chain',
    'identify',
    'identify_model',
    'load_calibration',
    'load_chain',
    'plan',
    'read_table',
    'recalibrate',
    'replay',
    'verify',
]

_HOMES = {
    'Calibration': 'identification.calibration',
    'CalibrationError': 'errors',
    'CalibrationSession': 'sampling.session',
    'Chain': 'kinematics.chain',
    'Compensator': 'apply.compensation',
    'Difference': 'identification.difference',
    'Identification': 'identification.identification',
    'Observations': 'identification.observations',
    'Plan': 'apply.planning',
    'Problem': 'identification.problem',
    'Program': 'apply.program',
    'Recalibration': 'identification.recalibration',
    'Settings': 'settings',
    'Verification': 'apply.verification',
    'chain_from_urdf': 'kinematics.urdf',
    'compensate': 'apply.compensation',
    'corrected_urdf': 'kinematics.urdf',
    'difference': 'identification.difference',
    'dump_chain': 'kinematics.chain_file',
    'identify': 'identification.identification',
    'identify_model': 'identification.model_choice',
    'load_calibration': 'identification.calibration',
    'load_chain': 'kinematics.chain_file',
    'plan': 'apply.planning',
    'read_table': 'files.tables',
    'recalibrate': 'identification.recalibration',
    'replay': 'files.bags',
    'verify': 'apply.verification',
}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(importlib.import_module(f'{__name__}.{_HOMES[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
