# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Does an accepted calibration make the arm worse anywhere that it may be used?

    python benchmarks/harm.py [--quick] [--jobs 2] [--only DESIGN] [--json]

Simulated sessions (`cell_simulator.py`, which shares no code with the package), 60 poses with
noise of 0.05 mm and 0.2 mrad unless the design says otherwise, a third of them without
orientations. The true arm judges: RMS position error after the best base and tool, at 1000
configurations drawn from the joint range (the limits, +-2.5 rad at most) within the region for
which the calibration was accepted; in all of the range where it names none. Where it covers less
than a hundredth of the range, they are drawn near the measured ones. Where a joint slipped, the
arm counts as it is afterwards.

- `accepted_harmful`: share of the accepted calibrations that err more there than the nominal arm,
  and more than 0.01 mm, a fifth of the noise.
- `false_accept`: share of the healthy arms (no error in any row of the table) with an accepted
  calibration; `false_accept_worst` of the worst design.
- `refused_good`: share of the arms with errors of 0.1 mm or more, measured at random, on a grid or
  along a path with nothing amiss, whose calibration is not accepted, or for less than half of the
  measured poses.
- `accepted_moved`: share of the accepted among sessions in which something moved by much: 0.1
  degrees or 1 mm.
- `compensated_worse`: share of the poses that `compensate` leaves worse than they were by more
  than the longest semi-axis of the calibration's own 95 % ellipsoid.
- `held`: share of positions within the 95 % ellipsoids of calibrations accepted from half of the
  workspace (q1 < 0), in the other half, within their region.
