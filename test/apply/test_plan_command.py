# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the target is seen, and `calib_ros plan`."""

import re
from dataclasses import replace

import numpy as np
import pytest
from designs import arm, design_of, some

from calib_ros.apply import simulation
from calib_ros.apply.candidates import Visibility, draw_candidates
from calib_ros.apply.choice import Choice
from calib_ros.cli.screen import Work
from calib_ros.errors import ConfigError, InputError
from calib_ros.files.programs import joints_csv, read_joints
from calib_ros.kinematics.chain_file import dump_chain, load_chain
from calib_ros.kinematics.se3 import invert


def test_candidates_are_within_box_and_cone(rng):
    chain = replace(arm(), base=simulation.random_frame(rng, 2.0))
    design = design_of(chain)
    box = np.array([[0.0, -1.0, 0.2], [1.2, 1.0, 1.5]])
    tracker = np.array([3.0, 0.5, 1.0])
    seen = Visibility(box, tracker, (0.0, 1.0, 0.0), np.radians(30.0))
    q = draw_candidates(design, 100, rng, seen)
    poses = invert(chain.base.matrix) @ chain.forward(q)
    position, axis = poses[:, :3, 3], poses[:, :3, 1]
    sight = tracker - position
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    assert q.shape == (100, 6)
    assert ((box[0] <= position) & (position <= box[1])).all()
    assert np.degrees(np.arccos((axis * sight).sum(axis=1))).max() < 30.0
    everything = chain.random_joints(2000, rng)
    share = seen.sees(design, everything).mean()
    assert 0.0 < share < 0.1


def test_unless_told_otherwise_a_target_is_seen_within_45_degrees_of_its_axis_z(rng):
    chain = replace(arm(), base=simulation.random_frame(rng, 2.0))
    tracker, q = np.array([3.0, 0.5, 1.0]), chain.random_joints(500, rng)
    poses = invert(chain.base.matrix) @ chain.forward(q)
    sight = tracker - poses[:, :3, 3]
    cosines = (poses[:, :3, 2] * sight).sum(axis=1) / np.linalg.norm(sight, axis=1)
    seen = Visibility(tracker=tracker).sees(design_of(chain), q)
    np.testing.assert_array_equal(seen, np.degrees(np.arccos(cosines)) <= 45.0)


def test_the_region_may_be_given_in_the_world(rng):
    chain = replace(arm(), base=simulation.random_frame(rng, 2.0))
    world = chain.base.matrix[:3, 3] + np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 0.0]])
    q = draw_candidates(design_of(chain), 50, rng, Visibility(world, world=True))
    position = chain.forward(q)[:, :3, 3]
    assert ((world[0] <= position) & (position <= world[1])).all()
    with pytest.raises(ConfigError, match='where the base is'):
        Visibility(world, world=True).sees(design_of(arm()), q)


def test_a_region_out_of_reach_is_refused(rng):
    far = Visibility(np.array([[5.0, 5.0, 5.0], [6.0, 6.0, 6.0]]))
    with pytest.raises(InputError, match=r'0 of .* random poses'):
        draw_candidates(design_of(arm()), 10, rng, far)
    with pytest.raises(ConfigError, match='is empty'):
        Visibility(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]))
    with pytest.raises(ConfigError, match='axis'):
        Visibility(axis=(0.0, 0.0, 0.0))
    for x in (np.nan, np.inf):
        with pytest.raises(ConfigError, match='the tracker must be at a place in metres'):
            Visibility(tracker=np.array([x, 0.0, 1.0]))


def test_places_in_mm_are_refused():
    """A tracker at 3 km saw every pose from one side; of a box no message named the unit."""
    box, tracker = np.array([[200.0, -600.0, 100.0], [900.0, 600.0, 900.0]]), [3000.0, 0.0, 1000.0]
    for given in ({'box': box}, {'tracker': np.array(tracker)}):
        with pytest.raises(ConfigError, match='must be in metres'):
            Visibility(**given)
        Visibility(**given, world=True)  # the coordinates of a plant


