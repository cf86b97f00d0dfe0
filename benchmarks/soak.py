# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Flood the node with messages for minutes: is every one accounted for, and what does it cost?

    python benchmarks/soak.py [--quick] [--json] [--minutes 10] [--rates 1000 1000] [--frames 30]

Four processes: the node; a publisher of joint states and poses of an arm that moves and stops; a
node with empty callbacks on the same executor, which hears the same messages; and this one, which
watches. An identification is asked for in the warm-up and another one later.

The empty callbacks take messages one by one and deserialised, as nodes usually do; ours takes them
serialised and by the batch, so that it may cost less than they do.

With `--frames` the poses come on a topic tf, each in a message of so many transforms, which needs
tf2_msgs.

Memory is resident memory after the warm-up. Every sample is kept, in memory as on disk, so what
kept samples are known to need is told apart from the growth, of which nothing should be left.

`lost_uncounted` is what was sent and neither received by the node nor counted by it as lost on the
way, plus what it received and does not account for: received poses = in samples + waiting + not
used + dropped.
"""

import copy
import csv
import json
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import bench
import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from calib_ros.apply.simulation import Cell, faulty, measure, motion
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.usable import NO_STAMP

LEG = 1.2
"""Time from one stop to the next [s], half of it in motion."""
WARM = 240.0
"""Time [s] until memory is watched; allocators have settled by then."""
TICK = 1.0 / os.sysconf('SC_CLK_TCK')
COUNTS = ('dropped', 'not used', 'note')
PAGE = os.sysconf('SC_PAGE_SIZE') / 1e6


def measurement(frames):
    """Return the type of the measurements, their topic, and what makes one of a pose."""
    if not frames:
        return PoseStamped, 'measured_pose', lambda each: each
    from tf2_msgs.msg import TFMessage

    others = [TransformStamped(child_frame_id=f'link_{k}') for k in range(1, frames)]

    def among_others(each):
        at, turn = each.pose.position, each.pose.orientation
        found = TransformStamped(header=each.header, child_frame_id='target')
        found.transform = Transform(translation=Vector3(x=at.x, y=at.y, z=at.z), rotation=turn)
        for other in others:
            other.header.stamp = each.header.stamp
        return TFMessage(transforms=[*others, found])

    return TFMessage, 'tf', among_others


def publisher(rates, namespace, frames):
    """Publish probes until a line comes on stdin, then the arm until another one does."""
    node = Node('publisher', namespace=namespace)
    truth = faulty(load_chain('ur10e'), Cell(), np.random.default_rng(0))
    names = list(truth.joint_names)
    kind, topic, made = measurement(frames)
    out = {
        JointState: node.create_publisher(JointState, 'joint_states', QoSProfile(depth=2000)),
        kind: node.create_publisher(kind, topic, QoSProfile(depth=2000)),
    }
    unstamped = JointState(name=names, position=[0.0] * len(names))
    probes = unstamped, made(PoseStamped(header=Header(frame_id='tracker')))
    os.set_blocking(0, False)
    while not sys.stdin.buffer.read(1):
        for probe in probes:
            out[type(probe)].publish(probe)  # without a stamp: counted, and no more
        time.sleep(0.1)
    sent, slowest = dict.fromkeys(('joints', 'poses'), 0), 0.0
    wall, start, leg = time.time_ns(), time.monotonic(), 0
    rng = np.random.default_rng(1)
    goals = truth.random_joints(1, rng)
    while not sys.stdin.buffer.read(1):
        goals = np.concatenate([goals[-1:], truth.random_joints(1, rng)])
        due = sorted(
            [(float(t), m) for t, m in joint_messages(goals, leg * LEG, rates[0], wall, names)]
            + [
                (float(t), made(m)) for t, m in poses(truth, goals, leg * LEG, rates[1], wall, rng)
            ],
            key=lambda item: item[0],
        )
        for moment, message in due:
            late = time.monotonic() - start - moment
            slowest = max(slowest, late)
            if late < 0.0:
                time.sleep(-late)
            out[type(message)].publish(message)
            sent['joints' if type(message) is JointState else 'poses'] += 1
        leg += 1
    print(json.dumps(sent | {'slowest': slowest}), flush=True)
    sys.stdin.buffer.raw.readall()
    node.destroy_node()


def angles(goals, begin, times):
    """Return joint values (N, n) of a smooth move after a stop."""
    return motion(goals, 0.5 * LEG, 0.5 * LEG)(times - begin)


def header(wall, moment, frame_id=''):
    """Return a header stamped with a moment [s] after `wall` [ns]."""
    seconds, nanoseconds = divmod(wall + round(moment * 1e9), 1_000_000_000)
    return Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def joint_messages(goals, begin, rate, wall, names):
    """Yield joint states with their times."""
    times = begin + np.arange(round(LEG * rate)) / rate
    for moment, values in zip(times, angles(goals, begin, times).tolist(), strict=True):
        yield moment, JointState(header=header(wall, moment), name=names, position=values)


def poses(truth, goals, begin, rate, wall, rng):
    """Yield measured poses with their times."""
    times = begin + np.arange(round(LEG * rate)) / rate + 0.3e-3
    measured = measure(truth, angles(goals, begin, times), rng, 5e-5, 1e-4)
    quats = se3.to_quat(measured.rotations).tolist()
    for moment, at, turn in zip(times, measured.positions.tolist(), quats, strict=True):
        pose = Pose(
            position=Point(x=at[0], y=at[1], z=at[2]),
            orientation=Quaternion(x=turn[0], y=turn[1], z=turn[2], w=turn[3]),
        )
        yield moment, PoseStamped(header=header(wall, moment, 'tracker'), pose=pose)


def empty(namespace, frames):
    """Hear the messages with callbacks that only count."""
    node = Node('empty', namespace=namespace)
    counts = [0, 0]

    def hear(which):
        def callback(message):
            counts[which] += getattr(message, 'transforms', [message])[-1].header.stamp.sec > 0

        return callback

    qos = QoSProfile(depth=2000, reliability=qos_profile_sensor_data.reliability)
    node.create_subscription(JointState, 'joint_states', hear(0), qos)
    kind, topic, _ = measurement(frames)
    node.create_subscription(kind, topic, hear(1), qos)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    os.set_blocking(0, False)
    while not sys.stdin.buffer.read(1):
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            executor.spin_once(timeout_sec=0.1)
    print(json.dumps({'joints': counts[0], 'poses': counts[1]}), flush=True)
    sys.stdin.buffer.raw.readall()


class Process:
    """A child process, and what it uses."""

    def __init__(self, *command):
        self.process = subprocess.Popen(
            [sys.executable, *map(str, command)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def tell(self):
        """Send it a character."""
        self.process.stdin.write('x')
        self.process.stdin.flush()

    def answer(self):
        """Send it a character; return the JSON that it prints."""
        self.tell()
        return json.loads(self.process.stdout.readline())

    @property
    def cpu(self):
        """Return the CPU time used so far [s]."""
        text = Path(f'/proc/{self.process.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(text[11]) + int(text[12])) * TICK

    @property
    def memory(self):
        """Return the resident memory [MB]."""
        return int(Path(f'/proc/{self.process.pid}/statm').read_text().split()[1]) * PAGE


def run(options, seconds, folder):
    """Run the soak; return what was found."""
    watch = Node('watch')
    executor = SingleThreadedExecutor()
    executor.add_node(watch)
    heard, mine = [], str(os.getpid())

    def listen(message):
        heard.extend(each for each in message.status if each.hardware_id == mine)

    watch.create_subscription(DiagnosticArray, '/diagnostics', listen, 10)
    identify = watch.create_client(Trigger, f'{options.namespace}/calibration_node/identify')

    def spin_until(predicate, timeout=60.0):
        end = time.monotonic() + timeout
        while not predicate():
            if time.monotonic() > end:
                raise TimeoutError('the node does not answer')
            executor.spin_once(timeout_sec=0.1)

    def values():
        return {item.key: item.value for item in heard[-1].values} if heard else {}

    parameters = ('-p', 'chain:=ur10e', '-p', f'data_dir:={folder}', '-p', f"serial:='{mine}'")
    if options.frames:
        parameters += ('-p', "sources:=['tf parent=tracker child=target']")
    rules = ('-r', f'__ns:={options.namespace}')
    node = Process('-m', 'calib_ros.ros.node', '--ros-args', *parameters, *rules)
    same = ('--namespace', options.namespace, '--frames', options.frames)
    idle = Process(__file__, '--role', 'empty', *same)
    flood = Process(__file__, '--role', 'publisher', '--rates', *options.rates, *same)
    probes = tuple(f'dropped {kind}: {NO_STAMP}' for kind in ('joints', 'measurements'))
    try:
        spin_until(lambda: all(name in values() for name in probes))
        spin_until(identify.service_is_ready)
        flood.tell()
        warm = min(WARM, 0.5 * seconds)
        start = time.monotonic()
        spin_until(lambda: time.monotonic() - start > 0.8 * warm, warm)
        asked = identify.call_async(Trigger.Request())
        spin_until(lambda: asked.done() and time.monotonic() - start > warm, 2.0 * warm)
        count = len(heard)
        spin_until(lambda: len(heard) > count)
        first = values()
        begin = (time.monotonic(), node.cpu, idle.cpu, received(first))
        memory, asked, answered = [], None, None
        while time.monotonic() - start < seconds:
            executor.spin_once(timeout_sec=0.1)
            if not memory or time.monotonic() - memory[-1][0] > 1.0:
                memory.append((time.monotonic(), node.memory, idle.memory))
            if asked is None and time.monotonic() - start > 0.6 * seconds:
                asked, called = identify.call_async(Trigger.Request()), time.monotonic()
            if asked is not None and asked.done() and answered is None:
                answered = time.monotonic() - called
        # Diagnostics come once a second: what they count and the time of them belong together.
        count = len(heard)
        spin_until(lambda: len(heard) > count)
        end = (time.monotonic(), node.cpu, idle.cpu, received(values()))
        sent = flood.answer()
        spin_until(lambda: len(heard) > 1 and steady(heard))
        last, other = values(), idle.answer()
        (journal,) = folder.glob('*Z.csv')  # of now: at its end the node writes what still waits
        with journal.open() as file:
            in_samples = sum(int(row['count']) for row in csv.DictReader(file))
    finally:
        for each in (flood, idle, node):
            each.process.terminate()
            each.process.wait()
    messages, span = end[3] - begin[3], end[0] - begin[0]
    probed = {name: int(last[name]) for name in probes}
    lost = {
        'joints': sent['joints'] + probed[probes[0]] - int(last['joint states']),
        'poses': sent['poses'] + probed[probes[1]] - int(last['poses']),
    }
    told = sum(int(value) for key, value in last.items() if key.startswith('lost on'))
    accounted = in_samples + int(last['poses waiting'])
    for key, value in last.items():
        if key.startswith(('dropped measurements', 'not used measurements')):
            accounted += int(value)
    unaccounted = int(last['poses']) - accounted
    times, sizes, idles = np.array(memory).T
    grown = slope(times, sizes)
    kept = round(0.06 * sample_size() * (int(last['samples']) - int(first['samples'])) / span, 1)
    return {
        'seconds': round(span, 1),
        'sent': {key: sent[key] for key in ('joints', 'poses')},
        'publisher late by at most [s]': round(sent['slowest'], 3),
        'lost': lost,
        'unaccounted poses': unaccounted,
        'lost on the way, as the node tells': told,
        'lost_uncounted': abs(sum(lost.values()) - told) + abs(unaccounted),
        'lost by the empty node': sent['joints'] + sent['poses'] - sum(other.values()),
        'samples': int(last['samples']),
        'account': {
            k: v for k, v in last.items() if k.startswith(('dropped', 'not used', 'note'))
        },
        'identify': {
            'success': bool(asked and asked.done() and asked.result().success),
            'seconds': None if answered is None else round(answered, 2),
        },
        'memory growth [kB/min]': grown,
        'memory growth of the empty node [kB/min]': slope(times, idles),
        'memory of kept samples [kB/min]': kept,
        'memory growth without kept samples [kB/min]': round(grown - kept, 1),
        'memory by the minute [MB]': [round(float(size), 1) for size in sizes[::60]],
        'cpu of the node [us/message]': round(1e6 * (end[1] - begin[1]) / messages, 1),
        'cpu of empty callbacks [us/message]': round(1e6 * (end[2] - begin[2]) / messages, 1),
        'ratio': round((end[1] - begin[1]) / (end[2] - begin[2]), 3),
        'share of a core': round((end[1] - begin[1]) / span, 3),
    }


def slope(times, sizes):
    """Return how fast memory [MB] grows over times [s], in kB a minute."""
    return round(6e4 * float(np.polyfit(times, sizes, 1)[0]), 1)


def sample_size(count=1000):
    """Return the bytes that a kept sample of a full pose takes."""
    one = Sample(1, np.zeros(6), np.zeros(6), np.zeros(3), np.eye(3), spread=1e-5)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    samples = [copy.deepcopy(one) for _ in range(count)]
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return (after - before) / len(samples)


def received(values):
    """Return how many messages the node has counted."""
    return int(values['joint states']) + int(values['poses'])


def steady(heard):
    """Tell whether nothing has changed between the last two diagnostics."""
    first, second = (
        [v.value for v in each.values if v.key in ('joint states', 'poses')] for each in heard[-2:]
    )
    return first == second


def main():
    """Play the part that is asked for."""
    options = bench.options(
        __doc__,
        minutes=10.0,
        rates={'type': float, 'nargs': 2, 'default': (1000.0, 1000.0), 'metavar': 'HZ'},
        frames=0,
        quick=False,
        json=False,
        namespace=(f'/soak_{os.getpid()}', 'of its processes'),
        role=({'choices': ('publisher', 'empty')}, 'of one of them'),
    )
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 101))
    rclpy.init(args=[])
    if options.role == 'publisher':
        publisher(options.rates, options.namespace, options.frames)
    elif options.role == 'empty':
        empty(options.namespace, options.frames)
    else:
        with tempfile.TemporaryDirectory() as folder:
            os.environ['ROS_HOME'] = folder
            seconds = 30.0 if options.quick else 60.0 * options.minutes
            found = run(options, seconds, Path(folder))
        bench.tell(found, options.json)


if __name__ == '__main__':
    main()
