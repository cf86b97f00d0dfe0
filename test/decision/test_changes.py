# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Effects of changes and their evidence. `test_recalibration.py` has the changes themselves."""

import numpy as np
import pytest
from fits import SCARA

from calib_ros.decision import changes
from calib_ros.decision.changes import Effects, Information, shown
from calib_ros.kinematics.parameter import Parameter
from calib_ros.settings import LEVER


@pytest.mark.parametrize(('frames', 'owners'), [((), {'elbow'}), (('tool',), {'elbow', 'quill'})])
def test_frames_that_cannot_have_moved_take_what_they_can(frames, owners):
    """A tilted quill moves its tip as the elbow does, and as another tool would."""
    found = Effects(SCARA, [Parameter('elbow.theta')], frames)
    assert {owner for owner, _ in found.sets} == owners


def test_another_height_of_the_target_shows_as_one_of_the_device():
    names = [Parameter('elbow.theta'), Parameter('base.z')]
    assert shown(SCARA, names, [Parameter('tool.z')]) == names[1:]
    assert shown(SCARA, names, [Parameter('tool.x')]) == []


@pytest.mark.parametrize(
    ('names', 'free', 'lever'),
    [
        (['base.rx'], False, 0.0),
        (['base.rx', 'tool.rx'], False, LEVER),
        (['base.rx'], True, LEVER),
    ],
)
def test_turns_count_where_those_of_the_target_are_known(names, free, lever, monkeypatch):
    told = []
    follow = changes.followed
    monkeypatch.setattr(changes, 'followed', lambda *x, **y: told.append(x[4]) or follow(*x, **y))
    changes.gauged(SCARA, [*map(Parameter, names)], [Parameter('arm.theta')], free)
    assert told == [lever]


@pytest.mark.parametrize(('size', 'times'), [(1.0, 1.0), (5.0, 10.0), (1e3, 100.0)])
def test_a_change_is_as_large_as_its_evidence_tells(size, times):
    """The evidence is that of one number, here known to a tenth of the typical change."""
    names = (Parameter('elbow.theta'),)
    information = Information(names, np.array([[100.0]]), np.array([100.0 * size]))
    evidence, found = information.evidence(np.eye(1), np.ones(1))
    assert found == times
    spread = 1.0 + 100.0 * times**2
    gain = 100.0**2 * size**2 * times**2 / spread
    seldom = np.log10(times) ** 2
    assert evidence == pytest.approx(0.5 * (gain - np.log(spread) - seldom))
