# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from commanded import missed
from fits import UR10E, arm, at_stations, rms

from calib_ros import Calibration, Compensator, Problem, compensate, identify, load_calibration
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.matrices import packed, parse_rows, unpacked_matrix
from calib_ros.decision.region import region_of_record
from calib_ros.decision.risk import region_of
from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.jacobian import ErrorModel, orientation_error
from calib_ros.report.documents import as_document
from calib_ros.report.words import summary

pytestmark = pytest.mark.usefixtures('unsearched')
HOME = np.array([0.3, -1.2, 1.4, -0.5, 0.9, 0.2])


def around(seed, reach, count=60):
    """Return joint values (count, 6) within `reach` [rad] of a posture."""
    return HOME + np.random.default_rng(seed + 50).uniform(-reach, reach, (count, 6))


def identified(true, q, seed=0):
    return identify(Problem(UR10E, measured(true, q, seed)))


def measured(true, q, seed=0):
    return measure(true, q, np.random.default_rng(seed + 7), 5e-5, 2e-4)


def with_a_still_joint(seed, reach):
    """Return joint values (60, 6) with the elbow within `reach` [rad] of HOME."""
    q = UR10E.random_joints(60, np.random.default_rng(seed))
    q[:, 2] = HOME[2] + np.random.default_rng(seed).uniform(-reach, reach, 60)
    return q


@pytest.fixture(scope='module')
def local():
    """Return an arm whose elbow stood still."""
    return identified(arm(0), with_a_still_joint(0, 3e-4))


@pytest.fixture
def folder(local, tmp_path):
    path = tmp_path / 'out'
    path.mkdir()
    (path / 'calibration.yaml').write_text(Calibration.of(local).dump())
    (path / 'result.json').write_text(json.dumps(as_document(local, {})))
    return path


def test_a_covariance_without_some_directions_survives_its_record(rng):
    root = 1e-4 * rng.normal(size=(6, 2))
    square = root @ root.T
    found = unpacked_matrix(packed(square), 6)
    np.testing.assert_allclose(found, square, atol=1e-7 * square.max())


@pytest.mark.parametrize(
    ('rows', 'triangular', 'wanted'),
    [
        (['1', '2 3'], True, [[1, 0], [2, 3]]),
        (['1 2 3', '4 5 6'], False, [[1, 2, 3], [4, 5, 6]]),
        (['', ''], False, [[], []]),
        (['1', '2 3'], False, None),
        (['1', '2'], True, None),
        (['1 2', '3'], False, None),
        (['1', '2 3', '4 5 6'], True, None),
        (['1', '2 nan'], True, None),
        (['1'], False, None),
    ],
)
def test_rows_are_of_one_length_or_up_to_the_diagonal(rows, triangular, wanted):
    if wanted is None:
        with pytest.raises(ValueError, match='rows of finite numbers for 2 names'):
            parse_rows(rows, 2, triangular)
    else:
        np.testing.assert_array_equal(parse_rows(rows, 2, triangular), wanted)


@pytest.mark.parametrize('seed', range(2))
def test_an_arm_measured_everywhere_may_be_used_everywhere(seed):
    q = UR10E.random_joints(60, np.random.default_rng(seed))
    found = identified(arm(seed), q, seed)
    assert found.accepted
    assert found.region.whole
    assert found.region.covers(UR10E.random_joints(50, np.random.default_rng(1))).all()
    q = UR10E.random_joints(7, np.random.default_rng(1))
    for wrong in (q[0], q[:, :5], q.T):  # one answer a row, or none
        with pytest.raises(InputError, match=r'must have the shape \(N, 6\)'):
            found.region.covers(wrong)
        with pytest.raises(InputError, match=r'must have the shape \(N, 6\)'):
            found.pose_covariance(wrong)
    for level in (0.0, 1.0, 95):
        with pytest.raises(ConfigError, match='level must be between 0 and 1'):
            found.confidence_ellipsoid(q, level)
    assert 'valid over the whole joint range' in summary(found)
    for share, text in ((0.0, 'under 1'), (0.4, '40'), (0.999, '99')):
        part = replace(found.region, limit=1e-3, share=share).in_words()
        assert f'in {text} % of the joint range; elsewhere it may make the arm worse' in part
    assert as_document(found, {})['region'] == {'whole': True, 'share': 1.0, 'limit_mm': None}


