# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy: what it answers."""

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from ros_cell import STOPS, Cell, part, pose_messages, stamp_ns, topics, true_arm
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool

from calib_ros.apply.simulation import measure
from calib_ros.decision.reasons import Rule
from calib_ros.errors import TooFewObservationsError
from calib_ros.files.history import History
from calib_ros.identification.records import nominal_document
from calib_ros.kinematics.chain_file import dump_chain, load_chain, parse_chain
from calib_ros.report.refusals import rules
from calib_ros.report.words import REFUSED
from calib_ros.ros.identifying import KEEP, NOT_FILED, ONE_BEFORE
from calib_ros.ros.inputs import deserialised
from calib_ros.sampling.batches import feed
from calib_ros.sampling.clock_hints import apart
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.sources import STANDARD
from calib_ros.sampling.streams import Stream
from calib_ros.shown import moment

JOINT_RATE = 25.0  # they cost more than what is asked


def test_errors_are_answers(cell, recording):
    for name, said in (
        ('identify', 'nothing was received: check joint_topics, sources, their types and QoS; 0'),
        ('capture', 'no joint states of this arm received'),
        ('remove_last', 'no pose to remove'),
        ('validate', 'identify or load one first'),
        ('load', '~/save first, or set calibration_filename'),
    ):
        assert said in f'{cell.refused(name).message}$'
    cell.play(part(recording, 0.0, 2.0))
    assert 'too few different poses: 2 measured, at least 5' in cell.refused('identify').message


@pytest.mark.parametrize(
    ('prefix', 'said'),
    [
        ('', '40 measurements came in motion, hardly any at a stop: stop at each pose'),
        ('ur_', 'waiting for joint states, set joint_names? '),
    ],
)
def test_what_gave_no_pose_is_in_the_short_answer(cell, recording, prefix, said):
    """The middle was cut out of the message, and the cause with it."""
    some = part(recording, 0.0, 10.0)
    for k, message in enumerate(some['joint_states']):
        message.name = [prefix + name for name in message.name]
        message.position = [0.002 * k] * len(message.name)
    cell.play(some)
    answer = cell.refused('identify')
    assert len(answer.message) <= 200
    assert answer.message.startswith(f'no poses to fit ... {said}')
    assert not prefix or cell.in_full(answer).endswith('set joint_names (--joint-names)')


def test_clocks_that_disagree_are_to_be_set_first(unsearched, cell, recording):
    session, (joints, poses) = cell.node.session, part(recording, 0.0, 12.0).values()
    come = sorted([*joints, *poses], key=stamp_ns)  # as they arrive, whatever their stamps
    for message in poses:
        message.header.stamp.sec += 3
    pose, joint = Stream('poses', STANDARD[0].type, STANDARD[0]), Stream('joints', JOINT_STATE)
    for first in range(0, len(come), 5):
        some = [(joint if type(m) is JointState else pose, m) for m in come[first : first + 5]]
        batch = [(stream, serialize_message(message)) for stream, message in some]
        assert feed(session, batch, deserialised) == []
    assert 'synchronise the clocks' in cell.refused('identify').message


def test_an_accepted_answer_keeps_its_hint_whole_and_says_how_to_save(cell, tmp_path):
    identifying = cell.node._identifying
    identifying._journal = tmp_path / 'ur10e_20260102T030405000006Z.csv'
    verdict, hint = 'accepted: 40 poses, RMS 1.911 -> 0.0053 mm', 'J moves one way: mix the order'
    said, end = f'{verdict} (95 %: 0.0045 to 0.006 mm); {"valid " * 30}', KEEP + NOT_FILED
    for advice, kept in ((hint, f' {hint}'), (f'{hint} (a ({40 * "on "}))', f' {hint}'), ('', '')):
        identifying._short = said, advice, end
        _, found = identifying.shortened((True, 20 * said))
        assert len(found) <= 200
        assert found.startswith(verdict)
        assert f' ...{kept}{end} ... full text: ' in found


@pytest.mark.parametrize('folder', ['data', 'of a cell with a long name ' * 9])
def test_a_refusal_keeps_what_to_do_first_and_where_all_of_it_is(cell, tmp_path, folder):
    identifying = cell.node._identifying
    identifying._journal = tmp_path / folder / 'ur10e+SN-0042_20260102T030405000006Z.csv'
    identifying._journal.parent.mkdir()
    reasons, figures = 'no gain on held-out poses; ' * 20, '60 poses, RMS 1 -> 2 mm; ' * 20
    for rule in Rule:
        step = rules()[rule].steps[0]
        text = f'{REFUSED}: {reasons}. To do first: {step} {figures}'
        identifying._short = f'{REFUSED}: {reasons}', step, ''
        _, found = identifying.shortened((False, text))
        assert len(found) <= 200
        assert found.startswith('NOT accepted: no gain')
        said, _, name = found.partition(' ... full text: ')
        assert said.endswith(step)
        assert (tmp_path / folder / name).read_text() == f'{text}\n'


