# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What becomes of sessions whose messages are wrong in a way that no message shows?

    python benchmarks/streams.py [--only NAME] [--json]

A simulated UR10e (errors of 0.5 mm and 1 mrad, noise 0.05 mm and 0.2 mrad) moves to 40 poses and
stops at each: 1.2 s measured at 50 Hz, 0.6 s at 10 Hz, and the latter by positions alone; for `in
motion` it hardly stops, and each measurement counts (20 Hz). Joint states come at 125 Hz. Each row
is one imperfection in several sizes.

- `accepted`, and of these `worse`: more than 1 mm further from the true arm than the same session
  without the imperfection, RMS at 1000 configurations after the best base and tool; `largest` of
  these errors.
- `silent`: accepted with seven outliers or more, or worse, and neither warning nor remark.
- `untold`: refused without a warning, a remark or a named mistake.
"""

import json
from collections import Counter
from functools import cache

import bench
import numpy as np
from cell_simulator import misfit

from calib_ros.apply.simulation import Cell, faulty, measure, motion
from calib_ros.decision.reasons import Rule
from calib_ros.errors import CalibrationError
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.sampling.session import CalibrationSession
from calib_ros.sampling.slices import Part
from calib_ros.sampling.sources import Source
from calib_ros.settings import Settings

CHAIN = load_chain('ur10e')
STOPS, MOVE, MANY, MUCH = 40, 1.5, 7, 1.0
DESIGNS = {'50 Hz': (50.0, 1.2, True), '10 Hz': (10.0, 0.6, True), 'points': (10.0, 0.6, False)}
MOTION = {'in motion': (20.0, 0.05, True)}
START = 1_700_000_000


def smoothed(values, step, time):
    """Return values (N, w) behind a low-pass of a time constant [s]."""
    found = values.copy()
    for k in range(1, len(values)):
        found[k] += (found[k - 1] - values[k]) * np.exp(-step / time)
    return found


class Session:
    """Streams of one session, which imperfections change."""

    def __init__(self, design, number):
        self.rng = np.random.default_rng([number, 0])
        self.true = faulty(CHAIN, Cell(), self.rng)
        rate, self.stand, self.oriented = design
        self.motion = motion(CHAIN.random_joints(STOPS, self.rng), MOVE, self.stand)
        self.end = STOPS * (MOVE + self.stand)
        self.joint_times = np.arange(0.0, self.end + 0.4, 0.008)
        self.times = np.arange(0.003, self.end + 0.3, 1.0 / rate)
        self.joint_stamps, self.stamps = self.joint_times.copy(), self.times.copy()
        self.joints = self.motion(self.joint_times)
        self.seen_at = self.times  # when the device saw what it sends
        self.smoothing = 0.0

    def run(self, mode):
        """Return the error [mm] of an accepted calibration or None, and what was told."""
        seen_at = np.clip(self.seen_at, 0.0, None)
        joints = self.motion(seen_at)
        if self.smoothing:  # of the target, for which that of the joints stands
            fine = np.arange(0.0, self.end + 0.4, 0.002)
            behind = smoothed(self.motion(fine), 0.002, self.smoothing)
            joints = behind[np.searchsorted(fine, seen_at)]
        seen = measure(self.true, joints, self.rng, 5e-5, 2e-4, self.oriented)
        rows = seen.positions
        if self.oriented:
            rows = np.hstack([rows, se3.to_quat(seen.rotations)])
        session = CalibrationSession(CHAIN, Settings(mode=mode))
        places = np.argsort(np.argsort(np.concatenate([self.joint_times, self.times + 0.01])))
        first, second = np.split(places, [len(self.joint_times)])
        names = ('', *session.joint_names)
        session.take(
            [
                Part(first, None, names, nanoseconds(self.joint_stamps), self.joints),
                Part(second, Source('pose'), ('d',), nanoseconds(self.stamps), rows),
            ]
        )
        session.finish()
        try:
            result = session.identify()
        except CalibrationError:
            return None, 0, bool(session.warnings)
        told = bool(session.warnings or result.remarks)
        told |= any(each.rule in (Rule.MISTAKE, Rule.SCALE) for each in result.refusals)
        q = CHAIN.random_joints(1000, np.random.default_rng(1))
        wanted, found = self.true.forward(q)[:, :3, 3], result.chain.forward(q)
        error = 1e3 * bench.rms(misfit(wanted, found[:, :3, :3], found[:, :3, 3]))
        return (error if result.accepted else None), len(result.outliers), told


def nanoseconds(times):
    """Return times [s] as stamps [ns]."""
    return START * 10**9 + np.rint(times * 1e9).astype(np.int64)


def poses_jump(one, size):
    """Move the clock of the device in the middle."""
    one.stamps = one.stamps + size * (one.times > 0.5 * one.end)


def joints_jump(one, size):
    """Set back the clock of the joints in the middle."""
    one.joint_stamps = one.joint_stamps - size * (one.joint_times > 0.5 * one.end)


def late(one, size):
    """Stamp poses late."""
    one.stamps = one.stamps + size


def jitter(one, size):
    """Stamp poses late by anything up to a time."""
    one.stamps = np.sort(one.stamps + one.rng.uniform(0.0, size, len(one.stamps)))


def drift(one, size):
    """Let the clock of the device run fast."""
    one.stamps = one.stamps * (1.0 + size)


def filtered(one, size):
    """Let the device smooth."""
    one.smoothing = size


def joints_filtered(one, size):
    """Let the driver of the arm smooth."""
    one.joints = smoothed(one.joints, 0.008, size)


def frozen(one, size):
    """Let the joint states freeze at a share of the session."""
    at = int(size * len(one.joints))
    one.joints[at:] = one.joints[at]


IMPERFECTIONS = {
    'none': (poses_jump, (0.0,)),
    'device clock jumps': (poses_jump, (-1.3, -0.9, -0.5, 0.3, 0.5, 0.9, 1.0, 1.3, 2.0, 3.0)),
    'joint clock set back': (joints_jump, (0.3, 0.5, 0.8, 0.9, 1.0, 1.1, 1.3, 2.0, 3.0)),
    'poses late': (late, (-0.1, -0.05, 0.05, 0.1, 0.2, 0.5, 0.9)),
    'stamps jitter': (jitter, (0.05, 0.1, 0.4)),
    'device clock drifts': (drift, (1e-4, 1e-3, 5e-3)),
    'device smooths': (filtered, (0.02, 0.05, 0.1, 0.2, 0.5)),
    'joint states smoothed': (joints_filtered, (0.02, 0.05, 0.1, 0.2, 0.5)),
    'joint states freeze': (frozen, (0.3, 0.5, 0.7)),
}


@cache
def best(name, number):
    """Return the error [mm] that the session has without an imperfection."""
    design, mode = (DESIGNS | MOTION)[name], 'continuous' if name in MOTION else 'dwell'
    return Session(design, number).run(mode)[0] or 0.0


def row_of(change, sizes, designs):
    """Return the counts of one imperfection."""
    row, largest = Counter(), 0.0
    for name, design in designs.items():
        for number, size in enumerate(sizes):
            one = Session(design, number)
            change(one, size)
            error, outliers, told = one.run('continuous' if name in MOTION else 'dwell')
            row['sessions'] += 1
            if error is None:
                row['untold'] += not told
                continue
            worse = error > best(name, number) + MUCH
            row['accepted'] += 1
            row['worse'] += worse
            row['silent'] += not told and (worse or outliers >= MANY)
            largest = max(largest, error)
    return {key: row[key] for key in ('sessions', 'accepted', 'worse', 'silent', 'untold')} | {
        'largest_mm': largest
    }


def main():
    """Run all imperfections and print what became of them."""
    options = bench.options(__doc__, only=('', 'imperfections whose names hold this'), json=False)
    found = {}
    for name, (change, sizes) in IMPERFECTIONS.items():
        for where, designs in (('', DESIGNS), (', in motion', MOTION)):
            if options.only in name + where:
                found[name + where] = row_of(change, sizes, designs)
                if not options.json:
                    cells = [f'{key} {value:.4g}' for key, value in found[name + where].items()]
                    print(f'{name + where:34} {", ".join(cells)}', flush=True)
    if options.json:
        print(json.dumps(found, indent=1))


if __name__ == '__main__':
    main()
