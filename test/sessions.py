# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sessions of a UR5e with errors, and samples of it."""

from functools import cache

import numpy as np
from fits import NOISE, SIGMAS
from streams import POSE, TRACKER, joint_state, of_joints, pose, stamps, stops, take

from calib_ros import CalibrationSession, Settings, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.kinematics.se3 import exp_rotation
from calib_ros.sampling.sample import Sample

UR5E = load_chain('ur5e')
TRUE = faulty(UR5E, Cell(), np.random.default_rng(11))


def seen(true, count, rng, oriented=True, start=0, **more):
    """Return samples of a true chain at random configurations."""
    joints = true.random_joints(count, rng)
    found = measure(true, joints, rng, *NOISE, oriented=oriented)
    turns = found.rotations if oriented else [None] * count
    rows = enumerate(zip(joints, found.positions, turns, strict=True), start + 1)
    return [Sample(k, q, position=p, rotation=r, **more) for k, (q, p, r) in rows]


def samples(count=30, seed=5, true=TRUE, **more):
    return seen(true, count, np.random.default_rng(seed), **more)


def session(*given, **settings):
    made = CalibrationSession(UR5E, Settings(**SIGMAS | settings))
    made.restore([each for some in given for each in some])
    return made


def drive(made, configurations, sources, start=0.0, rate=25.0):
    """Let an arm stand at each configuration while sources (source, type, maker) measure.

    Configurations may be a number of random ones.
    """
    if isinstance(configurations, int):
        configurations = UR5E.random_joints(configurations, np.random.default_rng(1))
    motion = stops(configurations, 0.8, 0.8)
    end = 1.6 * len(configurations)
    times = np.arange(0.0, end, 1.0 / rate)
    rows = motion(times)
    come = []
    for row, stamp in zip(rows, stamps(times + start).tolist(), strict=True):
        come.append(of_joints(joint_state(stamp, UR5E.joint_names, row.tolist())))
        come += [(source, kind, make(stamp, row)) for source, kind, make in sources]
    take(made, *come)
    return end


def tracker(true=TRUE, seed=3):
    rng, there = np.random.default_rng(seed), cache(lambda *row: true.forward(np.array([row]))[0])

    def message(stamp, row):  # as `measure`, which checks what it returns
        found = there(*row)
        position, turn = (rng.normal(scale=scale, size=3) for scale in NOISE)
        return pose(stamp, found[:3, 3] + position, exp_rotation(turn) @ found[:3, :3])

    return TRACKER, POSE, message
