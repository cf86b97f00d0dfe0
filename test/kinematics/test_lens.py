# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, strategies as st

from calib_ros.errors import ConfigError
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import dump_chain, load_chain, parse_chain
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.parameter import LENS_KINDS

small = st.floats(-0.2, 0.2)
lenses = st.builds(
    Lens,
    st.floats(200.0, 3000.0),
    st.floats(200.0, 3000.0),
    *[st.floats(0.0, 2000.0)] * 2,
    *[small] * 2,
    *[st.floats(-0.01, 0.01)] * 2,
    small,
)
places = st.lists(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.4, 0.4), st.floats(0.3, 3.0)),
    min_size=1,
    max_size=5,
)


def points_of(places):
    x, y, depth = np.array(places).T
    return np.stack([x * depth, y * depth, depth])


@given(lenses, places)
def test_derivatives_are_those_of_differences(lens, places):
    points = points_of(places)
    _, by_point = lens.project(points)
    step = 1e-6
    for k in range(3):
        more = np.zeros((3, 1))
        more[k] = step
        change = (lens.project(points + more)[0] - lens.project(points - more)[0]) / (2.0 * step)
        np.testing.assert_allclose(by_point[:, k], change, rtol=1e-5, atol=1e-3)
    pixels, _ = lens.project(points)
    by_lens = np.empty((len(LENS_KINDS), *pixels.shape))
    lens.by_lens(points, pixels, LENS_KINDS, by_lens)
    some = np.empty((1, *pixels.shape))
    lens.by_lens(points, pixels, ['k2'], some)
    np.testing.assert_array_equal(some[0], by_lens[LENS_KINDS.index('k2')])
    for kind, found in zip(LENS_KINDS, by_lens, strict=True):
        more, less = (lens.moved({kind: sign * step}) for sign in (1.0, -1.0))
        change = (more.project(points)[0] - less.project(points)[0]) / (2.0 * step)
        np.testing.assert_allclose(found, change, rtol=1e-5, atol=1e-3)


@given(places)
def test_rays_take_the_distortion_out(places):
    points = points_of(places)
    lens = Lens(1350.0, 1360.0, 790.0, 620.0, -0.12, 0.2, 0.001, -0.002, -0.05)
    pixels, _ = lens.project(points)
    np.testing.assert_allclose(lens.rays(pixels.T), (points[:2] / points[2]).T, atol=1e-9)


@given(places)
def test_without_distortion_a_lens_is_a_pinhole(places):
    points = points_of(places)
    pixels, _ = Lens(1350.0, 1360.0, 790.0, 620.0).project(points)
    focal, middle = np.array([[1350.0], [1360.0]]), np.array([[790.0], [620.0]])
    np.testing.assert_allclose(pixels, middle + focal * points[:2] / points[2])


def test_a_lens_is_kept_in_chain_files():
    lens = Lens(1000.0, 1001.0, 500.0, 400.0, 0.1, k3=0.25, fixed=False)
    chain = load_chain('ur5e').with_frame('base', Frame(lens=lens, fixed=True))
    again = parse_chain(dump_chain(chain), 'file')
    assert again.frame('base').lens == lens
    assert again.frame('tool').lens is None
    plain = dump_chain(load_chain('ur5e')) + 'tool: {lens: {fx: 1, fy: 2, cx: 3, cy: 4}}\n'
    held = Lens(1.0, 2.0, 3.0, 4.0, fixed=True)
    assert parse_chain(plain).frame('tool').lens == held == Lens(1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize(
    ('lens', 'said'),
    [
        ('{fx: 1, fy: 1, cx: 1}', 'key "cy" is missing'),
        ('{fx: 1, fy: 1, cx: 1, cy: 1, k4: 1}', 'k4'),
        ('{fx: 1, fy: 1, cx: 1, cy: a}', 'cy'),
        ('{fx: 1, fy: 1, cx: 1, cy: 1, fixed: 1}', 'fixed must be true or false'),
    ],
)
def test_a_lens_that_is_none_is_refused(lens, said):
    text = dump_chain(load_chain('ur5e')) + f'tool: {{lens: {lens}}}\n'
    with pytest.raises(ConfigError, match=said):
        parse_chain(text, 'file')
    with pytest.raises(ConfigError, match='fx of a camera must be a finite number'):
        Lens(np.inf, 1.0, 0.0, 0.0)
    for lengths in ((0.0, 1.0), (1.0, -1.0)):
        with pytest.raises(ConfigError, match='fx and fy of a camera must be positive'):
            Lens(*lengths, 0.0, 0.0)


def test_a_step_too_far_leaves_a_lens():
    """So that a fit can go back."""
    far = Lens(9e2, 8e2, 3e2, 2e2).moved({'fx': -1e3, 'fy': -1e3, 'cx': 1.0})
    pixels, slopes = far.project(points_of([(0.1, 0.2, 1.0)]))
    np.testing.assert_allclose(pixels[:, 0], [301.0, 200.0])
    assert np.isfinite(slopes).all()
