# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Does an accepted calibration make the arm worse anywhere that it may be used?

    python benchmarks/harm.py [--quick] [--jobs 2] [--only DESIGN] [--json]

Simulated sessions (`cell_simulator.py`, which shares no code with the package), 60 poses with
noise of 0.05 mm and 0.2 mrad unless the design says otherwise, a third of them without
orientations. The true arm judges: RMS position error after the best base and tool, at 250
configurations drawn from the joint range (the limits, +-2.5 rad at most) within the region for
which the calibration was accepted; in all of the range where it names none. Where it covers less
than a hundredth of the range, they are drawn near the measured ones. Where a joint slipped, the
arm counts as it is afterwards.

- `accepted_harmful`: share of the accepted calibrations that err more there than the nominal arm,
  and more than 0.01 mm, a fifth of the noise.
- `false_accept`: share of the healthy arms (no error in any row of the table) with an accepted
  calibration.
- `refused_good`: share of the arms with errors of 0.1 mm or more, measured at random, on a grid or
  along a path with nothing amiss, whose calibration is not accepted, or for less than half of the
  measured poses.
- `accepted_moved`: share of the accepted among sessions in which something moved by much: 0.1
  degrees or 1 mm.
- `compensated_worse`: share of the poses that `compensate` leaves worse than they were by more
  than the longest semi-axis of the calibration's own 95 % ellipsoid.
- `held`: share of positions within the 95 % ellipsoids of calibrations, accepted or not, from half
  of the workspace (q1 < 0), in the other half, in their region only.
