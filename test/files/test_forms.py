# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Forms in which other systems write the same table."""

import numpy as np
import pytest
from test_foreign import PLAIN, assert_same

from calib_ros import read_table
from calib_ros.errors import InputError
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout

FORMS = {
    'no values': PLAIN + 'NaN,0.3,n/a,#N/A,-\n0,0,nan,null,\n',
    'exponents of Fortran': PLAIN.replace('0.25', '2.5D-01'),
    'other separators in quotes': 'note,' + PLAIN.replace('\n', '\n"a; b; c; d; e; f, g",', 3),
}


@pytest.mark.parametrize('form', FORMS)
def test_a_table_in_another_form_is_the_same(tmp_path, form):
    path = tmp_path / 'cell.csv'
    path.write_text(FORMS[form])
    assert_same(read_table(path, 2, foreign=Foreign(Layout())), None)


def test_points_between_thousands_are_no_decimals(tmp_path):
    """Beside decimal commas; where neither is told from the other, both are refused."""
    path = tmp_path / 'cell.csv'
    path.write_text('q1;q2;x [mm];y [mm];z [mm];session\n0.642;0,5;999,5;356;1554;B 1,5\n')
    (found,) = read_table(path, 2, foreign=Foreign(Layout())).fitted
    np.testing.assert_allclose(found.joints, [[0.642, 0.5]])
    np.testing.assert_allclose(found.positions, [[0.9995, 0.356, 1.554]])
    text = path.read_text()
    for cell, said in (
        ('1.554', "not '1.554': write it without the marks between thousands"),
        ('1.554,25', "not '1.554,25': write it without the marks between thousands"),
    ):
        path.write_text(text.replace('1554', cell))
        with pytest.raises(InputError, match=said):
            read_table(path, 2, foreign=Foreign(Layout()))
    path.write_text('q1;q2;x;y;z\n1,554;2,125;1;2;3\n')
    with pytest.raises(InputError, match='give --decimal comma; if these are thousands, write it'):
        read_table(path, 2, foreign=Foreign(Layout()))
    (found,) = read_table(path, 2, foreign=Foreign(Layout(decimal=','))).fitted
    np.testing.assert_allclose(found.joints, [[1.554, 2.125]])


def test_stamps_in_seconds_are_told_what_to_give(tmp_path):
    path = tmp_path / 'cell.csv'
    path.write_text('stamp_ns,q1,q2,x,y,z\n1700000000.25,1,2,3,4,5\n')
    with pytest.raises(InputError, match='in seconds, give --columns time=stamp_ns'):
        read_table(path, 2)
    columns = {'time': 'stamp_ns'}
    (found,) = read_table(path, 2, foreign=Foreign(Layout(columns=columns))).fitted
    np.testing.assert_allclose(found.stamps_ns, 1_700_000_000_250_000_000, rtol=1e-15)
