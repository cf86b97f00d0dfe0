# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Numbers of a text, many at once: what is read is what `float` reads, to the last bit."""

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from calib_ros.files.decimals import LONGEST, decimals

REAL = st.floats(-1e4, 1e4).map(repr)
FIXED = st.builds('{:+.{}f}'.format, st.floats(-10.0, 10.0), st.integers(0, 20))
OTHER = st.text('0123456789.-+e /:', min_size=1, max_size=LONGEST + 2)


def read_of(cells):
    """Return the numbers in cells, and which were read."""
    text = ','.join([' ' * (LONGEST - 1), *cells, '']).encode()
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord(','))
    return decimals(text, ends[:-1] + 1, ends[1:])


@given(st.lists(REAL | FIXED | OTHER, min_size=1, max_size=20))
@example(['1..2', '1.2345678.1234', '1.23456789.0123456789', '.', '-', '', '--1', '/.5', '1:'])
@example(['9007199254740993', '9007199254740992.5', '576460752303423489.', '-0.0', '+.5', '1.'])
@example(['.00000000000000000000001', '.0000000000000000000001', '999999999999999999'])
def test_what_is_read_is_what_float_reads(cells):
    for cell, number, read in zip(cells, *read_of(cells), strict=True):
        if read:
            assert np.float64(number).tobytes() == np.float64(float(cell)).tobytes()


def test_what_devices_write_is_read():
    values = np.random.default_rng(0).uniform(-3.0, 3.0, 2000).tolist()
    for form in ('{:.6f}', '{:.9f}', '{:+.15f}', '{!r}'):
        found, read = read_of([form.format(value) for value in values])
        assert read.mean() > 0.99
    assert np.mean(found[read] == np.array(values)[read]) == 1.0
