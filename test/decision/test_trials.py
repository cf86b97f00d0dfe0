# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An arm tried on some samples, a part of which may be gross errors."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, UR10E, measured_arm

from calib_ros import Problem
from calib_ros.decision.trials import Trial, misses, refined, trial_of
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
        found = refined(Problem(UR10E, seen, sigma_position=NOISE[0]), trial)
        assert misses(found.chain, seen, arm)[8:].max() < 1e-6
