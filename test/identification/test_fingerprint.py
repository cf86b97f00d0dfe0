# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from calib_ros.errors import ConfigError
from calib_ros.estimation.observations import Observations
from calib_ros.identification.fingerprint import KEPT, Fingerprint, hashes, reused_in_words


def rows(count, seed=0):
    rng = np.random.default_rng(seed)
    return Observations.from_arrays(rng.normal(size=(count, 6)), rng.normal(size=(count, 3)))


@pytest.mark.parametrize('count', [60, 10 * KEPT])
def test_rows_that_were_fitted_are_known_in_any_order(count):
    fitted, new = rows(count), rows(count, 1)
    found = Fingerprint.of_record({'rows': Fingerprint.of([fitted]).document()}, 'file')
    again = fitted.select(np.random.default_rng(2).permutation(count))
    rounding = replace(again, joints=again.joints + 1e-12, positions=again.positions - 1e-12)
    assert found.share([rounding]) == 1.0
    last = fitted.select(np.argsort(hashes([fitted]))[[len(found.least) - 1]])  # of those kept
    assert found.share([last]) == 1.0
    assert found.share([new]) == 0.0
    assert found.share([fitted, new]) == pytest.approx(0.5, abs=0.15)
    assert found.share([]) == 0.0
    assert reused_in_words(0.0) == ''


def test_what_was_measured_counts_and_not_the_configuration_alone():
    fitted = rows(60)
    other = np.full(60, 1.0)
    found = Fingerprint.of([fitted])
    assert found.share([replace(fitted, positions=fitted.positions + 1e-5)]) == 0.0
    assert found.share([replace(fitted, distances=other)]) == 0.0
    lengths = Fingerprint.of([replace(fitted, distances=other)])
    assert lengths.share([replace(rows(60), distances=other)]) == 1.0
    images = replace(fitted, pixels=fitted.joints[:, :2], points=fitted.positions)
    assert found.share([images]) == 0.0
    assert Fingerprint.of([images]).share([replace(images, positions=0.0 * images.points)]) == 1.0


def test_files_of_before_hold_these_hashes():
    seen = Observations.from_arrays([[0.1, -0.2, 0.3]], [[1.0, 2.0, -3.0]])
    assert hashes([seen]).tolist() == [0xA33B42E5142807AD]


@pytest.mark.parametrize('count', [60, 10 * KEPT])
def test_rows_that_are_fitted_later_are_known_as_well(count):
    earlier, later = rows(count), rows(count, 1)
    found = Fingerprint.of([later], Fingerprint.of([earlier]))
    assert found.share([earlier]) == found.share([later]) == 1.0
    assert found.share([rows(count, 2)]) == 0.0


@pytest.mark.parametrize('count', [60, 50 * KEPT])
def test_the_few_rows_of_an_update_are_known_after_many_others(count):
    """A session filed twice would count twice; of 12,800 rows 256 are kept as a sample."""
    found = Fingerprint.of([rows(count)])
    for update in range(1, 41):
        found = Fingerprint.of([rows(8, update)], found)
        found = Fingerprint.of_record({'rows': found.document()}, 'file')
        assert found.share([rows(8, update)]) == found.share([rows(8, max(1, update - 20))]) == 1.0
        assert found.share([rows(8, 100)]) == 0.0
    assert 0.5 <= found.share([rows(8, 40), rows(8, 100)]) < 1.0
    assert len(found.latest) == KEPT


@pytest.mark.parametrize('wrong', [1, {}, {'count': 1, 'least': 'x'}, {'count': 1, 'least': '00'}])
def test_what_is_no_fingerprint_is_refused(wrong):
    with pytest.raises(ConfigError, match=r'calibration\.rows'):
        Fingerprint.of_record({'rows': wrong}, 'file')
