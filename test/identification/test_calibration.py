# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A calibration in its file: all that was known is known again."""

import re
from copy import deepcopy
from dataclasses import replace

import in_sockets
import numpy as np
import pytest
import yaml
from fits import UR10E as UR, measured_arm

from calib_ros.apply.simulation import measure
from calib_ros.decision.matrices import unpacked_matrix
from calib_ros.decision.misfits import Outlier
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.levels import ALIKE
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration, load_calibration, parse_calibration
from calib_ros.identification.identification import identify
from calib_ros.identification.records import nominal_document
from calib_ros.kinematics.chain import Chain, Frame, Joint
from calib_ros.kinematics.chain_file import dump_chain, load_chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.report.words import notes
from calib_ros.settings import Settings
from calib_ros.texts import dump_yaml

OWNED = {'session': '', 'eye_in_hand': False, 'socket': False, 'label': ''}


@pytest.fixture(scope='module')
def found():
    *_, seen = measured_arm(0, 40, (1e-4, 3e-4))
    owners = {'base': ('', False, False, 'tracker'), 'tool': ('', False, False, 'ball')}
    result = identify(Problem(UR, seen, effects=('gravity',), world_frame='tracker'))
    return Calibration.of(result, {'robot_serial': '7'}, owners)


def test_a_device_of_the_name_of_anothers_frame_has_a_frame_of_its_own():
    owners = {'base': ('', False, False, 'tracker'), 'tool': ('', False, False, '')}
    arm = Calibration(UR, UR, owners=owners)
    new = {'base_2': owners['base'], 'base': ('', False, False, 'camera')}
    assert arm.frames_of(new) == {'base_2': 'base', 'base': 'base (camera)'}
    seen = Observations.from_arrays(np.zeros((1, 6)), np.zeros((1, 3)))
    told = re.escape('the frames base (tracker), tool, not base (camera): name devices')
    with pytest.raises(InputError, match=told):
        arm.require_frames([seen.changed(base='base (camera)')])


def test_in_sockets_it_holds_up_to_its_former_error():
    """A joint off by 0.2 mm and 0.2 mrad was within a limit of 50 times that error."""
    _, problem = in_sockets.cell(0, noise=1e-5, count=10)
    result = identify(problem)
    assert notes(result)[0].startswith('errors in sockets leave out the scale of the bar: ')
    found = Calibration.of(result)
    assert found.limit(problem.sets, 2.0) == found.limit() == ALIKE * found.residual


def test_joints_keep_the_limits_of_the_file_and_of_the_nominal_chain(found):
    """A task was placed beyond the limits of --chain, since only those of the file were kept."""
    free, held, other = UR.joints[0].lower, -1.0, {'lower': -1.0, 'upper': None}
    joints = (UR.joints[0], *(replace(joint, **other) for joint in UR.joints[1:]))
    again = parse_calibration(found.dump(), 'file', replace(UR, joints=joints))
    for chain in (again.chain, again.before):
        assert [joint.lower for joint in chain.joints] == [free, *[held] * 5]
        assert [joint.upper for joint in chain.joints] == [joint.upper for joint in UR.joints]
    assert again.region.chain.joints[1].lower == UR.joints[1].lower
    apart = replace(UR, joints=(*UR.joints[:5], replace(UR.joints[5], lower=7.0, upper=8.0)))
    with pytest.raises(ConfigError, match=r'wrist_3_joint .*no value in common: .*6\.28319 in'):
        parse_calibration(found.dump(), 'file', apart)


@pytest.fixture(scope='module')
def document(found):
    """Return what its file holds, without the region, which takes long to read."""
    return yaml.safe_load(replace(found, record={**found.record, 'region': None}).dump())


@pytest.mark.parametrize('count', [2, 3])
def test_frames_by_which_the_last_poses_are_outliers_are_outdated(count):
    """Of a target that moved twice the first move was told, and the frame after it published."""
    *_, seen = measured_arm(0, 40, (1e-4, 3e-4))
    last = tuple(Outlier(0, k, int(seen.stamps_ns[k]), 9.0) for k in range(40 - count, 40))
    result = replace(identify(Problem(UR, seen)), outliers=last)
    assert Calibration.of(result).outdated == ('base', 'tool') * (count > 2)


