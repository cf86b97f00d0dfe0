# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A palletiser: parallelograms keep its hand level, so two of its six axes follow others."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, SIGMAS, measured_arm, rms
from streams import POSE, TRACKER, joint_state, of_joints, pose, stamps, stops, take
from urdfs import SCARA, ZERO, Z, limits, reference_forward, written

from calib_ros import CalibrationSession, Problem, Settings, identify
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.reasons import Rule
from calib_ros.errors import ConfigError, InputError
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.chain_file import dump_chain, load_chain, parse_chain
from calib_ros.kinematics.corrected_urdf import corrected_urdf
from calib_ros.kinematics.effects import basis, couple_held
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.joint import Joint
from calib_ros.kinematics.urdf import chain_from_urdf

Y = (0, 1, 0)
NAMES = ('turn', 'lower', 'upper', 'level_1', 'level_2', 'wrist')
PALLETISER = written(
    'palletiser',
    ('turn', 'revolute', 'base', 'column', (0, 0, 0.5), ZERO, Z, limits(-2.5, 2.5)),
    ('lower', 'revolute', 'column', 'arm_1', (0.26, 0, 0.24), ZERO, Y, limits(-0.7, 1.4)),
    ('upper', 'revolute', 'arm_1', 'arm_2', (0, 0, 0.945), ZERO, Y, limits(-0.3, 2.0)),
    ('level_1', 'revolute', 'arm_2', 'between', (1.025, 0, 0), ZERO, Y, limits(-2, 2)),
    ('level_2', 'continuous', 'between', 'hand', ZERO, ZERO, Y),
    ('wrist', 'revolute', 'hand', 'tool0', (0.22, 0, -0.2), ZERO, Z, limits(-2.5, 2.5)),
)
for _follower, _leader in (('level_1', 'lower'), ('level_2', 'upper')):
    _head = (
        f'<joint name="{_follower}" type="{"revolute" if _leader == "lower" else "continuous"}">'
    )
    assert _head in PALLETISER
    _mimic = f'<mimic joint="{_leader}" multiplier="-1" offset="{0.1 * (_leader == "upper")}"/>'
    PALLETISER = PALLETISER.replace(_head, _head + _mimic)
CHAIN = chain_from_urdf(PALLETISER)


def whole(q):
    """Return the values of all joints by name, those of the followers as in the URDF."""
    values = dict(zip(NAMES, q.tolist(), strict=True))
    return values | {'level_1': -values['lower'], 'level_2': 0.1 - values['upper']}


def test_mimicking_joints_follow_whatever_is_reported_of_them(rng):
    q = CHAIN.random_joints(20, rng)
    reported = q.copy()
    reported[:, 3:5] = rng.normal(size=(20, 2))
    expected = [reference_forward(PALLETISER, whole(row), 'base', 'tool0') for row in q]
    np.testing.assert_allclose(CHAIN.forward(reported), expected, rtol=0.0, atol=1e-9)


