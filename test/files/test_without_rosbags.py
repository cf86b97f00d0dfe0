# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""rosbags is not in Ubuntu: only bags need it."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.cli.main import main
from calib_ros.kinematics.chain_file import load_chain

UR = load_chain('ur10e')


@pytest.fixture
def table(tmp_path):
    rng = np.random.default_rng(3)
    chain = faulty(UR, Cell(), rng)
    seen = measure(chain, UR.random_joints(40, rng), rng, 5e-5, 2e-4)
    lines = ['q1,q2,q3,q4,q5,q6,x,y,z']
    lines += [
        ','.join(map(repr, [*q, *p]))
        for q, p in zip(seen.joints.tolist(), seen.positions.tolist(), strict=True)
    ]
    path = tmp_path / 'cell.csv'
    path.write_text('\n'.join(lines))
    return path


def test_the_node_and_tables_do_without(table):
    """All in a new interpreter: nothing may have been imported before."""
    identify = ['identify', '--csv', str(table), '--chain', 'ur10e', '--json']
    lines = ['import sys', "sys.modules['rosbags'] = None", 'import calib_ros.ros.node']
    lines += ['from calib_ros.cli.main import main', f'sys.exit(main({identify!r}))']
    leaked = ('LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE')
    ran = subprocess.run(
        [sys.executable, '-c', '\n'.join(lines)],
        env={name: value for name, value in os.environ.items() if name not in leaked},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)['accepted'] is True


def test_bags_say_how_to_install_it(tmp_path, table, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(['simulate', 'bag', '--chain', 'ur10e', '--poses', '3']) == 0
    monkeypatch.setitem(sys.modules, 'rosbags', None)
    for arguments in (
        ['identify', 'bag', '--chain', 'ur10e'],
        ['simulate', 'new', '--chain', 'ur10e', '--poses', '12'],
        ['csv2bag', str(table), 'new', '--chain', 'ur10e'],
    ):
        capsys.readouterr()
        assert main(arguments) == 1
        assert 'pip install rosbags' in capsys.readouterr().err
    assert not (tmp_path / 'new').exists()
