# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Position errors on held-out measurements of real robots, by model.

    CALIB_ROS_DATA=FOLDER python benchmarks/real_robots.py [--near] [--json]

Rows: the nominal chain with its frames fitted, the geometric model (default settings; `plain` is
without the robust loss, as the reference was made), the geometric model with each group of
non-geometric effects, and `auto`, which chooses among them by cross-validation on the fitted rows.
Sets of a ball in sockets (MUKCa) are judged by leaving out one place at a time; their reference
leaves out the last place only, so that place is printed as well.

Of the two sessions of the UR10 each is predicted by the arm of the other, with base and tool
refitted (`from ...`). On what `auto` leaves there, more was tried: the temperature of the arm, the
time, and a Gaussian process on the joint angles, all fitted to the residuals of the fitted rows.
"""

import csv
import time
from dataclasses import replace

import bench
import numpy as np
from cell_simulator import misfit
from scipy import linalg
from scipy.spatial.distance import cdist

from calib_ros.identification.identification import identify
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics import effects
from calib_ros.kinematics.se3 import norms

# Held-out RMS [mm] of an independent plain least squares with the geometric model.
SETS = {
    ('ur10_ipa_leica', 'A', 'chain.yaml'): 0.437,
    ('ur10_ipa_leica', 'B', 'chain.yaml'): 0.416,
    ('ur5_jacobi_lasertracker', 'grid', 'chain.yaml'): 0.116,
    ('wam7_jacobi_lasertracker', 'grid', 'chain.yaml'): 2.347,
    ('positioner_2axis_pose', 'all', 'chain.yaml'): 0.410,
    ('fr3_camera_eyeinhand', 'all', 'chain.yaml'): 1.622,
    ('mukca_sockets', 'panda_1', 'chain_panda.yaml'): 0.83,
    ('mukca_sockets', 'panda_3', 'chain_panda.yaml'): 0.24,
    ('mukca_sockets', 'kuka_14', 'chain_iiwa14.yaml'): 0.47,
}
# Mean [mm] before and after as published, and what is not comparable.
PUBLISHED = {
    ('ur5_jacobi_lasertracker', 'grid'): (2.566, 0.155, 'base not refitted before; other rows'),
    ('wam7_jacobi_lasertracker', 'grid'): (17.77, 2.92, 'base not refitted before; other rows'),
    ('positioner_2axis_pose', 'all'): (3.82, 1.74, 'frames not refitted; other rows'),
    ('mukca_sockets', 'panda_1'): (7.79, 0.347, 'other places fitted and judged'),
}
UR10 = 'ur10_ipa_leica'
NEAR, FEW = 40, 12
"""Sets of near poses of each robot, and rows that are too few to judge by."""


def row(label, figures, result, seconds):
    """Return one line of the table as plain values."""
    return {
        'model': label,
        'rms_mm': figures.rms_mm,
        'mean_mm': figures.mean_mm,
        'max_mm': figures.max_mm,
        'parameters': result.rank,
        'outliers': len(result.outliers),
        'accepted': result.accepted,
        'seconds': round(seconds, 2),
    }


def rows_of(problem):
    """Yield the lines of one data set."""
    begin = time.perf_counter()
    result = identify(problem)
    seconds = time.perf_counter() - begin
    yield row('nominal', result.validation.figures[0], result, 0.0)
    line = row('geometric', result.validation.figures[1], result, seconds)
    if problem.judging and not problem.judging[0].inverse:
        unseen = problem.judging[0]
        error = unseen.positions - result.chain.forward(unseen.joints)[:, :3, 3]
        line['within_95'] = float(bench.within(result, unseen.joints, error).mean())
    yield line
    plain = identify(replace(problem, loss='none'))
    yield row('geometric, plain', plain.validation.figures[1], plain, 0.0)
    if problem.separations:
        judged = result.validation
        last = judged.after.configurations == judged.after.configurations.max()
        for label, which in (('nominal', judged.before), ('geometric', judged.after)):
            yield row(f'{label}, last', which.figures(last & judged.judged), result, 0.0)
        return
    for group in effects.GROUPS:
        if group in ('gear', 'compliance', 'backlash'):  # ratios, masses, moves are not known
            continue
        begin = time.perf_counter()
        found = identify(replace(problem, effects=(group,)))
        yield row(f'+ {group}', found.validation.figures[1], found, time.perf_counter() - begin)
    begin = time.perf_counter()
    found = identify_model(problem, 'auto')
    line = row('auto', found.validation.figures[1], found, time.perf_counter() - begin)
    line['chosen'] = [verdict.what for verdict in found.verdicts if verdict.pays]
    yield line


def transfer():
    """Yield how well the arm of one session of the UR10 predicts the other."""
    problems = {session: bench.problem_of(UR10, session) for session in 'AB'}
    for source, target in ('BA', 'AB'):
        for model in ('geometric', 'gravity', 'eccentricity', 'auto'):
            result = identify_model(problems[source], model)
            arm = [name for name in result.names if not result.chain.owns_frame(name)]
            known = replace(result.chain, base=None, tool=None)
            judged = problems[target]
            held = replace(judged, chain=known, fixed=tuple(arm), loss='none')  # every row counts
            left = identify(held).validation.after
            figures = left.figures(np.ones(len(left.position), dtype=bool))
            yield f'{target} from {source}, {model}', figures.rms_mm, figures.max_mm


def tried(session):
    """Yield the RMS [mm] on held-out rows with more fitted to what `auto` leaves."""
    problem = bench.problem_of(UR10, session)
    result = identify_model(problem, 'auto')
    fitted, test = result.fitted.after.position, result.validation.after.position
    with open(bench.DATA / UR10 / 'uniform.csv', encoding='utf-8') as file:
        rows = [row for row in csv.DictReader(file) if row['session'] == session]
    train = np.array([row['split'] == 'train' for row in rows])
    temperature = np.array([float(row['temperature_C']) for row in rows])
    time_of = np.arange(len(rows)) / len(rows)

    def rms(errors):
        return 1e3 * bench.rms(norms(errors[result.validation.counting]))

    yield 'auto', rms(test)
    scaled = (temperature - temperature.mean()) / temperature.std()
    waves = np.cos(np.pi * np.outer(time_of, np.arange(1, 11)))
    for what, columns in (
        ('+ temperature, to the second power', np.column_stack([scaled, scaled**2])),
        ('+ time, ten cosines over the session', waves),
    ):
        model = np.column_stack([np.ones(len(rows)), columns])
        weights = np.linalg.lstsq(model[train], fitted, rcond=None)[0]
        yield what, rms(test - model[~train] @ weights)
    q, unseen = problem.observations.joints, problem.held_out[0].joints
    few = np.arange(0, len(q), 1 + len(q) // 1500)
    yield (
        '+ Gaussian process on the joint angles',
        rms(test - process(q[few], fitted[few], unseen)),
    )


def process(q, errors, unseen):
    """Return the prediction (M, 3) of a Gaussian process; its scales by cross-validation."""

    def place(angles):
        return np.concatenate([np.cos(angles), np.sin(angles)], axis=1)

    def predicted(at, length, noise, index):
        own = np.exp(-0.5 * cdist(place(q[index]), place(q[index]), 'sqeuclidean') / length**2)
        cross = np.exp(-0.5 * cdist(place(at), place(q[index]), 'sqeuclidean') / length**2)
        weights = linalg.solve(own + noise * np.eye(len(own)), errors[index], assume_a='pos')
        return cross @ weights

    def left(length, noise):
        folds = np.arange(len(q)) % 5
        parts = [
            errors[folds == k] - predicted(q[folds == k], length, noise, folds != k)
            for k in range(5)
        ]
        return sum(float((part**2).sum()) for part in parts)

    choices = [(length, noise) for length in (0.3, 1.0, 3.0) for noise in (0.1, 1.0, 10.0)]
    best = min(choices, key=lambda choice: left(*choice))
    return predicted(unseen, *best, np.ones(len(q), dtype=bool))


def near_one_pose(seen, rng):
    """Return some observations near one, and all others."""
    place = (seen.joints, seen.positions)[rng.integers(2)]
    apart = np.linalg.norm(place - place[rng.integers(len(seen))], axis=1)
    order, count = np.argsort(apart), rng.integers(12, 41)
    return seen.select(np.sort(order[:count])), seen.select(np.sort(order[count:]))


def worse_in_region(result, rest):
    """Return whether a calibration is worse than before on other rows in its region, if known."""
    inside = rest.select(result.region.covers(rest.joints))
    if len(inside) < FEW:
        return None
    poses = [each.forward(inside.joints) for each in (result.before, result.chain)]
    before, after = (misfit(inside.positions, p[:, :3, :3], p[:, :3, 3]) for p in poses)
    good = np.maximum(before, after) < 8.0 * np.median(after)  # without gross errors
    return bool(bench.rms(after[good]) > 1.05 * bench.rms(before[good]))


def near_poses():
    """Print by data set how many calibrations from near poses make the arm worse."""
    for name, session, chain_name in SETS:
        if name in ('positioner_2axis_pose', 'mukca_sockets'):
            continue
        problem, rng = bench.problem_of(name, session, chain_name), np.random.default_rng(0)
        verdicts = []
        for _ in range(NEAR):
            near, rest = near_one_pose(problem.observations, rng)
            result = identify(replace(problem, observations=near, held_out=None))
            if result.accepted:
                verdicts.append(worse_in_region(result, rest))
        judged = [each for each in verdicts if each is not None]
        print(
            f'{name} {session}: accepted {len(verdicts)} of {NEAR}, judged {len(judged)}, '
            f'worse {sum(judged)}'
        )


def main():
    """Run all sets and print the table."""
    options = bench.options(__doc__, json=False, near=(False, 'only from near poses'))
    if options.near:
        near_poses()
        return
    found = {}
    for (name, session, chain_name), reference in SETS.items():
        lines = list(rows_of(bench.problem_of(name, session, chain_name)))
        published = PUBLISHED.get((name, session))
        found[f'{name}/{session}'] = {
            'reference_rms_mm': reference,
            'published_mean_mm': published,
            'models': lines,
        }
    found['transfer'] = list(transfer())
    found['tried'] = {session: list(tried(session)) for session in 'AB'}
    bench.tell(found, options.json)


if __name__ == '__main__':
    main()
