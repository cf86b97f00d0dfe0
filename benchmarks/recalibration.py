# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""After a collision: what a few poses and the earlier calibration tell, against a full one.

A simulated UR10e is calibrated from 60 random poses (noise 0.05 mm, 0.2 mrad). Then a joint's
zero slips by 0.5 mrad (`zero`), a link is twisted by as much (`twisted`: alpha of a joint) or bent
at random (`bent`: a, alpha, d and beta of a joint, some tenths of a millimetre and of a
milliradian), or nothing happens (`none`), and 8 poses (--poses), the same for all arms, chosen
before by `plan`, are measured.

- `ratio`: RMS error over the joint range, in the best frames, of the arm brought up to date over
  that of a full calibration from 60 new poses
- `bound`: the least ratio of any unbiased estimate (Cramer, Rao) that is told which joint it was
  and uses the earlier calibration
- `named`: share of the arms whose joint is among those named
- `alone`: share of the arms of which only the right joint is named
- `claimed`: share of the unchanged arms of which a change is claimed

Then arms of three kinds (UR10e, Denso HSR065, Franka Panda), by poses and by positions only, are
measured by 1 to 8 poses that nobody planned: all over the joint range, or within 0.2 rad of each
other. `unchanged`: nothing happened. `slipped`: a zero slipped by 0.5 mrad. `mistyped`: nothing
happened, but one position is off by some millimetres. `smooth`: nothing happened, but the device,
which has been moved, has smooth errors as large as its sigma, then and now.

- `accepted`: share of the arms that are brought up to date
- `harmful`: how many of these are worse than the earlier calibration by half and 0.02 mm
"""

from __future__ import annotations

from dataclasses import replace

import bench
import numpy as np

from calib_ros.apply.candidates import Visibility, draw_candidates
from calib_ros.apply.design import Design
from calib_ros.apply.planning import plan
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.changes import ChangeColumns
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.samples import Samples
from calib_ros.estimation.system import System
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.identification.recalibration import recalibrate
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter, parameters_of

UR = load_chain('ur10e')
NOISE = (5e-5, 2e-4)
SLIPS = {'zero': 'theta', 'twisted': 'alpha'}
BENT = {'a': 3e-4, 'alpha': 5e-4, 'd': 3e-4, 'beta': 5e-4}
MANY = 60
SIGMAS = {'sigma_position': NOISE[0], 'sigma_orientation': NOISE[1]}


def few_poses(count):
    """Return poses (count, n) that tell of changes of an arm that is known but for these."""
    nominal = replace(UR, tool=faulty(UR, Cell(), np.random.default_rng(1)).tool)
    rng = np.random.default_rng(0)
    priors = {'*.a': 1e-3, '*.d': 1e-3, '*.theta': 2e-3, '*.alpha': 2e-3, '*.beta': 2e-3}
    problem = Problem(
        nominal, measure(nominal, UR.random_joints(1, rng), rng), priors=priors, **SIGMAS
    )
    design = Design.of(problem)
    candidates = draw_candidates(design, 500, rng, Visibility())
    task = UR.random_joints(100, rng)
    return plan(design, candidates, task, count, criterion='task').joints


def changed(true, kind, rng):
    """Return the arm after what happened, and the joint that it happened to."""
    joint = UR.joint_names[rng.integers(6 if kind == 'zero' else 5)]
    if kind in SLIPS:
        return true.with_offsets({f'{joint}.{SLIPS[kind]}': rng.choice([-5e-4, 5e-4])}), joint
    if kind == 'bent':
        offsets = {f'{joint}.{key}': rng.normal(scale=size) for key, size in BENT.items()}
        return true.with_offsets(offsets), joint
    return true, None


def error(chain, true, nominal=UR):
    """Return the RMS error [mm] of positions over the joint range in the best frames."""
    joints = nominal.random_joints(300, np.random.default_rng(99))
    wanted = measure(true, joints, np.random.default_rng(0))
    names = [*parameters_of('base'), *parameters_of('tool')]
    fit = minimise(chain, names, System((Samples(wanted, 1e-4, 1e-3),))).chain
    left = fit.forward(joints)[:, :3, 3] - wanted.positions
    return 1e3 * float(np.sqrt((left**2).sum(axis=1).mean()))


def bound(few, kind):
    """Return the least error by few poses (K, n) and the joint's name, over that by many."""
    rng = np.random.default_rng(0)
    chain = faulty(UR, Cell(), rng)
    frames = [*parameters_of('base'), *parameters_of('tool')[:3]]
    names = Calibration.of(identify(problem_of(chain, UR.random_joints(MANY, rng), rng))).names
    rest = [k for k, name in enumerate(names) if name not in frames]
    weights = 1.0 / np.repeat(NOISE, 3)[:, np.newaxis]

    def information(joints):
        flat = (weights * ErrorModel(chain, names).jacobian(joints)).reshape(-1, len(names))
        return flat.T @ flat

    flat = ErrorModel(chain, [*frames, *(names[k] for k in rest)]).jacobian(
        UR.random_joints(300, np.random.default_rng(99))
    )[:, :3]
    flat = flat.reshape(-1, flat.shape[2])
    basis = np.linalg.qr(flat[:, : len(frames)])[0]
    seen = flat[:, len(frames) :] - basis @ (basis.T @ flat[:, len(frames) :])

    def mean_square(matrix):
        return np.trace(seen @ np.linalg.inv(matrix)[np.ix_(rest, rest)] @ seen.T)

    columns = ChangeColumns(chain, tuple(map(Parameter, names)))
    ratios = []
    for _ in range(20):
        many = information(UR.random_joints(MANY, rng))
        for joint in UR.joint_names[: 6 if kind == 'zero' else 5]:
            sets = [own for _, own in columns.sets if {name.owner for name in own} == {joint}]
            wanted = (f'{joint}.{SLIPS[kind]}',) if kind in SLIPS else ()
            own = columns.of(next((each for each in sets if each == wanted), sets[-1]))
            shown = many @ own
            kept = many - shown @ np.linalg.solve(own.T @ shown, shown.T)  # of the rest
            ratios.append(mean_square(kept + information(few)) / mean_square(many))
    return float(np.sqrt(np.mean(ratios)))


