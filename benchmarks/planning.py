# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Planned poses against random ones: speed, simulated arms, measured robots.

    CALIB_ROS_DATA=FOLDER python benchmarks/planning.py [--quick] [--json]

Speed: a plan of 30 among 500 candidates, against the same search with every determinant computed
anew (both must choose the same poses), and an exchange by o5. A map of the errors removed and of
what is expected to remain, 10,000 configurations at once, against the same one at a time.

Simulated arms: errors of 0.5 mm and 1 mrad, noise 0.1 mm and 0.33 mrad. RMS position error on
300 unseen poses of the whole joint range after identification from 25 planned poses (of 2000
candidates), 25 random and 50 random ones: the mean over draws of noise and, for random ones, of
poses. `bound` is the least that any 25 of the candidates could predict for the unseen poses, by
the tangent at the plan. Ranges: all within the limits; facing the tracker, which stands 3 m in
front of the arm, within 30 degrees; and 0.6 rad about one posture.

Placement: a circle of 0.3 m, tool down, placed where a simulated UR10e is expected to miss least,
against the centre of all places that it reaches: expected and true error, of the arm that its
nominal model commands (one arm; mean over the circle) and that its identified one does (RMS over
draws of the measured noise, at the places that the first draw chose).

Measured robots: half of the fitted rows, and 30 of them, chosen by `d` without their measured
values, against random ones and all; RMS on held-out rows. `sigma` is the RMS of held-out residuals
over their predicted standard deviation with the noise that the fit found, which holds what the
model lacks; `predicted` the share of it that comes from the parameters. Held-out rows lie between
fitted ones and share the remainder with them; `outer` is that RMS where they do not: over the
lowest and highest fifth of every joint's values, left out one at a time, and `outer_noise` by the
noise alone, without that of the parameters. `a_priori` is the RMS error over that predicted from
the tracker's own noise alone, 0.02 mm. Of UR10 A every fifth row is used.
"""

import time
from dataclasses import replace
from functools import partial

import bench
import numpy as np

from calib_ros.apply.candidates import Visibility, draw_candidates
from calib_ros.apply.choice import Choice
from calib_ros.apply.design import Candidates, Design, accuracy, predicted
from calib_ros.apply.placement import place
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, transform

POSTURE = np.array([0.3, -1.2, 1.4, -0.5, 0.9, 0.2])
SIGMAS = (1e-4, 1e-4 / 0.3)
ARMS = ('ur10e', 'puma560')
SETS = {
    ('ur10_ipa_leica', 'A'): True,
    ('ur10_ipa_leica', 'B'): True,
    ('ur5_jacobi_lasertracker', 'grid'): True,
    ('wam7_jacobi_lasertracker', 'grid'): True,
    ('positioner_2axis_pose', 'all'): False,
    ('fr3_camera_eyeinhand', 'all'): False,
}
"""Whether a laser tracker measured; the noise of the other devices is not known."""
MOST_ROWS = 2000
TRACKER = 2e-5
"""Its noise [m] (0.01 to 0.02 mm)."""
WEIGHT_OF_ORIENTATION = 0.3
"""Orientation is weighted by so many metres a radian."""


def naive(design, candidates, count):
    """Choose by `d`, with every determinant of every candidate computed anew."""
    space = Candidates(design, candidates)
    rows, size = space.rows, space.rows.shape[2]
    each = [row.T @ row for row in rows]
    start = space.known + HALF_THE_DIGITS * np.eye(size)

    def best(others, free):
        information = start + sum(each[k] for k in others)
        worth = {k: np.linalg.slogdet(information + each[k])[1] for k in free}
        return max(worth, key=worth.get)

    chosen = []
    for _ in range(count):
        chosen.append(best(chosen, [k for k in range(len(rows)) if k not in chosen]))
    changed = True
    while changed:
        changed = False
        for k in range(count):
            others = chosen[:k] + chosen[k + 1 :]
            new = best(others, [k for k in range(len(rows)) if k not in others])
            changed |= new != chosen[k]
            chosen[k] = new
    return chosen


def speed():
    """Time a plan of 30 among 500 against the naive search, and an exchange by o5."""
    chain = load_chain('ur10e')
    rng = np.random.default_rng(0)
    candidates = chain.random_joints(500, rng)
    design = Design.of(Problem(chain, measure(chain, candidates, rng)))
    seconds = {}

    def timed(name, run):
        begin = time.perf_counter()
        found = run()
        seconds[name] = min(time.perf_counter() - begin, seconds.get(name, np.inf))
        return set(np.array(found).tolist())

    for _ in range(3):
        ours = timed('choose_d', lambda: Choice(design, candidates).best(30))
        theirs = timed('naive_d', lambda: naive(design, candidates, 30))
    timed('choose_o5', lambda: Choice(design, candidates, 'o5').best(30))
    true = faulty(chain, Cell(), rng)
    arm = Calibration.of(identify(Problem(chain, measure(true, candidates[:60], rng, *SIGMAS))))
    postures = chain.random_joints(10000, rng)

    def mapped(joints):
        return np.hypot(arm.removed(joints)[0], arm.sigma(joints))

    for _ in range(3):
        timed('map of 10,000', lambda: mapped(postures))
        timed('map of 500, one by one', lambda: [mapped(q[np.newaxis])[0] for q in postures[:500]])
    return {
        'seconds': seconds,
        'ratio': seconds['naive_d'] / seconds['choose_d'],
        'ratio_of_maps': 20.0 * seconds['map of 500, one by one'] / seconds['map of 10,000'],
        'same_choice': ours == theirs,
    }


def ranges(chain):
    """Return functions that draw joint values (count, n) from each range of poses."""
    facing = Visibility(tracker=np.array([3.0, 0.0, 1.0]), cone=np.radians(30.0))
    design = Design.of(Problem(chain, measure(chain, np.zeros((1, 6)), np.random.default_rng(0))))
    return {
        'whole range': chain.random_joints,
        'facing the tracker': lambda count, rng: draw_candidates(design, count, rng, facing),
        '0.6 rad about a posture': lambda count, rng: POSTURE + rng.uniform(-0.6, 0.6, (count, 6)),
    }


def simulated_error(nominal, true, joints, unseen, rng, oriented):
    """Return the RMS position error [mm] on unseen poses by what was measured at some."""
    seen = measure(true, joints, rng, *SIGMAS, oriented)
    judge = seen.select(np.arange(1))  # no cross-validation: the verdict is not asked for
    result = identify(Problem(nominal, seen, held_out=judge, loss='none'))
    return 1e3 * bench.rms(bench.distances(result.chain, true, unseen))


def simulated(arm, oriented, draws):
    """Return the errors of planned and of random poses, by range."""
    nominal = load_chain(arm)
    nominal = replace(
        nominal,
        tool=Frame(np.array([[1, 0, 0, 0.05], [0, 1, 0, 0.05], [0, 0, 1, 0.1], [0, 0, 0, 1.0]])),
    )
    rng = np.random.default_rng(0)
    true = replace(faulty(nominal, Cell(), rng), tool=nominal.tool)
    unseen = nominal.random_joints(300, rng)
    design = Design.of(Problem(nominal, measure(nominal, unseen[:1], rng, oriented=oriented)))
    found = {}

    def mean_error(poses_of):
        every = (poses_of() for _ in range(draws))
        given = unseen, rng, oriented
        return float(np.mean([simulated_error(nominal, true, q, *given) for q in every]))

    for label, draw in ranges(nominal).items():
        candidates = draw(2000, rng)
        row = {}
        for criterion in ('d', 'task'):
            chosen = Choice(design, candidates, criterion, unseen).best(25)
            row[criterion] = mean_error(partial(candidates.take, chosen, axis=0))
        share = Choice(design, candidates, 'task', unseen).efficiency(chosen)
        least = accuracy(design, candidates[chosen], unseen)[-1] * np.sqrt(share)
        row['bound'] = 1e3 * float(least)
        for count in (25, 50):
            row[f'random_{count}'] = mean_error(partial(draw, count, rng))
        found[label] = row
    return found


def placement(draws):
    """Return expected and true errors [mm] of a task at the best place and at the centre."""
    nominal, rng = load_chain('ur10e'), np.random.default_rng(0)
    true = faulty(nominal, Cell(), rng)
    joints = nominal.random_joints(40, rng)
    results = [
        identify(Problem(nominal, measure(true, joints, np.random.default_rng(seed), *SIGMAS)))
        for seed in range(draws)
    ]
    arm = Calibration.of(results[0])
    angle = 2.0 * np.pi * np.arange(12) / 12
    circle = np.column_stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), np.zeros(12)])
    task = transform(np.tile(np.diag([1.0, -1.0, -1.0]), (12, 1, 1)), circle)
    found = place(arm, task, 'mean', 'nominal')
    row = {}
    for label, which in (('best', found.best), ('centre', found.centre)):
        there = found.joints[which]
        missed = bench.distances(arm.before, true, there)
        row[f'{label}_mm'] = 1e3 * float(found.errors[which])
        row[f'{label}_true_mm'] = 1e3 * float(missed.mean())
    rows = {'nominal model': row}
    found, row = place(arm, task, 'mean', 'corrected'), {}
    for label, which in (('best', found.best), ('centre', found.centre)):
        there = found.joints[which]
        left = [bench.distances(each.chain, true, there) for each in results]
        row[f'{label}_mm'] = 1e3 * bench.rms(arm.sigma(there))
        row[f'{label}_true_mm'] = 1e3 * bench.rms(left)
    return rows | {'identified model': row}


def spread(problem, result, sigma_position):
    """Return the RMS of held-out position residuals over predicted sigma."""
    left = result.validation.after.position[result.validation.deciding]
    joints = np.concatenate([each.joints for each in problem.judging])[result.validation.deciding]
    variance = np.diagonal(result.pose_covariance(joints), axis1=1, axis2=2)[:, :3]
    return float(np.sqrt(np.mean(left**2 / (variance + sigma_position**2))))


def outer(problem):
    """Return the RMS of residuals over predicted sigma, and over noise, in the outer fifths."""
    joints = problem.observations.joints
    scores, by_noise = [], []
    for column in joints.T:
        order = np.argsort(column)
        fifth = len(order) // 5
        for out in (order[:fifth], order[-fifth:]):
            rest = np.setdiff1d(order, out)
            part, fitted = (problem.observations.select(index) for index in (out, rest))
            there = replace(problem, observations=fitted, held_out=part)
            result = identify(there)
            sigma = problem.sigma_position * result.noise.position
            scores.append(spread(there, result, sigma) ** 2)
            left = result.validation.after.position[result.validation.deciding]
            by_noise.append(np.mean((left / sigma) ** 2))
    return float(np.sqrt(np.mean(scores))), float(np.sqrt(np.mean(by_noise)))


def measured(name, session, tracker, draws):
    """Return the figures of one measured robot."""
    problem = bench.problem_of(name, session)
    rows = np.arange(0, len(problem.observations), 1 + len(problem.observations) // MOST_ROWS)
    problem = replace(problem, observations=problem.observations.select(rows))
    joints = problem.observations.joints
    design = Design.of(problem)
    full = identify(problem)
    rng = np.random.default_rng(0)

    def fitted_to(index):
        return identify(replace(problem, observations=problem.observations.select(index)))

    def rms(result):
        return result.validation.figures[1].rms_mm

    row = {'rows': len(joints), 'all_mm': rms(full)}
    for label, count in (('half', len(joints) // 2), ('30', 30)):
        chosen = Choice(design, joints).best(count)
        planned = fitted_to(chosen)
        random = [rms(fitted_to(rng.permutation(len(joints))[:count])) for _ in range(draws)]
        row[f'{label}_mm'] = rms(planned)
        row[f'{label}_random_mm'] = float(np.mean(random))
        row[f'{label}_sigma'] = spread(
            problem, planned, problem.sigma_position * planned.noise.position
        )
        row[f'{label}_predicted_mm'] = 1e3 * predicted(
            Design.of(problem, planned), problem.judging[0].joints
        )
    row['outer_sigma'], row['outer_noise'] = outer(problem)
    if tracker:
        told = replace(
            problem, sigma_position=TRACKER, sigma_orientation=TRACKER / WEIGHT_OF_ORIENTATION
        )
        sigma = predicted(Design.of(told).after(joints), problem.judging[0].joints)
        row['all_a_priori'] = row['all_mm'] / (1e3 * np.sqrt(sigma**2 + 3.0 * TRACKER**2))
    return row


def main():
    """Run everything and print the tables."""
    options = bench.options(__doc__, quick=(False, 'fewer draws, without UR10 A'), json=False)
    found = {'speed': speed(), 'simulated': {}, 'measured': {}}
    for arm in ARMS:
        for kind, oriented in (('pose', True), ('position', False)):
            rows = simulated(arm, oriented, 20 if options.quick else 200)
            found['simulated'] |= {f'{arm}, {kind}, {label}': row for label, row in rows.items()}
    found['placement'] = placement(10 if options.quick else 100)
    for (name, session), tracker in bench.measured(SETS).items():
        if not (options.quick and session == 'A'):
            found['measured'][f'{name}/{session}'] = measured(
                name, session, tracker, 3 if options.quick else 10
            )
    bench.tell(found, options.json)


if __name__ == '__main__':
    main()
