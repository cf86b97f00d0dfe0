# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements out of messages of motion capture that hold several bodies by name."""

import re
import shlex
import struct

import numpy as np
import pytest
from recorded import MS, TYPES, TYPESTORE, header, pose, record, session_of, standing, storages
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_types_from_msg
from test_transforms import TIMES, frame, link, tf

from calib_ros.errors import ConfigError, InputError
from calib_ros.files.stored import LARGEST_MESSAGE
from calib_ros.kinematics import se3
from calib_ros.sampling.source_texts import parse_source

MOCAP = 'mocap4r2_msgs/msg/RigidBodies'
NAMED = 'motion_capture_tracking_interfaces/msg/NamedPoseArray'
TEXTS = {
    'mocap4r2_msgs/msg/Marker': 'int8 USE_NAME=0\nint8 id_type\nint32 marker_index\n'
    'string marker_name\ngeometry_msgs/Point translation\n',
    'mocap4r2_msgs/msg/RigidBody': 'string rigid_body_name\nMarker[] markers\n'
    'geometry_msgs/Pose pose\n',
    MOCAP: 'std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/RigidBody[] rigidbodies\n',
    'motion_capture_tracking_interfaces/msg/NamedPose': 'string name\ngeometry_msgs/Pose pose\n'
    'float32 quality\n',
    NAMED: 'std_msgs/Header header\nNamedPose[] poses\n',
}
UNREADABLE = f'the definition of {MOCAP} in the bag cannot be read'
for name, text in TEXTS.items():
    TYPESTORE.register(get_types_from_msg(text, name))


def message(kind, stamp_ns, bodies):
    """Return a message that holds bodies (name to matrix)."""
    found = []
    for name, matrix in bodies.items():
        at = pose(matrix[:3, 3].tolist(), se3.to_quat(matrix[:3, :3]).tolist())
        if kind == MOCAP:
            point = TYPES['geometry_msgs/msg/Point'](1.0, 2.0, 3.0)
            marker = TYPES['mocap4r2_msgs/msg/Marker'](2, 7, 'm', point)
            found.append(TYPES['mocap4r2_msgs/msg/RigidBody'](name, [marker] * 4, at))
        else:
            kinds = TYPES['motion_capture_tracking_interfaces/msg/NamedPose']
            found.append(kinds(name, at, 0.5))
    head = header(stamp_ns, 'hall')
    return TYPES[kind](head, 3, found) if kind == MOCAP else TYPES[kind](head, found)


def measured(rng, kind, stamps=TIMES):
    """Return messages of the robot's base, the tool and something that is never seen."""
    base, lost = frame(rng), frame(rng)
    lost[0, 3] = np.nan
    tools = [frame(rng) for _ in stamps]
    return tools, [
        message(kind, ms * MS, {'base': base, 'tool': tool} | ({'lost': lost} if k % 2 else {}))
        for k, (ms, tool) in enumerate(zip(stamps, tools, strict=True))
    ]


def line(kind, child='tool'):
    return f'/bodies type={kind.rpartition("/")[2]} parent=hall child={child}'


@storages
@pytest.mark.parametrize('kind', [MOCAP, NAMED])
def test_a_body_is_worth_its_transform_to_the_last_digit(tmp_path, rng, kind, storage):
    tools, come = measured(rng, kind)
    content = standing(come, '/bodies')
    session, found = session_of(record(tmp_path / 'bag', content, storage), sources=(line(kind),))
    moving = [tf(link('hall', 'tool', ms * MS, t)) for ms, t in zip(TIMES, tools, strict=True)]
    as_tf = record(tmp_path / 'tf', standing(moving, '/tf'))
    expected, _ = session_of(as_tf, sources=('/tf parent=hall child=tool',))
    assert found == ()
    assert session.account() == expected.account()
    assert session.account().poses == session.account().samples == len(TIMES)
    assert {(each.frame_id, each.target) for each in session.samples} == {('hall', 'tool')}
    for name in ('stamps_ns', 'joints', 'positions', 'rotations'):
        np.testing.assert_array_equal(
            getattr(session.problem().observations, name),
            getattr(expected.problem().observations, name),
        )