def test_what_made_poses_too_few_is_in_the_answer_though_the_error_is_cut(cell, tmp_path):
    """With clocks 3 s apart it was "measure 30 or more"."""
    identifying, hint = cell.node._identifying, apart(-3.0)
    identifying._journal = tmp_path / 'ur10e_20260102T030405000006Z.csv'
    counts = f'2500 joint states{", dropped" * 30}; {hint.text}'
    text = str(TooFewObservationsError(2, 5, '6 equations each', counts))
    assert hint.text not in text
    identifying._short = text, hint.status, ''
    first, advice, _ = identifying.shortened((False, text))[1].split(' ... ')
    assert first.startswith('too few different poses: 2 measured')
    assert advice == hint.status
    identifying._failed(TooFewObservationsError(2, 5, '6 equations each', counts), text)
    assert 'at least 5 needed ... measure 30' in identifying.shortened((False, text))[1]


@pytest.mark.parametrize('short', [('', '', ''), ('poses came in different frames' * 9, '', '')])
def test_an_error_keeps_its_beginning_and_its_end(cell, tmp_path, short):
    """The fault is first, the remedy last."""
    identifying = cell.node._identifying
    identifying._journal = tmp_path / 'ur10e_20260102T030405000006Z.csv'
    identifying._short = short
    text = f'poses came in different frames{" (a, b)" * 50}: set frame_id'
    _, found = identifying.shortened((False, text))
    assert len(found) <= 200
    assert found.startswith('poses came in different')
    assert ('set frame_id ... full text: ' in found) == (not short[0])


def test_a_short_answer_names_the_mistake(cell, recording):
    some = part(recording, 0.0, 12.0)
    for message in some['joint_states']:
        message.position = np.degrees(message.position).tolist()
    cell.play(some)
    answer = cell.refused('identify')
    assert answer.message.startswith(
        'NOT accepted: the joint values are in degrees, not radians: '
        'correct the publisher and measure again (after ~/clear) ... full text: '
    )
    assert 'To do first: Check at the robot' in cell.in_full(answer)


def test_what_made_poses_too_few_is_said_with_it(cell, recording):
    """To measure more alone would be in vain."""
    poses = pose_messages(recording.poses)
    for message in poses[16:]:
        message.header.stamp = Time()
    cell.play(topics(recording, measured_pose=poses[:16]))
    for message in poses[16:]:
        cell.publisher(PoseStamped, 'measured_pose').publish(message)
    cell.spin_until(lambda: cell.node.session.received['measurements'] == len(poses))
    answer = cell.refused('identify')
    said = cell.in_full(answer)
    assert 'too few different poses: 4 measured, at least 5 needed' in said
    assert '600 joint states and 96 measurements gave 4 poses' in said
    assert said.endswith('or hold parameters (fixed)')
    for words in (answer.message, said):
        assert 'zero stamp (fill header.stamp where it is published)' in words


def test_a_refusal_leaves_its_report(unsearched, cell, recording):
    moved = pose_messages(recording.poses)
    shifts = np.random.default_rng(0).uniform(size=STOPS).repeat(4)
    for message, x in zip(moved, shifts, strict=True):
        message.pose.position.x += x
    cell.play(topics(recording, measured_pose=moved))
    answer = cell.refused('identify')
    assert len(answer.message) <= 200
    _, advice, _ = cell.node._identifying._short
    assert advice
    assert f' ... {advice} ... full text: ' in answer.message
    (page,) = cell.node._archive.folder.glob('*.identified.html')
    assert answer.message.endswith(f': {page.name}')
    assert 'what to do' in page.read_text()
    assert f'; nothing is published; report: {page}' in cell.in_full(answer)


def test_answers_are_in_the_log_as_well(cell, recording):
    told = cell.log()

    def said(name, answer, level):
        text = f'~/{name}: {cell.in_full(answer)}'
        cell.spin_until(lambda: (text, level) in [(each.msg, each.level) for each in told])

    for name in ('identify', 'export', 'capture', 'remove_last', 'validate', 'save', 'load'):
        said(name, cell.call(name), Log.WARN)
    said('record', cell.call('record', SetBool.Request(data=True)), Log.INFO)
    cell.play(topics(recording))
    for name in ('identify', 'export', 'save', 'load', 'remove_last', 'clear'):
        said(name, cell.call(name), Log.INFO)


