# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from fits import UR10E, fitted, measured_arm, worst_prediction
from hypothesis import given, settings, strategies as st
from urdfs import UR10E_ORIGINS, ur10e

from calib_ros.apply.simulation import measure, random_frame
from calib_ros.errors import ConfigError, InputError, TooFewObservationsError, UnknownNameError
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Learned, Problem
from calib_ros.identification.identification import _weak, identify
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.settings import Loss


def random_arm(rng, joints):
    """Return a revolute arm with arbitrary lengths and twists, none nearly parallel."""
    rows = tuple(
        Joint(
            f'joint_{k + 1}',
            a=rng.uniform(-0.5, 0.5),
            alpha=rng.choice([-1, 1]) * rng.uniform(0.3, np.pi - 0.3),
            d=rng.uniform(-0.5, 0.5),
            theta=rng.uniform(-np.pi, np.pi),
            sign=int(rng.choice([-1, 1])),
        )
        for k in range(joints)
    )
    return Chain('random', str(rng.choice(['standard', 'modified'])), rows)


@pytest.mark.parametrize(
    ('joints', 'oriented', 'rank'), [(6, 1.0, 30), (7, 1.0, 34), (6, 0.0, 27), (6, 0.1, 30)]
)
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=4)
def test_what_is_free_of_noise_gives_exact_predictions(joints, oriented, rank, seed):
    """Of a share of the poses the orientation is known."""
    rng = np.random.default_rng(seed)
    nominal = random_arm(rng, joints)
    _, true, seen = measured_arm(rng, 80, (0.0, 0.0), nominal)
    problem, shares = Problem(nominal, replace(seen, oriented=np.arange(80) < 80 * oriented)), []
    result = identify(problem, progress=shares.append)
    assert sorted(shares) == shares
    assert 0.0 < shares[0] < shares[-1] < 1.0
    assert result.converged
    assert result.rank == rank
    position, turn = worst_prediction(result.chain, true, rng)
    assert position < 1e-9
    assert turn < 1e-9 or not oriented


@pytest.mark.parametrize('seed', range(3))
def test_axes_a_few_degrees_from_parallel(seed):
    """Errors of the usual size would change d by centimetres, as no arm does."""
    rng = np.random.default_rng(seed)
    tilted = [*UR10E_ORIGINS]
    tilted[2] = (tilted[2][0], (0.0, np.radians(6.0), 0.0))
    real = [
        (xyz + rng.normal(scale=5e-4, size=3), rpy + rng.normal(scale=1e-3, size=3))
        for xyz, rpy in tilted
    ]
    nominal = replace(chain_from_urdf(ur10e(tilted)), base=None, tool=None)
    true = replace(chain_from_urdf(ur10e(real)), base=random_frame(rng, 2.0))
    seen = measure(true, nominal.random_joints(60, rng), rng, 5e-5, 2e-4)
    result = identify(Problem(nominal, seen))
    assert result.accepted
    assert worst_prediction(result.chain, true, rng)[0] < 2e-4


@pytest.mark.parametrize('oriented', [1.0, 0.5, 0.0])
def test_known_frames_leave_the_first_and_last_link_identifiable(oriented):
    rng = np.random.default_rng(1)
    frames = {key: random_frame(rng, 0.5) for key in ('base', 'tool')}
    nominal = replace(UR10E, **{k: replace(frame, fixed=True) for k, frame in frames.items()})
    offsets = {'shoulder_pan_joint.theta': 2e-3, 'wrist_3_joint.a': 1e-3, 'elbow_joint.beta': 1e-3}
    true = nominal.with_offsets(offsets)
    seen = measure(true, UR10E.random_joints(60, rng), rng)
    result = identify(Problem(nominal, replace(seen, oriented=np.arange(60) < 60 * oriented)))
    assert {name for name in result.names if name.startswith(('base', 'tool'))} == set()
    for each in result.parameters:
        assert each.offset == pytest.approx(offsets.get(each.name, 0.0), abs=1e-9)
    np.testing.assert_array_equal(result.chain.base.matrix, frames['base'].matrix)


