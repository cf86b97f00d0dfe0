# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What `import calib_ros` offers."""

import inspect
import subprocess
import sys

import calib_ros


def test_all_public_names_are_there_and_sorted():
    assert list(calib_ros.__all__) == sorted(calib_ros.__all__)
    for name in calib_ros.__all__:
        assert getattr(calib_ros, name).__name__ == name
    shown = [name for name in dir(calib_ros) if not name.startswith('__')]
    assert shown == list(calib_ros.__all__)


def test_help_of_a_value_says_what_its_fields_are():
    text = inspect.getdoc(calib_ros.Chain)
    assert text.startswith('A serial chain; immutable: offsets return a new one.\n\nname: str\n')
    assert 'tool: Frame | None = None\n"""T_world_base and T_flange_target; None if' in text
    assert text.endswith('in the base frame, for compliance."""')
    assert 'RMS position error [m] over poses like these' in calib_ros.Verification.__doc__
    inherited = calib_ros.Compensator.__doc__
    assert 'largest_turn: float = 0.1\n    """largest correction of' in inherited
    assert 'default: 1e-6, or 0.02 for arms' in inherited  # not the name of a constant


def test_the_import_loads_nothing_else():
    """It is for this that the names are loaded late: numpy alone takes 0.1 s."""
    line = 'import sys, calib_ros; print(sorted(m for m in sys.modules if "numpy" in m))'
    ran = subprocess.run([sys.executable, '-c', line], check=True, capture_output=True, text=True)
    assert ran.stdout.strip() == '[]'
