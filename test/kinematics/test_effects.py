# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from commanded import twist
from fits import NOISE, SCARA, SIGMAS, UR10E, arm, measured_arm

from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.chain_file import dump_chain, load_chain, parse_chain
from calib_ros.kinematics.jacobian import ErrorModel

GEARED = replace(
    UR10E,
    joints=tuple(
        replace(joint, gear_ratio=17.0) if joint.name == 'shoulder_lift_joint' else joint
        for joint in UR10E.joints
    ),
)


def loaded(chain, rng):
    """Return the chain with links of about 5 kg, their centres off the axes."""
    return replace(
        chain,
        joints=tuple(
            replace(
                joint,
                gear_ratio=17.0,
                mass=rng.uniform(3.0, 7.0),
                com=tuple(rng.normal(scale=0.1, size=3).tolist()),
            )
            for joint in chain.joints
        ),
    )


def gantry(rng):
    """Return an arm of two prismatic and four revolute joints."""
    kinds = ['prismatic', 'prismatic', *['revolute'] * 4]
    joints = tuple(
        Joint(f'joint_{k}', kind, a=0.2, alpha=rng.uniform(0.5, 2.0), d=0.2, theta=rng.normal())
        for k, kind in enumerate(kinds)
    )
    return Chain('gantry', 'modified', joints)


def chains():
    rng = np.random.default_rng(0)
    for chain in (load_chain('ur10e'), load_chain('franka_fr3'), gantry(rng)):
        yield chain.name, loaded(chain, rng)
        joints = tuple(replace(joint, sign=-joint.sign) for joint in chain.joints)
        yield f'{chain.name}, turned round', loaded(replace(chain, joints=joints), rng)


@pytest.mark.parametrize('chain', [pytest.param(chain, id=name) for name, chain in chains()])
def test_every_column_is_the_central_difference(chain, rng):
    names = [name for group in effects.GROUPS for name in effects.members(chain, group)]
    last = chain.joints[-1].name
    names += [f'{last}.sin_7', f'{last}.cos_7']
    values = dict(zip(names, rng.normal(scale=1e-3, size=len(names)), strict=True))
    chain = replace(chain, base=random_frame(rng, 1.0), tool=random_frame(rng, 0.3))
    chain = chain.with_effect_values(values)
    q = chain.random_joints(5, rng)
    approach = rng.choice([-1.0, 0.0, 1.0], q.shape)
    jacobian = ErrorModel(chain, names).jacobian(q, approach)
    for k, name in enumerate(names):
        # phi of compliance are N m, up to some 100; values change by 1e-5 rad, as all others do
        step = 1e-6 if name.endswith('compliance') else 1e-5
        ahead, behind = (
            chain.with_offsets({name: size}).forward(q, approach) for size in (step, -step)
        )
        difference = twist(behind, ahead) / (2.0 * step)
        size = max(1.0, np.abs(difference).max())
        np.testing.assert_allclose(jacobian[:, :, k] / size, difference / size, atol=1e-7)


@pytest.mark.parametrize('sign', [1, -1])
@pytest.mark.parametrize('robot', ['ur10e', 'franka_fr3'])
def test_torques_are_the_work_of_gravity(robot, sign, rng):
    """Hold torques against the change of potential energy with the joint value reported."""
    chain = load_chain(robot)
    chain = loaded(
        replace(chain, joints=tuple(replace(joint, sign=sign) for joint in chain.joints)), rng
    )
    chain = replace(chain, base=random_frame(rng, 1.0), gravity=(1.0, 2.0, -9.0))
    q = chain.random_joints(7, rng)
    down = chain.base.matrix[:3, :3] @ chain.gravity
    count = len(chain.joints)

    def ends(q):
        """Return the poses (n, N, 4, 4) of the ends of all links."""
        base = chain.base
        return np.stack(
            [
                Chain('part', chain.convention, chain.joints[: k + 1], base=base).forward(
                    q[:, : k + 1]
                )
                for k in range(count)
            ]
        )

    def work(q):
        """Return the work (N,) of gravity on the masses, and (n, N) on unit weights."""
        poses = ends(q)
        masses = 0.0
        for joint, pose in zip(chain.joints, poses, strict=True):
            masses = masses + joint.mass * (pose[:, :3, :3] @ joint.com + pose[:, :3, 3]) @ down
        return masses, poses[:, :, :3, 3] @ down / np.linalg.norm(down)

    for i, joint in enumerate(chain.joints):
        move = np.zeros(count)
        move[i] = 1e-5
        ahead, behind = work(q + move), work(q - move)
        names = [f'{joint.name}.compliance']
        names += [f'{joint.name}.gravity_{other}' for other in chain.joint_names[i:]]
        phi = effects.basis(chain, names, q.T, None)
        np.testing.assert_allclose(phi[0], (ahead[0] - behind[0]) / 2e-5, atol=1e-5)
        np.testing.assert_allclose(phi[1:], (ahead[1] - behind[1])[i:] / 2e-5, atol=1e-8)


