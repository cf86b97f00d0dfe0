# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Mistakes with arms that are worse than faulty ones: a humanoid's may be off by centimetres."""

from dataclasses import replace

import pytest
from fits import measured_arm
from scipy.spatial.transform import Rotation

from calib_ros import Problem, load_chain
from calib_ros.decision.mistakes import diagnose

ARM = load_chain('ur10e')


def seen_of(chain):
    """Poses of an arm off by 2 to 4 cm."""
    return measured_arm(1, 40, (1e-3, 1e-3), chain, errors=10.0)[2]


def as_vectors(each):
    angles = Rotation.from_matrix(each.rotations).as_euler('ZYX')[:, ::-1]
    return replace(each, rotations=Rotation.from_rotvec(angles).as_matrix())


@pytest.mark.parametrize(
    ('spoilt', 'remedy'),
    [
        (lambda e: replace(e, positions=1e-3 * e.positions), '--length m '),
        (as_vectors, '--euler ZYX, '),
    ],
)
def test_mistakes_are_named_although_the_arm_is_worse_than_faulty_ones(spoilt, remedy, single):
    found = diagnose(Problem(ARM, spoilt(seen_of(ARM))))
    assert remedy in str(found)
    assert 0.02 < found.corrected < 0.04


def test_of_an_arm_with_another_forearm_no_mistake_is_named():
    rows = [replace(each, a=1.6 * each.a) if k == 2 else each for k, each in enumerate(ARM.joints)]
    assert diagnose(Problem(ARM, seen_of(replace(ARM, joints=tuple(rows))))) is None
