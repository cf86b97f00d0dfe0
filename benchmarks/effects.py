# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How near does `--model auto` come to the model that is true?

    python benchmarks/effects.py [--arms 60]

Arms with errors of 0.5 mm and 1 mrad and, each with a chance of a half, gear ratios, couplings of
the wrist, eccentricities and gravity of the usual size or four times that; four in ten also have a
harmonic of one drive. 40, 60, 100 or 200 poses, noise 0.03 mm and 0.1 mrad. `times the true model`
is the RMS position error at 1000 other poses over that of a fit of just the true effects; `missed`
are arms with more than twice that, `false` those of a run without effects where one is chosen.
"""

from dataclasses import replace

import bench
import numpy as np

from calib_ros import Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure
from calib_ros.identification.model_choice import identify_model
from calib_ros.kinematics import effects

ROBOTS = ('ur10', 'staubli_tx90l', 'kuka_iiwa14')
GROUPS = ('ratio', 'coupling', 'eccentricity', 'gravity')
COUNTS = (40, 60, 100, 200)


def effects_of(chain, rng):
    """Return the sizes of the effects of an arm by name."""
    names = [n for g in GROUPS if rng.random() < 0.5 for n in effects.members(chain, g)]
    if rng.random() < 0.4:
        names += effects.waves(rng.choice(chain.joint_names), int(rng.integers(3, 30)))
    size = rng.choice([1.0, 4.0])
    return {name: size * effects.expected(name) * rng.normal() for name in names}


def errors_of(number, bare=False):
    """Return the RMS errors [m] by geometric model, `auto` and true model, and what is chosen."""
    rng = np.random.default_rng(number)
    chain = load_chain(ROBOTS[number % 3])
    values = {} if bare else effects_of(chain, rng)
    true = faulty(chain, Cell(), rng).with_effect_values(values)
    joints = chain.random_joints(COUNTS[number // 3 % 4], rng)
    problem = Problem(chain, measure(true, joints, rng, 3e-5, 1e-4))
    geometric, auto = identify(problem), identify_model(problem, 'auto')
    known = identify(replace(problem, effects=tuple(values)), geometric) if values else geometric
    unseen = chain.random_joints(1000, rng)
    found = (bench.distances(each.chain, true, unseen) for each in (geometric, auto, known))
    return [bench.rms(each) for each in found], auto.chain.effects


def main():
    """Print the figures."""
    arms = bench.options(__doc__, arms=60).arms
    errors = np.array([errors_of(number)[0] for number in range(arms)])
    for name, column in zip(('geometric', 'auto'), errors.T, strict=False):
        ratio = column / errors[:, 2]
        mean, missed = float(np.exp(np.log(ratio).mean())), int((ratio > 2.0).sum())
        print(f'{name:10} {mean:6.2f} times the true model, missed {missed} of {arms}')
    chosen = sum(bool(errors_of(number, bare=True)[1]) for number in range(arms))
    print(f'false {chosen} of {arms}')


if __name__ == '__main__':
    main()