@pytest.mark.parametrize(('a', 'true'), [(0.043, 0.045), (0.045, 0.043)])
def test_axes_that_coincide_in_one_of_two_arms_keep_the_parameters_of_the_nominal_one(a, true):
    rng = np.random.default_rng(1)
    nominal = Chain('arm', 'standard', (Joint('table', a=a, d=0.3), *UR.joints))
    real = nominal.with_offsets({'table.a': true - a, 'table.b': 4e-4, 'elbow_joint.a': 5e-4})
    seen = measure(real, real.random_joints(60, rng), rng, 5e-5, 2e-4)
    result = identify(Problem(nominal, seen))
    assert result.accepted
    assert tuple(each.name for each in result.parameters) == nominal.parameter_names
    read = parse_calibration(Calibration.of(result).dump(), 'c.yaml', nominal)
    assert read.names == result.names


@pytest.mark.parametrize('nominal', [UR, None])
def test_a_calibration_that_was_loaded_knows_what_the_one_saved_knew(found, nominal):
    text = found.dump()
    read = parse_calibration(text, 'c.yaml', nominal)
    again, before = (yaml.safe_load(each)['calibration'] for each in (read.dump(), text))
    assert again.pop('covariance').keys() == before.pop('covariance').keys()
    assert again == before
    assert read.whose == f'the calibration of ur10e 7, made {before["created"][:10]}'
    assert replace(read, record={}).whose == 'the calibration of ur10e (no serial)'
    q = UR.random_joints(200, np.random.default_rng(1))
    for ours, theirs in ((found, read), (replace(found, region=None), replace(read, region=None))):
        for ask in ('removed', 'sigma', 'remaining'):
            np.testing.assert_allclose(
                getattr(theirs, ask)(q), getattr(ours, ask)(q), rtol=1e-6, atol=1e-12
            )
    np.testing.assert_array_equal(read.region.covers(q), found.region.covers(q))
    wavy = replace(found, unmodelled=found.unmodelled._replace(waves=1e-4))
    sigma, known = wavy.sigma(q), found.region.known(q)
    assert (sigma > known).all()
    np.testing.assert_array_equal(replace(wavy, residual=None).remaining(q)[0], sigma)
    wanted = np.maximum(sigma, np.hypot(known, found.residual))  # that has the waves
    np.testing.assert_allclose(wavy.remaining(q), (wanted, sigma))
    poses = Observations.from_arrays(q, np.zeros((200, 3)))
    far = replace(found, unmodelled=found.unmodelled._replace(waves=1.0))
    removed = float(np.sqrt(np.mean(found.removed(q)[0] ** 2)))  # no error may be larger
    assert far.limit([poses]) == pytest.approx(removed, rel=0.05)
    assert far.limit() == found.limit([poses]) == 1.5 * found.residual
    jacobian = ErrorModel(found.chain, found.names).jacobian(q)
    variances = np.einsum('ncp,pr,ncr->nc', jacobian, found.covariance, jacobian)
    bare = replace(read, region=None)
    for sigma, part in ((bare.sigma(q), slice(3)), (bare.sigma(q, np.s_[3:]), slice(3, 6))):
        np.testing.assert_allclose(sigma**2, variances[:, part].sum(axis=1), rtol=1e-6)
    scale = np.sqrt(np.diag(found.covariance))
    difference = (read.covariance - found.covariance) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0.0, atol=1e-8)
    assert read.residual == found.residual
    for name in ('names', 'freedom', 'noise', 'owners', 'world_frame'):
        assert getattr(read, name) == getattr(found, name)
    np.testing.assert_allclose(read.before.table, found.before.table, atol=1e-15)
    assert read.serial_of('c.yaml') == read.serial_of('c.yaml', '7') == '7'