def test_effects_and_delays_take_coupled_joints_where_they_are_led(rng):
    """Whatever is reported of them: the torque of a weight in the hand, and the way in 1 s."""
    chain = CHAIN.with_effects(['upper.gravity_wrist', 'level_1.ratio', 'level_2.sin_1'])
    chain = chain.with_frame('base', Frame(delay=0.0))
    names = [name for name, _ in chain.effects[2:]]
    q, speeds = CHAIN.random_joints(5, rng), rng.normal(size=(5, 6))
    actual = np.array([[*whole(row).values()] for row in q])
    found, expected = (basis(chain, names, each.T, None) for each in (q, actual))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)
    later, earlier = (chain.forward(q + step * speeds)[:, :3, 3] for step in (1e-6, -1e-6))
    moved = ErrorModel(chain, ['base.delay']).jacobian(q, velocity=speeds)[:, :3, 0]
    np.testing.assert_allclose(moved, (earlier - later) / 2e-6, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize('order', [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_a_led_joint_may_lead_another(order):
    """In whatever order the chain file names the couplings."""
    names = ('b.coupling_a', 'c.coupling_b', 'd.coupling_c')
    held = (Joint(name, lower=0.0, upper=0.0) for name in 'bcd')
    given = tuple((names[k], -1.0) for k in order)
    chain = Chain('arm', 'standard', (Joint('a'), *held), effects=given)
    expected = np.array([[0.5], [-0.5], [0.5], [-0.5]])
    reported = np.array([[0.5], [0.1], [0.2], [0.3]])
    np.testing.assert_allclose(couple_held(chain, reported), expected, atol=1e-12)
    np.testing.assert_allclose(chain.effective(reported), expected, atol=1e-12)


@pytest.mark.parametrize('changes', [(0.0, 0.0), (-2e-3, 0.0), (1e-3, -1e-3)])
@pytest.mark.parametrize('ratio', [' multiplier="-1"', ''])
def test_a_corrected_urdf_has_the_fitted_couplings(changes, ratio, rng):
    """Also where a multiplier is missing, which then is 1."""
    urdf = PALLETISER.replace(' multiplier="-1"', ratio, 1)
    nominal = chain_from_urdf(urdf)
    effects = zip(nominal.effects, changes, strict=True)
    fitted = tuple((name, value + change) for (name, value), change in effects)
    true = replace(faulty(nominal, Cell(), rng), effects=fitted)
    text = corrected_urdf(urdf, true)
    assert chain_from_urdf(text).effects == fitted
    q = nominal.random_joints(20, rng)
    q[:, 3:5] = q[:, 1:3] * [value for _, value in fitted] + [0.0, 0.1]
    rows = [dict(zip(NAMES, row.tolist(), strict=True)) for row in q]
    found = [reference_forward(text, row, 'base', 'tool0') for row in rows]
    arm = replace(true, base=nominal.base, tool=nominal.tool)
    np.testing.assert_allclose(found, arm.forward(q), rtol=0.0, atol=1e-9)
    kept = bool(ratio) and not changes[0], not changes[1]
    assert text.count('multiplier="-1"') == sum(kept)


@pytest.mark.parametrize('oriented', [True, False])
def test_what_the_coupled_joints_show_is_identified_and_the_rest_named_a_gauge(oriented, rng):
    true = faulty(CHAIN, Cell(), rng)
    q = CHAIN.random_joints(60, rng)
    nominal = replace(CHAIN, base=None, tool=None)
    seen = measure(true, q, rng, *NOISE, oriented=oriented)
    result = identify(Problem(nominal, seen, **SIGMAS))
    assert result.accepted
    assert not result.not_excited
    assert {'turn.a', 'level_2.theta'} <= result.gauges.keys()
    fresh = CHAIN.random_joints(200, rng)
    assert rms(result.chain, true, fresh) < 0.05 * rms(result.before, true, fresh)


def test_the_hidden_height_of_a_target_on_a_level_hand_is_asked_for(rng):
    """Tilts by errors of the arm move it, too: 1 mrad at 0.3 m."""
    level = chain_from_urdf(PALLETISER.replace('offset="0.1"', 'offset="0.0"'))
    true = faulty(level, Cell(), rng)
    true = true.with_offsets({'tool.z': -0.3 - true.value('tool.z')})
    seen = measure(true, level.random_joints(60, rng), rng, *NOISE)
    roughly = true.with_offsets({'tool.z': 0.01}).tool
    errors = []
    for tool in (None, roughly):
        result = identify(Problem(replace(level, base=None, tool=tool), seen, **SIGMAS))
        asked = 'hides tool.z, taken as 0, but tilts by errors of the arm'
        assert any(asked in each for each in result.remarks) == (tool is None)
        errors.append(rms(result.chain, true, level.random_joints(200, rng)))
    assert errors[1] < 0.5 * errors[0]


def test_so_is_that_on_a_scara_whose_axes_tilt(rng):
    """Tool points count from its flange, which the fit puts at the height of the target."""
    scara = replace(load_chain('denso_hsr065'), base=None, tool=None)
    tilted = faulty(scara, Cell(), rng).with_offsets({'tool.z': 0.2})
    upright = replace(tilted, joints=scara.joints).with_offsets({'joint_1.a': 5e-4})
    q = scara.random_joints(60, rng)
    for true, tool, told in (
        (tilted, None, True),
        (tilted, tilted.tool, False),
        (upright, None, False),
    ):
        seen = measure(true, q, rng, *NOISE)
        result = identify(Problem(replace(scara, tool=tool), seen, **SIGMAS))
        assert result.accepted
        found = [each for each in result.remarks if 'tool points 0.3 m from there are' in each]
        assert bool(found) is told


@pytest.mark.parametrize(
    ('kind', 'told'),
    [
        ('base', 'tool.z, taken as 0, but tilts'),
        ('tool', 'tool_a.z, taken as 0, and tool_b.z, taken as 0.05, but tilts'),
    ],
)
def test_so_it_is_with_two_devices_or_targets(kind, told, rng):
    """The height of one device over another, or of one target, was the gauge; no tool was 0."""
    scara = replace(load_chain('denso_hsr065'), base=None, tool=None)
    true, q = faulty(scara, Cell(), rng), scara.random_joints(60, rng)
    sets = []
    for k, name in enumerate('ab'):
        there = true.with_offsets({f'{kind}.z': 0.05 * k})
        seen = measure(there, q[30 * k : 30 * k + 30], rng, *NOISE)
        sets.append(replace(seen, **{kind: f'{kind}_{name}'}))
    problem = Problem(scara, sets[0], more=sets[1:], **SIGMAS)
    (found,) = (each for each in identify(problem).remarks if 'stays level' in each)
    assert told in found
    known = replace(scara, frames=((f'{kind}_a', None), ('tool_a', true.tool)), tool=true.tool)
    given = identify(replace(problem, chain=known))
    assert not any('stays level' in each for each in given.remarks)


@pytest.mark.parametrize('second', ['motor" multiplier="-1" offset="0.2', 'outer" multiplier="-2'])
def test_the_first_joint_of_a_column_leads_the_others_of_a_motor_elsewhere(second, rng):
    """Two lifts mimic one that is not between the links, or one of them the other."""
    mimics = 'motor" multiplier="0.5" offset="0.1', second
    lifts = [f'{limits(-0.5, 0.5)}<mimic joint="{each}"/>' for each in mimics]
    column = written(
        'column',
        ('motor', 'prismatic', 'base', 'belt', ZERO, ZERO, Z),
        ('outer', 'prismatic', 'base', 'tube', (0, 0, 0.3), ZERO, Z, lifts[0]),
        ('inner', 'prismatic', 'tube', 'plate', (0, 0, 0.1), (0, 0.2, 0), Z, lifts[1]),
        ('turn', 'revolute', 'plate', 'tool0', (0.5, 0, 0), ZERO, Y, limits(-2, 2)),
    )
    chain = chain_from_urdf(column)
    assert (chain.joints[0].lower, chain.joints[0].upper) == (-0.5, 0.5)
    (held,) = chain.held
    assert chain.joint_names[held] == 'inner'
    for outer, _, turn in (q := chain.random_joints(5, rng)):
        motor = (outer - 0.1) / 0.5
        inner = 0.2 - motor if 'motor' in second else -2.0 * outer
        values = {'motor': motor, 'outer': outer, 'inner': inner, 'turn': turn}
        expected = reference_forward(column, values, 'base', 'tool0')
        found = chain.forward(np.array([[outer, 0.0, turn]]))[0]
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
    assert len(q) == 5
    ((name, value),) = chain.effects
    effects = ((name, 1.01 * value),)
    if 'motor' in second:
        with pytest.raises(ConfigError, match='one that has an offset itself'):
            corrected_urdf(column, replace(chain, effects=effects))
        column = column.replace(' offset="0.1"', '')
    fitted = replace(chain_from_urdf(column), effects=effects)
    found = dict(chain_from_urdf(corrected_urdf(column, fitted)).effects)
    assert found == {name: pytest.approx(1.01 * value, rel=1e-12)}


def test_without_couplings_in_the_chain_they_are_named(rng):
    alone = replace(
        CHAIN,
        joints=tuple(replace(each, lower=-3.0, upper=3.0) for each in CHAIN.joints),
        effects=(),
    )
    q = CHAIN.random_joints(60, rng)
    q[:, 3:5] = [0.0, 0.1] - q[:, 1:3]
    seen = measure(faulty(alone, Cell(), rng), q, rng, *NOISE)
    refused = identify(Problem(replace(alone, base=None, tool=None), seen, **SIGMAS)).refusals
    assert any('only moved together' in text and 'lower' in text for text in refused)


def test_only_joints_that_can_move_are_told_to_have_stood_still(rng):
    q = CHAIN.random_joints(60, rng)
    q[:, 1], q[:, 3:5] = 0.5, [0.0, 0.1] - q[:, 1:3]
    seen = measure(faulty(CHAIN, Cell(), rng), q, rng, *NOISE)
    refused = identify(Problem(replace(CHAIN, base=None, tool=None), seen, **SIGMAS)).refusals
    (reason,) = (each for each in refused if each.rule is Rule.EXCITATION)
    assert reason.startswith('lower stood still (or was not recorded): the poses do not')


def test_joint_states_need_not_name_them(rng):
    true = faulty(CHAIN, Cell(), rng)
    q = CHAIN.random_joints(5, rng)
    motion, end = stops(q, 0.8, 0.8), 8.0
    times = np.arange(0.0, end, 0.04)
    made = CalibrationSession(CHAIN, Settings(**SIGMAS))
    named = [0, 1, 2, 5]
    for row, stamp in zip(motion(times), stamps(times).tolist(), strict=True):
        found = true.forward(row[np.newaxis])[0]
        message = joint_state(stamp, [NAMES[k] for k in named], row[named].tolist())
        take(made, of_joints(message), (TRACKER, POSE, pose(stamp, found[:3, 3], found[:3, :3])))
    made.finish()
    np.testing.assert_allclose([each.joints for each in made.samples], q, atol=1e-3)


def test_names_that_never_came_are_not_told_to_have_come():
    made = CalibrationSession(CHAIN, Settings())
    take(made, of_joints(joint_state(1_000_000_000, ['turn', 'other'], [0.0, 0.0])))
    assert made.account().foreign_names == ('other', 'turn')


def test_equal_limits_that_are_none_are_refused(rng):
    assert parse_chain(dump_chain(CHAIN)).held == CHAIN.held == {3: 0.0, 4: 0.1}
    moved = CHAIN.random_joints(30, rng)
    moved[:3, 4] += 0.05
    seen = measure(CHAIN, moved, rng)
    assert Problem(CHAIN, seen).free
    with pytest.raises(InputError, match=r'level_2 was at .*, but both its limits are 0'):
        Problem(replace(CHAIN, effects=()), seen)
    assert Problem(replace(CHAIN, effects=()), seen.select(np.arange(0))).free
    stuck = SCARA.replace('lower="-3.0" upper="3.0"', 'lower="0.0" upper="0.0"')
    with pytest.raises(ConfigError, match=r'limits of joint "wrist" are equal.*leave them out'):
        chain_from_urdf(stuck)
    assert len(chain_from_urdf(stuck, tip_link='lower').joints) == 3  # it is not in the way


def test_a_joint_that_never_moves_has_gauges(rng):
    arm = load_chain('kuka_iiwa14')
    third = replace(arm.joints[2], lower=0.3, upper=0.3)
    nominal = replace(arm, joints=(*arm.joints[:2], third, *arm.joints[3:]))
    _, true, seen = measured_arm(rng, 60, chain=nominal)
    result = identify(Problem(nominal, seen, **SIGMAS))
    assert result.accepted
    assert not result.not_excited
    assert result.region.whole
    fresh = nominal.random_joints(200, rng)
    assert rms(result.chain, true, fresh) < 0.05 * rms(result.before, true, fresh)
