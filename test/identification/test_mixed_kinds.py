# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements of several kinds in one table, identified together by the command line.

A tracker sees the pose of one target and the position of another, a wire goes from a point of its
own to a third, and a camera on the flange sees a board.
"""

import json

import numpy as np
import pytest
from fits import NOISE, UR10E
from measured import write_csv

from calib_ros.apply.simulation import Cell, faulty, random_frame
from calib_ros.cli.main import main
from calib_ros.kinematics import se3


class Workcell:
    """The true chain, and the frames of all that measures and is measured."""

    def __init__(self, seed):
        rng = self.rng = np.random.default_rng(seed)
        self.true = faulty(UR10E, Cell(), rng)
        names = ('base_wire', 'base_board', 'tool_ball', 'tool_hook', 'tool_camera')
        for name in names:
            frame = random_frame(rng, 2.0 if name.startswith('base') else 0.2)
            self.true = self.true.with_frame(name, frame)

    def poses(self, joints, base='base', tool='tool', noise=NOISE):
        """Return noisy poses (N, 4, 4) of a tool in a base."""
        exact = self.true.forward(joints, base=base, tool=tool)
        count = len(joints)
        turn = se3.exp_rotation(self.rng.normal(scale=noise[1], size=(count, 3)))
        shift = self.rng.normal(scale=noise[0], size=(count, 3))
        return se3.transform(turn @ exact[:, :3, :3], exact[:, :3, 3] + shift)

    def distances(self, joints, noise=NOISE[0]):
        length = np.linalg.norm(
            self.true.forward(joints, base='base_wire', tool='tool_hook')[:, :3, 3], axis=1
        )
        return length + self.rng.normal(scale=noise, size=len(joints))

    def pictures(self, joints, noise=NOISE):
        """Return noisy poses of the board in the camera."""
        seen = se3.invert(self.poses(joints, 'base_board', 'tool_camera', (0.0, 0.0)))
        turn = se3.exp_rotation(self.rng.normal(scale=noise[1], size=(len(joints), 3)))
        shift = self.rng.normal(scale=noise[0], size=(len(joints), 3))
        return se3.transform(turn @ seen[:, :3, :3], seen[:, :3, 3] + shift)


@pytest.fixture
def identified(capsys):
    """Return a function that identifies by the command line and returns the JSON document."""

    def identified(*arguments):
        capsys.readouterr()
        sigmas = ('--sigma-position', NOISE[0], '--sigma-orientation', NOISE[1])
        words = ('identify', '--chain', 'ur10e', '--json', *sigmas, *arguments)
        status = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert (status, err) == (0, ''), err
        return json.loads(out)

    return identified


def corrected(document):
    """Return the chain of a JSON document, with its frames."""
    chain = UR10E
    for name in {key.partition('.')[0] for key in document['parameters']}:
        if name.startswith(('base_', 'tool_')):
            chain = chain.with_frame(name, None)
    return chain.with_offsets(
        {name: entry['offset'] for name, entry in document['parameters'].items()}
    )


def error(chain, cell, base='base', tool='tool', true_base='base', true_tool='tool'):
    """Return the RMS error [m] of the predicted positions at new configurations."""
    joints = UR10E.random_joints(300, np.random.default_rng(99))
    found = chain.forward(joints, base=base, tool=tool)
    wanted = cell.true.forward(joints, base=true_base, tool=true_tool)
    return np.sqrt(((found - wanted)[:, :3, 3] ** 2).sum(axis=1).mean())


def pose_cells(pose):
    quat = se3.to_quat(pose[:3, :3]).tolist()
    where = dict(zip('xyz', pose[:3, 3].tolist(), strict=True))
    return where | dict(zip(('qx', 'qy', 'qz', 'qw'), quat, strict=True))


def rows_of(cell, counts):
    """Return rows of all kinds, mixed."""
    rows = []

    def add(kind, joints, **more):
        row = {f'q{k + 1}': value for k, value in enumerate(joints.tolist())}
        rows.append(row | more | {'kind': kind})

    poses, points, lengths, pictures = (UR10E.random_joints(n, cell.rng) for n in counts)
    for joints, pose in zip(poses, cell.poses(poses), strict=True):
        add('pose', joints, **pose_cells(pose))
    for joints, pose in zip(points, cell.poses(points, tool='tool_ball'), strict=True):
        add('point', joints, target='ball', **dict(zip('xyz', pose[:3, 3].tolist(), strict=True)))
    for joints, length in zip(lengths, cell.distances(lengths), strict=True):
        add('wire', joints, device='wire', target='hook', distance=float(length))
    for joints, pose in zip(pictures, cell.pictures(pictures), strict=True):
        add('camera', joints, device='camera', target='board', eye_in_hand=1, **pose_cells(pose))
    order = np.concatenate([[0], 1 + cell.rng.permutation(len(rows) - 1)])  # the pose first
    return [rows[k] for k in order]


COUNTS = (25, 40, 60, 30)


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_all_kinds_in_one_table(identified, tmp_path, seed):
    cell = Workcell(seed)
    rows = rows_of(cell, COUNTS)
    document = identified('--csv', write_csv(tmp_path / 'cell.csv', rows))
    assert document['samples'] == {'samples': sum(COUNTS), 'held_out': 0, 'sets': 4}
    # by poses 30, and for another target, a wire and a camera what each adds
    assert document['rank'] == 30 + 3 + (3 + 3) + (6 + 6)
    assert document['noise_in_sigma']['position'] == pytest.approx(1.0, abs=0.15)
    chain = corrected(document)
    assert set(chain.frame_names) == {
        *('base', 'tool', 'tool_ball', 'base_wire', 'tool_hook', 'base_board', 'tool_camera')
    }
    together = error(chain, cell)
    assert together < NOISE[0]
    assert error(chain, cell, tool='tool_ball', true_tool='tool_ball') < NOISE[0]
    camera = ('base_board', 'tool_camera')
    # 0.2 mrad at the distance of the board are 0.4 mm
    assert error(chain, cell, *camera, *camera) < 4.0 * NOISE[0]
    only = [row for row in rows if row['kind'] == 'pose']
    alone = identified('--csv', write_csv(tmp_path / 'poses.csv', only))
    assert together < error(corrected(alone), cell)
