# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The public interface: `__init__.py` reads where each name is, type checkers what it is."""

from calib_ros.apply.compensation import compensate as compensate
from calib_ros.apply.compensator import Compensator as Compensator
from calib_ros.apply.design import Design as Design
from calib_ros.apply.planning import Plan as Plan, plan as plan
from calib_ros.apply.program import Program as Program
from calib_ros.apply.verification import verify as verify
from calib_ros.apply.verified import Verification as Verification
from calib_ros.decision.result import Identification as Identification
from calib_ros.errors import CalibrationError as CalibrationError
from calib_ros.estimation.observations import Observations as Observations
from calib_ros.estimation.problem import Problem as Problem
from calib_ros.files.bags import replay as replay
from calib_ros.files.tables import read_table as read_table
from calib_ros.identification.calibration import (
    Calibration as Calibration,
    load_calibration as load_calibration,
)
from calib_ros.identification.difference import Difference as Difference, difference as difference
from calib_ros.identification.identification import identify as identify
from calib_ros.identification.model_choice import identify_model as identify_model
from calib_ros.identification.recalibrated import Recalibration as Recalibration
from calib_ros.identification.recalibration import recalibrate as recalibrate
from calib_ros.kinematics.chain import Chain as Chain
from calib_ros.kinematics.chain_file import dump_chain as dump_chain, load_chain as load_chain
from calib_ros.kinematics.corrected_urdf import corrected_urdf as corrected_urdf
from calib_ros.kinematics.urdf import chain_from_urdf as chain_from_urdf
from calib_ros.sampling.session import CalibrationSession as CalibrationSession
from calib_ros.settings import Settings as Settings

__version__: str
__all__: list[str]
