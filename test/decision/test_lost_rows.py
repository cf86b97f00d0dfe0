# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows that one of two tables lacks: joint values and measurements stand side by side no more."""

from dataclasses import replace

import numpy as np
import pytest
from fits import NOISE, UR10E, arm

from calib_ros import Problem, identify
from calib_ros.apply.simulation import measure
from calib_ros.decision.lost_rows import _apart, _where, row_loss
from calib_ros.estimation.levels import LEAST_ASIDE


def seen_of(count, oriented):
    rng = np.random.default_rng(1)
    return measure(arm(rng), UR10E.random_joints(count, rng), rng, *NOISE, oriented)


@pytest.mark.parametrize(
    ('positions', 'joints', 'said'),
    [
        ([9], [-1], 'from pose 10 on the joint values stand 1 row below'),
        ([-2, -1], [21, 22], 'from pose 22 on the joint values stand 2 rows above'),
        ([31], [0], 'before pose 32 the joint values stand 1 row above'),
    ],
)
@pytest.mark.parametrize('oriented', [True, False])
def test_rows_lost_in_one_of_two_tables_are_named(positions, joints, said, oriented):
    """Joint values and measurements were put side by side, row by row."""
    seen = seen_of(40, oriented)
    measured = seen.select(np.delete(np.arange(len(seen)), positions))
    kept = np.delete(seen.joints, joints, axis=0)
    result = identify(Problem(UR10E, replace(measured, joints=kept)))
    assert not result.accepted
    assert result.refusals[0].startswith(f'{said} their measurement')


def test_rows_lost_before_the_first_and_again_later_are_not_told_as_one():
    """Corrected as told, the first half would still stand one row off."""
    seen = seen_of(40, False)
    rows = np.delete(np.arange(40), [0, 20])
    shifted = replace(seen.select(rows), joints=seen.joints[:-2])
    assert row_loss(Problem(UR10E, shifted), UR10E, shifted, 5e-3) is None


@pytest.mark.parametrize(
    ('before', 'after', 'row'),
    [('11100', '00111', 2), ('11110', '00011', 3), ('00000', '11111', 0), ('11111', '00000', 5)],
)
def test_the_row_is_the_first_that_leaves_most_to_fit(before, after, row):
    assert _where(*(np.array([*map(int, each)], dtype=bool) for each in (before, after))) == row


@pytest.mark.parametrize(
    ('own', 'other', 'found'),
    [
        (20, 0, True),
        (17, 0, True),  # all but nearly a fifth
        (16, 0, False),
        (20, 9, True),
        (20, 10, False),  # the other shift fits as many
    ],
)
@pytest.mark.parametrize('first', [True, False])
def test_each_side_of_a_lost_row_fits_by_its_own_shift(own, other, found, first):
    far = np.full((2, 20 + LEAST_ASIDE), 1.0)
    side, rest = (np.s_[:20], np.s_[20:]) if first else (np.s_[-20:], np.s_[:-20])
    which = int(not first)  # before or after
    far[which, side][:own] = 0.0
    far[1 - which, side][:other] = 0.0
    far[1 - which, rest] = 0.0
    row = 20 if first else LEAST_ASIDE
    assert _apart(*far, row, 0.5) == found
    assert not _apart(*far[:, :-1] if first else far[:, 1:], row - (not first), 0.5)
