# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Benchmarks are not run by the tests, but all that they import is there."""

import subprocess
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).parents[1] / 'benchmarks'
IMPORT = 'import runpy, sys; [runpy.run_path(path) for path in sys.argv[1:]]'


def test_all_that_benchmarks_import_is_there():
    paths = map(str, sorted(BENCHMARKS.glob('*.py')))
    subprocess.run([sys.executable, '-c', IMPORT, *paths], cwd=BENCHMARKS, check=True)