def test_a_rail_without_limits_is_not_known_to_its_end(rng):
    """It may be 10 m long; with limits all of the range is valid."""
    rail = load_chain('ur10e_on_linear_axis')
    endless = replace(rail, joints=(replace(rail.joints[0], upper=None), *rail.joints[1:]))
    q = np.column_stack([rng.uniform(0.1, 0.7, 60), around(0, 1.0)])
    seen = measure(faulty(rail, Cell(), rng), q, rng, 5e-5, 2e-4)
    found = identify(Problem(endless, seen))
    assert found.accepted
    assert 'no limits for linear_axis_joint' in summary(found)
    q = np.repeat(q, 2, axis=0)
    q[1::2, 0] = 10.0
    assert found.region.covers(q).tolist() == [True, False] * 60
    assert identify(Problem(rail, seen)).region.whole


@pytest.mark.parametrize(('seed', 'way'), [(0, 'fixed'), (1, 'priors'), (2, 'fixed')])
def test_what_is_held_nominal_is_not_known(seed, way):
    true, q = arm(seed), with_a_still_joint(seed, 0.0)
    seen = measure(true, q, np.random.default_rng(seed + 7), 5e-5, 2e-4)
    still = identify(Problem(UR10E, seen)).not_excited
    assert still
    held = {'fixed': still} if way == 'fixed' else {'priors': dict.fromkeys(still, 1e-3)}
    found = identify(Problem(UR10E, seen, **held))
    assert found.accepted
    assert not found.region.whole
    everywhere = UR10E.random_joints(500, np.random.default_rng(1))
    near = everywhere[found.region.covers(everywhere)]
    assert rms(found.chain, true, near) < rms(found.before, true, near)
    left = found.chain.forward(near)[:, :3, 3] - true.forward(near)[:, :3, 3]
    assert np.mean((left**2).sum(axis=1) / Calibration.of(found).sigma(near) ** 2) < 2.0


@pytest.mark.parametrize(
    ('reach', 'errors'), [(3e-4, 0.1), (3e-4, 10.0), (1e-3, 1.0), (1e-2, 0.1), (1e-2, 10.0)]
)
def test_a_joint_that_hardly_moved_is_no_worse_where_it_may_be_used(reach, errors):
    seed = int(errors == 1.0)
    true = arm(seed, errors)
    q = with_a_still_joint(seed, reach)
    found = identified(true, q, seed)
    assert found.accepted
    assert found.region.covers(q).all()
    other = UR10E.random_joints(1000, np.random.default_rng(3))
    used = other[found.region.covers(other)]
    assert len(used)
    assert rms(found.chain, true, used) < rms(found.before, true, used)


@pytest.mark.parametrize('seed', [2, 4, 5])
def test_a_coupling_that_hardly_shows_near_a_posture_is_not_fitted_for_elsewhere(seed):
    """The joint values are those of motors: the sixth lacks a hundredth of the fifth's turn."""
    name = 'wrist_3_joint.coupling_wrist_2_joint'
    true = arm(seed, 0.1).with_effects([name]).with_offsets({name: -1e-2})
    rng = np.random.default_rng(seed)
    posture = rng.uniform(-1.5, 1.5, 6)
    found = identified(true, posture + rng.uniform(-0.4, 0.4, (60, 6)))
    assert found.accepted
    rng = np.random.default_rng(3)
    other = [rng.uniform(-2.5, 2.5, (2000, 6)), posture + rng.uniform(-0.8, 0.8, (500, 6))]
    used, near = (each[found.region.covers(each)] for each in other)
    assert len(near) > 200
    used = np.concatenate([used, near])
    assert rms(found.chain, true, used) < rms(found.before, true, used)


