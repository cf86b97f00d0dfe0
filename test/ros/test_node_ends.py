# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in a process of its own that is killed, or finds no room."""

import os
import resource
import shutil
import signal
import threading
from contextlib import contextmanager

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from ros_cell import NODE, PATIENCE, START, STOPS, Cell, Child, direct, part, topics, values_of
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from calib_ros.files.archive import Archive
from calib_ros.files.journal import read_journal
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.ros.outputs import UNSAVED


@pytest.fixture
def journal(tmp_path, recording):
    """Return a folder with the journal of a whole shift."""
    archive = Archive(tmp_path, 'ur10e', load_chain('ur10e').joint_names, lambda: '')
    session = direct(recording)
    session.finish()
    for sample in session.samples:
        archive.add(sample)
    archive.close()
    return tmp_path


def begun(folder):
    return any(path.stat().st_size for path in folder.glob('*Z.csv'))


def samples_in(folder):
    (path,) = folder.glob('*Z.csv')
    return read_journal(path, 6)[0]


@contextmanager
def cell_and_child(**parameters):
    """Start a peer and a node in a child process, which misses nothing.

    Each child has a peer and a domain of its own: DDS takes a killed one to be alive for a while.
    """
    qos = {
        f'qos_overrides./{topic}.subscription.reliability': 'reliable'
        for topic in ('joint_states', 'measured_pose')
    }
    with (
        Cell() as cell,
        # the probes below have no stamps
        Child(domain=cell.domain, chain='ur10e', largest_loss=1.0, **qos, **parameters) as child,
    ):
        reports = cell.listen(DiagnosticArray, '/diagnostics', 10)
        probes = [
            (cell.publisher(JointState, 'joint_states'), JointState()),
            (cell.publisher(PoseStamped, 'measured_pose'), PoseStamped()),
        ]

        def hears():  # that the peer knows of the child does not say that it hears the peer
            for publisher, probe in probes:
                publisher.publish(probe)
            return reports and min(heard(reports[-1]))

        cell.spin_until(hears)
        yield cell, child


def heard(report):
    """Return how many joint states and poses a node has received."""
    values = {v.key: int(v.value) for v in report.status[0].values if v.value.isdigit()}
    return [values.get(stream, 0) for stream in ('joint states', 'poses')]


def all_heard(cell):
    """Wait until a child has received what was played: nothing more between two reports."""
    reports = cell.listen(DiagnosticArray, '/diagnostics', 10)
    cell.spin_until(lambda: len(reports) > 1 and heard(reports[-1]) == heard(reports[-2]))


def test_a_node_killed_in_its_first_run_goes_on_with_all_samples(monkeypatch, tmp_path, recording):
    monkeypatch.setenv('HOME', str(tmp_path))
    monkeypatch.delenv('ROS_HOME', raising=False)
    monkeypatch.delenv('ROS_LOG_DIR', raising=False)
    folder = tmp_path / '.ros' / 'calib_ros'
    with cell_and_child() as (cell, child):
        cell.play(part(recording, 0.0, 12.0))
        cell.spin_until(lambda: begun(folder))
        cell.spin_until(lambda: len(samples_in(folder)) == 10)
        child.kill()
    (path,) = folder.glob('*Z.csv')
    with path.open('a') as file:
        file.write('1700000000,0.1,0.')  # a row that a crash of the machine cut off
    with cell_and_child(resume='true') as (cell, child):
        output = child.wait_for('ready to calibrate')
        assert 'was cut off and is ignored' in output
        assert f'resumed 10 poses of {path}' in output
        cell.play(part(recording, 12.0, 24.0))
        cell.spin_until(lambda: len(samples_in(folder)) == 20)
        all_heard(cell)
        answer = cell.done('identify')
        assert '22 poses' in answer.message  # two stops waited when it was killed
    expected = direct(recording)
    expected.finish()
    survived = [s for s in expected.samples if not 10.0 < (s.stamp_ns - START) * 1e-9 < 12.0]
    for kept, sample in zip(samples_in(folder), survived, strict=True):
        assert kept.stamp_ns == sample.stamp_ns
        np.testing.assert_array_equal(kept.joints, sample.joints)
        np.testing.assert_array_equal(kept.position, sample.position)


def test_a_session_that_could_go_on_is_told_of(journal):
    """After a crash the node began another without a word."""
    (path,) = journal.glob('*Z.csv')
    with Cell() as cell:
        told = cell.log()
        node = cell.start(chain='ur10e', data_dir=str(journal))
        said = f'to continue {path}, start with resume:=true'
        cell.spin_until(lambda: any(said in each.msg for each in told))
        assert node.session.samples == []
        node._archive._unmark()  # as if killed
        again = cell.start(chain='ur10e', data_dir=str(journal), resume=True)
        said = f'the last session had no poses: to continue {path} instead, delete {journal}'
        cell.spin_until(lambda: any(said in each.msg for each in told))
        assert again.session.samples == []


