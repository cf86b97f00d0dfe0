# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Read a recording of ten minutes with our reader and with others: CPU time per message.

    python benchmarks/bags.py [--minutes 10] [--environments FOLDER] [--quick] [--json]

500 Hz of joint states and 100 Hz of poses of an arm that moves and stops, in bags of both
storages, compressed and not. In each, side by side:

    decoded             our replay up to joint values and poses, which nobody takes
    replay              the whole of it: samples of all stops
    rosbags             its reader and its deserialiser, messages that nobody takes
    mcap-ros2-support   likewise, in an environment of its own (see `peers.py`); mcap only

`foreign` is the same bag with 100 MB of pictures that nobody wants between the messages: by what
factor it takes longer to replay.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bench
import numpy as np
from peers import CACHE, environment, machine
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calib_ros.apply.simulation import Cell, drive, faulty, measure
from calib_ros.files.bags import replay
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.se3 import to_quat
from calib_ros.sampling.messages import JOINT_STATE
from calib_ros.sampling.session import CalibrationSession

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
POSE, IMAGE = 'geometry_msgs/msg/PoseStamped', 'sensor_msgs/msg/Image'
TOPICS = {'/joint_states': JOINT_STATE, '/measured_pose': POSE, '/camera': IMAGE}
BAGS = {
    'sqlite3': (StoragePlugin.SQLITE3, None),
    'sqlite3, messages in zstd': (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    'mcap': (StoragePlugin.MCAP, None),
    'mcap, chunks in zstd': (StoragePlugin.MCAP, CompressionMode.STORAGE),
}
PICTURES = 100
OTHER = """
import sys, time
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
begin, count = time.process_time(), 0
with open(sys.argv[1], 'rb') as file:
    topics = ['/joint_states', '/measured_pose']
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    for _ in reader.iter_decoded_messages(topics=topics):
        count += 1
print(1e6 * (time.process_time() - begin) / count)
"""


def messages(minutes):
    """Return topics, stamps and serialised messages in the order of their stamps."""
    rng = np.random.default_rng(0)
    nominal = load_chain('ur10e')
    true = faulty(nominal, Cell(), rng)
    cell = Cell(joint_rate=500.0, move=0.6, dwell=0.6)
    goals = nominal.random_joints(round(60.0 * minutes / 1.2), rng)
    stamps, joints, _ = drive(goals, cell, 1_700_000_000_000_000_000)
    poses = measure(true, joints[::5], rng, 5e-5, 2e-4)
    quats = to_quat(poses.rotations)
    names, none = list(nominal.joint_names), np.zeros(0)

    def header(stamp_ns, frame_id):
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        time = TYPES['builtin_interfaces/msg/Time'](seconds, nanoseconds)
        return TYPES['std_msgs/msg/Header'](time, frame_id)

    found = []
    for k, stamp in enumerate(stamps.tolist()):
        message = TYPES[JOINT_STATE](header(stamp, ''), names, joints[k], none, none)
        found.append(('/joint_states', stamp, STORE.serialize_cdr(message, JOINT_STATE)))
        if k % 5 == 0:
            point = TYPES['geometry_msgs/msg/Point'](*poses.positions[k // 5].tolist())
            turn = TYPES['geometry_msgs/msg/Quaternion'](*quats[k // 5].tolist())
            pose = TYPES['geometry_msgs/msg/Pose'](point, turn)
            message = TYPES[POSE](header(stamp, 'tracker'), pose)
            found.append(('/measured_pose', stamp, STORE.serialize_cdr(message, POSE)))
    return found


def with_pictures(wanted):
    """Return messages with large ones of a foreign topic between them."""
    header = TYPES['std_msgs/msg/Header'](TYPES['builtin_interfaces/msg/Time'](1, 0), '')
    data = np.random.default_rng(0).integers(0, 256, 1_000_000).astype(np.uint8)
    image = TYPES[IMAGE](header, 1000, 1000, 'mono8', 0, 1000, data)
    blob = STORE.serialize_cdr(image, IMAGE)
    found = []
    for k, each in enumerate(wanted):
        if k % (len(wanted) // PICTURES) == 0:
            found.append(('/camera', each[1], blob))
        found.append(each)
    return found


def write(path, content, storage, compression):
    """Write a bag."""
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=STORE)
            for topic, kind in TOPICS.items()
        }
        for topic, stamp, data in content:
            writer.write(connections[topic], stamp, data)


class Nobody(CalibrationSession):
    """A session that takes decoded messages and does nothing with them."""

    def miss(self, kind, count, cause):
        """Do nothing."""

    def take(self, parts):
        """Do nothing."""

    def finish(self):
        """Do nothing."""


def by_rosbags(path):
    """Read and deserialise all messages that we read."""
    with Reader(path) as reader:
        wanted = [each for each in reader.connections if each.topic != '/camera']
        for connection, _, data in reader.messages(wanted):
            STORE.deserialize_cdr(data, connection.msgtype)


def by_other(python, path):
    """Return the CPU time per message [us] of mcap-ros2-support."""
    (file,) = path.glob('*.mcap')
    done = subprocess.run([python, '-c', OTHER, file], stdout=subprocess.PIPE, check=True)
    return float(done.stdout)


def measured(path, large, count, other):
    """Return CPU times per message [us] of one bag and of that with pictures.

    The shortest of three times, all in turn, so that they share what else the machine does.
    """
    sessions, chain = [], load_chain('ur10e')

    def whole():
        sessions.append(CalibrationSession(chain))
        replay(path, sessions[-1])

    def timed(work):
        begin = time.process_time()
        work()
        return 1e6 * (time.process_time() - begin) / count

    works = {
        'decoded': lambda: timed(lambda: replay(path, Nobody(chain))),
        'replay': lambda: timed(whole),
        'rosbags': lambda: timed(lambda: by_rosbags(path)),
        'foreign': lambda: timed(lambda: replay(large, Nobody(chain))),
    }
    if other and any(path.glob('*.mcap')):
        works['mcap-ros2-support'] = lambda: by_other(other, path)
    rounds = [{name: work() for name, work in works.items()} for _ in range(3)]
    account = sessions[-1].account()
    assert account.joint_states + account.poses == count, account
    return {name: min(each[name] for each in rounds) for name in works}


def main():
    """Write the bags, read them and print what it took."""
    options = bench.options(__doc__, minutes=10.0, environments=CACHE, quick=False, json=False)
    minutes = 0.5 if options.quick else options.minutes
    other = environment(options.environments, 'mcap-ros2-support', not options.quick)
    content = messages(minutes)
    found = {}
    with tempfile.TemporaryDirectory() as name:
        for k, (kind, how) in enumerate(BAGS.items()):
            path, large = Path(name) / f'{k}', Path(name) / f'{k}_large'
            write(path, content, *how)
            write(large, with_pictures(content), *how)
            figures = measured(path, large, len(content), other)
            for peer in ('rosbags', 'mcap-ros2-support'):
                if peer in figures:
                    figures[f'{peer} / decoded'] = figures[peer] / figures['decoded']
            figures['foreign'] /= figures['decoded']
            found[kind] = figures
    found = {'machine': machine(), 'messages': len(content), 'bags': found}
    bench.tell(found, options.json)


if __name__ == '__main__':
    sys.exit(main())
