# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements of an arm with two joints, as they arrive at a collector."""

from dataclasses import fields

import numpy as np
from streams import stamps, stops

from calib_ros.sampling.collector import Collector
from calib_ros.sampling.sample import Sample
from calib_ros.sampling.slices import Piece, Slice, StreamKey
from calib_ros.settings import Settings

POSE = StreamKey('', '', False, False, False)
JUDGE = StreamKey('', '', True, False, False)
WIRE = StreamKey('distance', '', False, True, False)
NOISE = 5e-5
STOPS = np.array([[0.0, 0.0], [0.5, -0.4], [1.0, 0.3], [0.2, 0.9], [-0.6, 0.1]])
MOVE = STAND = 1.0
REST = 'measurements: of a stop that already has its pose'


def place(joints):
    """Return what a tracker would see of an arm with two joints."""
    return np.stack([joints[:, 0], joints[:, 1], joints[:, 0] + joints[:, 1]], axis=1) + 2.0


def joint_events(motion, end, rate=100.0, begin=0.0):
    """Return (time of arrival [s], stream, stamp, numbers) of joint samples."""
    times = np.arange(begin, end, 1.0 / rate)
    return [
        (time, (0, 1), stamp, row)
        for time, stamp, row in zip(times.tolist(), stamps(times), motion(times), strict=True)
    ]


def pose_events(motion, end, rate=50.0, begin=0.0, key=POSE, delay=0.0, noise=NOISE, seed=1):
    """Return (time of arrival [s], stream, stamp, numbers) of measurements stamped late."""
    times = np.arange(begin + 0.003, end, 1.0 / rate)
    values = place(motion(times))
    values = values + np.random.default_rng(seed).normal(scale=noise, size=values.shape)
    if key.distance:
        values = np.linalg.norm(values, axis=1, keepdims=True)
    return [
        (time + delay, key, stamp, value)
        for time, stamp, value in zip(times.tolist(), stamps(times + delay), values, strict=True)
    ]


def play(made, *events, finish=True):
    """Play events in the order of their arrival and return the samples."""
    come = []
    for time, *what in sorted((e for each in events for e in each), key=lambda event: event[0]):
        if len(what) > 1:
            come.append((time, *what))
            continue
        give(made, come)
        come = []
        what[0](made)
    give(made, come)
    if finish:
        made.finish()
    return made.sampler.take()[0]


def give(made, come):
    """Let a collector take (time, stream, stamp, numbers), as a session does."""
    streams = {}
    for k, (_, key, *what) in enumerate(come):
        streams.setdefault(key, []).append((k, *what))
    pieces = [
        Piece(key, *(np.array(each) for each in zip(*rows, strict=True)))
        for key, rows in streams.items()
    ]
    left = Slice.of(pieces, round(1e9 * made.settings.delay)) if pieces else ()
    while len(left):
        count, rounds = made.reach(left, lambda stamp: False)
        made.take(left.between(0, count))
        if rounds:
            made.round(rounds)
        left = left.between(count, len(left))


def collector(**settings):
    return Collector([True, True], Settings(**settings))


def toured(*more, end=9.5, **settings):
    """Return a collector that hears of joints and poses on a tour, and its samples."""
    made, motion = collector(**settings), tour()
    return made, play(made, joint_events(motion, end), pose_events(motion, end), *more)


def tour(**settings):
    return stops(STOPS, settings.pop('move', MOVE), settings.pop('stand', STAND))


def assert_same(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        for name in (field.name for field in fields(Sample)):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