def test_standard_deviations_are_honest():
    """Deviations from the truth in units of the standard deviation given: spread 1, seeded."""
    scores = []
    for seed in range(40):
        _, true, seen = measured_arm(seed, 40, (5e-5, 5e-5 / 0.3))
        rows = [p for p in fitted(Problem(UR10E, seen)).parameters if p.std is not None]
        scores += [(p.value - true.value(p.name)) / p.std for p in rows]
    assert len(scores) == 40 * 30
    assert np.std(scores) == pytest.approx(1.0, abs=0.06)
    assert abs(np.mean(scores)) < 0.1
    assert np.mean(np.abs(scores) < 1.96) == pytest.approx(0.95, abs=0.015)


def test_too_few_pairs_say_how_many_are_needed():
    rng = np.random.default_rng(13)
    seen = measure(UR10E, UR10E.random_joints(4, rng), rng)
    with pytest.raises(TooFewObservationsError, match=r': 4 measured, at least 5'):
        identify(Problem(UR10E, seen))
    same = seen.select(np.zeros(50, dtype=int))
    with pytest.raises(TooFewObservationsError, match=r': 1 measured'):
        identify(Problem(UR10E, same))


def test_problems_that_make_no_sense_are_refused():
    *_, seen = measured_arm(1, 12)
    with pytest.raises(UnknownNameError, match=r'"hubert".*did you mean "huber"') as caught:
        Problem(UR10E, seen, loss='hubert')
    assert caught.value.alternatives == get_args(Loss)
    with pytest.raises(InputError, match='6 joints'):
        Problem(UR10E, Observations.from_arrays(np.zeros((5, 7)), np.zeros((5, 3))))


def bent(chain, rng, length=5e-4, angle=1e-3):
    """Return the arm as a function q -> poses, every link bent and shifted in all six directions.

    Unlike `faulty`, it asks nothing of the model: what it cannot express, no fit will find.
    """
    shifts = rng.normal(scale=length, size=(len(chain.joints) + 1, 3))
    turns = se3.exp_rotation(rng.normal(scale=angle, size=(len(chain.joints) + 1, 3)))
    errors = se3.transform(turns, shifts)
    frames = [random_frame(rng, 1.0).matrix for _ in range(2)]

    def poses(q):
        pose = np.broadcast_to(frames[0] @ errors[-1], (len(q), 4, 4))
        for k, joint in enumerate(chain.joints):
            link = Chain('link', chain.convention, (joint,)).forward(q[:, k : k + 1])
            pose = (
                pose @ link @ errors[k]
                if chain.convention == 'standard'
                else pose @ (errors[k] @ link)
            )
        return pose @ frames[1]

    return poses


def architectures():
    straight = {'a': 0.3, 'd': 0.1}
    yield (
        'SCARA',
        'standard',
        [
            Joint('j1', a=0.375),
            Joint('j2', a=0.275),
            Joint('j3', 'prismatic', lower=-0.3, upper=0.0),
            Joint('j4'),
        ],
    )
    for convention in ('standard', 'modified'):
        for name, kind, a in (
            ('turntable', 'revolute', 0.0),
            ('turntable 20 mm off', 'revolute', 0.02),
            ('telescope', 'prismatic', 0.0),
            ('telescope beside', 'prismatic', 0.3),
        ):
            yield (
                name,
                convention,
                [
                    Joint('j1', kind, a=a),
                    Joint('j2', kind, a=a, d=0.4),
                    Joint('j3', alpha=np.pi / 2, **straight),
                    Joint('j4', alpha=-np.pi / 2, **straight),
                    Joint('j5'),
                    Joint('j6'),
                    Joint('j7', alpha=np.pi / 2, **straight),
                ],
            )
    for convention, to_wrist in (('standard', 0.0), ('modified', np.pi / 2)):
        yield (
            'gantry',
            convention,
            [
                Joint('j1', 'prismatic', alpha=np.pi / 2),
                Joint('j2', 'prismatic', alpha=np.pi / 2, theta=np.pi / 2),
                Joint('j3', 'prismatic', alpha=to_wrist),
                Joint('j4', alpha=np.pi / 2, **straight),
                Joint('j5', alpha=-np.pi / 2, **straight),
                Joint('j6', **straight),
            ],
        )
        for tilt in (0.0, np.radians(1.0), np.radians(4.0)):
            yield (
                f'parallel but {tilt:.3f}',
                convention,
                [
                    Joint('j1', alpha=np.pi / 2, **straight),
                    Joint('j2', alpha=tilt, **straight),
                    Joint('j3', alpha=tilt, **straight),
                    Joint('j4', alpha=np.pi / 2, **straight),
                    Joint('j5', alpha=-np.pi / 2, **straight),
                    Joint('j6', alpha=tilt, **straight),
                ],
            )


