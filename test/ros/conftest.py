# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the tests of the node share: an arm, a shift in which it is measured, a cell."""

import gc
from functools import partial

import pytest


@pytest.fixture(autouse=True)
def no_node_stays():
    """Free nodes that did not come up: ROS logs for the oldest of a name only."""
    gc.freeze()  # what is there before the test need not be looked at after it
    yield
    gc.collect()


@pytest.fixture(scope='session')
def truth():
    from ros_cell import true_arm

    return true_arm()


@pytest.fixture(scope='module')
def recording(request, truth):
    """Return a shift, with as many joint states as a module asks for: 50 a second or fewer."""
    from ros_cell import shift

    return shift(truth, getattr(request.module, 'JOINT_RATE', 50.0))


@pytest.fixture
def launched(monkeypatch):
    """Return a function that evaluates a launch file, and returns its actions."""
    from launching import launch

    return partial(launch, monkeypatch)


@pytest.fixture
def ended_by(monkeypatch):
    """Return a function that runs the node with parameters until it ends; it returns the status.

    Besides, there may be a parameter file. Signals stay with the tests; a node that does not end
    is given to `spun`, if it may go on.
    """
    from calib_ros.ros import node, running

    monkeypatch.setattr(running, '_handle_signals', lambda handler: None)

    def endless(*_):
        pytest.fail('the node does not end')

    def run(*parameters, file=None, names=(), spun=endless):
        monkeypatch.setattr(running, '_spin', spun)
        words = ['--params-file', str(file)] if file else []
        words += [word for rule in names for word in ('-r', rule)]
        words += [word for given in parameters for word in ('-p', given)]
        return node.main(['--ros-args', *words])

    return run


@pytest.fixture
def cell(tmp_path):
    from ros_cell import Cell

    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        yield cell


@pytest.fixture(scope='module')
def idle(tmp_path_factory):
    """Return a cell with a node that nothing shall change."""
    from ros_cell import Cell

    with Cell(chain='ur10e', data_dir=str(tmp_path_factory.mktemp('idle'))) as cell:
        yield cell


@pytest.fixture(scope='module')
def empty():
    """Return a cell in which no node comes up."""
    from ros_cell import Cell

    with Cell() as cell:
        yield cell
