# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A real node in real rclpy and how well it hears."""

import signal

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_cell import Cell, Child, joint_messages, stamp_ns, topics, values_of
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from calib_ros.errors import ConfigError
from calib_ros.ros import inputs as inputs_module

BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_an_overridden_qos(tmp_path, recording):
    override = {'qos_overrides./joint_states.subscription.reliability': 'reliable'}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        deaf = cell.peer.create_publisher(JointState, 'joint_states', BEST_EFFORT)
        said = (
            '/joint_states is published best effort, but heard as reliable: '
            'set qos_overrides to best_effort'
        )
        cell.spin_until(lambda: heard and said in heard[-1].status[0].message)
        assert heard[-1].status[0].level == DiagnosticStatus.WARN
        short = f'no poses to fit; {said} ... full text: '
        assert cell.refused('identify').message.startswith(short)
        for topic, policy in (
            ('/joint_states', ReliabilityPolicy.RELIABLE),
            ('/measured_pose', ReliabilityPolicy.BEST_EFFORT),
        ):
            (offered,) = cell.peer.get_subscriptions_info_by_topic(topic)
            assert offered.qos_profile.reliability == policy
        deaf.publish(joint_messages(recording)[0])
        cell.play(topics(recording))
        assert cell.node.session.received['joints'] == len(recording.joints)
        cell.done('identify')
        del heard[:]
        cell.spin_until(lambda: heard and said in heard[-1].status[0].message)  # another is heard
        cell.peer.destroy_publisher(deaf)
        cell.spin_until(lambda: said not in heard[-1].status[0].message)


def test_a_topic_of_another_type_is_told(cell):
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    context = rclpy.Context()  # a participant of its own: one has one type for each topic
    rclpy.init(context=context, args=[], domain_id=cell.domain)
    other = Node('other', context=context)
    other.create_publisher(PointStamped, 'measured_pose', 10)
    said = '/measured_pose is published as geometry_msgs/msg/PointStamped, not as PoseStamped'
    status = cell.listen(String, 'calibration_node/status')
    cell.spin_until(lambda: heard and said in heard[-1].status[0].message)
    assert heard[-1].status[0].level == DiagnosticStatus.WARN
    cell.spin_until(lambda: status and said in status[-1].data)  # the operator reads no other
    answer = cell.refused('identify')
    short = f'no poses to fit; {said}: set type in sources ... full text: '
    assert answer.message.startswith(short)
    assert 'no poses to fit' in cell.in_full(answer)
    other.destroy_node()
    cell.spin_until(lambda: said not in heard[-1].status[0].message)
    context.try_shutdown()


@pytest.mark.parametrize(
    ('policy', 'value', 'said'),
    [
        ('reliability', 'often', 'often'),
        ('reliability', 'unknown', 'invalid qos_overrides for "joint_states"'),
        ('history', 'sometimes', 'sometimes'),
        ('history', 'unknown', 'invalid qos_overrides for "joint_states"'),
        ('depth', 0, 'must be >= 1'),
        ('depth', -1, 'must be >= 1'),  # it was told as an invalid allocator
        ('reliabilty', 'reliable', r'did you mean .*/joint_states.subscription.reliability'),
        ('durability', 'volatile', 'unknown parameter'),
    ],
)
def test_a_qos_that_there_is_not_is_refused(empty, tmp_path, policy, value, said):
    override = {f'qos_overrides./joint_states.subscription.{policy}': value}
    with pytest.raises(ConfigError, match=said):
        empty.start(chain='ur10e', data_dir=str(tmp_path), **override)


def test_a_queue_that_was_full_is_told(tmp_path, recording):
    override = {'qos_overrides./joint_states.subscription.depth': 5}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        publisher = cell.publisher(JointState, 'joint_states')
        for message in joint_messages(recording)[:20]:
            publisher.publish(message)
        cell.spin_until(lambda: any('lost on /joint_states' in r.status[0].message for r in heard))
        assert cell.node.session.received['joints'] < 20
        assert int(values_of(heard[-1])['queue of /joint_states full']) > 0
        cell.spin_until(lambda: 'are lost' not in heard[-1].status[0].message)


def test_a_short_queue_that_loses_nothing_is_no_loss(tmp_path, recording):
    """With depth 1 each message was told as lost ones."""
    override = {'qos_overrides./joint_states.subscription.depth': 1}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        publisher, messages = cell.publisher(JointState, 'joint_states'), joint_messages(recording)

        def play(burst, count):
            for k in range(0, 20, burst):
                for message in messages[k : k + burst]:
                    publisher.publish(message)
                before = cell.node.session.received['joints']
                cell.spin_until(lambda n=before: cell.node.session.received['joints'] > n)
            del heard[:]
            cell.spin_until(lambda: heard)
            assert (int(values_of(heard[-1])['queue of /joint_states full']) > 0) == count

        play(1, False)
        play(2, True)


def test_a_gripper_that_publishes_apart_is_no_loss(cell, recording):
    """Each message was dropped, and the diagnostics were WARN for ever."""
    heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
    arm = joint_messages(recording)[:50]
    finger = [
        JointState(header=each.header, name=['finger'], position=[0.01 * k])
        for k, each in enumerate(arm)
    ]
    cell.play({'joint_states': [each for both in zip(arm, finger, strict=True) for each in both]})
    del heard[:]
    cell.spin_until(lambda: heard)
    values = values_of(heard[-1])
    assert values['not used joints: none of the joints in the message'] == '50'
    assert values['note joint that moves but is not in the chain: finger'] == '1'
    assert not any(key.startswith('dropped') for key in values)
    assert not any('messages are dropped' in report.status[0].message for report in heard)


