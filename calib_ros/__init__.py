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
    from calib_ros.apply.compensation import Compensator as Compensator, compensate as compensate
    from calib_ros.apply.planning import Plan as Plan, plan as plan
    from calib_ros.apply.program import Program as Program
    from calib_ros.apply.verification import Verification as Verification, verify as verify
    from calib_ros.errors import CalibrationError as CalibrationError
    from calib_ros.files.bags import replay as replay
    from calib_ros.files.tables import read_table as read_table
    from calib_ros.identification.calibration import (
        Calibration as Calibration,
        load_calibration as load_calibration,
    )
    from calib_ros.identification.difference import (
        Difference as Difference,
        difference as difference,
    )
    from calib_ros.identification.identification import (
        Identification as Identification,
        identify as identify,
    )
    from calib_ros.identification.model_choice import identify_model as identify_model
    from calib_ros.identification.observations import Observations as Observations
    from calib_ros.identification.problem import Problem as Problem
    from calib_ros.identification.recalibration import (
        Recalibration as Recalibration,
        recalibrate as recalibrate,
    )
    from calib_ros.kinematics.chain import Chain as Chain
    from calib_ros.kinematics.chain_file import dump_chain as dump_chain, load_chain as load_chain
    from calib_ros.kinematics.urdf import (
        chain_from_urdf as chain_from_urdf,
        corrected_urdf as corrected_urdf,
    )
    from calib_ros.sampling.session import CalibrationSession as CalibrationSession
    from calib_ros.settings import Settings as Settings

__version__ = '0.1.0'

_HOMES = {
    'apply.compensation': ('Compensator', 'compensate'),
    'apply.planning': ('Plan', 'plan'),
    'apply.program': ('Program',),
    'apply.verification': ('Verification', 'verify'),
    'errors': ('CalibrationError',),
    'files.bags': ('replay',),
    'files.tables': ('read_table',),
    'identification.calibration': ('Calibration', 'load_calibration'),
    'identification.difference': ('Difference', 'difference'),
    'identification.identification': ('Identification', 'identify'),
    'identification.model_choice': ('identify_model',),
    'identification.observations': ('Observations',),
    'identification.problem': ('Problem',),
    'identification.recalibration': ('Recalibration', 'recalibrate'),
    'kinematics.chain': ('Chain',),
    'kinematics.chain_file': ('dump_chain', 'load_chain'),
    'kinematics.urdf': ('chain_from_urdf', 'corrected_urdf'),
    'sampling.session': ('CalibrationSession',),
    'settings': ('Settings',),
}
"""Modules, and what they have that is public."""
_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted(_OF)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use."""
    if name not in _OF:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(importlib.import_module(f'{__name__}.{_OF[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
