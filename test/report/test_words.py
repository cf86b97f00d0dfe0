# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from datetime import datetime, timezone

import numpy as np
import pytest

from calib_ros.apply.simulation import measure
from calib_ros.apply.verification import verify
from calib_ros.files.history import Filing, verified
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.identification.validation import ErrorFigures
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report.verdicts import in_words
from calib_ros.report.words import checked, verdict


@pytest.mark.parametrize(('rms_mm', 'holds'), [(0.14, True), (0.16, False)])
def test_a_calibration_holds_by_one_rule(rms_mm, holds):
    """By ~/validate, and by ~/check where no change shows besides."""
    arm = load_chain('ur10e')
    previous = Calibration(arm, arm, residual=1e-4)
    now = ErrorFigures(20, rms_mm, rms_mm, rms_mm, rms_mm, None)
    for told in (
        verdict(previous, now, now),
        checked(previous, Recalibration(previous, (), 1.0, now, now, 1e-4, 1e-4, 0.0)),
    ):
        assert told[0] == holds
        assert ('no longer holds: RMS 0.160 mm' in told[1]) != holds


@pytest.mark.parametrize(('bumped', 'verdict'), [(0.0, 'holds'), (5e-3, 'does not hold')])
def test_what_holds_no_more_is_filed_as_that(bumped, verdict):
    """Without a tolerance, too: a history tells no less than the screen."""
    arm, rng = load_chain('ur10e'), np.random.default_rng(0)
    seen = measure(arm, arm.random_joints(10, rng), rng, 5e-5, 2e-4)
    seen.positions[:] += bumped
    found = verify(Calibration(arm, arm, residual=1e-4), [seen], None)
    row = verified(arm, found, Filing('7', datetime.now(timezone.utc), 'i', 's'))
    assert (row.verdict, row.accepted) == (verdict, False)
    assert ('the error has grown' in in_words(found)) == (verdict == 'does not hold')
