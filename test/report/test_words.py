# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import pytest

from calib_ros.identification.calibration import Calibration
from calib_ros.identification.recalibration import Recalibration
from calib_ros.identification.validation import ErrorFigures
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report.words import checked, verdict


@pytest.mark.parametrize(('rms_mm', 'holds'), [(0.14, True), (0.16, False)])
def test_a_calibration_holds_by_one_rule(rms_mm, holds):
    """By ~/validate, and by ~/check where no change shows besides."""
    arm = load_chain('ur10e')
    previous = Calibration(arm, arm, residual=1e-4)
    now = ErrorFigures(20, rms_mm, rms_mm, rms_mm, rms_mm, None)
    for told in (
        verdict(previous, now, now),
        checked(previous, Recalibration(previous, (), 1.0, now, now, 0.0)),
    ):
        assert told[0] == holds
        assert ('does not hold any more: RMS 0.160 mm' in told[1]) != holds