def test_several_bodies_are_several_targets(tmp_path, rng):
    _, come = measured(rng, MOCAP)
    path = record(tmp_path / 'bag', standing(come, '/bodies'))
    session, _ = session_of(path, sources=(line(MOCAP), f'{line(MOCAP, "base")} validation=true'))
    found = [(each.target, each.validation) for each in session.samples]
    assert sorted(found) == [('base', True)] * len(TIMES) + [('tool', False)] * len(TIMES)


@storages
@pytest.mark.parametrize('kind', [MOCAP, NAMED])
def test_a_bag_without_named_sources_lists_the_bodies(tmp_path, rng, kind, storage):
    _, come = measured(rng, kind, range(10, 1000, 5))
    path = record(tmp_path / 'bag', standing(come, '/bodies'), storage)
    with pytest.raises(InputError, match='has no pose topic') as caught:
        session_of(path)
    assert 'hall to tool at 200 Hz' in str(caught.value)
    assert f'such as "{line(kind, "base")}"' in str(caught.value)
    with pytest.raises(InputError) as caught:
        session_of(path, sources=(line(kind, 'tol'),))
    assert 'nothing links frame "tol" to "hall" on /bodies' in str(caught.value)
    assert 'hall to tool at 200 Hz' in str(caught.value)


def test_the_line_that_is_proposed_is_of_use_whatever_a_body_is_called(tmp_path, rng):
    come = [
        message(NAMED, ms * MS, {"Rigid Body 1 of 'Tom'": frame(rng)}) for ms in range(10, 1000, 5)
    ]
    path = record(tmp_path / 'bag', standing(come, '/bodies'))
    with pytest.raises(InputError, match='has no pose topic') as caught:
        session_of(path)
    (proposed,) = re.findall('such as (.*)$', str(caught.value))
    (text,) = shlex.split(proposed)
    session, _ = session_of(path, sources=(text,))
    assert {each.target for each in session.samples} == {"Rigid Body 1 of 'Tom'"}
    with pytest.raises(ConfigError, match='closing quotation'):
        parse_source("/bodies type=NamedPoseArray parent=hall child='Tom")


def test_bodies_are_read_beside_a_wrong_index_too(tmp_path, rng):
    _, come = measured(rng, MOCAP)
    path = record(tmp_path / 'bag', standing(come, '/bodies'))
    with Reader(path) as reader:
        (chunk,) = reader.storage.storages[0].chunks
    (file,) = path.glob('*.mcap')
    right, wrong = (
        struct.pack('<QQ', chunk.chunk_start_offset + off, chunk.chunk_length) for off in (0, 7)
    )
    file.write_bytes(file.read_bytes().replace(right, wrong))
    session, (warning,) = session_of(path, sources=(line(MOCAP),))
    assert session.account().samples == len(TIMES)
    assert 'is damaged (' in warning
    assert ', 0 of ' in warning


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('', f'does not define {MOCAP}'),
        ('std_msgs/Header header\nnonsense', UNREADABLE),
        (f'{TEXTS[MOCAP]}# {"x" * LARGEST_MESSAGE}', UNREADABLE),
        ('std_msgs/Header header\nuint32 a=b', UNREADABLE),
    ],
)
def test_a_definition_that_is_not_there_or_cannot_be_read_is_told(tmp_path, rng, text, said):
    _, come = measured(rng, MOCAP, [105])
    path = record(tmp_path / 'bag', standing(come, '/bodies'), texts=[('/bodies', text)])
    with pytest.raises(InputError, match=said):
        session_of(path, sources=(line(MOCAP),))


@pytest.mark.parametrize(
    'text',
    [
        'std_msgs/Header header\nuint32 class\nuint32 x',
        'uint8[] rigidbodies',
        'uint8[<=9] rigidbodies\nmocap4r2_msgs/RigidBody header',
        'mocap4r2_msgs/RigidBodies header',
    ],
)
def test_another_message_of_that_name_is_told(tmp_path, rng, text):
    _, come = measured(rng, MOCAP, [105])
    path = record(tmp_path / 'bag', standing(come, '/bodies'), texts=[('/bodies', text)])
    _, warnings = session_of(path, sources=(line(MOCAP),))
    assert 'a message on /bodies cannot be decoded' in ' '.join(warnings)