def test_the_nominal_chain_of_axes_that_coincide_has_no_b_unless_given():
    rows = (Joint('table'), *UR.joints)
    nominal = Chain('turned', 'standard', rows)
    record = {'accepted': True, 'nominal': nominal_document(nominal)}
    text = dump_chain(nominal.with_offsets({'table.b': 1e-3}), record)
    assert parse_calibration(text, 'c.yaml').before.value('table.b') == 0.0
    with pytest.raises(ConfigError, match=r'another nominal chain, with table\.b 0 and not 0\.3'):
        parse_calibration(text, 'c.yaml', nominal.with_offsets({'table.b': 0.3}))
    bent = nominal.with_offsets({'table.b': 0.3})
    text = dump_chain(bent, {'accepted': True, 'nominal': nominal_document(bent)})
    assert parse_calibration(text, 'c.yaml').before.value('table.b') == 0.3


@pytest.mark.parametrize(
    ('key', 'change'),
    [
        ('covariance', {'root': ['1.0']}),
        ('covariance', {'root': 3}),
        ('covariance', {'names': ['no_joint.a']}),
        ('covariance', {'freedom': 'many'}),
        ('covariance', 5),
        ('region', 5),
        ('noise_in_sigma', {'position': 'small'}),
        ('noise_in_sigma', {'shared': None}),
        ('noise_in_sigma', {'given': {'sigma_position': 'small'}}),
        ('frames', {'base': {'session': ''}}),
        ('frames', {'base': OWNED | {'label': 3}}),
        ('frames', {'base': OWNED | {'eye_in_hand': 0}}),
        ('frames', {'base': OWNED | {'socket': 0}}),
        ('frames', {'base': 3}),
        ('nominal', {'base': {'xyz': [0.0]}}),
        ('nominal', {'effects': {'elbow_joint.sin_1': 'a'}}),
        ('nominal', {'effects': 3}),
        ('nominal', {'joints': 3}),
        ('rms_mm_after', [1] * 10_000),
        ('frames', [1] * 10_000),
        ('nominal', {'base': {'xyz': [0.0] * 10_000}}),
    ],
)
def test_a_damaged_record_is_refused(document, key, change):
    document = deepcopy(document)
    old = document['calibration'][key]
    document['calibration'][key] = old | change if isinstance(change, dict) else change
    with pytest.raises(ConfigError, match=rf'c\.yaml: (calibration\.{key}|{key})') as refused:
        parse_calibration(dump_yaml(document), 'c.yaml')
    assert len(str(refused.value)) < 300


def test_of_a_file_of_before_what_it_tells_is_known(found):
    """Its nominal frames are fitted to the corrected arm, over the whole joint range."""
    document = yaml.safe_load(found.dump())
    record = document['calibration']
    for key in ('covariance', 'noise_in_sigma', 'frames'):
        del record[key]
    record['nominal'] = {key: record['nominal'][key] for key in ('convention', 'joints')}
    read = parse_calibration(dump_yaml(document), 'c.yaml')
    q = UR.random_joints(300, np.random.default_rng(1))
    assert (read.names, read.covariance, read.noise, read.owners) == ((), None, None, {})
    assert np.isnan(replace(read, region=None).sigma(q, np.s_[3:])).all()
    np.testing.assert_allclose(read.remaining(q), found.remaining(q), rtol=1e-6)
    first, second = (np.sqrt(np.mean(each.removed(q)[0] ** 2)) for each in (read, found))
    assert first == pytest.approx(second, rel=0.05)
    held = {name: Frame(fixed=True) for name in ('base', 'tool')}
    both = parse_calibration(dump_chain(replace(UR, **held), {'nominal': record['nominal']}), 'c')
    assert both.before.base == both.chain.base


def test_a_file_that_was_cut_off_is_refused(found):
    """Its region, and the nominal chain that it belongs to, would be lost without a word."""
    text = found.dump()
    ends = re.finditer(r':|\n(?!\s+-?\d)', text.rstrip())  # those within a matrix are alike
    for end in (each.start() for each in ends):
        with pytest.raises(ConfigError):
            parse_calibration(text[:end], 'c.yaml', UR)
    cut = text[: text.index('\n  covariance:') + 1]
    with pytest.raises(ConfigError, match=r'c\.yaml is cut off: its record lacks table_sha256, '):
        parse_calibration(cut, 'c.yaml', UR)
    assert parse_calibration(text.rstrip(), 'c.yaml', UR).region is not None
    emptied = re.sub(r'(?ms)^  nominal:\n.*?(?=^  \w)', '  nominal: {}\n', text)
    with pytest.raises(ConfigError, match='its record lacks nominal'):
        parse_calibration(emptied, 'c.yaml', UR)