def test_nothing_bends_without_gravity(rng):
    chain = replace(loaded(UR10E, rng), gravity=(0.0, 0.0, 0.0))
    names = [*effects.members(chain, 'gravity'), *effects.members(chain, 'compliance')]
    assert not effects.basis(chain, names, chain.random_joints(4, rng).T, None).any()


def test_effects_may_be_a_third_of_an_arc_minute_or_one_of_what_bends():
    minute = np.radians(1.0 / 60.0)
    for group in effects.GROUPS:
        sizes = {effects.expected(name) for name in effects.members(GEARED, group)}
        bends = group in ('gravity', 'compliance', 'backlash')
        assert len(sizes) == 1
        assert sizes.pop() == pytest.approx(minute if bends else minute / 3.0, rel=0.05)


def test_linear_joints_have_play_as_well():
    chain = load_chain('ur10e_on_linear_axis')
    names = effects.members(chain, 'backlash')
    assert [name.owner for name in names] == list(chain.joint_names)
    assert [name.unit for name in names] == ['m', *['rad'] * 6]
    for name in ('linear_axis_joint.backlash', 'elbow_joint.play'):
        with pytest.raises(UnknownNameError, match='did you mean'):
            chain.with_effect_values({name: 1e-4})
    q, approach = np.zeros((2, 7)), np.array([[1.0] * 7, [-1.0] * 7])
    moved = chain.with_effect_values({names[0]: 3e-4}).forward(q, approach)[:, :3, 3]
    assert np.linalg.norm(moved[0] - moved[1]) == pytest.approx(6e-4)


def test_couplings_are_those_of_the_last_three_joints():
    found = effects.members(load_chain('kuka_iiwa14'), 'coupling')
    pairs = [('joint_6', 'joint_5'), ('joint_7', 'joint_5'), ('joint_7', 'joint_6')]
    assert found == tuple(f'{joint}.coupling_{other}' for joint, other in pairs)


def test_the_quill_of_a_scara_is_coupled_to_the_turn_after_it():
    """Its ball screw lifts it by 20 mm a turn: 5 mm became 3 mm by its other parameters."""
    screw = f'{SCARA.joint_names[2]}.coupling_{SCARA.joint_names[3]}'
    assert effects.members(SCARA, 'coupling')[-1] == screw
    rng = np.random.default_rng(0)
    true = arm(0, chain=SCARA).with_effect_values({screw: 0.02 / (2.0 * np.pi)})
    seen = measure(true, SCARA.random_joints(60, rng), rng, *NOISE)
    result = identify_model(Problem(SCARA, seen, **SIGMAS), 'auto')
    assert result.accepted
    assert result.chain.value(screw) == pytest.approx(0.02 / (2.0 * np.pi), rel=0.01)


