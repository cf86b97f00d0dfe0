# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Closed forms of the frames, and the search for the best half of the samples."""

from dataclasses import replace

import numpy as np
import pytest

from calib_ros.apply.simulation import measure, random_frame
from calib_ros.identification.leastsquares import Samples, System
from calib_ros.identification.start import closed_forms
from calib_ros.identification.trimmed import _Linear
from calib_ros.kinematics.chain_file import load_chain

UR = load_chain('ur10e')


@pytest.mark.parametrize('fixed', [(), ('base',), ('tool',), ('base', 'tool')])
@pytest.mark.parametrize('oriented', [True, False])
def test_closed_forms_are_exact_and_keep_fixed_frames(fixed, oriented, rng):
    frames = {'base': random_frame(rng, 2.0), 'tool': random_frame(rng, 0.2)}
    seen = measure(replace(UR, **frames), UR.random_joints(30, rng), rng, oriented=oriented)
    given = {key: replace(frames[key], fixed=True) if key in fixed else None for key in frames}
    found = list(closed_forms(replace(UR, **given), seen))
    away = [np.abs(each.forward(seen.joints)[:, :3, 3] - seen.positions).max() for each in found]
    assert min(away) < 1e-9
    best = found[int(np.argmin(away))]
    for key, frame in frames.items():
        whole = oriented or key == 'base' or key in fixed
        part = (slice(None), slice(None) if whole else 3)  # positions do not turn the tool
        np.testing.assert_allclose(best.frame(key).matrix[part], frame.matrix[part], atol=1e-9)


def test_units_of_the_residuals_do_not_change_a_fit_to_a_half(rng):
    seen = measure(UR, UR.random_joints(40, rng), rng, 1e-4, 3e-4)
    names = [*UR.joints[1].parameters[:3], 'tool.x', 'tool.rx']
    masks = rng.random((3, 40)) < 0.5
    few, many = (
        _Linear(UR, names, System((Samples(seen, size, 3.0 * size),))).squares(masks)
        for size in (1e-4, 1e6)
    )
    np.testing.assert_allclose(1e20 * many, few, rtol=1e-5)
