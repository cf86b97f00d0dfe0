# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
import pytest

from calib_ros.errors import ConfigError
from calib_ros.sampling.messages import MEASURES, TRANSFORMS
from calib_ros.sampling.source_texts import parse_source, parse_sources
from calib_ros.sampling.sources import RANGEFINDER, STANDARD, Source


def test_keys_in_any_order():
    assert parse_source('/wire type=Range').device == RANGEFINDER  # an origin of its own
    assert parse_source('/wire type=Range device=left').device == 'left'
    source = parse_source(
        '/cam  target=board eye_in_hand=true type=PoseStamped device=left validation=true'
    )
    kind = 'geometry_msgs/msg/PoseStamped'
    assert source == Source('/cam', kind, 'left', 'board', eye_in_hand=True, validation=True)


@pytest.mark.parametrize('kind', sorted(MEASURES))
def test_a_short_type_will_do(kind):
    short = kind.rpartition('/')[2]
    assert parse_source(f'/x type={short}') == parse_source(f'/x type={kind}')
    assert parse_source(f'/x type={kind}').type == kind


@pytest.mark.parametrize(
    ('text', 'judges'),
    [
        ('validation_pose', True),
        ('/cell/validation_2', True),
        ('/validation_cell/pose', False),
        ('/pose_validation_', False),
        ('/validation_pose validation=false', False),
        ('/pose validation=true', True),
    ],
)
def test_the_last_name_of_the_topic_tells_what_judges_unless_it_is_said(text, judges):
    assert parse_source(text).validation is judges


@pytest.mark.parametrize(
    ('texts', 'said'),
    [
        (['', '   ', 'device=left', 'type=PoseStamped /pose'], 'must begin with its topic'),
        (['/x devise=left', '/x left', '/x =left'], 'unknown key'),
        (['/x devise=left'], 'did you mean "device"'),
        (['/x type=Pose'], 'source "/x": unknown type'),
        (['/x eye_in_hand=', '/x eye_in_hand=1', '/x validation=True'], 'must be true or false'),
        (['/x device=a.b', '/x device=a,b', '/x target=a.b'], r'without \. and ,'),
        (
            ['/tf', '/tf parent=tool child=/tool', '/x type=TFMessage'],
            'needs parent=FRAME child=FRAME',
        ),
        (['/x type=PoseStamped parent=a child=b'], 'needs parent=FRAME child=FRAME'),
        (['/x type=RigidBodies', '/x type=NamedPoseArray child=a'], 'NamedPoseArray, and only t'),
    ],
)
def test_what_is_no_source_is_refused(texts, said):
    for text in texts:
        with pytest.raises(ConfigError, match=said):
            parse_source(text)


def test_the_standard_sources_can_be_written_down():
    """What the node listens to by itself is what these lines say."""
    for source in STANDARD:
        assert parse_source(f'{source.topic} type={source.type}') == source


def test_a_topic_is_named_once_or_once_for_each_pair_of_frames():
    assert parse_sources(['/a', '/b']) == (Source('/a'), Source('/b'))
    pairs = ['/bodies parent=world child=a', '/bodies parent=world child=b']
    assert parse_sources(pairs)[0] == Source('/bodies', TRANSFORMS, parent='world', child='a')
    bodies = [f'/x parent=w child=a type={kind}' for kind in ('RigidBodies', 'NamedPoseArray')]
    for texts, said in (
        (['/a', '/b', '/a device=left'], '"/a" is named twice'),
        ([*pairs, pairs[0]], '"/bodies world a" is named twice'),
        ([bodies[0], bodies[1].replace('=a', '=b')], '"/x" is named with different types'),
    ):
        with pytest.raises(ConfigError, match=said):
            parse_sources(texts)
