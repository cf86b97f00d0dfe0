# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which mistakes are named, on measured robots spoilt in each way, and how often none is one.

    CALIB_ROS_DATA=FOLDER python benchmarks/mistakes.py [--only SET] [--rows N] [--json]
    python benchmarks/mistakes.py --clean 1000

The first prints the table of docs/mistakes.md. A cell holds `named` where the mistake is named
first, `or` where it is among two or three that explain the same, `same` where it makes no
difference that matters (the typical error as given is below FACTOR times that of the clean set),
`-` where a set cannot have it, and else what was said.

The second tries the suspects on simulated sets without any of these mistakes, whether or not their
errors are suspicious, and prints how many were named: of arms with errors (a third of them ten
times larger than usual), few or many poses or positions, gross errors in up to 30 % of them, and
of such that nothing explains: noise of decimetres, joint values of other poses.
"""

import json
import time
from dataclasses import replace

import bench
import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision import mistakes, suspects, undoing
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain_file import load_chain, shipped_robots

SETS = (
    ('ur10_ipa_leica', 'B', 'chain.yaml'),
    ('ur5_jacobi_lasertracker', 'grid', 'chain.yaml'),
    ('wam7_jacobi_lasertracker', 'grid', 'chain.yaml'),
    ('positioner_2axis_pose', 'all', 'chain.yaml'),
    ('fr3_camera_eyeinhand', 'all', 'chain.yaml'),
    ('mukca_sockets', 'panda_1', 'chain_panda.yaml'),
    ('mukca_sockets', 'kuka_14', 'chain_iiwa14.yaml'),
)
FACTOR = 3.4
"""Ratio of typical errors below which a mistake makes no difference that could be told."""
OTHERS = {'ur10': 'ur5e', 'ur5': 'ur10e', 'iiwa': 'franka_fr3', 'wam': 'kuka_iiwa14'}


def changed(problem, change):
    """Return a problem with all its observations changed."""
    judging = tuple(map(change, problem.judging))
    return problem.with_sets(map(change, problem.sets), held_out=judging)


def joints(change):
    """Return a change of the observations by one of their joint values."""
    return lambda each: replace(each, joints=change(each.joints))


def turned(change):
    """Return a change of the observations by one of their quaternions."""
    return lambda each: replace(each, rotations=se3.from_quat(change(se3.to_quat(each.rotations))))


def rewritten(read, written, in_turn=False, size=1.0):
    """Return a change of the observations: angles `written` in one order, `read` in another.

    They are read about the axes that they are written about, or `in_turn`. None is a vector.
    """
    names = written or 'XYZ'

    def change(each):
        turns = Rotation.from_matrix(each.rotations)
        angles = size * (turns.as_euler(written) if written else turns.as_rotvec())
        if not in_turn:
            angles = angles[:, [names.index(axis) for axis in read or 'XYZ']]
        made = Rotation.from_euler(read, angles) if read else Rotation.from_rotvec(angles)
        return replace(each, rotations=made.as_matrix())

    return change


def later(each):
    """Return observations with the joint values of the next row."""
    count = len(each)
    last = replace(each.select(np.arange(count - 1)), joints=each.joints[1:])
    return replace(last, covariance=None)


def mixed_up(problem):
    """Return a problem whose rows, held-out ones included, have the next row's joint values."""
    sets = []
    for each in problem.sets:
        same = [e for e in problem.judging if (e.base, e.tool) == (each.base, each.tool)]
        parts = (each, *same)
        order = np.argsort(np.concatenate([e.stamps_ns for e in parts]))
        names = ('stamps_ns', 'joints', 'positions', 'rotations', 'oriented')
        whole = {n: np.concatenate([getattr(e, n) for e in parts])[order] for n in names}
        sets.append(later(replace(each, **whole, covariance=None, delay=None)))
    return problem.with_sets(sets, held_out=None)


def both(size, angle=1.0):
    """Return a change of the observations by the units of positions and joint values."""
    return lambda each: replace(each, positions=size * each.positions, joints=angle * each.joints)


