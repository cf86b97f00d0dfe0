# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy: an identification that runs."""

import errno
import queue
import threading
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_cell import PATIENCE, STOPS, Cell, pose_messages, topics, values_of
from std_msgs.msg import String
from std_srvs.srv import Trigger

from calib_ros.files import loading
from calib_ros.files.history import History
from calib_ros.identification import recalibration
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.ros.arguments import NODE
from calib_ros.ros.calls import InOrder
from calib_ros.ros.identifying import ONE_BEFORE
from calib_ros.ros.outputs import Keeper
from calib_ros.sampling.session import CalibrationSession

JOINT_RATE = 25.0  # they cost more than what is asked


@pytest.fixture
def held(monkeypatch):
    """Let identifications end when they are let go; return what does, and their problems."""
    release, problems = threading.Event(), []

    def slow(problem, model, progress):
        result = identify(problem)
        problems.append(problem)
        assert release.wait(PATIENCE)
        return result

    monkeypatch.setattr(loading, 'identify_model', slow)
    return release, problems


def test_messages_are_taken_while_an_identification_runs(tmp_path, recording, held):
    release, problems = held
    joints, poses = topics(recording).values()
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        cell.play({'joint_states': joints[:500], 'measured_pose': poses[:80]})
        first = cell.start_call('identify')
        cell.spin_until(lambda: problems)
        second = cell.refused('identify')
        assert 'running' in second.message
        cell.play({'joint_states': joints[500:], 'measured_pose': poses[80:]})
        assert cell.node.session.account().poses == len(poses)
        assert not first.done()
        release.set()
        cell.spin_until(first.done)
        assert first.result().success, first.result().message
        assert len(problems[0].observations) == 20
        # The samples that came meanwhile were not fitted, so they may judge; but they are few.
        release.clear()
        again = cell.start_call('identify')
        cell.spin_until(lambda: len(problems) == 2)
        judged = cell.refused('validate')
        assert 'too few poses to tell whether the calibration holds' in judged.message
        assert '4 poses measured since' in judged.message
        assert ONE_BEFORE not in judged.message  # what the identification gives is not known yet
        release.set()
        cell.spin_until(again.done)
        assert again.result().success, again.result().message