def problem_of(true, joints, rng):
    """Return what is measured of an arm at joint values (N, n)."""
    return Problem(UR, measure(true, joints, rng, *NOISE), **SIGMAS)


def trial(kind, seed, few):
    """Return what came of one arm."""
    rng = np.random.default_rng(seed)
    true = faulty(UR, Cell(), rng)
    earlier = Calibration.of(identify(problem_of(true, UR.random_joints(MANY, rng), rng)))
    now, joint = changed(true, kind, rng)
    found = recalibrate(earlier, problem_of(now, few, rng), 0.1)
    owners = {each.owner for reasons in found.changed for each in reasons}
    row = {'named': joint in owners, 'alone': owners == {joint}, 'claimed': bool(owners)}
    if kind != 'none':
        full = identify(problem_of(now, UR.random_joints(MANY, rng), rng))
        row |= {'few': error(found.calibration.chain, now), 'full': error(full.chain, now)}
        row |= {'accepted': found.accepted, 'before': error(earlier.chain, now)}
    return row


def smooth(problem, rng):
    """Return what a device with smooth errors measures, of its sigma (RMS) in each coordinate."""
    seen = problem.observations
    waves = np.sin(np.pi * seen.positions[:, [1, 2, 0]] + rng.uniform(0.0, 2.0 * np.pi, 3))
    positions = seen.positions + np.sqrt(2.0) * NOISE[0] * waves
    return replace(problem, observations=replace(seen, positions=positions))


def unplanned(kind, chain, oriented, count, seed):
    """Return for poses spread and alike whether an arm was brought up to date, and harmed."""
    rng = np.random.default_rng(seed)
    true = faulty(chain, Cell(), rng)

    def measured(arm, joints):
        return Problem(chain, measure(arm, joints, rng, *NOISE, oriented), **SIGMAS)

    many = measured(true, chain.random_joints(MANY, rng))
    earlier = Calibration.of(identify(smooth(many, rng) if kind == 'smooth' else many))
    now = true
    if kind == 'slipped':
        joint = chain.joint_names[rng.integers(len(chain.joints))]
        now = true.with_offsets({f'{joint}.theta': rng.choice([-5e-4, 5e-4])})
    found = []
    for alike in (False, True):
        joints = chain.random_joints(count, rng)
        if alike:
            joints = joints[:1] + rng.uniform(-0.2, 0.2, joints.shape)
        few = measured(now, joints)
        if kind == 'smooth':
            few = smooth(few, rng)
        if kind == 'mistyped':
            positions = few.observations.positions.copy()
            positions[rng.integers(count)] += rng.normal(scale=2e-3, size=3)
            few = replace(few, observations=replace(few.observations, positions=positions))
        done = recalibrate(earlier, few, 0.1)
        before, after = (
            error(each, now, chain) for each in (earlier.chain, done.calibration.chain)
        )
        found.append((done.accepted, bool(done.accepted and after > 1.5 * before + 0.02)))
    return found


def few_of_all(arms):
    """Return the figures of poses that nobody planned, by what happened."""
    figures = {}
    for kind in ('unchanged', 'slipped', 'mistyped', 'smooth'):
        rows = [
            row
            for name in ('ur10e', 'denso_hsr065', 'franka_panda')
            for oriented in (True, False)
            for count in (1, 2, 3, 5, 8)
            for seed in range(arms)
            for row in unplanned(kind, load_chain(name), oriented, count, seed)
        ]
        accepted, harmful = map(sum, zip(*rows, strict=True))
        figures[kind] = {'arms': len(rows), 'accepted': accepted / len(rows), 'harmful': harmful}
    return figures


def main():
    """Print the figures of all arms."""
    options = bench.options(
        __doc__, quick=(False, 'fewer arms'), poses=(8, 'after the collision'), json=False
    )
    counts = (
        {'zero': 20, 'twisted': 20, 'bent': 20, 'none': 40}
        if options.quick
        else {'zero': 200, 'twisted': 200, 'bent': 200, 'none': 500}
    )
    few = few_poses(options.poses)
    figures = {}
    for kind, count in counts.items():
        rows = [trial(kind, seed, few) for seed in range(count)]
        mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        if kind == 'none':
            figures[kind] = {'arms': count, 'claimed': mean['claimed']}
            continue
        rms = {
            key: float(np.sqrt(np.mean([row[key] ** 2 for row in rows])))
            for key in ('few', 'full', 'before')
        }
        figures[kind] = {
            'arms': count,
            'named': mean['named'],
            'alone': mean['alone'],
            'accepted': mean['accepted'],
            'ratio': rms['few'] / rms['full'],
            'bound': bound(few, kind),
            **{f'{key}_mm': value for key, value in rms.items()},
        }
    figures |= few_of_all(2 if options.quick else 10)
    bench.tell(figures, options.json)


if __name__ == '__main__':
    main()
