# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
from designs import POSTURE, TOOL, arm, design_of, log_det, predicted_square, some
from hypothesis import given, settings, strategies as st
from robots import DATA, needs_data
from scipy.spatial.distance import pdist

from calib_ros import Chain, Problem, identify, load_chain, read_table
from calib_ros.apply import choice, planning
from calib_ros.apply.candidates import visit_order
from calib_ros.apply.choice import Choice
from calib_ros.apply.design import Candidates, Design, accuracy
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.observability import observability
from calib_ros.kinematics.chain import Frame, Joint

POSITIONER = Chain(
    'positioner',
    'standard',
    (Joint('tilt', a=0.1, alpha=1.5, lower=-1.5, upper=1.5), Joint('turn', d=0.2)),
    tool=TOOL,
)


@settings(max_examples=5)
@given(st.integers(0, 10_000))
def test_the_choice_is_close_to_the_best_of_all_choices(seed):
    """Of 126 choices of 4 from 9; and the bound of how good it is holds."""
    design = design_of(POSITIONER)
    q, task = some(POSITIONER, 9, seed), some(POSITIONER, 30, 7)
    choices = [list(each) for each in combinations(range(9), 4)]
    size = len(design.names)

    best = max(log_det(design, q[each]) for each in choices)
    chosen = Choice(design, q).best(4)
    share = np.exp((log_det(design, q[chosen]) - best) / size)
    assert 0.95 < share < 1.0 + 1e-6
    assert Choice(design, q).efficiency(chosen) <= share + 1e-6

    best = min(predicted_square(design, q[each], task) for each in choices)
    chosen = Choice(design, q, 'task', task).best(4)
    share = best / predicted_square(design, q[chosen], task)
    assert 0.8 < share < 1.0 + 1e-6
    assert Choice(design, q, 'task', task).efficiency(chosen) <= share + 1e-6


def test_no_choice_is_better_than_all():
    design = design_of(POSITIONER)
    q, task = some(POSITIONER, 9), some(POSITIONER, 30, 7)
    assert Choice(design, q, 'task', task).efficiency(np.arange(9)) == pytest.approx(1.0)
    placed = replace(POSITIONER, base=Frame(fixed=True), tool=replace(TOOL, fixed=True))
    known = design_of(placed, priors={'*': 1e-9})  # whatever is measured
    assert Choice(known, q).efficiency(np.arange(4)) == pytest.approx(1.0)
    space = Candidates(design, q)
    square = space.of_task(task)
    wanted = np.trace(space.rows @ square @ np.swapaxes(space.rows, 1, 2), axis1=1, axis2=2)
    np.testing.assert_allclose(space.traces(square), wanted)


@pytest.mark.parametrize('criterion', ['o3', 'o5'])
def test_choosing_by_an_index_raises_it(criterion):
    design = design_of(arm())
    q = some(design.chain, 100)

    def index(chosen):
        factor = np.linalg.qr(design.rows(q[chosen]).reshape(-1, 30), mode='r')
        return observability(factor, len(chosen))[criterion]

    assert index(Choice(design, q, criterion).best(15)) > 1.01 * index(Choice(design, q).best(15))


def test_effects_are_planned_for_as_well():
    chain = arm()
    design = design_of(chain, effects=('eccentricity', 'gravity'))
    q, task = some(chain, 200), some(chain, 100, 2)
    chosen = Choice(design, q).best(40)
    assert any(name.endswith('.sin_1') for name in design.names)
    assert accuracy(design, q[chosen], task)[-1] < accuracy(design, q[:40], task)[-1]


def test_each_criterion_is_best_by_its_own_measure():
    design = design_of(arm())
    q, task = some(design.chain, 200), POSTURE + 0.1 * some(design.chain, 50, 2)
    choices = [Choice(design, q, each, task) for each in ('d', 'task')]
    chosen = [each.best(20) for each in choices]
    assert choices[1].efficiency(chosen[1]) > choices[1].efficiency(chosen[0])
    by_det, by_task = (q[each] for each in chosen)
    assert log_det(design, by_det) > log_det(design, by_task)
    assert accuracy(design, by_task, task)[-1] < 0.97 * accuracy(design, by_det, task)[-1]