def test_a_noisier_device_condemns_no_arm(cell, recording, rng, monkeypatch):
    """By ~/check it no longer held, where ~/validate could not tell."""
    monkeypatch.setattr(recalibration, '_without_one', lambda *_: ())  # which pose is odd
    noisy = pose_messages(recording.poses)
    for k, off in enumerate(np.repeat(rng.normal(0.0, 1e-3, STOPS), len(noisy) // STOPS)):
        noisy[k].pose.position.x += off
    cell.play(topics(recording))
    cell.done('identify')
    cell.done('clear')
    cell.play(topics(recording, measured_pose=noisy))
    for sigma in (1e-4, 1e-3):  # the first is not stated
        cell.set_parameters({'sigma_position': sigma})
        assert 'too much noise to tell' in cell.refused('validate').message
        assert cell.call('check').success == (sigma > 1e-4)


def test_no_earlier_calibration_is_taken_for_the_one_that_is_identified(cell, recording, held):
    """~/save during an identification wrote the calibration before it without a word."""
    release, problems = held
    release.set()
    cell.play(topics(recording))
    cell.done('identify')
    cell.done('save')
    release.clear()
    running = cell.start_call('identify')
    cell.spin_until(lambda: len(problems) == 2)
    files = sorted(cell.node._archive.folder.iterdir())
    for name in ('save', 'export', 'load'):
        said = cell.refused(name).message
        assert said.startswith('refused: an identification is running')
        assert said.endswith('wait for its answer, or call ~/cancel')
    assert sorted(cell.node._archive.folder.iterdir()) == files
    release.set()
    cell.spin_until(running.done)
    for name in ('save', 'export', 'load'):
        cell.done(name)


def test_an_accepted_calibration_worse_than_the_one_in_use_is_told(cell, recording):
    """With a length fixed that has an error, it replaced a better one without a word."""
    cell.play(topics(recording))
    cell.done('identify')
    cell.done('save')
    cell.done('clear')
    said = 'the calibration before is nearer (0.0'
    again = pose_messages(recording.poses)
    for message in again:
        message.pose.position.x += 1e-5
    for fixed, worse in ((['wrist_1_joint.d'], True), (['shoulder_pan_joint.d'], False)):
        cell.set_parameters({'fixed': fixed})
        cell.play(topics(recording, measured_pose=again))
        answer = cell.done('identify')
        assert (said in answer.message) == worse
        assert (said in cell.in_full(answer)) == worse
        cell.done('load')
        cell.done('clear')


def test_messages_are_taken_while_a_judgement_is_filed(tmp_path, recording, monkeypatch):
    """The node stood still until a slow history had answered."""
    filing, release, rows = threading.Event(), threading.Event(), []

    def slow(history, row):
        rows.append(row)
        filing.set()
        assert release.wait(PATIENCE)

    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': '7'}
    with Cell(**parameters, history=str(tmp_path / 'history')) as cell:
        messages = topics(recording)
        cell.play(messages)
        cell.done('identify')
        cell.done('clear')
        cell.play(messages)
        monkeypatch.setattr(History, 'file', slow)
        judging = cell.start_call('validate')
        cell.spin_until(filing.is_set)
        count = cell.node.session.received['joints']
        cell.play({'joint_states': messages['joint_states'][-10:]})
        assert cell.node.session.received['joints'] == count + 10
        cell.done('clear')
        assert not judging.done()
        assert 'running' in cell.refused('validate').message
        release.set()
        cell.spin_until(judging.done)
        assert f'{STOPS} poses' in judging.result().message
        assert [row.kind for row in rows] == ['validate']


def test_warnings_of_the_measurements_are_filed_too(tmp_path, recording, monkeypatch):
    """As by `identify` and `fleet`."""
    rows = []
    monkeypatch.setattr(History, 'file', lambda history, row: rows.append(row))
    monkeypatch.setattr(CalibrationSession, 'warnings', ('the clocks differ',))
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': '7'}
    with Cell(**parameters, history=str(tmp_path / 'history')) as cell:
        cell.play(topics(recording))
        cell.done('identify')
    (row,) = rows
    assert row.remarks[0] == 'the clocks differ'


@pytest.mark.parametrize(
    ('error', 'said'),
    [
        (ZeroDivisionError('no credentials'), 'no credentials'),
        (OSError(errno.ENOSPC, 'No space left', 'rows'), 'rows: the disk is full: make room'),
    ],
)
def test_a_result_is_told_though_its_history_fails(tmp_path, recording, monkeypatch, error, said):
    """Clients of remote storage raise errors of their own: an accepted result seemed refused."""

    def fail(history, row):
        raise error

    monkeypatch.setattr(History, 'file', fail)
    parameters = {'chain': 'ur10e', 'data_dir': str(tmp_path), 'serial': '7'}
    with Cell(**parameters, history=str(tmp_path / 'history')) as cell:
        cell.play(topics(recording))
        assert f'history: {said}' in cell.in_full(cell.done('identify'))


STAGES = ['model geometric', 'effects', 'effects: ratio', 'harmonics of elbow_joint']


@pytest.fixture
def stages(monkeypatch):
    """Let identifications of model auto wait at each stage; return a queue that lets them go."""
    release, reached = queue.Queue(), []
    identify_model = loading.identify_model

    def slow(problem, model, progress):
        def at(stage):
            progress(stage)
            if isinstance(stage, str):  # no share of the work
                reached.append(stage)
                release.get(timeout=PATIENCE)

        return identify_model(problem, model, at)

    monkeypatch.setattr(loading, 'identify_model', slow)
    return release, reached


def test_the_status_names_the_stage_of_an_identification(tmp_path, recording, stages):
    release, reached = stages
    with Cell(chain='ur10e', data_dir=str(tmp_path), model='auto') as cell:
        words = cell.listen(String, 'calibration_node/status')
        cell.play(topics(recording))
        running = cell.start_call('identify')
        for stage in STAGES[:2]:
            cell.spin_until(lambda s=stage: words and f'; identifying ({s}), ' in words[-1].data)
            release.put(None)
        for _ in range(100):
            release.put(None)
        cell.spin_until(running.done)
        assert running.result().success, running.result().message
        assert set(STAGES) <= set(reached)
        cell.spin_until(lambda: 'identifying' not in words[-1].data)


def test_an_identification_is_cancelled_between_stages(tmp_path, recording, stages):
    release, reached = stages
    with Cell(chain='ur10e', data_dir=str(tmp_path), model='auto') as cell:
        none = cell.refused('cancel')
        assert 'nothing to cancel' in none.message
        cell.play(topics(recording))
        texts = cell.listen(String, 'calibration_node/calibration')
        for _ in range(100):
            release.put(None)
        cell.done('identify')
        cell.spin_until(lambda: texts)
        good = cell.node.session.calibration
        while not release.empty():
            release.get()
        for stage in (0, 2):
            reached.clear()
            running = cell.start_call('identify')
            for _ in range(stage):
                release.put(None)
            cell.spin_until(lambda last=stage: len(reached) == last + 1)
            answer = cell.done('cancel')
            assert f'({reached[-1]})' in answer.message
            release.put(None)
            cell.spin_until(running.done)
            assert not running.result().success
            assert f'cancelled: identifying ({reached[-1]})' in running.result().message
            assert len(reached) == stage + 1
        assert cell.node.session.calibration is good
        assert len(texts) == 1
        assert len(cell.node.session.samples) == STOPS
        for _ in range(100):
            release.put(None)
        cell.done('identify')


def test_a_result_that_cannot_be_told_leaves_the_one_before(cell, recording, monkeypatch):
    """It was taken for published: ~/save did not say that it saves another one."""
    cell.play(topics(recording))
    cell.done('identify')
    good, heard = cell.node.session.calibration, cell.listen(DiagnosticArray, '/diagnostics', 10)
    monkeypatch.setattr(Calibration, 'dump', None)
    assert 'internal error' in cell.refused('identify').message
    assert cell.node.session.calibration is good
    assert cell.done('save').message.startswith(ONE_BEFORE)
    said = "no result: 'NoneType' object is not callable"
    cell.spin_until(lambda: heard and values_of(heard[-1])['last identification'] == said)


@pytest.mark.parametrize('call', ['cancel', 'clear'])
def test_what_is_called_at_last_holds(cell, recording, held, call):
    """A cancelled result is not published; one whose poses were cleared is, and judges others."""
    release, problems = held
    cell.play(topics(recording))
    running = cell.start_call('identify')
    cell.spin_until(lambda: problems)
    cell.done(call)
    release.set()
    cell.spin_until(running.done)
    answer = running.result()
    assert answer.success == (call == 'clear'), answer.message
    assert (cell.node.session.calibration is None) == (call == 'cancel')
    if call == 'cancel':
        assert 'cancelled' in answer.message
        return
    cell.play(topics(recording))
    judged = cell.call('validate')
    assert f'{STOPS} poses measured since' in judged.message


@pytest.mark.parametrize('largest_error', [1e-6, 0.01])
def test_the_text_stays_beside_the_journal_of_its_poses(
    unsearched, cell, recording, held, largest_error
):
    """After a ~/clear meanwhile it was beside the next journal, as was the report."""
    release, problems = held
    cell.set_parameters({'largest_error': largest_error})
    cell.play(topics(recording))
    running = cell.start_call('identify')
    cell.spin_until(lambda: problems)
    journal = cell.node._archive.journal
    cell.done('clear')
    release.set()
    cell.spin_until(running.done)
    accepted = running.result().success
    assert accepted == (largest_error == 0.01)
    kinds = ('.txt',) if accepted else ('.html', '.txt')
    notes = sorted(path.name for path in journal.parent.glob('*.identified.*'))
    assert notes == [journal.with_suffix(f'.identified{kind}').name for kind in kinds]


def test_a_calibration_is_saved_where_it_was_to_be_when_it_was_called(
    cell, recording, monkeypatch
):
    release, save = threading.Event(), Keeper.save

    def late(*given):
        assert release.wait(PATIENCE)
        return save(*given)

    monkeypatch.setattr(Keeper, 'save', late)
    cell.play(topics(recording))
    cell.done('identify')
    cell.set_parameters({'target_filename': 'first.yaml'})
    saved = cell.start_call('save')
    cell.spin_until(lambda: cell.node._working['~/save'].busy)
    cell.set_parameters({'target_filename': 'second.yaml'})
    release.set()
    cell.spin_until(saved.done)
    assert 'first.yaml' in saved.result().message


@pytest.mark.parametrize(
    'calls',
    [
        {
            'identify': 'accepted: 24 poses',
            'remove_last': '24 removed',
            'set_parameters': '',
            'clear': '23 poses',
        },
        {'clear': ' poses cleared; kept in', 'identify': 'no poses to fit'},
        {'set_parameters': '', 'identify': 'NOT accepted'},
    ],
)
def test_calls_that_wait_are_answered_in_order(unsearched, cell, recording, calls):
    """~/clear overtook the ~/identify before it, which then had no poses."""
    cell.play(topics(recording))
    changes = Parameter('largest_error', value=1e-6).to_parameter_msg()
    requests = {'set_parameters': SetParameters.Request(parameters=[changes])}
    clients = [
        cell.peer.create_client(SetParameters if name in requests else Trigger, f'{NODE}/{name}')
        for name in calls
    ]
    cell.spin_until(lambda: all(client.service_is_ready() for client in clients))
    answers = [
        client.call_async(requests.get(name, Trigger.Request()))
        for name, client in zip(calls, clients, strict=True)
    ]
    cell.spin_until(lambda: all(answer.done() for answer in answers))
    for said, answer in zip(calls.values(), answers, strict=True):
        assert said in getattr(answer.result(), 'message', '')


@pytest.mark.parametrize('clock', ['received_timestamp', 'source_timestamp'])
def test_calls_are_in_order_by_the_stamps_that_the_middleware_has(clock):
    """Some leave the time of reception at zero."""
    stamps = {'clear': [30, 10], 'identify': [20]}

    def served(name):
        blank = {'received_timestamp': 0, 'source_timestamp': 0}
        come = [(name, SimpleNamespace(**{**blank, clock: each})) for each in stamps[name]]
        handle = MagicMock(service_take_request=lambda kind: come.pop(0) if come else (None, None))
        return SimpleNamespace(handle=handle, srv_type=Trigger)

    calls = InOrder(MagicMock(services=[*map(served, stamps)])).take_data()
    assert [request for _, _, request, _ in calls] == ['clear', 'identify', 'clear']