def test_plan_writes_joint_values_in_order_of_visit(run, tmp_path):
    status, out, err = run('plan', '--chain', 'ur10e', '--poses', 25, '--out', 'plan.csv')
    assert (status, err) == (0, '')
    q = read_joints(tmp_path / 'plan.csv', load_chain('ur10e'))
    assert q.shape == (25, 6)
    assert np.abs(np.diff(q, axis=0)).max(axis=1).sum() < 150.0
    assert np.abs(q).max() <= 2.0 * np.pi
    rows = [line.split() for line in out.splitlines()[2:] if line[:1] == ' ']
    assert rows[0][0] == '5'
    assert rows[-1][0] == '25'
    assert float(rows[-1][1]) == pytest.approx(0.093, abs=0.005)
    assert all(float(planned) < float(random) for _, planned, random in rows)
    assert 'the tool is unknown' in out
    before = (tmp_path / 'plan.csv').read_bytes()
    again = ('--chain', 'ur10e', '--seed', 1, '--draw', 100, '--out', 'plan.csv')
    assert run('plan', *again)[0] == 1
    assert (tmp_path / 'plan.csv').read_bytes() == before
    assert run('plan', *again, '--force')[0] == 0
    assert (tmp_path / 'plan.csv').read_bytes() != before


def test_plan_names_joints_without_limits(run, tmp_path):
    rail = load_chain('ur10e_on_linear_axis')
    first, turn, lift, *rest = rail.joints
    turn, lift = replace(turn, lower=None, upper=None), replace(lift, lower=None)
    rail = replace(rail, joints=(replace(first, upper=None), turn, lift, *rest))
    (tmp_path / 'rail.yaml').write_text(dump_chain(rail))
    _, said, _ = run('plan', '--chain', 'rail.yaml', '--poses', 10, '--draw', 50)
    assert said.endswith('- Nothing was saved: --out FILE writes the poses and a report\n')
    assert 'without limits, planned from 0 to 1 m: linear_axis_joint; give' in said
    assert f'planned from -180 to 180 degrees: {turn.name}' in said
    assert f'planned from -180 to 360 degrees: {lift.name}' in said


def test_plan_takes_candidates_task_and_poses_taken_from_files(run, tmp_path):
    chain = arm()
    (tmp_path / 'chain.yaml').write_text(dump_chain(chain))
    q, task, taken = (some(chain, count, count) for count in (80, 20, 30))
    for name, values in (('q', q), ('task', task), ('taken', taken)):
        (tmp_path / f'{name}.csv').write_text(joints_csv(values))
    common = ('--chain', 'chain.yaml', '--candidates', 'q.csv', '--poses', 12, '--force')
    common += ('--task', 'task.csv', '--measured', 'position', '--out', 'plan.csv')
    _, alone, _ = run('plan', *common)
    found = read_joints(tmp_path / 'plan.csv', chain)
    nearest = np.abs(found[:, None] - q).max(axis=2).min(axis=1)
    assert nearest.max() < 1e-8
    expected = Choice(design_of(chain, oriented=False), q).best(12)
    assert {tuple(row) for row in found.round(6)} == {tuple(row) for row in q[expected].round(6)}
    _, after, _ = run('plan', *common, '--taken', 'taken.csv', '--criterion', 'task')

    def last(text):
        return float(next(row for row in text.splitlines() if row.startswith('    12')).split()[1])

    assert last(after) < 0.9 * last(alone)
    assert 'the tool' not in alone
    assert '--measured' not in alone


def test_plan_says_how_many_poses_a_wanted_error_needs(run, tmp_path):
    given = ('plan', '--chain', 'ur10e', '--accuracy', 0.1, '--draw', 200)
    _, out, _ = run(*given, '--out', 'plan.csv')
    count = len(read_joints(tmp_path / 'plan.csv', load_chain('ur10e')))
    assert f'{count} poses will reach 0.1 mm' in out
    assert 18 <= count <= 26
    _, out, _ = run(*given, '--poses', 10)
    assert f'{count} poses will reach 0.1 mm' in out
    assert out.splitlines()[-6].split()[0] == '10'