@pytest.mark.parametrize(('near', 'inside'), [(0.3, 0.0), (0.0, 0.3)])
def test_the_risk_is_the_larger_of_poses_and_those_known_as_well(local, near, inside, monkeypatch):
    """That by the scale of the device counts as far as a scale is likely, in log odds."""
    sets, sizes = [measured(arm(0), UR10E.random_joints(60, np.random.default_rng(0)))], []
    posterior = replace(local.posterior, rival=None)
    rival = 0.5, np.full_like(posterior.offsets, 7.0), posterior.covariance
    harmful = [False]

    def risk(judge, which, around, doubts):
        sizes.append(np.trace(which))
        found = near if sizes[-1] == sizes[0] else inside
        return found if harmful[0] or (doubts[1] == 7.0).all() else 0.0

    monkeypatch.setattr('calib_ros.decision.risk._Judge.risk', risk)
    assert region_of(posterior, sets, np.inf, np.inf).by_scale == 0.0
    found = region_of(replace(posterior, rival=rival), sets, np.inf, np.inf)
    assert found.by_scale == pytest.approx(0.3 / (1.0 + np.exp(-0.5)))
    harmful[0] = True
    assert region_of(posterior, sets, np.inf, np.inf) is None


@pytest.mark.parametrize(('largest', 'covered'), [(0.01, False), (np.inf, True)])
def test_no_pose_is_covered_with_an_expected_error_that_no_result_may_have(largest, covered):
    """Play at two stations looked like errors of 50 mm, and metres were expected elsewhere."""
    rng = np.random.default_rng(26)
    q, play = at_stations(rng, 2)[:40], 3e-4 * rng.uniform(0.0, 1.0, 6)
    turned = q + play * np.sign(np.diff(q, axis=0, prepend=q[:1] - rng.normal(size=(1, 6))))
    seen = replace(measure(UR10E, turned, rng, 2e-5, oriented=False), joints=q)
    found = identify(Problem(UR10E, seen, sigma_position=2e-5))
    region = region_of(found.posterior, [seen], found.uncertainty.overall, largest)
    assert region.covers(q).all()
    anywhere = UR10E.random_joints(500, rng)
    assert (region.known(anywhere[region.covers(anywhere)]) > 0.01).any() is np.bool_(covered)


def test_what_a_still_joint_leaves_open_is_not_covered(local):
    region, q = local.region, with_a_still_joint(0, 3e-4)
    assert not region.whole
    away = q - np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0])
    assert region.covers(q).all()
    assert region.covers(away).mean() < 0.5
    assert np.median(region.known(away)) > 2.0 * np.median(region.known(q))
    other = region.covers(UR10E.random_joints(2000, np.random.default_rng(4)))
    assert region.share == pytest.approx(other.mean(), abs=0.1)


@pytest.mark.parametrize(('seed', 'group'), [(0, 'eccentricity'), (1, 'gravity')])
def test_the_other_half_of_the_workspace_is_within_the_ellipsoids(group, seed):
    """Measured on one side of an arm that has what the model lacks."""
    names = effects.members(UR10E, group)
    rng = np.random.default_rng(seed)
    size = {'eccentricity': 2e-4, 'gravity': 3e-4}[group]
    values = rng.normal(scale=size, size=len(names)).tolist()
    true = arm(seed).with_effects(names).with_effect_values(dict(zip(names, values, strict=True)))
    q = UR10E.random_joints(500, rng)
    left = (se3.invert(true.base.matrix) @ true.forward(q))[:, 0, 3] < 0.0
    found = identified(true, q[left][:60], seed)
    other = q[~left]
    axes = found.confidence_ellipsoid(other)
    error = (found.chain.forward(other) - true.forward(other))[:, :3, 3]
    squares = (axes**2).sum(axis=2)
    inside = ((np.einsum('nij,nj->ni', axes, error) / squares) ** 2).sum(axis=1) <= 1.0
    assert (inside | ~found.region.covers(other)).mean() >= 0.9
    assert rms(found.chain, true, other) < rms(found.before, true, other)
    turned = orientation_error(*(each.trace(q.T)[0] for each in (found.chain, true)))
    known = Calibration.of(found).sigma(q, np.s_[3:])
    assert np.sqrt(np.mean(np.sum(turned**2, axis=0)) / np.mean(known**2)) < 1.25