OF_ORIENTATIONS = (
    ('wxyz', 'are w x y z', turned(lambda q: q[:, [3, 0, 1, 2]])),
    ('xyzw read as wxyz', 'are x y z w', turned(lambda q: q[:, [1, 2, 3, 0]])),
    (
        *('transposed', 'transposed'),
        lambda each: replace(each, rotations=np.swapaxes(each.rotations, 1, 2)),
    ),
    (
        *('inverse pose, eye in hand not given', 'world in the target'),
        lambda each: replace(each.inverted(), inverse=False),
    ),
    ('eye in hand given needlessly', 'not of a fixed target', lambda each: each.inverted()),
    ('Euler order', 'angles are ZYX (xyz about fixed axes), not', rewritten('XYZ', 'ZYX')),
    ('Euler order', 'angles are XYZ (zyx about fixed axes), not', rewritten('ZYX', 'XYZ')),
    ('Euler order', 'angles are ZXY (yxz about fixed axes), not', rewritten('XYZ', 'ZXY')),
    ('Euler order and columns', 'in the order of', rewritten('ZYX', 'XYZ', True)),
    ('rotation vectors read as Euler angles', 'are rotation vec', rewritten('ZYX', None)),
    ('Euler angles read as rotation vectors', 'not rotation vec', rewritten(None, 'ZYX')),
    ('radians read as degrees', 'in radians, not', rewritten('ZYX', 'ZYX', size=np.pi / 180)),
    ('degrees read as radians', 'orientations do', rewritten('ZYX', 'ZYX', size=180 / np.pi)),
)


def spoilt(problem):
    """Yield mistakes: group, words that name it, and the problem with it (None: cannot be)."""
    chain, seen = problem.chain, problem.observations
    names, unit = chain.joint_names, np.eye(len(chain.joints))
    count, placed = len(names), not seen.socket
    posed = placed and bool(seen.oriented.all())
    for can, group, words, change in (
        *(
            (placed, kind, f'positions are in {name},', both(1.0 / size))
            for kind, name, size in suspects.UNITS
        ),
        (True, 'degrees', 'in degrees,', joints(np.degrees)),
        (
            *(placed, 'mm and degrees', 'in mm, not metres and the joint values in degrees'),
            both(1e3, 180.0 / np.pi),
        ),
        *((posed, *each) for each in OF_ORIENTATIONS),
        (placed, 'left-handed', 'left-handed', undoing.mirrored),
    ):
        yield group, words, changed(problem, change) if can else None

    def moved(matrix, zero=0.0):
        return changed(problem, joints(lambda q: q @ matrix.T + zero))

    for k, name in enumerate(names):
        flipped = unit - 2.0 * np.diag(unit[k])
        yield 'sign of a joint', f'{name} counts the other way', moved(flipped)
        for degrees in (90, -90, 180):
            off, zero = abs(degrees), np.radians(degrees) * unit[k]
            yield f'zero off by {off}', f'{name} has its zero {off}', moved(unit, zero)
        if k:
            order = np.arange(count)
            order[[k - 1, k]] = k, k - 1
            yield 'joints swapped', f'{names[k - 1]} and {name} are swapped', moved(unit[order])
    for k in range(1, count):
        for sign in (1.0, -1.0):
            matrix = unit + sign * np.outer(unit[k], unit[k - 1])
            words = f'{names[k]} is not given against {names[k - 1]}'
            yield 'joints coupled', words, moved(matrix)
    for k in range(1, count - 2):
        bad = moved(unit - 2.0 * np.diag(unit[k]), 0.5 * np.pi * unit[k + 1])
        yield 'a sign and a zero', 'several mistakes', bad
        in_mm = changed(bad, both(1e3)) if placed else None
        yield 'a sign, a zero, and mm', 'several mistakes', in_mm
    for k, joint in enumerate(chain.joints):
        for kind in ('a', 'd', 'alpha'):
            arm = list(chain.joints)
            arm[k] = replace(joint, **{kind: -getattr(joint, kind)})
            if arm != [*chain.joints]:
                yield (
                    'sign in the DH table',
                    f'{kind} of {names[k]} has the other sign',
                    replace(problem, chain=replace(chain, joints=tuple(arm), parallel=None)),
                )
    other = 'modified' if chain.convention == 'standard' else 'standard'
    yield (
        'standard and modified DH',
        f'in the {chain.convention} convention',
        replace(problem, chain=replace(chain, convention=other, parallel=None)),
    )
    if count > 2 and not any(key in chain.name for key in ('wam', 'iiwa')):
        right = 'franka' if count == 7 else chain.name.partition('_')[0]
        wrong = 'kuka_iiwa14' if count == 7 else OTHERS[right]
        yield 'another robot', f'the arm is a {right}', replace(problem, chain=load_chain(wrong))
    elif 'iiwa' in chain.name:
        yield 'another robot', 'kuka_iiwa14', replace(problem, chain=load_chain('franka_fr3'))
    yield 'a row later', 'their measurement', mixed_up(problem)


def fewer(problem, count):
    """Return the problem with a part of its rows."""

    def some(each):
        index = np.linspace(0, len(each) - 1, min(count, len(each))).round().astype(int)
        return each.select(np.unique(index))

    return changed(problem, some)


def typical(problem):
    """Return the typical error of a problem as it is given [m]."""
    sets = tuple(each for each in problem.sets if each.distances is None)
    trial = mistakes.in_frames(problem, problem.chain, sets)
    return np.inf if trial is None else trial.error