SLOW_IDENTIFICATION = """
import time
from calib_ros.files import loading
from calib_ros.ros import node
def identify_model(problem, model, progress):
    print('identifying', flush=True)
    time.sleep(600.0)
loading.identify_model = identify_model
close = node.CalibrationNode.close
def noisy(self):
    print('joining', flush=True)
    return close(self)
node.CalibrationNode.close = noisy
"""


def test_ended_while_an_identification_runs(journal):
    command = ('-c', SLOW_IDENTIFICATION + NODE)
    with cell_and_child(data_dir=journal, resume='true', command=command) as (cell, child):
        cell.start_call('identify')
        child.wait_for('identifying')
        child.process.send_signal(signal.SIGTERM)
        child.process.send_signal(signal.SIGINT)  # a second one harms nothing
        child.wait_for('joining')
        child.process.send_signal(signal.SIGINT)
        assert child.end() == 0, child.output
        assert 'Traceback' not in child.output
        assert 'ended before the answer of ~/identify' in child.output


def test_a_calibration_that_was_not_saved_is_told_of(journal):
    """Who forgot ~/save heard nothing, and had to identify again."""
    first = {'chain': 'ur10e', 'data_dir': str(journal)}
    with Cell() as cell:
        told = cell.log()
        node = cell.start(**first, resume=True)
        cell.done('identify')
        assert 'not saved' not in cell.done('save').message
        assert 'not saved' not in cell.done('load').message
        cell.done('identify')
        assert cell.done('load').message.endswith(UNSAVED)
        cell.done('identify')
        cell.executor.remove_node(node)
        cell.nodes.remove(node)
        assert node.close()
        cell.spin_until(lambda: any(UNSAVED in each.msg and each.level == 30 for each in told))
        node = cell.start(**first)
        assert 'not saved' not in cell.done('load').message
    assert sum(UNSAVED in each.msg and each.level == 30 for each in told) == 1


SLOW_SAVE = """
import signal, threading, time
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored below nohup
from calib_ros.report import page
from calib_ros.ros import node
node.JOIN_TIMEOUT = 0.1
late, close = threading.Event(), node.Archive.close
def closed(self):  # after the threads that are late were found
    late.set()
    return close(self)
node.Archive.close = closed
def slow(*given):
    print('rendering', flush=True)
    late.wait()
    time.sleep(0.5)
    return '<html>'
page.render = slow
"""


def test_ended_while_a_calibration_is_saved(journal):
    """By a terminal that is closed: its thread could end in the middle of a file."""
    command = ('-c', SLOW_SAVE + NODE)
    with cell_and_child(data_dir=journal, resume='true', command=command) as (cell, child):
        cell.done('identify')
        cell.start_call('save')
        child.wait_for('rendering')
        assert child.end(signal.SIGHUP) == 0, child.output
    (path,) = journal.glob('*Z.html')
    said = f'~/save: saved to {path.with_suffix(".yaml")}, {path}'
    assert said in child.output
    assert 'waiting for ~/save' in child.output
    assert 'ended before' not in child.output
    assert not [each for each in journal.iterdir() if '.partial' in each.name]


def test_ended_while_it_waits_for_the_robot(tmp_path):
    with Child(chain='robot_description', data_dir=tmp_path) as child:
        child.wait_for('waiting up to')
        assert child.end(signal.SIGTERM) == 0, child.output
        assert 'no robot_description' not in child.output


def test_the_last_stop_is_kept_at_the_end(tmp_path, recording):
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        cell.play(topics(recording))
        assert len(cell.node.session.samples) == STOPS - 2
    assert len(samples_in(tmp_path)) == STOPS


def test_a_node_that_could_keep_no_samples_ends_with_one_clear_line(tmp_path, capsys, ended_by):
    """As with a journal on a disk that is not there, or of another user."""
    path = tmp_path / 'ur10e_20260102T030405000006Z.csv'
    path.symlink_to(tmp_path / 'elsewhere' / path.name)
    unkept, unread = 'poses cannot be kept in /proc/nope', f'cannot read {path}'
    for folder, said in (('/proc/nope', unkept), (tmp_path, unread)):
        assert ended_by('chain:=ur10e', f'data_dir:={folder}', 'resume:=true') == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f'calibration_node: {said}')


