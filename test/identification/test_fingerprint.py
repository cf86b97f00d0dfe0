# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from calib_ros.errors import ConfigError
from calib_ros.estimation.observations import Observations
from calib_ros.identification.fingerprint import KEPT, Fingerprint, hashes, reused_in_words

LEAST = {'count': 1, 'least': '00' * 8}
WRONG = [
    1,
    {},
    {**LEAST, 'least': 'x'},
    {**LEAST, 'least': '00'},
    {**LEAST, 'values': ['x']},
    {**LEAST, 'values': ['ff' * 4]},
]


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


@pytest.mark.parametrize('wrong', [*WRONG, {**LEAST, 'values': ['00' * 4, '00' * 8]}])
def test_what_is_no_fingerprint_is_refused(wrong):
    with pytest.raises(ConfigError, match=r'calibration\.rows'):
        Fingerprint.of_record({'rows': wrong}, 'file')


@pytest.mark.parametrize('count', [60, 10 * KEPT])
@pytest.mark.parametrize('digits', [(4, 5), (3, 4)])
def test_rows_written_with_fewer_digits_are_known_and_those_measured_again_are_not(count, digits):
    """They held on all of their own training rows."""
    rng, fitted = np.random.default_rng(3), rows(count)
    found = Fingerprint.of_record({'rows': Fingerprint.of([fitted]).document()}, 'file')
    again = replace(fitted, positions=fitted.positions + rng.normal(scale=3e-5, size=(count, 3)))
    of_before = {key: found.document()[key] for key in ('count', 'least', 'latest')}
    bare = Fingerprint.of_record({'rows': of_before}, 'file')
    for seen, share in ((fitted, 1.0), (again, 0.0), (rows(count, 1), 0.0)):
        joints, positions = map(np.round, (seen.joints, seen.positions), digits)
        written = Observations.from_arrays(joints, positions).select(rng.permutation(count))
        assert found.share([written]) == share
        later = Fingerprint.of([rows(8, 2)], found)
        assert later.share([written]) == pytest.approx(share, abs=0.05)
        assert found.share([written.select(slice(1))]) == bare.share([written]) == 0.0


def test_the_same_program_in_sockets_is_measured_again():
    """All positions are zero there: joint values alone tell measurements apart."""
    seen = replace(rows(60), positions=np.zeros((60, 3)), socket=True)
    again = replace(seen, joints=seen.joints + 1e-4)
    assert Fingerprint.of([seen]).share([again]) == 0.0
    assert Fingerprint.of([seen]).share([seen]) == 1.0


@pytest.mark.parametrize('width', [1, 4, 9])
def test_kept_rows_of_another_width_are_no_rows_of_this_arm(width):
    """An update of a file with them ended in a traceback."""
    other = Fingerprint.of([rows(3)]).document() | {'values': ['00' * 4 * width]}
    found = Fingerprint.of_record({'rows': other}, 'file')
    assert found.share([rows(60, 1)]) == 0.0
    assert not found.narrow([rows(60, 1)]).any()
    assert Fingerprint.of([rows(8, 2)], found).share([rows(8, 2)]) == 1.0