def test_record_remove_last_and_clear(cell, recording):
    joints, poses = topics(recording).values()
    cell.done('record', SetBool.Request(data=False))
    cell.play({'joint_states': joints[:5], 'measured_pose': poses[:2]})
    unused = cell.node.session.account().unused
    assert unused == {'joints: not recording': 5, 'measurements: not recording': 2}
    cell.done('record', SetBool.Request(data=True))
    cell.play({'joint_states': joints[5:150], 'measured_pose': poses[2:20]})
    assert len(cell.node.session.samples) == 5
    assert cell.done('remove_last').message == 'pose 5 removed'
    assert len(cell.node.session.samples) == 4
    cleared = cell.done('clear')
    assert '4 poses cleared; kept in' in cleared.message
    assert 'calibration' not in cleared.message  # there is none
    account = cell.node.session.account()
    assert account.samples == account.joint_states == 0


def test_capture_takes_one_sample_when_it_is_asked_to(tmp_path, recording):
    joints, poses = topics(recording).values()
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'mode': 'triggered'}
    with Cell(**parameters) as cell:
        cell.play({'joint_states': joints[:14], 'measured_pose': poses[:4]})
        taken = cell.done('capture')
        assert taken.message.startswith('pose 1 taken (4 measurements, spread 0.0')
        assert 'no measurements since the last pose' in cell.refused('capture').message
        cell.node.set_parameters([Parameter('socket', value='plate A/1')])
        ball = cell.done('capture')
        assert ball.message == 'pose 2 taken: ball in socket plate A/1'
        (path,) = tmp_path.glob('*Z.csv')
        assert path.read_text().splitlines()[-1].endswith(',plate A,1,')
        cell.done('remove_last')
        (refused,) = cell.node.set_parameters([Parameter('socket', value='A')])
        assert 'socket must be LOCATION/SOCKET' in refused.reason
        cell.node.set_parameters([Parameter('socket', value='')])
        cell.play({'joint_states': joints[14:20], 'measured_pose': poses[4:5]})
        assert 'the arm has not been still for 0.2 s yet' in cell.refused('capture').message
        cell.play({'joint_states': joints[20:], 'measured_pose': poses[5:]})
        assert len(cell.node.session.samples) == 1


def test_a_saved_calibration_is_loaded_and_judged_on_new_samples(tmp_path, recording):
    history = tmp_path / 'history'
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': '7'}
    parameters['history'] = str(history)
    other = tmp_path / 'ur10e_on_linear_axis_20990101T000000000000Z.yaml'
    other.write_text('of another robot, whose name begins alike')
    with Cell(**parameters) as cell:
        cell.play(topics(recording))
        cell.done('identify')
        assert 'measure some new ones' in cell.refused('validate').message
        cell.done('save')
        chain = cell.node.session.calibration.chain
    with Cell(**parameters) as cell:
        cell.done('load')
        np.testing.assert_array_equal(cell.node.session.calibration.chain.table, chain.table)
        assert cell.node.session.calibration.world_frame == 'tracker'
        texts = cell.listen(String, 'calibration_node/calibration')
        cell.spin_until(lambda: texts)
        np.testing.assert_array_equal(parse_chain(texts[0].data).table, chain.table)
        cell.play(topics(recording))
        again = cell.refused('validate')
        assert again.message.startswith('no verdict: the calibration was fitted to')
        cell.call('clear')
        fresh = pose_messages(recording.poses)
        for message in fresh:
            message.pose.position.x += 1e-5
        cell.play(topics(recording, measured_pose=fresh))
        holds = cell.done('validate')
        assert 'the calibration holds: RMS 0.0' in holds.message
        assert f'{STOPS} poses measured since' in holds.message
        assert 'agrees with the measurements: RMS 0.0' in cell.done('check').message
        cell.call('clear')
        moved = pose_messages(recording.poses)
        for message in moved:
            message.pose.position.x += 0.003
        cell.play(topics(recording, measured_pose=moved))
        broken = cell.refused('validate')
        assert 'no longer holds' in broken.message
        assert 'RMS 3.0' in broken.message
        bumped = cell.refused('check')
        assert 'no longer fits, changed: base' in bumped.message
        assert ': was the robot, the target or the device bumped? RMS 3.0' in bumped.message
    filed = {(row.kind, row.verdict): row for row in History(history).rows('7')}
    _, holds, broken = judged = [
        filed['validate', text] for text in ('no verdict', 'holds', 'does not hold')
    ]
    assert set(filed) == {('identify', 'accepted'), *((r.kind, r.verdict) for r in judged)}
    assert broken.rms_mm > 3.0 > holds.rms_mm


