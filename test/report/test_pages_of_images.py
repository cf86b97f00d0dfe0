# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is told of images of a board is told in images, corners and lines of the user's tables."""

import json
import re

import numpy as np
import pytest
from measured import write_images, write_places
from pages import Page

from calib_ros.apply.camera import Camera, before_camera, photograph
from calib_ros.apply.simulation import Cell, faulty
from calib_ros.cli.common import Status
from calib_ros.kinematics.chain_file import load_chain

UR, CAMERA = load_chain('ur10e'), Camera()
POINTS = np.array([(0.03 * i, 0.03 * j, 0.0) for j in range(1, 5) for i in range(1, 7)])
SLIPPED = 13


@pytest.fixture(scope='module')
def photographs(tmp_path_factory):
    """Return a folder with the tables of 30 images; in `slipped.csv` a joint lost its zero."""
    folder, rng = tmp_path_factory.mktemp('camera'), np.random.default_rng(5)
    true = before_camera(faulty(UR, Cell(), rng), CAMERA, POINTS, True, rng)
    seen = photograph(true, CAMERA, POINTS, True, 30, rng, noise=0.1)
    write_images(folder, seen, CAMERA.lens, 0.03)
    joints = seen.joints[:: len(POINTS)].copy()
    joints[SLIPPED:, 2] += 3e-3
    write_places(folder / 'slipped.csv', joints)
    return folder


@pytest.fixture
def identified(photographs, run, monkeypatch, tmp_path):
    monkeypatch.chdir(photographs)

    def identified(places, *more):
        words = ['identify', '--chain', 'ur10e', '--eye-in-hand', '--sigma-pixel', '0.1']
        words += ['--detections', 'corners.csv', '--board', 'board.yaml', '--places', places]
        code, out, _ = run(*words, '--intrinsics', 'camera.yaml', '--out', tmp_path / 'out', *more)
        return code, ' '.join(out.split()), tmp_path / 'out'

    return identified


def test_a_result_counts_images_and_corners(identified):
    status, told, out = identified('places.csv', '--lens', 'fitted')
    assert status == 0
    assert 'fitted to 30 images with 720 corners position error' in told
    found = re.search(r': fx (\S+), fy', told)
    assert float(found.group(1)) == pytest.approx(CAMERA.lens.fx, rel=1e-3)
    page = Page((out / 'report.html').read_text())
    for text in ('Corners one by one', 'Share of corners within', 'Corners 720'):
        assert text in page.text
    assert page.data['explorer']['images'][24] == '1.png'
    assert page.data['explorer']['things'] == 'corners'
    document = json.loads((out / 'result.json').read_text())
    read = {each['name'] for each in document['origin']['inputs']}
    assert read == {'corners.csv', 'board.yaml', 'places.csv', 'camera.yaml'}


def test_a_slip_is_told_by_its_image_and_line(identified):
    status, told, out = identified('slipped.csv')
    assert status == Status.NOT_ACCEPTED
    line = 2 + SLIPPED * len(POINTS)
    assert f'before image {SLIPPED + 1}, line {line} (if' in told
    where = json.loads((out / 'result.json').read_text())['step']['where']
    assert where.startswith(f'image {SLIPPED + 1}, line {line} (')
    assert 'Measure more poses' not in told  # which would not help
    rows = (out / 'residuals.csv').read_text().splitlines()
    assert rows[0].startswith('line,')
    assert rows[len(POINTS)].startswith('2,')
    assert rows[len(POINTS) + 1].startswith(f'{2 + len(POINTS)},')
