# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows what a running node does, and nothing else."""

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from rclpy.node import Node
from ros_cell import LATCHED, Cell
from std_msgs.msg import String
from test_node_robot import urdf_of

from calib_ros.kinematics.chain_file import load_chain

ROOT = Path(__file__).parents[2]
POLICY = ROOT / 'security' / 'policy.xml'
FRAMES = '/tf_static'
AT_START = {'/robot_description'}
"""Heard at the start only, with chain:=robot_description."""


def profile():
    policy = ET.parse(POLICY).getroot()
    assert (policy.tag, policy.get('version')) == ('policy', '0.2.0')
    (enclave,) = policy.findall('enclaves/enclave')
    assert enclave.get('path') == '/calib_ros/calibration_node'
    (found,) = enclave.findall('profiles/profile')
    return found


def allowed(kind, rule):
    """Return the full names that the policy allows, in the way of sros2."""
    found = profile()
    namespace, node = found.get('ns'), found.get('node')
    names = []
    for group in found.findall(f'{kind}s'):
        assert set(group.attrib.values()) == {'ALLOW'}
        if rule in group.attrib:
            names += [element.text for element in group.findall(kind)]
    assert len(names) == len(set(names))
    full = {'~': f'{namespace}{node}', '/': ''}
    return {full.get(name[0], namespace) + name.removeprefix('~') for name in names}


@pytest.fixture
def names(tmp_path):
    """Return a function that tells what the graph knows of a running node."""
    with Cell(chain='ur10e', data_dir=str(tmp_path), use_sim_time=True) as cell:

        def names(what):
            ask = getattr(cell.node, f'get_{what}_names_and_types_by_node')
            return {name for name, _ in ask('calibration_node', '/')}

        wanted = allowed('service', 'reply')  # discovery takes its time, also of oneself
        cell.spin_until(lambda: names('service') >= wanted)
        yield names


def test_topics_and_services_are_those_of_a_running_node(names):
    own = {'/rosout'}  # one publisher serves all nodes of a name in a process
    assert allowed('topic', 'publish') - own == (names('publisher') | {FRAMES}) - own
    assert allowed('topic', 'subscribe') == names('subscriber') | AT_START
    assert allowed('service', 'reply') == names('service')
    assert allowed('service', 'request') == names('client') == set()
    rules = {rule for group in profile() for rule in group.attrib}
    assert rules == {'publish', 'subscribe', 'reply'}


def test_frames_found_may_be_published(tmp_path):
    pytest.importorskip('tf2_msgs.msg', reason='make test builds it')
    assert FRAMES in allowed('topic', 'publish')
    with Cell(chain='ur10e', data_dir=str(tmp_path), base_frame='base') as cell:
        assert FRAMES in {each.topic_name for each in cell.node.publishers}


def test_what_is_heard_at_the_start_is_allowed(tmp_path, monkeypatch):
    heard = set()
    create = Node.create_subscription

    def note(self, kind, topic, *arguments, **more):
        subscription = create(self, kind, topic, *arguments, **more)
        heard.add(subscription.topic_name)
        return subscription

    text = urdf_of(load_chain('ur10e'))
    with Cell() as cell:
        cell.peer.create_publisher(String, 'robot_description', LATCHED).publish(String(data=text))
        monkeypatch.setattr(Node, 'create_subscription', note)
        node = cell.start(chain='robot_description', data_dir=str(tmp_path))
        by_graph = {
            name
            for name, _ in node.get_subscriber_names_and_types_by_node('calibration_node', '/')
        }
    assert heard - by_graph == AT_START
    assert heard <= allowed('topic', 'subscribe')