def test_a_full_disk(tmp_path, recording):
    with cell_and_child(data_dir=tmp_path) as (cell, child):
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        told = cell.listen(String, '/calibration_node/status')
        count = 0

        def play(begin, end):  # a second at a time: else joint states may overtake poses by more
            nonlocal count
            for second in range(begin, end):
                streams = part(recording, second, second + 1.0)
                cell.play(streams)
                count += sum(isinstance(m, JointState) for each in streams.values() for m in each)
                cell.spin_until(
                    lambda n=count: heard and int(values_of(heard[-1])['joint states']) >= n
                )

        play(0, 6)
        cell.spin_until(lambda: begun(tmp_path))
        cell.spin_until(lambda: len(samples_in(tmp_path)) == 4)
        (path,) = tmp_path.glob('*Z.csv')
        _, hard = resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE)
        full = path.stat().st_size + 100  # there is room for a part of the next row
        resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (full, hard))
        play(6, 16)

        def level(wanted, said):
            cell.spin_until(lambda: heard and heard[-1].status[0].level == wanted)
            assert said in heard[-1].status[0].message

        level(DiagnosticStatus.ERROR, 'poses are in memory only')
        cell.spin_until(lambda: told and told[-1].data.startswith('poses are in memory only: '))
        assert heard[-1].status[0].message.count('in memory only') == 1
        cell.spin_until(lambda: values_of(heard[-1])['samples'] == '14')
        assert len(samples_in(tmp_path)) == 4
        answer = cell.refused('clear')
        assert 'poses are in memory only and would be lost' in answer.message
        cell.done('identify')
        resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (100, hard))
        unsaved = cell.refused('save')
        assert 'too large for this disk' in unsaved.message
        assert unsaved.message.endswith('write to another place')
        assert [*tmp_path.glob('*yaml*')] == [path.with_suffix('.settings.yaml')]
        resource.prlimit(child.process.pid, resource.RLIMIT_FSIZE, (hard, hard))
        cell.spin_until(lambda: heard[-1].status[0].level != DiagnosticStatus.ERROR)
        assert 'memory' not in heard[-1].status[0].message
        assert ' poses' in heard[-1].status[0].message
        cell.spin_until(lambda: 'memory' not in told[-1].data)
        assert len(samples_in(tmp_path)) == 16
        cell.done('save')
        assert child.end(signal.SIGINT) == 0
        assert child.output.count('poses are kept in memory only') == 1


def test_an_answer_says_that_a_pose_is_in_memory_only(tmp_path, recording):
    """*pose 1 taken* was all that who called heard of it."""
    joints, poses = topics(recording).values()
    folder = tmp_path / 'data'
    with Cell(chain='ur10e', data_dir=str(folder), mode='triggered') as cell:
        cell.play({'joint_states': joints[:28], 'measured_pose': poses[:4]})
        shutil.rmtree(folder)
        folder.write_text('in the way')
        answer = cell.done('capture').message
        assert answer.startswith('poses are in memory only: ')
        assert '; pose 1 taken' in answer
        folder.unlink()


def test_a_journal_that_an_editor_saves_meanwhile_begins_anew(tmp_path, recording):
    """Rows that the editor did not have were lost without a word."""
    with Cell(chain='ur10e', data_dir=str(tmp_path)) as cell:
        told = cell.log()
        cell.play(part(recording, 0.0, 6.0))
        (path,) = tmp_path.glob('*Z.csv')
        os.truncate(path, path.stat().st_size // 2)
        warned = f'{path} was deleted, moved or changed by another program: all poses of this'
        cell.spin_until(lambda: any(warned in each.msg for each in told))
        stamps = [each.stamp_ns for each in cell.node.session.samples]
        samples, _ = read_journal(cell.node._archive.journal, 6)
        assert stamps
        assert [each.stamp_ns for each in samples] == stamps


def test_a_closed_node_does_not_end_its_executor(tmp_path):
    """In a process with other nodes, spun on a thread, its services were waited for without it."""
    with Cell() as cell:
        node, heard = cell.start(chain='ur10e', data_dir=str(tmp_path)), threading.Event()
        others = threading.Thread(target=cell.executor.spin)
        others.start()
        cell.nodes.remove(node)
        node.close()
        cell.peer.create_timer(0.01, heard.set)
        found = heard.wait(PATIENCE)
        cell.executor.shutdown()
        others.join()
        assert found


def test_an_executor_that_asks_no_callback_group(tmp_path):
    """It ended at two callbacks of one service; one created later is served by itself."""
    experimental = pytest.importorskip('rclpy.experimental')
    with Cell() as cell:
        cell.executor.remove_node(cell.peer)
        cell.executor.shutdown()
        cell.executor = experimental.EventsExecutor(context=cell.context)
        cell.executor.add_node(cell.peer)
        node = cell.start(chain='ur10e', data_dir=str(tmp_path), use_sim_time=True)
        node.create_service(Trigger, '~/later', lambda *_: Trigger.Response(message='here'))
        assert 'no poses to fit' in cell.call('identify').message
        assert cell.call('later').message == 'here'
