# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A ball that sits in sockets, captured live as a table tells it."""

from dataclasses import replace

import numpy as np
import pytest
from in_sockets import DISTANCE, IIWA, cell
from streams import joint_state, of_joints, take

from calib_ros.errors import ConfigError, InputError
from calib_ros.files.journal import Journal, read_journal
from calib_ros.files.tables import read_table
from calib_ros.sampling.dataset import dataset_of
from calib_ros.sampling.session import CalibrationSession
from calib_ros.settings import Settings

S = 1_000_000_000


def captured(problem, count, mode='triggered'):
    """Return a session in which the ball was captured in each socket a few times."""
    session = CalibrationSession(IIWA, Settings(mode=mode, sigma_position=1e-5))
    now = 10 * S
    for number, each in enumerate(problem.sets):
        for row in each.joints[:count]:
            stamps = now + np.arange(0, 50) * 10_000_000
            come = [
                of_joints(joint_state(t, IIWA.joint_names, (row + (-1) ** k * 1e-5).tolist()))
                for k, t in enumerate(stamps.tolist())
            ]
            take(session, *come)
            assert session.capture(f'place {number // 2}/{number % 2}') == (1, '')
            now += S
    return session


@pytest.mark.parametrize('mode', ['triggered', 'dwell'])
def test_who_has_captured_a_pose_is_told_to_capture_again_but_no_longer_how_to_stop(mode):
    session = captured(cell(0, count=6)[1], 1, mode)
    assert 'its pose is measured: move on' in session.status()
    again = session.capture('place 3/1')
    assert again == (0, 'it was captured already, and no joint states came since')
    for time in range(19 * S, 30 * S, S // 20):
        take(session, of_joints(joint_state(time, IIWA.joint_names, [0.3] * 7)))
    assert ' s: call ~/capture; ' in session.status()
    take(session, of_joints(joint_state(30 * S, IIWA.joint_names, [0.5] * 7)))
    assert session.status().startswith('the arm is moving; ')


def test_sockets_are_identified_from_the_node_as_from_a_table(tmp_path):
    _, problem = cell(0, count=6)
    session = captured(problem, 6)
    live = session.problem()
    assert session.account().poses == 0
    for one, other in zip(live.sets, problem.sets, strict=True):
        np.testing.assert_allclose(one.joints, other.joints, atol=1e-12)
        assert one.socket
    assert [each[2] for each in live.separations] == [DISTANCE] * (len(live.sets) // 2)
    journal = Journal(tmp_path / 'journal.csv', 7)
    for sample in session.samples:
        journal.add(sample)
    journal.close()
    table = read_table(tmp_path / 'journal.csv', 7)
    assert table.pairs == tuple(each[:2] for each in live.separations)
    for one, other in zip(table.fitted, live.sets, strict=True):
        assert (one.base, one.tool, one.socket) == (other.base, other.tool, True)
        np.testing.assert_array_equal(one.joints, other.joints)
    resumed = CalibrationSession(IIWA, session.settings)
    resumed.restore(read_journal(tmp_path / 'journal.csv', 7)[0])
    assert resumed.problem().separations == live.separations
    found = session.identify()
    assert found.fitted.figures[1].rms_mm < 1e-3
    assert 'poses' in session.status()


def test_a_moving_arm_and_a_wrong_label_are_refused():
    _, problem = cell(0, count=6)
    session = captured(problem, 1)
    later = 1000 * S + np.arange(0, 50) * 10_000_000
    rows = problem.sets[0].joints[0] + 0.01 * np.arange(50)[:, np.newaxis]
    moving = [
        of_joints(joint_state(t, IIWA.joint_names, row.tolist()))
        for t, row in zip(later.tolist(), rows, strict=True)
    ]
    take(session, *moving)
    count, why = session.capture('A/1')
    assert (count, 'has not been still' in why) == (0, True)
    three = [replace(session.samples[0], device=f'A_{k}') for k in range(3)]
    with pytest.raises(InputError, match='location A has the sockets 0, 1, 2: the distance known'):
        dataset_of(three, session.settings.sigmas)
    for label in ('A', '/1', 'A/', 'A/1_2', 'A/B/1', 'A/\n'):
        with pytest.raises(ConfigError, match='LOCATION/SOCKET'):
            session.capture(label)
