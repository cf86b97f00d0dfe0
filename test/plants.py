# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Plants of simulated robots, with a table of measured poses of each for every night."""

import json
from datetime import datetime, timezone

import numpy as np

from calib_ros.apply import simulation
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain

FIRST = 1_760_000_000
DAY = 86_400
SIGMAS = (5e-5, 2e-4)


def night(true, rng, number=0, poses=30):
    """Return the CSV of a night's poses of an arm, with their stamps."""
    measured = simulation.measure(true, true.random_joints(poses, rng), rng, *SIGMAS)
    stamps = (FIRST + DAY * number + np.arange(poses)) * 10**9
    names = [f'q{k + 1}' for k in range(measured.joints.shape[1])]
    lines = [','.join(['stamp_ns', *names, 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'])]
    quats = se3.to_quat(measured.rotations)
    values = np.hstack([measured.joints, measured.positions, quats])
    for stamp, row in zip(stamps, values, strict=True):
        lines.append(','.join([str(stamp), *(f'{value:.9f}' for value in row)]))
    return '\n'.join(lines) + '\n'


def robot(seed, chain='ur10e'):
    """Return an arm with errors of its own, and its random numbers."""
    rng = np.random.default_rng(seed)
    return simulation.faulty(load_chain(chain), simulation.Cell(), rng), rng


def write_plant(folder, serials, nights, poses=30, bumps=None, where='', chain='ur10e'):
    """Write tables and plant.yaml; `bumps` gives the night and the offsets of some serials.

    Returns the path of plant.yaml. The tables are at `where` for those who read them.
    """
    for number, serial in enumerate(serials):
        true, rng = robot(number, chain)
        place = folder / 'nights' / serial
        place.mkdir(parents=True)
        for k in range(nights):
            if bumps and serial in bumps and bumps[serial][0] == k:
                true = true.with_offsets(bumps[serial][1])
            (place / f'{k:03}.csv').write_text(night(true, rng, k, poses))
    settings = dict(zip(('sigma_position', 'sigma_orientation'), SIGMAS, strict=True))
    plant = {
        'groups': {'line': {'chain': chain, 'settings': settings, 'tolerance': 0.3}},
        'robots': [
            {'serial': s, 'group': 'line', 'measured': f'{where}nights/{s}/*.*'} for s in serials
        ],
    }
    path = folder / 'plant.yaml'
    path.write_text(json.dumps(plant))  # which is YAML
    return path


def when(number):
    """Return when a night's last of 30 poses was measured."""
    return datetime.fromtimestamp(FIRST + DAY * number + 29, timezone.utc)
