# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Does a device that is out of scale make arms of few lengths worse, and are sound sets refused?

    python benchmarks/scale.py [--arms 40] [--only ARM] [--checked 1e-5]

Positions alone of 60 random poses, noise 0.05 mm, of arms whose lengths err by 0.15, 0.5 and 1.5
mm and angles by 0.3, 1 and 3 mrad; the device is right, or out of scale by 0.1 to 3 % in either
direction. The true arm judges at 1000 configurations of the region, after the best base and
tool. `harmful` are the accepted calibrations that err more there than the nominal arm, and more
than 0.01 mm; `by scale` those refused because of the scale; `other` those refused for another
reason. With `--checked` the scale is stated as known to that (`sigma_scale`), right or wrong.
"""

from collections import Counter
from dataclasses import replace

import bench
import numpy as np
from cell_simulator import misfit

from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.decision.reasons import Rule
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain import Chain, Joint
from calib_ros.kinematics.chain_file import load_chain

NOISE = 5e-5
ERRORS = (0.3, 1.0, 3.0)
SCALES = (0.0, 1e-3, 2e-3, 3e-3, 1e-2, 3e-2)
DOWN = {'alpha': -0.5 * np.pi}
SHIPPED = ('kuka_youbot', 'denso_hsr065', 'ur10e', 'puma560')


def palletiser(rng):
    """Return four joints: a turn, and three parallel axes."""
    rows = ({'d': 0.5, 'a': rng.uniform(0.0, 0.3), **DOWN}, {'a': rng.uniform(0.4, 0.9)})
    rows += ({'a': rng.uniform(0.4, 0.9)}, {'a': rng.uniform(0.05, 0.2)})
    return chain_of('four joints', rows)


def five(rng):
    """Return the same with a turning flange."""
    rows = ({'d': 0.4, 'a': rng.uniform(0.0, 0.2), **DOWN}, {'a': rng.uniform(0.3, 0.7)})
    rows += ({'a': rng.uniform(0.3, 0.7)}, DOWN, {'d': rng.uniform(0.05, 0.2)})
    return chain_of('five joints', rows)


def planar(_):
    """Return three parallel joints."""
    return chain_of('planar', ({'a': 0.4}, {'a': 0.3}, {'a': 0.2}))


def chain_of(name, rows):
    """Return a chain of revolute joints."""
    joints = (Joint(f'joint_{k}', lower=-2.5, upper=2.5, **row) for k, row in enumerate(rows))
    return Chain(name, 'standard', tuple(joints))


ARMS = {
    'four joints': palletiser,
    'five joints': five,
    **{name: lambda _, name=name: load_chain(name) for name in SHIPPED},
    'planar': planar,
}


def judged(name, number, size, scale, checked):
    """Return what becomes of one arm: 'harmful', 'good', 'by scale' or 'other'."""
    rng = np.random.default_rng([list(ARMS).index(name), number])
    chain = ARMS[name](rng)
    true = faulty(chain, Cell(length_error=5e-4 * size, angle_error=1e-3 * size), rng)
    seen = measure(true, chain.random_joints(60, rng), rng, NOISE, oriented=False)
    scale *= (-1.0) ** number
    seen = replace(seen, positions=(1.0 + scale) * seen.positions)
    result = identify(Problem(chain, seen, sigma_position=NOISE, sigma_scale=checked))
    if not result.accepted:
        return 'by scale' if any(r.rule is Rule.SCALE for r in result.refusals) else 'other'
    q = chain.random_joints(1000, rng)
    q = q[result.region.covers(q)]
    wanted = true.forward(q)[:, :3, 3]
    reached = result.chain.forward(q), replace(chain, base=true.base, tool=true.tool).forward(q)
    after, before = (
        bench.rms(misfit(wanted, each[:, :3, :3], each[:, :3, 3])) for each in reached
    )
    return 'harmful' if after > max(before, 1e-5) else 'good'


def main():
    """Print a line for each arm and scale."""
    options = bench.options(
        __doc__,
        arms=(40, 'of each kind and size of errors'),
        only=('', 'arms whose names hold this'),
        checked=(0.0, 'stated error of the scale'),
    )
    heads = ('good', 'harmful', 'by scale', 'other')
    print(f'{"arm":14}{"scale":>8}' + ''.join(f'{head:>10}' for head in heads))
    total = {scale: Counter() for scale in SCALES}
    for name in (each for each in ARMS if options.only in each):
        for scale in SCALES:
            found = Counter(
                judged(name, k, size, scale, options.checked)
                for size in ERRORS
                for k in range(options.arms)
            )
            total[scale] += found
            print(line_of(name, scale, [found[head] for head in heads]), flush=True)
    for scale, found in total.items():
        print(line_of('all', scale, [found[head] for head in heads]))


def line_of(name, scale, counts):
    """Return a line of the table."""
    return f'{name:14}{100 * scale:>6.1f} %' + ''.join(f'{count:>10}' for count in counts)


if __name__ == '__main__':
    main()
