# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Position errors on held-out measurements of real robots, by model.

    CALIB_ROS_DATA=FOLDER python benchmarks/real_robots.py [--json]

Rows: the nominal chain with its frames fitted, the geometric model (default settings; `plain` is
without the robust loss, as the reference was made), the geometric model with each group of
non-geometric effects, and `auto`, which chooses among them by cross-validation on the fitted rows.
Sets of a ball in sockets (MUKCa) are judged by leaving out one place at a time; their reference
leaves out the last place only, so that place is printed as well.
"""

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from calib_ros import effects
from calib_ros.config import load_chain
from calib_ros.identification import Problem, identify
from calib_ros.selection import identify_model
from calib_ros.tables import read_table

DATA = Path(os.environ.get('CALIB_ROS_DATA', Path(__file__).parents[2] / 'shared' / 'data'))
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


def problem_of(name, session, chain_name):
    """Return the problem of a data set, with its held-out rows."""
    chain = load_chain(DATA / name / chain_name)
    table = read_table(DATA / name / 'uniform.csv', len(chain.joints), (session,))
    return Problem(
        chain,
        table.fitted[0],
        table.held_out,
        more=table.fitted[1:],
        separations=tuple((*pair, 0.05) for pair in table.pairs),
    )


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
    yield row('geometric', result.validation.figures[1], result, seconds)
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


def main():
    """Run all sets and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--json', action='store_true')
    options = parser.parse_args()
    found = {}
    for (name, session, chain_name), reference in SETS.items():
        lines = list(rows_of(problem_of(name, session, chain_name)))
        found[f'{name}/{session}'] = {'reference_rms_mm': reference, 'models': lines}
        if options.json:
            continue
        print(f'{name} {session} (reference {reference:.3f} mm)')
        for line in lines:
            print(
                f'  {line["model"]:18} RMS {line["rms_mm"]:7.3f}  mean {line["mean_mm"]:7.3f}  '
                f'max {line["max_mm"]:7.3f} mm  {line["parameters"]:3} parameters  '
                f'{"accepted" if line["accepted"] else "NOT accepted":12} {line["seconds"]:5.2f} s'
            )
        if 'chosen' in lines[-1]:
            print(f'  chosen: {"; ".join(lines[-1]["chosen"]) or "nothing"}')
    if options.json:
        print(json.dumps(found, indent=2))


if __name__ == '__main__':
    main()
