# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import gc
import os
import shutil
import tempfile

# Read by rclpy and its messages when they are imported.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_HOME'] = os.path.join(tempfile.gettempdir(), f'calib_ros_test_{os.getpid()}')
# As the command line has it: more threads only wait for each other on small matrices.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile(
    'calib_ros', deadline=None, derandomize=True, max_examples=30, database=None
)
settings.load_profile('calib_ros')


@pytest.fixture
def rng():
    return np.random.default_rng(20240607)


@pytest.fixture
def unsearched(monkeypatch):
    """Let no mistakes be looked for, which takes far longer than the identification."""
    monkeypatch.setattr('calib_ros.decision.mistakes.diagnose', lambda *_, **__: None)


@pytest.fixture
def single(monkeypatch):
    """Let several mistakes at once not be looked for, which takes most of a search."""
    monkeypatch.setattr('calib_ros.decision.mistakes._beam_search', lambda *_: None)


@pytest.fixture
def none_odd(monkeypatch):
    """Let no single pose be left out of an update, which takes longer than all else."""
    monkeypatch.setattr('calib_ros.identification.recalibration._without_one', lambda *_: ())


@pytest.fixture
def table(tmp_path):
    """Return the path of a table of what was measured of a UR5e."""
    from measured import measured, rows_of, write_csv

    return write_csv(tmp_path / 'cell.csv', rows_of(measured()))


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    """Return a function that runs a command in `tmp_path`: status, output and errors."""
    from calib_ros.cli.main import main

    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        capsys.readouterr()
        status = main([*map(str, arguments)])
        out, err = capsys.readouterr()
        return status, out, err

    return run


@pytest.fixture(scope='session', autouse=True)
def png_of():
    """Leave PNG files empty: to draw one takes longer than to identify. Return what draws.

    Nor does a command say how long it takes on a busy machine.
    """
    from calib_ros.report import plots

    known = plots.png_of
    with pytest.MonkeyPatch.context() as always:
        always.setattr(plots, 'png_of', lambda figure: b'')
        always.setattr('calib_ros.cli.screen.EVERY_S', 1e6)
        yield known


@pytest.fixture
def drawn(monkeypatch, png_of):
    """Let pictures be drawn."""
    monkeypatch.setattr('calib_ros.report.plots.png_of', png_of)


def pytest_collection_finish():
    gc.freeze()  # thousands of tests need not be looked at again by every collection


def pytest_unconfigure():
    shutil.rmtree(os.environ['ROS_HOME'], ignore_errors=True)
