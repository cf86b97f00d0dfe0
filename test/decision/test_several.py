# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Several simultaneous changes of an arm. `test_changed_zeros.py` has them in few poses."""

from types import SimpleNamespace

import numpy as np
import pytest
from fits import UR10E
from scipy import optimize
from test_changes import THREE, known

from calib_ros.decision.changes import ChangeColumns, Information
from calib_ros.decision.several import likelier, one_by_one
from calib_ros.kinematics.parameter import Parameter, parameters_of

TOOL = parameters_of('tool')


def told(*names):
    return (SimpleNamespace(names=names),)


@pytest.mark.parametrize(
    ('steps', 'wanted'),
    [
        (['tool', 'base', 'tool'], ['tool', 'base']),  # named twice, far from where it was
        (['tool', 'base', 'base shift'], ['tool', 'base']),
        (['base shift', 'tool', 'base'], ['tool', 'base']),
        (['tool', 'base', 'zero', '', '', '', 'other'], ['tool', 'base', 'zero']),
        ([], []),
    ],
)
def test_a_frame_is_named_once(steps, wanted):
    base = parameters_of('base')
    known = {'tool': told(*TOOL), 'base': told(*base), 'base shift': told(*base[:3])}
    known |= {'zero': told(THREE[0]), 'other': told(THREE[1]), '': ()}
    answers = iter([known[step] for step in steps])
    found = one_by_one(lambda _: next(answers, ()))
    assert found == [known[name] for name in wanted]


def test_each_change_is_looked_for_again_beside_the_others():
    """The first was the best single explanation of both."""
    link, base, tool = told(*THREE), told(*parameters_of('base')), told(*TOOL)
    after = [([], link), ([link], base), ([link, base], ()), ([base], tool), ([tool], base)]
    assert one_by_one(lambda found: next(more for some, more in after if some == found)) == [
        tool,
        base,
    ]


def test_zeros_are_told_beside_a_moved_target(rng):
    """Of 12 arms with two slipped zeros and another target a bent link was named for 9."""
    names = [*THREE, *TOOL]
    change = np.array([2e-3, -2e-3, 0.0, *[5e-4] * 6])
    columns = ChangeColumns(UR10E, names, ['tool'])
    information = known(rng, change, names=names)
    given = [(SimpleNamespace(names=TOOL, owner='tool', share=0.9, times=1.0),), told(*THREE)]
    (target,), *zeros = likelier(information, columns, 100.0, given)
    assert (target.owner, target.names, target.share) == ('tool', TOOL, 0.9)
    np.testing.assert_allclose(target.change, change[3:], atol=1e-4)
    assert [each.names for (each,) in zeros] == [(name,) for name in THREE[:2]]


@pytest.mark.parametrize(
    ('change', 'first', 'wanted'),
    [
        ((2e-3, 0.0, 0.0), (0,), (0,)),
        ((2e-3, -2e-3, 0.0), (2,), (0, 1)),
        ((2e-3, -2e-3, 0.0), (0, 1), (0, 1)),  # as found one by one
        ((2e-3, -2e-3, 3e-3), (0, 1), (0, 1, 2)),
    ],
)
def test_the_fewest_zeros_that_explain_all_are_likelier(change, first, wanted, rng):
    information, columns = known(rng, np.array(change)), ChangeColumns(UR10E, THREE)
    one = SimpleNamespace
    given = [(one(names=(THREE[k],)),) for k in first]
    found = likelier(information, columns, 100.0, given)
    assert [reasons[0].names for reasons in found] == [(THREE[k],) for k in wanted]
    if first == wanted:
        assert found is given
        return
    for (each,), k in zip(found, wanted, strict=True):
        assert (each.owner, each.share) == (THREE[k].owner, 1.0)
        assert each.change == pytest.approx(change[k], abs=5.0 * each.sigma[0])
        assert 1e-6 < each.sigma[0] < 1e-4
    assert likelier(information, columns, 100.0, []) == []


def test_the_zeros_of_all_joints_are_one_change(rng):
    names = [joint.driven for joint in UR10E.joints[1:5]]
    information = known(rng, np.full(4, 3e-3), names=names)
    given = [(SimpleNamespace(names=(names[0],)),)]
    ((found,),) = likelier(information, ChangeColumns(UR10E, names), 100.0, given)
    assert (found.owner, list(found.names)) == ('all joints', names)


@pytest.mark.parametrize('odds', [0.96, 1.04])
@pytest.mark.parametrize(('count', 'choices'), [(2, 5), (4, 7)])
def test_one_change_more_must_be_likelier_than_any_of_as_many(count, choices, odds):
    """All zeros count as one more than any three of them, a link with parts of the next once."""
    names = [joint.driven for joint in UR10E.joints[1 : 1 + count]]
    names += [Parameter('elbow_joint.a'), Parameter('elbow_joint.alpha')]
    columns, matrix = ChangeColumns(UR10E, names), 1e10 * np.eye(count + 2)
    change = np.array([*[3e-3] * (count - 1), 0.0, 0.0, 0.0])

    def evidence(size):
        change[count - 1] = size
        information = Information(tuple(names), matrix, matrix @ change)
        return columns.evidence(information, [names[count - 1]])[0]

    optimize.brentq(lambda size: evidence(size) - odds * np.log(choices), 1e-7, 1e-3)
    given = [(SimpleNamespace(names=(name,)),) for name in names[: count - 1]]
    found = likelier(Information(tuple(names), matrix, matrix @ change), columns, 100.0, given)
    told = [name for (each,) in found for name in each.names]
    assert told == names[: count if odds > 1.0 else count - 1]