def test_plan_tells_how_many_poses_are_tried_and_exchanged(monkeypatch, run):
    told = []
    monkeypatch.setattr(Work, '__call__', lambda self, at: told.append(at))
    assert run('plan', '--chain', 'ur5e', '--accuracy', 0.1, '--draw', 100)[0] == 0
    assert re.fullmatch(r'\d+ poses', told[0])
    assert any(re.fullmatch(r'\d+ poses, exchange 2', each) for each in told)


def test_plan_with_too_few_poses_says_so(run, tmp_path):
    few = ('plan', '--chain', 'ur10e', '--poses', 3, '--draw', 200, '--out', 'plan.csv')
    _, out, _ = run(*few)
    assert 'too few poses to determine all parameters: at least 5 are needed' in out
    page = (tmp_path / 'plan.report.html').read_text()
    assert 'Plan again with more poses' in page
    assert 'Drive to each pose' not in page


FROM, HEAD = ('--candidates', 'q.csv'), 'q1,q2,q3,q4,q5,q6\n'


@pytest.mark.parametrize(
    ('arguments', 'text', 'content'),
    [
        *(
            (*each, joints_csv(some(arm(), 10)))
            for each in [
                (('--poses', 0), '--poses must be at least 1'),
                (('--accuracy', -1), '--accuracy must be positive'),
                (('--velocity', 0), 'each --velocity must be positive'),
                (('--velocity', 1, 2), '--velocity: give one value, or 6'),
                (('--candidates', 'missing.csv'), 'cannot read missing.csv'),
                (('--priors', 'elbow.a=1'), 'unknown parameter "elbow.a"'),
                (
                    ('--box', 9, 9, 9, 10, 10, 10, '--draw', 50),
                    'random poses only; 50 candidates are needed: widen what the device sees '
                    '(--box, --cone), turn the target (--axis)',
                ),
                (('--tracker', 3, 0, 1, '--cone', -10), 'between 0 and 180 degrees, not -10'),
                (('--iso9283', '--poses', 20), '--poses does not apply to --iso9283'),
                (('--iso9283', '--candidates', 'q.csv'), '--candidates does not apply'),
                (('--box', 0, 0, 0, 1, 1, 1, '--world'), 'where the base is'),
                ((*FROM, '--box', 5, 5, 5, 6, 6, 6), 'the target at no pose of q.csv'),
            ]
        ),
        *(
            (
                (option, 'q.csv'),
                'line 2: q3 180 is beyond the limits of elbow_joint',
                f'{HEAD}0,0,180,0,0,0\n',
            )
            for option in ('--task', '--taken')
        ),
        (FROM, 'line 3: q2 -90 is beyond the limits of sh', f'{HEAD}0,0,0,0,0,0\n0,-90,0,0,0,0\n'),
        (
            FROM,
            'line 2: shoulder_lift_joint -90 is beyond the limits',
            ','.join(load_chain('ur10e').joint_names) + '\n0,-90,0,0,0,0\n',
        ),
        (FROM, 'has no column q3, q4, q5, q6', 'q1,q2\n0,0\n'),
    ],
)
def test_plan_refuses_what_makes_no_sense(run, tmp_path, arguments, text, content):
    (tmp_path / 'q.csv').write_text(content)
    status, out, err = run('plan', '--chain', 'ur10e', *arguments)
    assert (status, out) == (1, '')
    assert text in err


@pytest.mark.usefixtures('unsearched')
def test_poses_of_a_refused_table_of_another_layout_are_taken_as_advised(run, tmp_path):
    chain = arm()
    rows = simulation.measure(chain, some(chain, 9, 1), np.random.default_rng(2), 5e-5, 2e-4)
    values = np.column_stack([np.degrees(rows.joints), 1e3 * rows.positions])
    head = ','.join([*(f'J{k + 1} [deg]' for k in range(6)), 'X [mm]', 'Y [mm]', 'Z [mm]'])
    np.savetxt(tmp_path / 'measured.csv', values, delimiter=',', header=head, comments='')
    given = ('measured.csv', '--columns', 'q*=J*', '--chain', 'ur10e', '--out', 'result')
    assert run('identify', *given)[0] == 3
    taken = ('--taken', 'result/residuals.csv', '--poses', 3, '--draw', 50, '--out', 'plan.csv')
    assert run('plan', '--chain', 'ur10e', *taken)[0] == 0