- `crashed`: share that ended in a traceback. Errors of the package count as not accepted.
"""

import json
import time
import traceback
from collections import Counter
from multiprocessing import get_context
from pathlib import Path

import bench
import numpy as np
from cell_simulator import misfit
from harm_designs import DESIGNS, GOOD, session

from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.errors import CalibrationError
from calib_ros.identification.identification import identify
from calib_ros.identification.model_choice import identify_model

FLOOR = 1e-5
"""Errors [m] below which nothing is harm."""
FEW, MOST = 20, 1000
"""Configurations that are too few to judge by, and as many as are drawn to judge by."""
SUMS = ('unjudged', 'compensated', 'worse', 'beyond', 'held', 'seconds')


def covered(result, q):
    """Return (N,) whether the calibration may be used at joint values; without region anywhere."""
    region = getattr(result, 'region', None)
    return np.ones(len(q), dtype=bool) if region is None else np.asarray(region.covers(q))


def region(result, one, rng):
    """Return the share of the range that is covered, and joint values (MOST or less, n) there."""
    q = one.nominal.draw(4 * MOST, rng)
    inside = covered(result, q)
    share, q = float(inside.mean()), q[inside]
    if share < 0.01:
        fitted = one.problem.observations.joints
        near = fitted[rng.integers(len(fitted), size=4 * MOST)]
        near = near + rng.normal(scale=0.05, size=near.shape)
        near = np.clip(np.concatenate([near, fitted]), *one.nominal.limits.T)
        q = near[covered(result, near)]
    return share, q[:MOST]


def judge(task):
    """Identify one arm and judge what comes of it."""
    design, number = task
    one = session(design, number)
    rng = np.random.default_rng([number, 1])
    q = one.nominal.draw(MOST, rng)
    known = bench.rms(misfit(one.arm.forward(q)[1], *one.nominal.forward(q)))
    row = {
        'design': design.name,
        'number': number,
        'robot': one.chain.name,
        'order': one.order,
        'errors': one.errors,
        'nominal_mm': 1e3 * known,
        'healthy': one.healthy,
        'good': design.name in ('random', 'grid', 'path') and known >= GOOD,
        'moved': design.what in ('tool', 'base', 'slip') and design.size >= 1e-3,
        'accepted': False,
    }
    begin = time.perf_counter()
    try:
        model = design.model
        result = identify(one.problem) if model != 'auto' else identify_model(one.problem, model)
        row['seconds'] = time.perf_counter() - begin
        if result.accepted:
            return row | {'accepted': True} | used(result, one, rng)
        return row | {'refusals': list(result.refusals)}
    except CalibrationError as err:
        return row | {'error': str(err)}
    except Exception as err:  # a traceback is what is looked for
        place = traceback.extract_tb(err.__traceback__)[-1]
        where = f'{Path(place.filename).name}:{place.lineno}'
        return row | {'crash': f'{type(err).__name__} in {where}: {err}'}


def used(result, one, rng):
    """Judge an accepted calibration over its region."""
    share, q = region(result, one, rng)
    row = {
        'share': share,
        'fitted': float(covered(result, one.problem.observations.joints).mean()),
        'unjudged': len(q) < FEW,
    }
    if len(q) < FEW:
        return row
    wanted = one.arm.forward(q)[1]
    nominal = bench.rms(misfit(wanted, *one.nominal.forward(q)))
    reached = result.chain.forward(q)
    calibrated = bench.rms(misfit(wanted, reached[:, :3, :3], reached[:, :3, 3]))
    row |= {
        'nominal_mm': 1e3 * nominal,
        'calibrated_mm': 1e3 * calibrated,
        'harmful': calibrated > max(nominal, FLOOR),
    }
    if one.order == 'half':
        row |= other_half(result, one, rng)
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
    return {'beyond': len(q), 'held': int(bench.within(result, q, error).sum())}


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
    return {'count': hits, 'of': len(chosen), 'share': hits / len(chosen) if chosen else None}


def refused(row):
    """Tell whether a calibration is of no use even where it was measured."""
    return not row['accepted'] or row['fitted'] < 0.5


def figures(rows):
    """Return the counts of some arms."""
    judged = [row for row in rows if 'calibrated_mm' in row]
    total = Counter()
    for row in rows:
        total.update({key: row.get(key, 0) for key in SUMS})

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
        'covered_share': float(np.median(accepted)) if accepted else None,
        'nominal_mm': middle('nominal_mm'),
        'calibrated_mm': middle('calibrated_mm'),
        'calibrated_max_mm': middle('calibrated_mm', np.max),
        **total,
        'errors': sum('error' in row for row in rows),
    }


def text_of(value, digits=3):
    """Return a figure as text."""
    return '-' if value is None else f'{value:.{digits}f}'


def among(part):
    """Return a count and of how many."""
    return f'{part["count"]}/{part["of"]}' if part['of'] else '-'


def line_of(name, row):
    """Return a line of the table."""
    cells = [
        f'{name:27} {row["arms"]:5} {row["accepted"]:5}',
        *(among(row[key]) for key in ('accepted_harmful', 'false_accept', 'refused_good')),
        str(row['crashed']['count']),
        text_of(row['covered_share'], 2),
        *(text_of(row[key]) for key in ('nominal_mm', 'calibrated_mm', 'calibrated_max_mm')),
        f'{row["worse"]}/{row["compensated"]}' if row['compensated'] else '-',
        f'{row["held"]}/{row["beyond"]}' if row['beyond'] else '-',
    ]
    return cells[0] + ''.join(f'{cell:>11}' for cell in cells[1:])


def main():
    """Run all designs and print the figures."""
    options = bench.options(
        __doc__,
        quick=(False, 'a tenth of the arms'),
        jobs=(2, 'processes'),
        only=('', 'designs whose names hold this'),
        json=False,
    )
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
        worst = [row['false_accept']['share'] for row in table.values()]
        document['false_accept_worst'] = max((w for w in worst if w is not None), default=None)
        for key, part, of in (
            ('compensated_worse', 'worse', 'compensated'),
            ('held', 'held', 'beyond'),
        ):
            document[key] = total[part] / total[of] if total[of] else None
        print(json.dumps(document | {'total': total, 'designs': table, 'arms': rows}, indent=1))
        return
    heads = ('harmful', 'false', 'refused', 'crashed', 'covered', 'nominal', 'calibrated', 'max')
    print(f'{"design":27} {"arms":>5} {"acc.":>5}', end='')
    print(''.join(f'{head:>11}' for head in (*heads, 'worse', 'held')))
    for name, row in (table | {'all': total}).items():
        print(line_of(name, row))
    print(f'accepted although much moved: {among(total["accepted_moved"])}')
    for row in rows:
        if 'crash' in row:
            print(f'{row["design"]} {row["number"]} ended in {row["crash"]}')


if __name__ == '__main__':
    main()
