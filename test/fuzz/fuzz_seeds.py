# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the seeds of the corpus: a small valid input or more for each target."""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from fuzz_targets import ARM, CORPUS, MARK
from recorded import (
    distance,
    joint_state,
    odometry,
    point_stamped,
    pose_stamped,
    pose_with_covariance,
    serialised,
    transform_stamped,
    write,
)

from calib_ros.files.tables import cells, columns
from calib_ros.identification.records import nominal_document
from calib_ros.kinematics.chain_file import dump_chain
from calib_ros.sampling.messages import DECODERS, JOINT_STATE
from calib_ros.sampling.sample import Sample

COVARIANCE = np.diag([1e-8] * 6)
POSE = 'geometry_msgs/msg/PoseStamped'
URDF = """<robot name="arm">
  <link name="base"/><link name="upper">
  <inertial><origin xyz="0 0 1"/><mass value="2"/></inertial></link>
  <link name="tool0"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3"/></joint>
  <joint name="b" type="prismatic"><parent link="upper"/><child link="tool0"/>
    <origin xyz="0.4 0 0" rpy="1.57 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1"/></joint>
</robot>
"""
TRAJECTORY = """header: {frame_id: ''}
joint_names: [a, b, c]
points:
- {positions: [0.1, 0.2, 0.3], velocities: [0.0, 0.0, 0.0], time_from_start: {sec: 1, nanosec: 0}}
- positions:
  - 0.2
  - 0.3
  - 0.1
  velocities: [0.0, 1e-3, 0.0]
---
"""
FOREIGN = """separator: ';'
decimal: ','
length: mm
angle: deg
euler: ZYX
columns: {q1: A1, q2: A2, q3: J3 + J2, x: X, y: Y, z: Z, r1: A, r2: B, r3: C}
===
A1;A2;J2;J3;X;Y;Z;A;B;C
1,5;2;3;4;100;2;3;10;20;30
1,6;2;3;4;100;2;3;10;20;30
"""
OPTIONS = (
    '--sigma-position\n0.001\n--fixed\na.a',
    '--priors\n*.a=0.001',
    '--mode\ncontinuous',
    '--sources\n/pose type=PoseStamped device=t',
    '--model\nratio+backlash',
    '--folds\n3',
)