def off_by(kind, true, q, rng):
    """Return pose errors (N, 6) by some waves a turn of the joints, about or across their axes."""
    owner = 'theta' if kind == 'teeth' else kind
    model = ErrorModel(true, [f'{name}.{owner}' for name in true.joint_names])
    sizes, order = 3e-4 * rng.uniform(0.3, 1.0, 6), {'teeth': 50, 'alpha': 2, 'theta': 1}[kind]
    waves = sizes * np.sin(order * q + rng.uniform(0.0, 6.28, 6))
    return np.einsum('nij,nj->ni', model.jacobian(q), waves)


def moved_by(off, seen):
    """Return observations with pose errors (N, 6)."""
    turned = se3.exp_rotation(off[:, 3:]) @ seen.rotations
    return replace(seen, positions=seen.positions + off[:, :3], rotations=turned)


@pytest.mark.parametrize('kind', ['teeth', 'alpha'])
def test_positions_are_within_the_ellipsoids_whatever_turns_or_tilts_the_joints(kind):
    """By 50 waves a turn, or twice a turn across the axis; the device's sigmas are not known."""
    inside = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        true, q = arm(seed), UR10E.random_joints(160, rng)
        off = off_by(kind, true, q, rng)
        seen = moved_by(off, measure(true, q, rng, 5e-5, 2e-4))
        found = identify(Problem(UR10E, seen.select(np.arange(60))))
        lacking = found.posterior.unmodelled
        assert (lacking.turns > max(lacking.tilts, lacking.waves)) == (kind == 'teeth')
        error = found.chain.forward(q)[60:, :3, 3] - true.forward(q)[60:, :3, 3] - off[60:, :3]
        axes = found.confidence_ellipsoid(q[60:])
        along = np.einsum('nij,nj->ni', axes, error) / (axes**2).sum(axis=2)
        inside.append((along**2).sum(axis=1) <= 1.0)
        stated = np.trace(found.pose_covariance(q)[:, :3, :3], axis1=1, axis2=2)
        np.testing.assert_allclose(Calibration.of(found).sigma(q) ** 2, stated)
    assert np.mean(inside) > 0.9


@pytest.mark.parametrize('kind', ['teeth', 'alpha', 'theta'])
def test_parameters_are_within_their_limits_whatever_turns_or_tilts_the_joints(kind):
    """Also by what moves all parameters alike, however many poses are measured."""
    inside = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        true, q = arm(seed), rng.uniform(-2.0, 2.0, (200, 6))
        seen = moved_by(off_by(kind, true, q, rng), measure(true, q, rng, 5e-5, 2e-4))
        found = identify(Problem(UR10E, seen, held_out=seen.select(np.arange(2))))
        inside += [
            abs(p.offset - true.offset(p.name, UR10E)) < p.half_width()
            for p in found.parameters
            if p.std is not None and p.name.of_dh
        ]
    assert np.mean(inside) > 0.9


def test_expected_errors_hold_where_a_joint_that_hardly_moved_is_used():
    """The ellipsoids hold 95 % of the positions, also where the prior alone tells the errors."""
    held, ratios = [], []
    for seed in range(9):
        rng = np.random.default_rng(seed)
        q = UR10E.random_joints(20, rng)
        q[:, 1 + seed % 4] = HOME[1 + seed % 4] + rng.uniform(-3e-3, 3e-3, len(q))
        true = arm(seed)
        found = identified(true, q, seed)
        other = UR10E.random_joints(300, rng)
        used = other[found.region.covers(other)]
        if not len(used):
            continue
        error = (found.chain.forward(used) - true.forward(used))[:, :3, 3]
        axes = found.confidence_ellipsoid(used)
        along = np.einsum('nij,nj->ni', axes, error) / (axes**2).sum(axis=2)
        held.append(((along**2).sum(axis=1) <= 1.0).mean())
        ratios.append(
            (error**2).sum(axis=1).mean() / (Calibration.of(found).sigma(used) ** 2).mean()
        )
    assert len(held) > 6
    assert np.mean(held) > 0.9
    assert np.mean(ratios) < 1.25