@pytest.mark.parametrize(
    'change',
    [
        lambda document: document['joints'][1].update(a=document['joints'][1]['a'] + 1e-3),
        lambda document: document['joints'][2].pop('beta'),
        lambda document: document['effects'].update({'elbow_joint.ratio': 1e-3}),
        lambda document: document.pop('effects'),
    ],
    ids=['length', 'beta', 'another effect', 'no effects'],
)
def test_a_table_that_was_edited_is_not_the_calibration(document, change):
    """The region, the covariance and the verdict are those of another table."""
    document = deepcopy(document)
    parse_calibration(dump_yaml(document), 'c.yaml', UR)
    change(document)
    with pytest.raises(ConfigError, match=r'c\.yaml does not contain the table and effects'):
        parse_calibration(dump_yaml(document), 'c.yaml', UR)


def test_a_file_whose_keys_were_sorted_is_the_same_calibration(found):
    text = yaml.safe_dump(yaml.safe_load(found.dump()), sort_keys=True)
    read = parse_calibration(text, 'c.yaml', UR)
    assert [*read.chain.effects] == sorted(found.chain.effects) != [*found.chain.effects]


def test_effects_that_were_held_may_stand_before_those_fitted():
    """The file was said to be edited: the region lists what was held last."""
    *_, seen = measured_arm(0, 40, (1e-4, 3e-4))
    result = identify(Problem(UR, seen, effects=('ratio',), fixed=('shoulder_pan_joint.ratio',)))
    read = parse_calibration(Calibration.of(result).dump(), 'c.yaml', UR)
    assert read.chain.effects == result.chain.effects


def test_a_nominal_chain_with_other_effects_is_another(document):
    text = dump_yaml(document)
    parse_calibration(text, 'c.yaml', UR.with_effect_values({'elbow_joint.ratio': 0.0}))
    with pytest.raises(ConfigError, match=r'another nominal.*, with effect elbow_joint\.ratio'):
        parse_calibration(text, 'c.yaml', UR.with_effect_values({'elbow_joint.ratio': 1e-3}))


def calibrated_text(nominal, record):
    """Return the text of a calibration of a nominal chain, with a record of its origin."""
    return dump_chain(nominal.with_offsets({f'{nominal.joint_names[1]}.a': 1e-3}), record)


def test_a_calibration_is_read_from_its_file_or_folder(tmp_path):
    record = {'accepted': True, 'nominal': nominal_document(UR)}
    (tmp_path / 'calibration.yaml').write_text(calibrated_text(UR, record))
    for path in (tmp_path, tmp_path / 'calibration.yaml', str(tmp_path)):
        found = load_calibration(path, UR)
        assert found.record == record
        assert found.serial_of(str(path), '8') == '8'
        assert found.chain.joints[1].a == pytest.approx(UR.joints[1].a + 1e-3, abs=1e-12)


def test_a_refused_result_has_no_calibration_and_says_so(tmp_path):
    with pytest.raises(
        ConfigError, match=f'{tmp_path} holds no calibration.yaml: give the folder'
    ):
        load_calibration(tmp_path)
    (tmp_path / 'result.json').write_text('{}')
    for path in (tmp_path, tmp_path / 'calibration.yaml'):
        with pytest.raises(ConfigError, match=f'the result in {tmp_path} was not accepted'):
            load_calibration(path)
    with pytest.raises(ConfigError, match=r'no calibration at .*other\.yaml'):
        load_calibration(tmp_path / 'other.yaml')


GOOD = {'nominal': nominal_document(UR), 'rms_mm_after': 0.1, 'world_frame': 'tracker'}


