# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Does a drifting tracker pass for a gain of the arm, or for effects?

    python benchmarks/drift.py [--runs 30] [--quick] [--json]

Simulated UR10e, measured along a path through 12 way-points (all of the joint range, or +-0.8 rad)
with noise of 0.05 mm and 0.2 mrad, by a tracker that drifts by 0.3 mm: errors that fade over 10
poses, a random walk, a swing of about one period, a ramp. Of arms without any error none should be
accepted; of arms with errors of 0.5 mm and 1 mrad all should be, but for those whose lengths grew
or shrank alike by chance, as with a device out of scale (`like_scale`). `effects`: arms with such
errors, on which `auto` chose an effect that is not there. `coverage_95`: how many 95 % intervals
of their DH parameters hold the truth; `independent`: without regard to what neighbours share.
"""

import json
from dataclasses import replace

import bench
import numpy as np
from scipy.signal import lfilter

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.reasons import Rule
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics.chain_file import load_chain

NOISE = {'sigma_position': 5e-5, 'sigma_orientation': 2e-4}
DRIFT = 3e-4
WAYS = 12


def along_path(nominal, count, width, rng):
    """Return joint values (count, n) on straight lines through way-points."""
    corners = nominal.random_joints(WAYS, rng)
    if width is not None:
        corners = rng.uniform(-1.0, 1.0, 6) + rng.uniform(-width, width, corners.shape)
    share = np.arange(count // WAYS)[:, np.newaxis] / (count // WAYS)
    ways = np.roll(corners, -1, axis=0) - corners
    return (corners[:, np.newaxis] + share * ways[:, np.newaxis]).reshape(count, -1)


def drift(kind, count, rng):
    """Return how far (count, 3) [m] the tracker is off."""
    share = np.arange(count)[:, np.newaxis] / count
    if kind == 'walk':
        return DRIFT * np.cumsum(rng.normal(size=(count, 3)), axis=0) / np.sqrt(count)
    if kind == 'swing':
        cycles, phase = rng.uniform(0.5, 1.5, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
        return DRIFT * np.sin(2.0 * np.pi * cycles * share + phase)
    if kind == 'ramp':
        return DRIFT * rng.normal(size=3) * share
    decay = np.exp(-0.1)
    steps = np.sqrt(1.0 - decay**2) * rng.normal(size=(count, 3))
    return DRIFT * lfilter([1.0], [1.0, -decay], steps, axis=0)


def session(nominal, seed, errors, count, width, kind):
    """Return the true arm and the problem of one session."""
    rng = np.random.default_rng(seed)
    cell = Cell(length_error=5e-4 * errors, angle_error=1e-3 * errors)
    q = along_path(nominal, count, width, rng)
    true = faulty(nominal, cell, rng)
    seen = measure(true, q, rng, *NOISE.values(), oriented=bool(seed % 2))
    seen = replace(seen, positions=seen.positions + drift(kind, count, rng))
    return true, Problem(nominal, seen, **NOISE)


def hits(true, result):
    """Return whether the intervals of the DH parameters hold the truth, by both covariances."""
    arm = [p for p in result.parameters if p.std is not None and not true.owns_frame(p.name)]
    deviation = np.abs([p.value - true.value(p.name) for p in arm])
    widths = np.array([p.half_width() for p in arm])
    return deviation <= widths, deviation <= widths / result.noise.widened


def main():
    """Run all kinds of drift and print the figures."""
    options = bench.options(
        __doc__, runs=30, quick=(False, 'a few runs, under a minute'), json=False
    )
    runs = 4 if options.quick else options.runs
    nominal = load_chain('ur10e')
    rows = []
    for width in (None, 0.8):
        for count in (60, 120):
            for kind in ('fading', 'walk', 'swing', 'ramp'):
                where = (count, width, kind)
                healthy = [
                    identify(session(nominal, seed, 0.0, *where)[1]) for seed in range(runs)
                ]
                sessions = [session(nominal, seed, 1.0, *where) for seed in range(runs)]
                results = [identify(problem) for _, problem in sessions]
                chosen = [identify_model(problem, 'auto') for _, problem in sessions[: runs // 2]]
                pairs = [hits(true, r) for (true, _), r in zip(sessions, results, strict=True)]
                covered, independent = (np.concatenate(part) for part in zip(*pairs, strict=True))
                row = {
                    'poses': count,
                    'half_range_rad': width,
                    'drift': kind,
                    'runs': runs,
                    'healthy_accepted': sum(result.accepted for result in healthy),
                    'faulty_accepted': sum(result.accepted for result in results),
                    'like_scale': sum(
                        reason.rule is Rule.SCALE for r in results for reason in r.refusals
                    ),
                    'effects': sum(bool(result.chain.effects) for result in chosen),
                    'effects_runs': len(chosen),
                    'coverage_95': round(float(covered.mean()), 3),
                    'independent': round(float(independent.mean()), 3),
                }
                rows.append(row)
                if not options.json:
                    print(', '.join(f'{key} {value}' for key, value in row.items()), flush=True)
    keys = ('runs', 'healthy_accepted', 'faulty_accepted', 'like_scale', 'effects')
    total = {key: sum(row[key] for row in rows) for key in (*keys, 'effects_runs')}
    for key in ('coverage_95', 'independent'):
        total[key] = float(np.mean([row[key] for row in rows]))
    if options.json:
        print(json.dumps({'total': total, 'rows': rows}, indent=2))
    else:
        print('total:', ', '.join(f'{key} {value}' for key, value in total.items()))


if __name__ == '__main__':
    main()