def by_hand(true, values, q, approach):
    """Return poses (N, 4, 4) with effects that are written out here, torques excepted."""
    moved = q.copy()
    names = list(true.joint_names)
    for name, value in values.items():
        joint, _, kind = name.partition('.')
        first, _, rest = kind.partition('_')
        i = names.index(joint)
        moved[:, i] += (
            value
            * {
                'ratio': lambda i=i: q[:, i],
                'coupling': lambda rest=rest: q[:, names.index(rest)],
                'sin': lambda i=i, rest=rest: np.sin(int(rest) * q[:, i]),
                'cos': lambda i=i, rest=rest: np.cos(int(rest) * q[:, i]),
                'backlash': lambda i=i: approach[:, i],
                'gravity': lambda name=name: effects.basis(true, [name], q.T, None)[0],
                'compliance': lambda name=name: effects.basis(true, [name], q.T, None)[0],
            }[first]()
        )
    return true.forward(moved)


@pytest.mark.parametrize('group', effects.GROUPS)
def test_effects_turn_the_joints_as_is_written(group, rng):
    true = faulty(loaded(UR10E, rng), Cell(), rng)
    names = effects.members(true, group)
    values = dict(zip(names, rng.normal(scale=1e-4, size=len(names)).tolist(), strict=True))
    q = true.random_joints(50, rng)
    came = rng.choice([-1.0, 0.0, 1.0], q.shape)
    found = true.with_effect_values(values).forward(q, came)
    np.testing.assert_allclose(found, by_hand(true, values, q, came), rtol=0, atol=1e-12)
    assert np.abs(found - true.forward(q)).max() > 1e-5


@pytest.mark.parametrize('ratio', [17.0, 50.5, 101.25])
def test_gear_ratios_need_not_be_whole(ratio, rng):
    joints = list(UR10E.joints)
    joints[1] = replace(joints[1], gear_ratio=ratio)
    nominal = replace(UR10E, joints=tuple(joints))
    true = faulty(nominal, Cell(), rng)

    def moved(q):
        found = q.copy()
        found[:, 1] += 3e-4 * np.sin(ratio * q[:, 1]) - 2e-4 * np.cos(2.0 * ratio * q[:, 1])
        return found

    q, unseen = nominal.random_joints(100, rng), nominal.random_joints(300, rng)
    seen = replace(measure(true, moved(q), rng, *NOISE), joints=q)
    result = identify(Problem(nominal, seen, effects=('gear',)))
    error = (result.chain.forward(unseen) - true.forward(moved(unseen)))[:, :3, 3]
    assert len(result.chain.effects) == 4
    assert np.sqrt((error**2).sum(axis=1).mean()) < 6e-5  # 0.3 mrad are 0.3 mm at 1 m


@pytest.mark.parametrize(
    ('group', 'lacking'),
    [
        ('backlash', 'backlash needs the signs of the last moves'),
        ('elbow_joint.backlash', 'backlash needs the signs of the last moves'),
        ('gear', r'nothing to fit in "gear" \(gear needs the gear_ratio of joints'),
        ('compliance', 'compliance needs the masses of the links'),
        ('elbow_joint.compliance', 'compliance needs the masses of the links'),
    ],
)
def test_a_group_without_what_it_goes_by_is_refused(group, lacking):
    *_, seen = measured_arm(0, 20)
    with pytest.raises(ConfigError, match=lacking):
        Problem(UR10E, seen, effects=(group,))
    if 'backlash' in group:  # one session tells it
        signed = replace(seen, approach=np.ones_like(seen.joints))
        assert Problem(UR10E, seen, more=(signed,), effects=(group,)).model.effects


@pytest.mark.parametrize(
    ('name', 'alternative'),
    [
        ('ratios', 'ratio'),
        ('excentricity', 'eccentricity'),
        ('elbow_joint.ratios', 'ratio'),
        ('elbow_joint.ratio_2', 'ratio'),
        ('elbow_jont.ratio', 'elbow_joint'),
        ('elbow_joint.coupling_wrist', 'wrist_1_joint'),
        ('elbow_joint.gravity_hand', 'wrist_3_joint'),
        ('elbow_joint.sin_x', '1'),
        ('elbow_joint.sin_nan', '1'),
        ('elbow_joint.cos_inf', '1'),
    ],
)
def test_unknown_effects_are_named_with_the_alternatives(name, alternative):
    *_, seen = measured_arm(0, 20)
    with pytest.raises(UnknownNameError) as caught:
        Problem(UR10E, seen, effects=(name,))
    assert caught.value.name not in caught.value.alternatives
    assert alternative in str(caught.value).partition('valid:')[2]