@pytest.mark.parametrize(
    ('convention', 'joints'),
    [pytest.param(c, tuple(joints), id=f'{name}, {c}') for name, c, joints in architectures()],
)
def test_the_model_is_complete_for_every_architecture(convention, joints):
    rng = np.random.default_rng(16)
    nominal = Chain('arm', convention, joints)
    poses = bent(nominal, rng)
    q = nominal.random_joints(60, rng)
    true = poses(q)
    result = identify(
        Problem(nominal, Observations.from_arrays(q, true[:, :3, 3], true[:, :3, :3].copy()))
    )
    prismatic = sum(joint.type == 'prismatic' for joint in joints)
    assert result.rank == 4 * (len(joints) - prismatic) + 2 * prismatic + 6
    unseen = nominal.random_joints(100, rng)
    error = result.chain.forward(unseen)[:, :3, 3] - poses(unseen)[:, :3, 3]
    assert np.abs(error).max() < 1e-9
    lengths = [p.offset for p in result.parameters if p.name.kind in ('a', 'b', 'd')]
    assert np.abs(lengths).max() < 0.02  # nothing absurd


def test_a_single_linear_joint_has_no_parameter_beside_its_frames():
    rng = np.random.default_rng(3)
    rail = Chain('rail', 'standard', (Joint('rail', 'prismatic'),))
    result = identify(Problem(rail, measure(rail, rail.random_joints(30, rng), rng, 1e-5, 1e-4)))
    assert not any(name.of_dh for name in result.names)
    assert not result.accepted


@pytest.mark.parametrize(
    ('setting', 'value'),
    [
        ('sigma_position', '1e-4'),
        ('sigma_position', None),
        ('sigma_orientation', np.array([1e-4, 1e-4])),
        ('folds', 2.5),
        ('fixed', 'shoulder_pan_joint.a'),
        ('effects', 'gravity'),
        ('more', Observations.from_arrays(np.zeros((3, 6)), np.zeros((3, 3)))),  # is no list
        ('sigma_scale', -0.1),
        *(('priors', {'elbow_joint.a': sigma}) for sigma in (0.0, -1.0, np.nan, np.inf)),
    ],
)
def test_settings_of_another_type_or_out_of_range_are_refused(setting, value):
    *_, seen = measured_arm(1, 12)
    with pytest.raises(ConfigError, match=setting.removesuffix('s')):
        Problem(UR10E, seen, **{setting: value})


def test_velocities_of_an_arm_that_stands_are_none():
    """A log of the controller has a column of zeros at each stop: no delay is to be fitted."""
    _, _, seen = measured_arm(2, 40)
    still = replace(seen, velocity=np.zeros_like(seen.joints))
    plain, found = (identify(Problem(UR10E, each)) for each in (seen, still))
    assert found.accepted
    assert found.names == plain.names
    np.testing.assert_allclose(found.chain.table, plain.chain.table, rtol=0, atol=1e-12)


def test_parameters_of_which_priors_tell_more_than_poses_are_weak():
    """Those given by the user are no news."""
    problem = Problem(UR10E, measured_arm(0, 8)[2], priors={'wrist_2_joint.d': 1e-3})
    sizes = {'elbow_joint.a': 0.7e-3, 'wrist_2_joint.d': 0.9e-3, 'elbow_joint.alpha': 0.72e-3}
    rows = [SimpleNamespace(name=name, std=std) for name, std in sizes.items()]
    rows.append(SimpleNamespace(name='elbow_joint.beta', std=None))
    assert _weak(problem, rows) == ()
    learned = Learned({row.name: 1e-3 for row in rows}, 1.0)
    assert _weak(replace(problem, learned=learned), rows) == ('elbow_joint.alpha',)