def test_the_first_of_a_choice_tell_the_most():
    design = design_of(arm())
    q, task = some(design.chain, 300), some(design.chain, 100, 2)
    chosen = q[Choice(design, q).best(30)]
    forward, backward = (accuracy(design, each, task) for each in (chosen, chosen[::-1]))
    assert np.isfinite(forward[4])
    assert forward[9] < 0.9 * backward[9]
    assert forward[-1] == pytest.approx(backward[-1], rel=1e-9)
    assert (np.diff(forward[4:]) < 0.0).all()


def test_poses_keep_apart():
    design = design_of(arm())
    q = POSTURE + np.random.default_rng(1).uniform(-0.5, 0.5, (200, 6))
    chosen = Choice(design, q, apart=0.4).best(20)
    assert pdist(q[chosen], 'chebyshev').min() > 0.4
    assert pdist(q[Choice(design, q).best(20)], 'chebyshev').min() < 0.4
    with pytest.raises(InputError, match='give more candidates'):
        Choice(design, q, apart=0.9).best(100)


def test_no_configuration_is_chosen_twice():
    design = design_of(arm())
    q = np.repeat(some(design.chain, 20), 5, axis=0)
    chosen = Choice(design, q).best(20)
    assert len(np.unique(q[chosen], axis=0)) == 20
    with pytest.raises(InputError, match='only 20 of 100 candidates'):
        Choice(design, q).best(21)


def test_wrong_arguments_are_refused():
    design = design_of(arm())
    q = some(design.chain, 20)
    with pytest.raises(ConfigError, match='needs the poses of a task'):
        Choice(design, q, 'task').best(5)
    with pytest.raises(ConfigError, match='count must be at least 1, not 0'):
        Choice(design, q).best(0)
    with pytest.raises(ConfigError, match='unknown criterion "e"'):
        Choice(design, q, 'e').best(5)
    for in_degrees in (np.degrees(q), q), (q, np.degrees(q)):
        with pytest.raises(InputError, match=r'\[0, .*beyond the limits of .*not degrees'):
            planning.plan(design, *in_degrees, 5)
    for nothing in (q[:0], q), (q, q[:0]):
        with pytest.raises(InputError, match='a plan needs candidates, and at least one pose'):
            planning.plan(design, *nothing, 5)
    for speeds in (np.ones(1), np.append(np.zeros(1), np.ones(len(q.T) - 1))):
        with pytest.raises(ConfigError, match=r'velocities must be \d positive numbers'):
            planning.plan(design, q, q, 5, velocities=speeds)
    for chosen in (np.arange(4), np.array([0, 1, 2, 3, 20])):
        with pytest.raises(ConfigError, match='chosen must be 5 numbers from 0 to 19, not'):
            planning.plan(design, q, q, 5, chosen=chosen)


@pytest.fixture
def unmoved(unsearched, monkeypatch):
    """Let neither mistakes nor moves be looked for, which takes most of the time."""
    monkeypatch.setattr('calib_ros.identification.identification.find_step', lambda *_: None)


def measured_problem(name, session):
    chain = load_chain(DATA / name / 'chain.yaml')
    table = read_table(DATA / name / 'uniform.csv', len(chain.joints), (session,))
    return Problem(chain, table.fitted[0], table.held_out)


