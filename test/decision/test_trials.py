# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An arm tried on some samples, a part of which may be gross errors."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fits import NOISE, UR10E, arm, measured_arm

from calib_ros import Observations, Problem, identify, load_chain
from calib_ros.apply.simulation import Cell, faulty, measure, random_frame
from calib_ros.decision.mistakes import diagnose
from calib_ros.decision.reasons import Rule
from calib_ros.decision.trials import (
    Trial,
    _usual,
    fits_each_side,
    refine_trial,
    sample_errors,
    set_in_words,
    trial_of,
    trials_of,
)
from calib_ros.estimation.start import flange


def with_gross_errors(count, gross):
    """Return an arm, and poses of it of which the first are off by a metre or two."""
    rng, true, seen = measured_arm(1, count, (0.0, 0.0))
    seen.positions[:gross] += rng.choice([-1.0, 1.0, 2.0], (gross, 3))
    return replace(true, base=None, tool=None), seen


@pytest.mark.parametrize(('count', 'found'), [(17, False), (18, True), (40, True)])
def test_gross_errors_do_not_spoil_the_closed_form(count, found):
    """Twelve rows are the fewest: base and tool explain any half a dozen."""
    chain, seen = with_gross_errors(count, count // 3)
    seen = replace(seen, base='base_B', tool='tool_B')
    trial = trial_of(chain, (seen,))
    assert (trial.error < 1e-7) == found
    places = trial.arms[0][:, :3, 3], seen.positions
    spreads = (np.sqrt(((x - x.mean(axis=0)) ** 2).sum() / count) for x in places)
    assert trial.chain.all_frames.keys() >= {'base_B', 'tool_B'}
    assert trial.spread == pytest.approx(min(spreads))
    assert trial.share == trial.error / trial.spread


def test_trials_at_once_are_those_one_by_one():
    """Of as many samples of one kind; other arms, counts and kinds are computed apart."""
    chain, seen = with_gross_errors(24, 6)
    placed = replace(seen, oriented=np.zeros(24, dtype=bool))
    kinds = (seen, placed.inverted(), seen.select(np.arange(4, 22)), replace(seen, tool='tool_B'))
    turned = [replace(each, joints=each.joints + 0.1 * k) for k in range(3) for each in kinds]
    cases = [(chain, (turned[k], turned[k - 1])) for k in range(0, 12, 2)]
    cases += [(one, (each,)) for one in (chain, UR10E) for each in turned]
    for (tried, sets), found in zip(cases, trials_of(cases), strict=True):
        alone = trial_of(tried, sets)
        assert (found.error, found.share) == pytest.approx((alone.error, alone.share), rel=1e-9)
        assert Trial(found.chain, sets, found.arms).error == pytest.approx(found.error, rel=1e-9)


def test_a_mistake_that_spares_half_of_the_samples_is_not_small():
    """Poses of two orientations, one of them told wrongly, had a typical error of 2 mm."""
    chain, seen = with_gross_errors(40, 0)
    found = trial_of(chain, (seen,))
    shifts = np.where(np.arange(40) < 16, 0.1, 0.0)[:, np.newaxis]
    shifted = replace(seen, positions=seen.positions + shifts)
    assert Trial(found.chain, (shifted,), found.arms).error > 0.1


@pytest.mark.parametrize('socket', [False, True])
def test_the_spread_is_that_of_the_smaller_of_arm_and_measurements(socket):
    """A socket measures no spread at all."""
    chain, seen = with_gross_errors(20, 0)
    small = replace(seen, positions=1e-3 * seen.positions, socket=socket)
    places = flange(chain, seen)[:, :3, 3] if socket else small.positions
    trial = trial_of(chain, (small,))
    assert trial.spread == pytest.approx(np.sqrt(places.var(axis=0).sum()))


def test_gross_errors_do_not_spoil_the_refinement():
    chain, seen = with_gross_errors(40, 8)
    arm = flange(chain, seen)
    near = trial_of(chain, (seen,)).chain
    off = near.with_offsets({f'base.{axis}': 1e-3 for axis in 'xyz'})
    rough = Trial(off, (seen,), (arm,))
    assert rough.error == pytest.approx(1e-3 * np.sqrt(3.0), abs=1e-8)
    turned = Trial(near.with_offsets({'base.rz': 1e-3}), (seen,), (arm,))
    for trial in (rough, turned):
        found = refine_trial(Problem(UR10E, seen, sigma_position=NOISE[0]), trial)
        assert sample_errors(found.chain, seen, arm)[8:].max() < 1e-6


def coupled(chain, seed, home=None):
    """Return an arm measured joint by joint, the third one given less the second."""
    rng, turns = np.random.default_rng(seed), np.linspace(-0.7, 0.8, 10)
    true = arm(rng, chain=chain)
    home = chain.random_joints(1, rng) if home is None else home
    joints = home + np.kron(np.eye(6), turns[:, np.newaxis])
    seen = measure(true, joints, rng, *NOISE, oriented=False)
    less = joints[:, 2:3] - joints[:, 1:2]
    return Problem(chain, replace(seen, joints=np.hstack([joints[:, :2], less, joints[:, 3:]])))


@pytest.mark.parametrize('seed', [0, 3, 8])
def test_the_mistake_of_a_joint_that_moves_in_few_rows_is_named(seed):
    """A usual share lies within joints moved one by one: in 3 of 16 arms another was named."""
    assert 'they are coupled' in str(diagnose(coupled(UR10E, seed)))


def test_beside_a_mistake_nothing_else_is_remarked():
    """The target was said to have moved by 710 mm, and the device by 75 mm."""
    home = np.array([0.4, 0.3, -0.1, -1.4, -0.1, 1.0])
    result = identify(coupled(load_chain('fanuc_r2000ic_165f'), 2, home))
    assert (result.refusals[0].rule, result.remarks) == (Rule.MISTAKE, ())


def test_two_sessions_in_one_are_no_mistakes():
    """Of two days of a measured Meca500, cm, signs, zeros and orders of joints were told."""
    nominal, rng = load_chain('meca500'), np.random.default_rng(0)
    true, days = faulty(nominal, Cell(), rng), []
    for count, home in ((40, (5, -37, 28, 0, 27, 5)), (50, (4, 14, 38, -89, -88, 78))):
        there = replace(true, base=random_frame(rng, 2.0), tool=random_frame(rng, 0.05))
        q = np.radians(home + rng.normal(size=(count, 6)) * (10, 10, 8, 15, 12, 35))
        days.append(measure(there, q, rng, 2e-5, 2e-4, False))
    given = (np.concatenate([getattr(e, k) for e in days]) for k in ('joints', 'positions'))
    problem = Problem(nominal, Observations.from_arrays(*given, None))
    refused = identify(problem).refusals
    assert refused[0].rule is Rule.MOVED
    assert Rule.MISTAKE not in {each.rule for each in refused}
    seen, begin = problem.observations, problem.observations.stamps_ns[40]
    assert fits_each_side(problem, seen, begin)
    wrong = np.where(seen.stamps_ns < begin, 100.0, 1.0)[:, np.newaxis] * seen.positions
    assert not fits_each_side(problem, replace(seen, positions=wrong), begin)
    one, stamps = seen.select(np.arange(24)), seen.stamps_ns
    assert [fits_each_side(problem, one, stamps[k]) for k in (11, 12, 13)] == [False, True, False]


def test_a_usual_share_is_65_percent_and_sets_are_told_by_what_not_all_share(rng):
    assert _usual(rng.permutation(np.arange(20.0))) == 12.0
    ends = (('base', 'tool'), ('base', 'tool_b'), ('base_2', 'tool_b'))
    sets = [SimpleNamespace(base=base, tool=tool) for base, tool in ends]
    told = [set_in_words(sets, each) for each in sets]
    words = ('base, tool', 'base, tool_b', 'base_2, tool_b')
    assert told == [f'in the measurements with {each} alone, ' for each in words]
    assert set_in_words(sets[:2], sets[1]) == 'in the measurements with tool_b alone, '
    assert set_in_words(sets[:1], sets[0]) == ''