def verdict(problem, words, clean):
    """Return what a mistake leads to, in a word, and in a sentence if it is not named."""
    found = mistakes.diagnose(problem)
    if found is None:
        if typical(problem) < FACTOR * clean:
            return 'same', ''
        return 'MISSED', f'{words}: nothing said'
    said = [each.what for each in found.suspects]
    if words in said[0]:
        return 'named', ''
    if any(words in each for each in said):
        return 'or', ''
    return 'OTHER', f'{words}: {"; ".join(said)}'


def of_real_robots(only, rows, as_json):
    """Print which mistakes are named on measured robots, by all rows or some."""
    table, columns, wrong = {}, [], []
    for name, session, chain in SETS:
        column = f'{name.partition("_")[0]} {session}'
        if only and only not in column:
            continue
        problem = bench.problem_of(name, session, chain)
        problem = fewer(problem, rows) if rows else problem
        columns.append(column)
        found = mistakes.diagnose(problem)
        table.setdefault('nothing', {})[column] = ['silent' if found is None else str(found)]
        clean = typical(problem)
        for group, words, bad in spoilt(problem):
            cell = table.setdefault(group, {}).setdefault(column, [])
            if bad is None or (rows and group == 'a row later'):
                continue
            word, sentence = verdict(bad, words, clean)
            cell.append(word)
            if sentence:
                wrong.append(f'{column}: {sentence}')
    if as_json:
        print(json.dumps({'table': table, 'wrong': wrong}, indent=2))
        return
    print(f'| mistake | {" | ".join(columns)} |')
    print('|---' * (len(columns) + 1) + '|')
    for group, cells in table.items():
        texts = []
        for column in columns:
            words = cells.get(column, [])
            counts = {word: words.count(word) for word in dict.fromkeys(words)}
            one = len(words) == 1
            texts.append(', '.join(w if one else f'{n} {w}' for w, n in counts.items()) or '-')
        print(f'| {group} | {" | ".join(texts)} |')
    for line in wrong:
        print(line)


def clean_set(seed):
    """Return a simulated problem without any mistake that has a name, and what it is."""
    rng = np.random.default_rng(seed)
    names = sorted(shipped_robots())
    chain = load_chain(names[rng.integers(len(names))])
    size = 10.0 if rng.random() < 0.33 else 1.0
    cell = Cell(length_error=5e-4 * size, angle_error=1e-3 * size)
    count = int(rng.choice([10, 15, 30, 60]))
    q = chain.random_joints(count, rng)
    if rng.random() < 0.5:  # about a point, as with a camera or a tracker's line of sight
        q = q[:1] + rng.uniform(0.1, 0.8) * (q - q[:1])
    oriented = bool(rng.random() < 0.6)
    noise = float(rng.choice([2e-5, 2e-4, 1e-3]))
    seen = measure(faulty(chain, cell, rng), q, rng, noise, 3.0 * noise, oriented)
    kind = rng.choice(['plain', 'plain', 'gross', 'noise', 'shuffled', 'inverted'])
    if kind == 'gross':
        bad = rng.random(count) < rng.uniform(0.05, 0.3)
        seen.positions[bad] += rng.normal(scale=0.05, size=(int(bad.sum()), 3))
    elif kind == 'noise':
        seen = replace(seen, positions=seen.positions + rng.normal(scale=0.2, size=(count, 3)))
    elif kind == 'shuffled':
        seen = replace(seen, joints=rng.permutation(seen.joints))
    elif kind == 'inverted' and oriented:
        seen = replace(seen.inverted(), inverse=bool(rng.random() < 0.5)).inverted()
    return Problem(
        chain, seen
    ), f'{chain.name}, {count} {"poses" if oriented else "points"}, {kind}'


def of_clean_sets(count, first):
    """Print how many clean sets have a mistake named; return their number."""
    alarms = 0
    begin = time.process_time()
    for seed in range(first, first + count):
        problem, what = clean_set(seed)
        found = mistakes.diagnose(problem)
        if found is not None:
            alarms += 1
            print(f'{seed}: {what}: {found}')
    each = (time.process_time() - begin) / max(count, 1)
    print(f'{alarms} false alarms in {count} sets without a mistake, {1e3 * each:.0f} ms each')
    return alarms


def main():
    """Print the table, or the false alarms."""
    options = bench.options(
        __doc__,
        clean=({'type': int, 'metavar': 'N'}, 'simulated sets without a mistake'),
        first=(0, 'seed of the first of these'),
        only=('', 'columns with this in the name'),
        rows=(0, 'rows of each set, else all'),
        json=False,
    )
    if options.clean is not None:
        of_clean_sets(options.clean, options.first)
    else:
        of_real_robots(options.only, options.rows, options.json)


if __name__ == '__main__':
    main()
