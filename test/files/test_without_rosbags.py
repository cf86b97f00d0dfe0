# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""rosbags is not in Ubuntu: only bags need it."""

import json
import os
import subprocess
import sys


def test_the_node_and_tables_do_without(table):
    """All in a new interpreter: nothing may have been imported before."""
    identify = ['identify', '--csv', str(table), '--chain', 'ur5e', '--json']
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


def test_bags_say_how_to_install_it(run, tmp_path, table, monkeypatch):
    assert run('simulate', 'bag', '--chain', 'ur5e', '--poses', 3)[0] == 0
    monkeypatch.setitem(sys.modules, 'rosbags', None)
    for arguments in (
        ('identify', 'bag'),
        ('simulate', 'new', '--poses', 12),
        ('csv2bag', table, 'new'),
    ):
        status, _, err = run(*arguments, '--chain', 'ur5e')
        assert status == 1
        assert 'pip install rosbags' in err
    assert not (tmp_path / 'new').exists()