@pytest.mark.parametrize('model', ['geometric', 'auto'])
def test_no_effects_join_a_model_that_stands_alone(model):
    with pytest.raises(ConfigError, match=f'model {model} stands alone') as caught:
        effects.resolve(UR10E, model)
    assert not isinstance(caught.value, UnknownNameError)


def rich(rng):
    """Return a chain with everything that a chain file can hold."""
    chain = faulty(loaded(UR10E, rng), Cell(), rng)
    chain = replace(chain, gravity=(0.5, -9.5, 1.0))
    chain = chain.with_frame('base_B', random_frame(rng, 1.0))
    chain = chain.with_frame('tool_2', replace(random_frame(rng, 0.2), fixed=True))
    names = [name for group in effects.GROUPS for name in effects.members(chain, group)]
    return chain.with_effect_values(
        dict(zip(names, rng.normal(scale=1e-4, size=len(names)), strict=True))
    )


@pytest.mark.parametrize('known', [True, False])
def test_a_chain_file_keeps_effects_frames_masses_and_gravity(known, rng):
    """Also those of a nominal chain that hangs from a wall, of which no effect is known yet."""
    chain = rich(rng)
    if not known:
        chain = replace(chain, effects=())
    again = parse_chain(dump_chain(chain))
    assert dict(again.effects) == dict(chain.effects)
    assert again.frame('tool_2').fixed
    assert not again.frame('base_B').fixed
    if not known:
        values = dict.fromkeys(effects.members(chain, 'compliance'), 5e-6)
        chain, again = (each.with_effect_values(values) for each in (chain, again))
    q = chain.random_joints(50, rng)
    approach = rng.choice([-1.0, 1.0], q.shape)
    for base in ('base', 'base_B'):
        for tool in ('tool', 'tool_2'):
            np.testing.assert_allclose(
                again.forward(q, approach, base, tool),
                chain.forward(q, approach, base, tool),
                rtol=0,
                atol=1e-12,
            )


@pytest.mark.parametrize(
    'orders', [range(1, 41), (7, 40), (2.5, 1.0, 3.0), (1.5, 2.5), (0, -1, 1)]
)
def test_waves_are_sines_and_cosines_however_many(rng, orders):
    joint = UR10E.joint_names[1]
    names = [name for order in orders for name in effects.waves(joint, order)]
    q = UR10E.random_joints(20, rng)
    found = effects.basis(UR10E, names, q.T, None)
    for order, (sin, cos) in zip(orders, found.reshape(-1, 2, len(q)), strict=True):
        np.testing.assert_allclose(sin, np.sin(order * q[:, 1]), rtol=0, atol=1e-13)
        np.testing.assert_allclose(cos, np.cos(order * q[:, 1]), rtol=0, atol=1e-13)


def test_held_joints_follow_their_couplings_one_after_another():
    joints = (Joint('a'), Joint('c', lower=0.3, upper=0.3), Joint('b', lower=0.1, upper=0.1))
    arm = Chain('arm', 'standard', joints)
    led = arm.with_effect_values({'b.coupling_a': 0.5, 'c.coupling_b': 2.0})
    values = np.array([[1.0, -2.0], [7.0, 7.0], [7.0, 7.0]])
    given = values.copy()
    b = 0.1 + 0.5 * values[0]
    np.testing.assert_allclose(effects.couple_held(led, values), [values[0], 0.3 + 2.0 * b, b])
    rates = [values[0], values[0], 0.5 * values[0]]
    np.testing.assert_allclose(effects.couple_held(led, values, rates=True), rates)
    still = [values[0], [0.3, 0.3], [0.1, 0.1]]
    np.testing.assert_allclose(effects.couple_held(led, values, couplings=False), still)
    np.testing.assert_allclose(effects.couple_held(arm, values), still)
    free = Chain('arm', 'standard', (Joint('a'), Joint('b')))
    np.testing.assert_array_equal(effects.couple_held(free, values[:2]), values[:2])
    np.testing.assert_array_equal(values, given)