@needs_data
def test_half_of_the_measured_poses_predict_as_well_as_all(unmoved):
    """Chosen without what was measured there; and the noise found is what is left on others."""
    problem = measured_problem('fr3_camera_eyeinhand', 'all')
    fitted = problem.observations
    chosen = Choice(Design.of(problem), fitted.joints).best(len(fitted) // 2)
    half = identify(replace(problem, observations=fitted.select(chosen)))
    whole = identify(problem).validation.figures[1].rms_mm
    assert half.validation.figures[1].rms_mm < 1.1 * whole
    left = half.validation.after.position[half.validation.deciding]
    noise = problem.sigma_position * half.noise.position
    assert 0.8 < np.sqrt(np.mean((left / noise) ** 2)) < 1.25


@needs_data
@pytest.mark.parametrize(
    ('name', 'session', 'least'),
    [('wam7_jacobi_lasertracker', 'grid', 0.8), ('positioner_2axis_pose', 'all', 0.45)],
)
def test_errors_away_from_the_fitted_poses_are_of_the_size_predicted(
    unmoved, name, session, least
):
    """Over the outer fifths of a joint's values, each left out: not by much more than that.

    By less on the positioner: errors that neighbours share count against the parameters as a whole
    there, and are less than that at the edge of the range (docs/planning.md).
    """
    problem = measured_problem(name, session)
    squares = []
    for column in problem.observations.joints.T[::5]:
        order = np.argsort(column)
        fifth = len(order) // 5
        for out in (order[:fifth], order[-fifth:]):
            rest = np.setdiff1d(order, out)
            part, fitted = (problem.observations.select(index) for index in (out, rest))
            result = identify(replace(problem, observations=fitted, held_out=part))
            judged = result.validation.judged
            variance = np.diagonal(result.pose_covariance(part.joints), axis1=1, axis2=2)
            variance = variance[judged, :3] + (problem.sigma_position * result.noise.position) ** 2
            squares.append(np.mean(result.validation.after.position[judged] ** 2 / variance))
    assert least < np.sqrt(np.mean(squares)) < 1.35


@pytest.mark.parametrize(('criterion', 'wanted'), [('d', 1e-4), ('task', 1e-4), ('d', 7.5e-5)])
def test_so_many_poses_are_needed_and_no_fewer(criterion, wanted):
    """Also of more poses than the parameters that the search begins with."""
    chain = arm()
    design, q, task = design_of(chain), some(chain, 200), some(chain, 100, 2)
    found = choice.fewest(Choice(design, q, criterion, task), wanted)

    def best(count):
        return accuracy(design, q[Choice(design, q, criterion, task).best(count)], task)[-1]

    assert (len(found) > len(design.names)) == (wanted < 1e-4)
    assert accuracy(design, q[found], task)[-1] <= wanted < best(len(found) - 1)
    with pytest.raises(InputError, match='all 200 candidates together'):
        choice.fewest(Choice(design, q, 'd', task), 1e-6)
    with pytest.raises(InputError, match='give the poses at which'):
        choice.fewest(Choice(design, q), 1e-3)


def travel(q, order, speeds):
    return (np.abs(np.diff(q[list(order)], axis=0)) / speeds).max(axis=1).sum()


@pytest.mark.parametrize(('count', 'seed'), [(1, 0), (2, 0), *((7, seed) for seed in range(3))])
def test_the_way_is_close_to_the_shortest(count, seed):
    rng = np.random.default_rng(seed)
    q, speeds = rng.uniform(-3.0, 3.0, (count, 3)), np.array([1.0, 2.0, 0.5])
    order = visit_order(q, speeds)
    assert sorted(order.tolist()) == list(range(count))
    shortest = min(travel(q, each, speeds) for each in permutations(range(count)))
    assert travel(q, order, speeds) <= 1.25 * shortest
    changed = order.copy()  # no part turned round is shorter
    for i, j in combinations(range(count + 1), 2):
        changed[i:j] = order[i:j][::-1]
        assert travel(q, changed, speeds) >= travel(q, order, speeds) - 1e-6
        changed[i:j] = order[i:j]


@pytest.mark.parametrize(('oriented', 'least'), [(True, 5), (False, 9)])
def test_a_plan_tells_the_fewest_poses_that_determine_all(oriented, least):
    """A pose of 6 rows or 3, for 28 parameters or 25."""
    chain = arm()
    design, poses = design_of(chain, oriented, fixed=('*.beta',)), some(chain, 200)
    for count in (least - 1, least):
        found = planning.plan(design, poses, poses[:20], count, draws=1)
        assert found.least == least
        assert np.isfinite(found.accuracy[-1]) == (count == least)
