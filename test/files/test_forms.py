# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Forms in which other systems write the same table."""

import pytest
from test_foreign import PLAIN, assert_same

from calib_ros import read_table
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout

FORMS = {
    'other separators in quotes': 'note,' + PLAIN.replace('\n', '\n"a; b; c; d; e; f, g",', 3),
}


@pytest.mark.parametrize('form', FORMS)
def test_a_table_in_another_form_is_the_same(tmp_path, form):
    path = tmp_path / 'cell.csv'
    path.write_text(FORMS[form])
    assert_same(read_table(path, 2, foreign=Foreign(Layout())), None)