MAKERS = {
    JOINT_STATE: lambda stamp: joint_state(stamp, (0.1, 0.2, stamp // (40 * 10**7) * 0.1)),
    POSE: pose_stamped,
    'geometry_msgs/msg/PoseWithCovarianceStamped': lambda stamp: pose_with_covariance(
        stamp, COVARIANCE
    ),
    'geometry_msgs/msg/PointStamped': point_stamped,
    'geometry_msgs/msg/TransformStamped': transform_stamped,
    'nav_msgs/msg/Odometry': lambda stamp: odometry(stamp, COVARIANCE),
    'sensor_msgs/msg/Range': lambda stamp: distance(stamp, 1.5),
}


def made(kind, k):
    return serialised(MAKERS[kind](k * 10**7))


def bag(path, storage, mode, count):
    types = {f'/{kind[:4]}': kind for kind in (JOINT_STATE, POSE)}
    content = [(t, k, made(kind, k)) for k in range(1, count) for t, kind in types.items()]
    write(path, types, content, storage, mode)


def put(name, number, data):
    folder = CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f'seed{number}').write_bytes(data if isinstance(data, bytes) else data.encode())


def main():
    position = np.array([1.0, 2.0, 3.0])
    samples = [
        Sample(
            k * 10**9,
            np.array([0.1 * k, 0.2, 0.3]),
            position=position,
            rotation=np.eye(3),
            covariance=COVARIANCE if k % 2 else None,
            approach=np.ones(3),
            device='d',
            target=f't{k % 2}',
            validation=k == 3,
        )
        for k in range(1, 5)
    ]
    rows = '\n'.join(','.join(cells(sample)) for sample in samples)
    whole = ','.join(columns(3)) + '\n' + rows + '\n'
    put('journal', 0, whole)
    put('table', 0, whole)
    put('table', 1, 'q1,q2,q3,x,y,z,split\n0.1,0.2,0.3,1,2,3,train\n0.2,0.2,0.3,1,2,3,test\n')
    put('table', 2, 'q1,q2,q3,distance,session,device\n0.1,0.2,0.3,1.5,A,w\n0.2,0.2,0.3,1.6,A,w\n')
    put('table', 3, 'q1,q2,q3,location,socket\n0.1,0.2,0.3,L,1\n0.2,0.2,0.3,L,2\n')
    put('foreign', 0, FOREIGN)
    put('foreign', 1, 'quaternion: wxyz\n===\nq1 q2 q3 x y z qw qx qy qz\n1 2 3 1 2 3 1 0 0 0\n')
    square = 'columns: 4\nrows: 3\nsquare: 0.03\nmarker: 0.02\n'
    put('board', 0, f'type: charuco\n{square}dictionary: DICT_5X5_250\n')
    put('board', 1, f'type: markers\n{square}dictionary: DICT_APRILTAG_36h11\n')
    matrix = '{rows: 3, cols: 3, data: [900, 0, 640, 0, 900, 480, 0, 0, 1]}'
    bent = '{rows: 1, cols: 5, data: [0.1, 0, 0, 0, 0]}'
    put(
        'lens',
        0,
        f'camera_matrix: {matrix}\ndistortion_model: plumb_bob\ndistortion_coefficients: {bent}\n',
    )
    put(
        'detections', 0, 'image,corner,u,v\na.png,0,1.5,2\na.png,1,3,4\nb.png,0,1,2\nb.png,5,6,7\n'
    )
    put('detections', 1, 'image,q1,q2,q3\na.png,1,2,3\n')
    put('waypoints', 0, 'q1,q2,q3\n0.1,0.2,0.3\n')
    put('waypoints', 1, 'x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,1\n')
    put(
        'program_csv',
        0,
        'name,q1,q2,q3,s1,s2,s3\nP1,0.1,0.2,0.3,1,-1,0\n"P,2",0.2,0.2,0.3,1,1,1\n',
    )
    put('program_yaml', 0, TRAJECTORY)
    put('chain', 0, dump_chain(ARM.with_effects(('a.ratio',))))
    put(
        'chain',
        1,
        'convention: modified\njoints:\n- &j {name: a, a: 0, alpha: 0, d: 0, theta: 0}\n'
        '- {<<: *j, name: b}\n'
        'tool: {xyz: [0, 0, 1e-1], quat_xyzw: [0, 0, 0, 1], fixed: true}\n',
    )
    record = {
        'accepted': True,
        'rms_mm_after': 0.1,
        'world_frame': 't',
        'nominal': nominal_document(ARM),
    }
    put('calibration', 0, dump_chain(ARM.with_offsets({'a.d': 1e-3}), record))
    put('urdf', 0, URDF)
    for k, text in enumerate(OPTIONS):
        put('settings', k, text)
    put('command', 0, 'identify\n--csv\ntable.csv\n--chain\nur10e\n--out\nout')
    put('command', 1, 'chain\nur10e')
    put('command', 2, 'verify\nm.csv\n--chain\nur10e\n--calibration\nc\n--tolerance\n0.1')
    put('command', 3, 'workspace\nresult\n--chain\nur10e\n--out\no\n--joint-box\n1\n2')
    put(
        'message',
        0,
        MARK.join(
            bytes([k % 7]) + made([JOINT_STATE, *DECODERS][k % 7], 20 + k) for k in range(14)
        ),
    )
    put('message', 1, MARK.join(b'\0' + made(JOINT_STATE, k) for k in range(1, 9)))
    with tempfile.TemporaryDirectory() as name:
        for k, (storage, mode) in enumerate(
            [('mcap', 'none'), ('mcap', 'storage'), ('sqlite3', 'none')]
        ):
            path = Path(name) / 'bag'
            bag(path, storage, mode, 12)
            (file,) = (each for each in path.iterdir() if each.suffix in ('.mcap', '.db3'))
            put('bag_mcap' if storage == 'mcap' else 'bag_sqlite3', k, file.read_bytes())
            if k == 0:
                put('metadata', 0, (path / 'metadata.yaml').read_text())
            for each in path.iterdir():
                each.unlink()
            path.rmdir()


if __name__ == '__main__':
    main()