def test_messages_of_seconds_wait_while_the_node_is_busy(tmp_path, recording):
    """Joint values in degrees let the node judge poses for five seconds: a fifth was lost."""
    override = {'qos_overrides./joint_states.subscription.reliability': 'reliable'}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:
        publisher = cell.publisher(JointState, 'joint_states')
        for k, message in enumerate(joint_messages(recording) * 3):
            publisher.publish(message)
            assert k % 500 or publisher.wait_for_all_acked(Duration(seconds=60))
        cell.spin_until(lambda: cell.node.session.received['joints'] == 3600)


@pytest.mark.parametrize('depth', [{}, {'depth': 8000}])
def test_a_queue_holds_no_more_than_fast_dds_and_an_overflow_is_told(tmp_path, recording, depth):
    """Of 20,000 asked for it kept the first 5,000, and nobody was told of the others."""
    policies = {'reliability': 'reliable', **depth}
    override = {f'qos_overrides./joint_states.subscription.{k}': v for k, v in policies.items()}
    with Cell(chain='ur10e', data_dir=str(tmp_path), **override) as cell:
        heard = cell.listen(DiagnosticArray, '/diagnostics', 10)
        publisher = cell.publisher(JointState, 'joint_states')
        for k, message in enumerate(joint_messages(recording) * 5):
            publisher.publish(message)
            assert depth or k % 500 or publisher.wait_for_all_acked(Duration(seconds=60))
        said = 'messages are lost on /joint_states'
        cell.spin_until(lambda: any(said in each.status[0].message for each in heard))
        assert int(values_of(heard[-1])['queue of /joint_states full']) > 0
        if not depth:
            assert cell.node.session.received['joints'] == 5000
            assert cell.node.session.latest[0] == stamp_ns(joint_messages(recording)[-1])


def test_what_is_lost_while_the_process_stands_still_is_counted(tmp_path, recording):
    with Cell() as cell, Child(domain=cell.domain, chain='ur10e', data_dir=tmp_path) as child:
        reports = cell.listen(DiagnosticArray, '/diagnostics', 10)
        status = cell.listen(String, 'calibration_node/status')
        publisher = cell.publisher(JointState, 'joint_states', ReliabilityPolicy.BEST_EFFORT)

        def told():
            values = values_of(reports[-1]) if reports else {}
            names = 'joint states', 'lost on /joint_states'
            return [int(values.get(name, 0)) for name in names]

        sent = 0
        message = joint_messages(recording)[0]

        def publish(count=1):
            nonlocal sent
            for _ in range(count):
                publisher.publish(message)
            sent += count

        def settled():
            """Return how many were heard and lost, once two more reports say so."""
            count = len(reports)
            cell.spin_until(lambda: len(reports) >= count + 2)
            return told()

        cell.spin_until(lambda: publish() or told()[0] > 0)
        first = sent - sum(settled())
        child.process.send_signal(signal.SIGSTOP)
        publish(3000)
        child.process.send_signal(signal.SIGCONT)
        # DDS tells of a loss with the next message that it takes, and any one may be lost, too.
        cell.spin_until(lambda: publish() or told()[1] > 0)
        missing = sent - first - settled()[0]
        cell.spin_until(lambda: publish() or told()[1] >= missing)
        assert missing > 1000
        cell.spin_until(lambda: any(' % of /joint_states is lost' in s.data for s in status))


def test_a_large_share_is_told_as_lost_as_long_as_more_is():
    heard = inputs_module.TopicState(count=80)
    heard.note_lost(20)
    heard.look(1.0, 1.0)
    assert heard.share_lost == 0.2
    inputs = object.__new__(inputs_module.Inputs)
    inputs._topics, inputs.failures = {'/joint_states': heard}, []
    assert not inputs.troubles()  # it is among the failures
    heard.count = 200
    heard.look(2.0, 1.0)
    assert heard.share_lost == 0.0
    heard.note_lost(21)  # of so many that it is an exception
    heard.look(3.0, 1.0)
    assert heard.share_lost == 0.0
    assert inputs.troubles() == ['messages are lost on /joint_states']


def test_what_dds_tells_of_losses_never_goes_below_zero():
    """A total of -2147483645 came as 18446744071562067971 once."""
    heard = inputs_module.TopicState()
    totals = 3, 2**64 - 2147483645, 2**64 - 2147483640, 5, 9, 9
    for total, lost in zip(totals, (3, 3, 8, 8, 12, 12), strict=True):
        heard.note_lost(total)
        assert heard.lost == lost
    heard = inputs_module.TopicState()  # which goes on where it overflows
    for total in (2**29, 2**30, 3 * 2**29, 2**31 - 1, 2**64 - 2**31, 2**64 - 2**31 + 2):
        heard.note_lost(total)
    assert heard.lost == 2**31 + 2


def test_no_executor_waits_for_the_inputs_or_the_time_or_their_events(tmp_path):
    """Fast DDS wakes it for events as long as a message waits: a core would be busy."""
    with Cell(chain='ur10e', data_dir=str(tmp_path), use_sim_time=True) as cell:
        served = {*cell.node.subscriptions, *cell.node.waitables}
        for topic in ('/joint_states', '/clock'):
            (heard,) = (s for s in Node.subscriptions.fget(cell.node) if s.topic_name == topic)
            assert heard.event_handlers
            assert served.isdisjoint([heard, *heard.event_handlers])
