# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the model lacks something, a calibration from near poses is not known to help far away."""

from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E, arm, rms
from robots import DATA, needs_data

from calib_ros import Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision.comparison import compare
from calib_ros.files.tables import read_table
from calib_ros.kinematics.chain_file import load_chain

pytestmark = pytest.mark.usefixtures('unsearched')
HOME = np.array([0.3, -1.2, 1.4, -0.5, 0.9, 0.2])


@pytest.mark.parametrize('seed', [0, 2])
def test_no_error_clearly_larger_than_the_correction_is_expected_in_the_region(seed):
    """Of an arm with a wave of five periods a turn in each joint; of noise as told it may be."""
    rng = np.random.default_rng(seed)
    q = HOME + rng.uniform(-0.6, 0.6, (40, 6))
    turned = q + 3e-4 * np.sin(5.0 * q + rng.uniform(0.0, 6.0, 6))
    seen = replace(measure(arm(rng), turned, rng, 5e-5, oriented=False), joints=q)
    lacking, told = (identify(Problem(UR10E, seen, sigma_position=s)) for s in (5e-5, 1.5e-4))
    anywhere = UR10E.random_joints(500, rng)
    for found, limited in ((lacking, True), (told, False)):
        known = found.region.known(anywhere)
        largest = known[known <= found.region.limit].max(initial=0.0)
        assert (largest < 1.6 * rms(found.chain, found.before, q)) == limited


@needs_data
@pytest.mark.parametrize(('count', 'pose'), [(25, 135), (30, 81)])
def test_a_cable_driven_arm_measured_near_a_pose_is_no_worse_in_the_region(count, pose):
    """It has joint errors of milliradians that no parameter explains."""
    folder = DATA / 'wam7_jacobi_lasertracker'
    chain = load_chain(folder / 'chain.yaml')
    seen = read_table(folder / 'uniform.csv', 7, ('grid',)).problem(chain).observations
    order = np.argsort(np.linalg.norm(seen.joints - seen.joints[pose], axis=1))
    near, rest = (seen.select(np.sort(part)) for part in (order[:count], order[count:]))
    found = identify(Problem(chain, near))
    inside = rest.select(found.region.covers(rest.joints))
    errors = compare(found.before, found.chain, [inside])
    assert found.accepted
    assert len(inside) > 10
    assert errors.figures[1].rms_mm < errors.figures[0].rms_mm