- `crashed`: share that ended in a traceback. Errors of the package count as not accepted.
"""

import argparse
import json
import os
import time
from collections import Counter
from dataclasses import dataclass, replace
from multiprocessing import get_context
from zlib import crc32

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import numpy as np
from cell_simulator import RIPPLE, Arm, misfit, poses, resized, rms
from scipy.spatial.transform import Rotation

from calib_ros.compensation import Compensator, compensate
from calib_ros.config import load_chain
from calib_ros.errors import CalibrationError
from calib_ros.identification import Observations, Problem, identify
from calib_ros.selection import identify_model

NOISE = (5e-5, 2e-4)
FLOOR = 1e-5
GOOD = 1e-4
SIX = ('ur10', 'puma560', 'staubli_tx90l')
SEVEN = ('kuka_iiwa14', 'franka_panda')
ERRORS = {  # lengths [m], angles [rad]
    'none': (0.0, 0.0),
    'good': (5e-4, 1e-3),  # then scaled to pose errors of 0.1 to 0.2 mm
    'small': (5e-5, 1e-4),
    'usual': (5e-4, 1e-3),
    'large': (5e-3, 1e-2),
}
SIZES = ('usual', 'large', 'small', 'none')
ORDERS = ('random', 'path', 'sweeps')


@dataclass(frozen=True)
class Design:
    """A kind of session, with the number of its arms in a full run."""

    name: str
    arms: int
    orders: tuple = ('random',)
    errors: tuple = ('none', 'usual')
    what: str = ''
    size: float = 0.0
    robots: tuple = SIX + SEVEN
    model: str = 'geometric'
    bends: tuple = ('',)
    counts: tuple = (60,)


DESIGNS = (
    *(
        Design(order, 90, (order,), tuple(ERRORS))
        for order in ('random', 'sweeps', 'grid', 'path', 'local')
    ),
    *(
        Design(f'a joint within {size} mrad', 40, errors=SIZES, what='still', size=1e-3 * size)
        for size in (0, 0.3, 1, 3, 10)
    ),
    Design('five of seven joints still', 40, what='still five', robots=SEVEN),
    Design(
        *('grid in succession', 80, ('succession',), ('none', 'small', 'usual')),
        bends=('', 'soft', 'wavy'),
        counts=(40, 80, 120, 160),
        robots=SIX,
    ),
    *(
        Design(f'{bend}, {order}', 60, (order,), ('none', 'small', 'usual'), bends=(bend,))
        for bend in ('soft', 'wavy')
        for order in ('local', 'half', 'random')
    ),
    *(
        Design(f'{what} moved, {size} mm', 72, ORDERS, what=what, size=1e-3 * size)
        for what, size in (('tool', 0.3), ('tool', 1), ('tool', 4), ('base', 1), ('base', 4))
    ),
    *(
        Design(f'slip of {size} degrees', 72, ORDERS, what='slip', size=np.radians(size))
        for size in (0.02, 0.1, 0.5)
    ),
    Design('drifting tracker', 80, ('path',), what='drift', size=3e-4),
    *(Design(f'rounded, {order}', 40, (order,), what='rounded') for order in ('sweeps', 'grid')),
    Design('test rows repeat', 40, what='test repeats', bends=('ripple',)),
    Design('repeats within 2 mrad', 40, what='repeats', bends=('ripple',)),
    Design('two or three targets', 60, ORDERS, what='targets', bends=('', 'ripple')),
    Design('one orientation', 40, ('lines',), robots=('ur10', 'puma560', 'kuka_iiwa14')),
    Design('scale of 500 ppm', 40, what='scale', size=5e-4),
    Design('scale of 1 %', 40, what='scale', size=1e-2),
    Design('auto', 40, ORDERS, model='auto'),
    Design('auto, bent', 40, ('local', 'half', 'path'), bends=('soft', 'wavy'), model='auto'),
    Design('auto, targets', 20, ORDERS, what='targets', bends=('', 'ripple'), model='auto'),
)


@dataclass(frozen=True)
class Session:
    """What was measured, of which arm: `arm` in the end, nothing wrong with it or `healthy`."""

    chain: object
    nominal: Arm
    arm: Arm
    problem: Problem
    healthy: bool


def session(design, number):
    """Return the session of the arm of that number."""
    rng = np.random.default_rng([crc32(design.name.encode()), number])
    errors = design.errors[number % len(design.errors)]
    robot, order, bend, count = (
        each[rng.integers(len(each))]
        for each in (design.robots, design.orders, design.bends, design.counts)
    )
    nominal = Arm.read(robot).in_cell(rng)
    arm = nominal.faulty(*ERRORS[errors], rng)
    if errors == 'good':
        arm = resized(nominal, arm, 'table', rng.uniform(1.0, 2.0) * GOOD)
    if bend in ('soft', 'wavy', 'ripple'):
        field = 'softness' if bend == 'soft' else 'waves'
        bare = nominal.soft(rng) if bend == 'soft' else nominal.wavy((1, 2), 1e-3, rng)
        bare = nominal.wavy((RIPPLE,), 1e-3, rng) if bend == 'ripple' else bare
        size = rng.uniform(1e-4, 2e-4) if bend == 'ripple' else rng.uniform(2e-4, 1e-3)
        arm = replace(arm, **{field: getattr(resized(nominal, bare, field, size), field)})
    q = poses(nominal, order, count, rng)
    if design.what.startswith('still'):
        still = rng.permutation(q.shape[1])[: 5 if design.what == 'still five' else 1]
        home = nominal.draw(1, rng)[0]
        q[:, still] = home[still] + rng.uniform(-1.0, 1.0, (len(q), len(still))) * design.size
    measured, problem = measured_by(design, arm, q, rng)
    chain = load_chain(robot)
    problem = problem(chain)
    healthy = errors == 'none' and bend in ('', 'ripple') and design.what != 'slip'
    return Session(chain, nominal, measured, problem, healthy)


def measured_by(design, arm, q, rng):
    """Return the arm in the end, and what makes a problem of the chain."""
    what, size = design.what, design.size
    oriented = rng.random() > 1.0 / 3.0
    options = {'sigma_position': NOISE[0], 'sigma_orientation': NOISE[1]}
    if what in ('test repeats', 'repeats'):
        q = q[:20] if what == 'test repeats' else q[:12]
        q = np.tile(q, (3 if what == 'test repeats' else 5, 1))
        q = q + (rng.uniform(-2e-3, 2e-3, q.shape) if what == 'repeats' else 0.0)
        if what == 'test repeats':
            options['held_out'] = observed(arm, q[:20], rng, oriented)
    late = np.arange(len(q)) >= rng.integers(len(q) // 4, 3 * len(q) // 4)
    direction = rng.normal(size=3)
    far = size * (rng.uniform(0.5, 1.75) if size > 2e-3 else 1.0)
    moved = late[:, None] * far * direction / np.linalg.norm(direction)
    if what == 'tool':
        seen = observed(arm, q, rng, oriented, shift=moved)
    elif what == 'targets':
        tools = [rng.uniform(-0.15, 0.15, 3) for _ in range(rng.integers(2, 4))]
        q = q[:: len(tools)]
        seen, *more = (observed(arm, q, rng, oriented, shift=tool) for tool in tools)
        options['more'] = [replace(o, tool=f'tool_{k}') for k, o in enumerate(more)]
    elif what == 'slip':
        after = arm.slipped(rng.integers(q.shape[1]), size * rng.choice([-1.0, 1.0]))
        early, then = (observed(a, q[w], rng, oriented) for a, w in ((arm, ~late), (after, late)))
        parts = [
            np.concatenate([getattr(o, name) for o in (early, then)])
            for name in ('joints', 'positions', 'rotations')
        ]
        seen, arm = Observations.from_arrays(*parts[: 3 if oriented else 2]), after
    else:
        seen = observed(arm, q, rng, oriented)
    if what == 'base':
        seen = replace(seen, positions=seen.positions + moved)
    if what == 'drift':
        seen = replace(seen, positions=seen.positions + drift(len(q), size, rng))
    if what == 'scale':
        seen = replace(seen, positions=seen.positions * (1.0 + size))
    if what == 'rounded':
        seen = replace(seen, joints=np.round(seen.joints, 3))
    return arm, lambda chain: Problem(chain, seen, **options)


def observed(arm, q, rng, oriented, shift=0.0):
    """Return observations of an arm at joint values (N, n)."""
    rotation, place = arm.forward(q, shift)
    place = place + rng.normal(scale=NOISE[0], size=place.shape)
    noise = Rotation.from_rotvec(rng.normal(scale=NOISE[1], size=place.shape)).as_matrix()
    return Observations.from_arrays(q, place, noise @ rotation if oriented else None)


def drift(count, size, rng):
    """Return how far (count, 3) [m] a tracker is off: a swing, or a random walk."""
    if rng.random() < 0.5:
        share = np.arange(count)[:, None] / count
        return size * np.sin(6.28 * (rng.uniform(0.5, 1.5, 3) * share + rng.random(3)))
    return size * np.cumsum(rng.normal(size=(count, 3)), axis=0) / np.sqrt(count)


def covered(result, q):
    """Return (N,) whether the calibration may be used at joint values; without region anywhere."""
    region = getattr(result, 'region', None)
    return np.ones(len(q), dtype=bool) if region is None else np.asarray(region.covers(q))


def region(result, one, rng):
    """Return the share of the range that is covered, and joint values (250 or less, n) there."""
    q = one.nominal.draw(2000, rng)
    inside = covered(result, q)
    share, q = float(inside.mean()), q[inside]
    if share < 0.01:
        fitted = one.problem.observations.joints
        near = fitted[rng.integers(len(fitted), size=2000)]
        near = near + rng.normal(scale=0.05, size=near.shape)
        near = np.clip(np.concatenate([near, fitted]), *one.nominal.limits.T)
        q = near[covered(result, near)]
    return share, q[:250]


def judge(task):
    """Identify one arm and judge what comes of it."""
    design, number = task
    one = session(design, number)
    rng = np.random.default_rng([number, 1])
    q = one.nominal.draw(250, rng)
    known = rms(misfit(one.arm.forward(q)[1], *one.nominal.forward(q)))
    row = {
        'design': design.name,
        'number': number,
        'robot': one.chain.name,
        'errors': design.errors[number % len(design.errors)],
        'nominal_mm': 1e3 * known,
        'healthy': one.healthy,
        'good': design.name in ('random', 'grid', 'path') and known >= GOOD,
        'moved': design.what in ('tool', 'base', 'slip') and design.size >= 1e-3,
    }
    begin = time.perf_counter()
    try:
        model = design.model
        result = identify(one.problem) if model != 'auto' else identify_model(one.problem, model)
    except CalibrationError as err:
        return row | {'seconds': time.perf_counter() - begin, 'error': str(err), 'accepted': False}
    except Exception as err:  # a traceback is what is looked for
        text = f'{type(err).__name__}: {err}'
        return row | {'seconds': time.perf_counter() - begin, 'crash': text, 'accepted': False}
    row |= {'seconds': time.perf_counter() - begin, 'accepted': result.accepted}
    if 'half' in design.orders:
        row |= other_half(result, one, rng)
    if not result.accepted:
        return row | {'refusals': list(result.refusals)}
    row['share'], q = region(result, one, rng)
    row['fitted'] = float(covered(result, one.problem.observations.joints).mean())
    if len(q) < 20:
        return row
    wanted = one.arm.forward(q)[1]
    nominal = rms(misfit(wanted, *one.nominal.forward(q)))
    poses_of = result.chain.forward(q)
    calibrated = rms(misfit(wanted, poses_of[:, :3, :3], poses_of[:, :3, 3]))
    row |= {
        'nominal_mm': 1e3 * nominal,
        'calibrated_mm': 1e3 * calibrated,
        'harmful': calibrated > max(nominal, FLOOR),
    }
    return row | compensated(result, one, q[:60])


def other_half(result, one, rng):
    """Return how many of 100 positions beyond q1 = 0 are covered, and within their ellipsoids."""
    limits = one.nominal.limits.copy()
    limits[0, 0] = 0.0
    q = one.nominal.draw(100, rng, limits)
    q = q[covered(result, q)]
    if not len(q):
        return {'beyond': 0, 'held': 0}
    error = one.arm.forward(q)[1] - result.chain.forward(q)[:, :3, 3]
    axes = result.confidence_ellipsoid(q)
    square = np.sum(axes**2, axis=2)
    along = np.einsum('nki,ni->nk', axes, error) / square
    return {'beyond': len(q), 'held': int(np.sum(np.sum(along**2, axis=1) <= 1.0))}


def compensated(result, one, q):
    """Return how many poses are corrected, and worse by more than the 95 % limit stated.

    Meant are the poses of the nominal arm, in the frames that suit the real arm best.
    """
    done = compensate(Compensator(one.chain, result.chain), q).joints
    kept = ~np.isnan(done).any(axis=1) & covered(result, np.nan_to_num(done))
    if np.count_nonzero(kept) < 10:
        return {'compensated': 0, 'worse': 0}
    q, done = q[kept], done[kept]
    meant = one.nominal.forward(q)
    before, after = (misfit(one.arm.forward(each)[1], *meant) for each in (q, done))
    limit = np.linalg.norm(result.confidence_ellipsoid(done), axis=2).max(axis=1)
    return {'compensated': len(q), 'worse': int(np.sum(after > before + limit))}


def share_of(rows, part, of):
    """Return how many of the rows that have `of` have `part`, of how many, and the share."""
    chosen = [row for row in rows if row.get(of, of == 'arms')]
    hits = sum(bool(part(row)) for row in chosen)
    return {'count': hits, 'of': len(chosen), 'share': hits / max(len(chosen), 1)}


def refused(row):
    """Tell whether a calibration is of no use even where it was measured."""
    return not row['accepted'] or row['fitted'] < 0.5


def figures(rows):
    """Return the counts of some arms."""
    judged = [row for row in rows if 'calibrated_mm' in row]
    total = Counter()
    for row in rows:
        total.update({k: row.get(k, 0) for k in ('compensated', 'worse', 'beyond', 'held')})

    def middle(key, pick=np.median):
        return float(pick([row[key] for row in judged])) if judged else None

    accepted = [row['share'] for row in rows if 'share' in row]
    return {
        'arms': len(rows),
        'accepted': sum(row['accepted'] for row in rows),
        'accepted_harmful': share_of(rows, lambda row: row.get('harmful'), 'accepted'),
        'false_accept': share_of(rows, lambda row: row['accepted'], 'healthy'),
        'refused_good': share_of(rows, refused, 'good'),
        'accepted_moved': share_of(rows, lambda row: row['accepted'], 'moved'),
        'crashed': share_of(rows, lambda row: 'crash' in row, 'arms'),
        'errors': sum('error' in row for row in rows),
        'covered_share': float(np.median(accepted)) if accepted else None,
        'nominal_mm': middle('nominal_mm'),
        'calibrated_mm': middle('calibrated_mm'),
        'calibrated_max_mm': middle('calibrated_mm', np.max),
        **total,
        'seconds': sum(row['seconds'] for row in rows),
    }


def text_of(value, digits=3):
    """Return a figure as text."""
    return '-' if value is None else f'{value:.{digits}f}'


def of(part):
    """Return a count and of how many."""
    return f'{part["count"]}/{part["of"]}' if part['of'] else '-'


def line_of(name, row):
    """Return a line of the table."""
    cells = [
        f'{name:27} {row["arms"]:5} {row["accepted"]:5}',
        *(of(row[key]) for key in ('accepted_harmful', 'false_accept', 'refused_good')),
        str(row['crashed']['count']),
        text_of(row['covered_share'], 2),
        *(text_of(row[key]) for key in ('nominal_mm', 'calibrated_mm', 'calibrated_max_mm')),
        f'{row["worse"]}/{row["compensated"]}' if row['compensated'] else '-',
        f'{row["held"]}/{row["beyond"]}' if row['beyond'] else '-',
    ]
    return cells[0] + ''.join(f'{cell:>11}' for cell in cells[1:])


def main():
    """Run all designs and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--quick', action='store_true', help='a tenth of the arms')
    parser.add_argument('--jobs', type=int, default=2, help='processes')
    parser.add_argument('--only', default='', help='designs whose names hold this')
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()
    designs = [design for design in DESIGNS if options.only in design.name]
    share = 10 if options.quick else 1
    tasks = [(d, number) for d in designs for number in range(-(-d.arms // share))]
    with get_context('spawn').Pool(options.jobs) as pool:
        rows = pool.map(judge, tasks, chunksize=4)
    table = {d.name: figures([row for row in rows if row['design'] == d.name]) for d in designs}
    total = figures(rows)
    if options.json:
        keys = ('accepted_harmful', 'false_accept', 'refused_good', 'accepted_moved', 'crashed')
        document = {key: total[key]['share'] for key in keys}
        document['compensated_worse'] = total['worse'] / max(total['compensated'], 1)
        document['held'] = total['held'] / max(total['beyond'], 1)
        print(json.dumps(document | {'total': total, 'designs': table, 'arms': rows}, indent=1))
        return
    heads = ('harmful', 'false', 'refused', 'crashed', 'covered', 'nominal', 'calibrated', 'max')
    print(f'{"design":27} {"arms":>5} {"acc.":>5}', end='')
    print(''.join(f'{head:>11}' for head in (*heads, 'worse', 'held')))
    for name, row in (table | {'all': total}).items():
        print(line_of(name, row))
    print(f'accepted although much moved: {of(total["accepted_moved"])}')
    for row in rows:
        if 'crash' in row:
            print(f'{row["design"]} {row["number"]} ended in {row["crash"]}')


if __name__ == '__main__':
    main()