@pytest.mark.parametrize('seed', range(2))
def test_a_device_out_of_scale_does_not_spoil_an_arm_of_small_errors(seed):
    """A scale of 0.8 per mille is the device's, not eight lengths all too long by chance."""
    rng = np.random.default_rng(seed)
    seen = measure(arm(seed, 0.1), UR10E.random_joints(40, rng), rng, 5e-5, 2e-4)
    found = identify(Problem(UR10E, replace(seen, positions=seen.positions * (1.0 + 8e-4))))
    assert 'as if the measuring device were out of scale' in found.refusals[0]
    assert found.posterior.sizes['scale'] == pytest.approx(8e-4, rel=0.3)
    assert identify(Problem(UR10E, seen)).accepted


@pytest.mark.parametrize(
    'change',
    [
        {'limit': 'wide'},
        {'limit': -1.0},
        {'limit': [1.0]},
        {'share': 2.0},
        {'share': None},
        {'names': ['no_joint.a']},
        {'names': None},
        {'root': ['1.0']},
        {'root': []},
        {'root': 3},
        {'root': [[1.0]]},
        {'base': 'nowhere'},
    ],
)
def test_a_damaged_region_is_refused(local, change):
    used = local.region.document() | {'share': 0.0}
    assert region_of_record({'region': used}, local.chain, 'here').share == 0.0
    older = {key: value for key, value in used.items() if key != 'device'}
    assert not region_of_record({'region': older}, local.chain, 'here').device.size
    with pytest.raises((ConfigError, UnknownNameError), match=r'here: calibration\.region'):
        region_of_record({'region': used | change}, local.chain, 'here')


@pytest.mark.parametrize('what', ['yes', 3, ['limit'], {}, {'limit': None}])
def test_what_is_no_region_is_refused(what):
    with pytest.raises(ConfigError, match=r'calibration\.region is damaged \((Key|Type)Error\):'):
        region_of_record({'region': what}, UR10E, 'here')


def test_a_calibration_without_a_region_is_still_read(folder):
    path = folder / 'calibration.yaml'
    document = yaml.safe_load(path.read_text())
    for key in ('region', 'software', 'created'):  # by hand: calib_ros always writes them
        del document['calibration'][key]
    path.write_text(yaml.safe_dump(document))
    assert load_calibration(path, UR10E).region is None


def test_programs_are_corrected_inside_the_region_only(local, folder):
    inside = around(2, 0.1, 15)
    other = UR10E.random_joints(50, np.random.default_rng(0))
    outside = other[~local.region.covers(other)][:5]
    assert local.region.covers(inside).all()
    true, refused = Compensator(UR10E, arm(0)), []
    for calibration in (local, load_calibration(folder, UR10E)):
        compensator = Compensator(UR10E, calibration.chain, region=calibration.region)
        result = compensate(compensator, inside)
        assert not result.refusals
        after, before = (missed(true, inside, q)[0] for q in (result.joints, inside))
        assert np.sqrt((after**2).mean()) < 0.2 * np.sqrt((before**2).mean())
        result = compensate(compensator, np.concatenate([inside, outside]))
        refused.append([each.sample for each in result.refusals if 'not valid' in each.reason])
        first = min(each.reason for each in result.refusals if 'not valid' in each.reason)
        assert 'not valid in 25 % of the program' in first
        said = f'exceeds the limit of {1e3 * local.region.limit:.3f} mm; identify again'
        assert first.endswith(f'{said} with poses near it')
    assert refused == [list(range(15, 20))] * 2