def test_the_calibration_of_another_robot_of_the_kind_is_not_loaded(tmp_path):
    saved = tmp_path / 'saved.yaml'
    record = {'nominal': nominal_document(load_chain('ur10e')), 'robot_serial': '7'}
    saved.write_text(dump_chain(true_arm(), record))
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'calibration_filename': str(saved)}
    for serial, loads in (('8', False), ('7', True), ('', True)):
        with Cell(**parameters, serial=serial) as cell:
            answer = cell.call('load')
            assert answer.success == loads, answer.message
            said = 'the calibration of ur10e 7' if loads else 'serial "7"; this one is "8"'
            assert said in answer.message
            assert (cell.node.session.calibration is not None) == loads


@pytest.fixture(scope='module')
def saved(tmp_path_factory, recording):
    """Return a folder in which two calibrations are saved, and the path of the newest."""
    folder = tmp_path_factory.mktemp('saved')
    with Cell(chain='ur10e', data_dir=str(folder)) as cell:
        cell.play(topics(recording))
        cell.done('identify')
        cell.done('save')
        cell.done('save')
    *_, newest = sorted(folder.glob('*Z.yaml'))
    return folder, newest


@pytest.mark.parametrize('named', [True, False])
def test_the_calibration_is_published_again_after_a_restart(saved, named):
    folder, newest = saved
    path = sorted(folder.glob('*Z.yaml'))[0] if named else newest
    given = {'calibration_filename': path.name} if named else {'autoload': True}
    with Cell() as cell:
        told = cell.log()
        node = cell.start(chain='ur10e', data_dir=str(folder), **given)
        texts = cell.listen(String, 'calibration_node/calibration')
        cell.spin_until(lambda: texts)
        assert texts[0].data == path.read_text()
        assert node.session.calibration.world_frame == 'tracker'
        cell.spin_until(lambda: any(f'loaded {path}' in each.msg for each in told))


def test_a_calibration_that_could_be_loaded_is_named_but_not_published(saved):
    folder, newest = saved
    with Cell() as cell:
        told = cell.log()
        node = cell.start(chain='ur10e', data_dir=str(folder))
        cell.spin_until(lambda: any(str(newest) in each.msg for each in told))
        assert any('~/load' in each.msg for each in told)
        assert node.session.calibration is None


@pytest.mark.parametrize(('content', 'said'), [(None, "or to '' for"), ('puma', 'joints')])
def test_what_cannot_be_loaded_at_the_start_is_told_and_costs_nothing_else(
    tmp_path, recording, content, said
):
    """A node that did not start would take no samples, and a respawned one gives up."""
    path = tmp_path / 'of_before.yaml'
    if content is not None:
        path.write_text(dump_chain(load_chain('puma560')))
    given = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'calibration_filename': str(path)}
    with Cell() as cell:
        told = cell.log()
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        node = cell.start(**given)
        cell.spin_until(lambda: any(said in m.msg and m.level == m.ERROR for m in told))
        cell.spin_until(lambda: heard and said in heard[-1].status[0].message)
        assert heard[-1].status[0].level == DiagnosticStatus.ERROR
        assert node.session.calibration is None
        cell.play(part(recording, 0.0, 4.0), node=node)
        assert node.session.samples


def test_outliers_are_named_by_number_and_stamp(cell, recording):
    some = pose_messages(recording.poses)
    for message in some[24:28]:
        message.pose.position.z += 0.02
    cell.play(topics(recording, measured_pose=some))
    answer = cell.done('identify')
    stamp = moment(cell.node.session.samples[6].stamp_ns)
    assert f'1 outlier carries little or no weight: pose 7 ({stamp})' in cell.in_full(answer)


def test_a_poor_identification_publishes_nothing_and_keeps_the_last(unsearched, cell, recording):
    cell.play(topics(recording))
    texts = cell.listen(String, 'calibration_node/calibration')
    cell.done('identify')
    cell.spin_until(lambda: texts)
    good = cell.node.session.calibration
    cell.done('clear')
    nominal = load_chain('ur10e')
    noisy = measure(nominal, recording.poses.joints, np.random.default_rng(5), 1e-4, 1e-4)
    noisy = noisy.at(recording.poses.stamps_ns)
    cell.play(topics(recording, measured_pose=pose_messages(noisy)))
    answer = cell.refused('identify')
    assert 'no gain' in answer.message
    assert 'last good calibration stays in use' in cell.in_full(answer)
    assert cell.node.session.calibration is good
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.spin_until(lambda: heard)
    assert len(texts) == 1
    assert all(cell.call(k).message.startswith(ONE_BEFORE) for k in ('save', 'export', 'validate'))
    cell.done('load')
    assert ONE_BEFORE not in cell.done('save').message
