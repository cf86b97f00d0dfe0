# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A UR10e, calibrated, and measurements by which it is verified."""

from dataclasses import replace

import numpy as np
from fits import NOISE, UR10E as UR, measured_arm

from calib_ros.apply import simulation
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.report.content import Origin
from calib_ros.report.gathered import poses_to_verify
from calib_ros.report.remarks import each_in_words, likely_rms, remarks
from calib_ros.report.verdicts import verification_report


def cell():
    """Return a true arm, its identification and what was fitted."""
    _, true, seen = measured_arm(0, 40)
    return true, identify(Problem(UR, seen)), seen


def measured(true, joints, repeats=3, noise=NOISE, seed=1):
    rng = np.random.default_rng(seed)
    return simulation.measure(true, np.repeat(joints, repeats, axis=0), rng, *noise)


def with_errors(arm, errors):
    """Return observations whose position errors by the calibrated arm are (N, 3) [m]."""
    seen = measured(arm.chain, UR.random_joints(len(errors), np.random.default_rng(2)), 1, (0, 0))
    return replace(seen, positions=seen.positions + errors)


def verification_page(chain, sets, found):
    """Return the page of a verification of an arm by some observations."""
    poses = poses_to_verify(found.chain, sets, found.comparison)
    return verification_report(chain, found, poses, Origin())


def in_words(found):
    """Return what screen and report say of a verification, a line each."""
    rms = f'the RMS error over poses like these is {likely_rms(found)}'
    return '\n'.join([*each_in_words(found), rms, *remarks(found)])