@pytest.mark.parametrize(
    ('nominal', 'record', 'message'),
    [
        ('ur10e', None, 'is a chain, but not a calibration'),
        ('ur10e', {}, 'is a chain, but not a calibration'),
        ('ur10e', {'accepted': False}, 'was not accepted'),
        ('puma560', {'samples': 3}, 'the nominal chain has .* are they the same arm'),
        ('ur5e', {'samples': 3}, r'is not the calibration of chain "ur5e": .*elbow_joint\.a'),
        ('ur10', {'nominal': nominal_document(load_chain('ur10e'))}, r'\.d 0.1807 and not 0.1273'),
        ('ur10e', {'nominal': {'convention': 'standard'}}, 'must be a list of 5 numbers'),
        ('ur10e', {'nominal': 'ur10e'}, 'must be a mapping'),
        ('ur10e', GOOD | {'outdated': ['bases']}, 'unknown frame "bases": did you'),
        *(
            ('ur10e', GOOD | {key: value}, rf'c\.yaml: calibration\.{key} must be')
            for key, values in {
                'accepted': ('no', 0, None),
                'rms_mm_after': (float('nan'), float('inf'), 'small', -0.1),
                'world_frame': (5, None),
                'outdated': (5, None, [1]),
            }.items()
            for value in values
        ),
    ],
)
def test_what_is_no_calibration_of_a_nominal_chain_is_refused(nominal, record, message):
    parse_calibration(calibrated_text(UR, GOOD), 'c.yaml', UR)
    with pytest.raises(ConfigError, match=message):
        parse_calibration(calibrated_text(UR, record), 'c.yaml', load_chain(nominal))


def test_a_record_in_another_convention_is_taken_as_it_is():
    """Its numbers cannot be compared with those of the nominal chain."""
    record = {'nominal': nominal_document(load_chain('franka_fr3')), 'table_sha256': 'another'}
    assert record['nominal']['convention'] == 'modified'
    found = parse_calibration(calibrated_text(UR, record), 'c.yaml', UR)
    assert found.record == record
    assert found.chain.joint_names == UR.joint_names
    with pytest.raises(ConfigError, match=r'that chain \(--chain\)'):
        parse_calibration(calibrated_text(UR, record), 'c.yaml')


def test_a_calibration_too_far_from_its_nominal_chain_is_refused():
    nominal = load_chain('ur5e')
    far = calibrated_text(nominal.with_offsets({'elbow_joint.theta': 0.2}), {'samples': 3})
    with pytest.raises(ConfigError, match=r'of chain "ur5e": too far .*: elbow_joint\.theta'):
        parse_calibration(far, 'c.yaml', nominal)
    parse_calibration(far, 'c.yaml', nominal, Settings(largest_angle=0.3))
    near = calibrated_text(nominal, {'samples': 3})
    with pytest.raises(ConfigError, match='its convention is standard, not modified'):
        parse_calibration(near, 'c.yaml', replace(nominal, convention='modified'))


def test_a_large_error_of_the_nominal_chain_itself_was_judged_when_it_was_identified():
    nominal = load_chain('ur5e')
    record = {'accepted': True, 'nominal': nominal_document(nominal)}
    true = nominal.with_offsets({'elbow_joint.theta': 0.2})
    far = dump_chain(true, record)
    assert parse_calibration(far, 'c.yaml', nominal).chain.value('elbow_joint.theta') == (
        pytest.approx(true.value('elbow_joint.theta'))
    )
    with pytest.raises(ConfigError, match=r'of chain "ur5e": too far .*: elbow_joint\.theta'):
        parse_calibration(far, 'c.yaml', nominal, Settings())
    elbow = nominal.joint_names.index('elbow_joint')
    joints = list(nominal.joints)
    joints[elbow] = replace(joints[elbow], sign=-1)
    with pytest.raises(ConfigError, match='the sign of elbow_joint is 1, not -1'):
        parse_calibration(far, 'c.yaml', replace(nominal, joints=tuple(joints)))


@pytest.mark.parametrize('rows', [['1', '2', '3 4 5'], ['1', '2 3', '4 5'], ['1', '2 3']])
def test_rows_of_another_length_are_no_matrix(rows):
    assert unpacked_matrix(['1', '2 3', '4 5 6'], 3).shape == (3, 3)
    with pytest.raises(ValueError, match=r'rows|zip|broadcast'):
        unpacked_matrix(rows, 3)
