# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Formulas in workbooks."""

import zipfile

import numpy as np
import pytest
from test_foreign import JOINTS, NAMES, PLACES, assert_same

from calib_ros import read_table
from calib_ros.errors import InputError
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a workbook with a formula, of which XML is replaced."""
    openpyxl = pytest.importorskip('openpyxl')

    def read(formula, *replaced):
        rows = [NAMES, *np.column_stack([JOINTS, PLACES]).tolist()]
        rows[2][3] = formula
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append([*row])
        book.save(tmp_path / 'source.xlsx')
        with (
            zipfile.ZipFile(tmp_path / 'source.xlsx') as source,
            zipfile.ZipFile(tmp_path / 'cell.xlsx', 'w') as made,
        ):
            for name in source.namelist():
                text = source.read(name).decode()
                for old, new in replaced:
                    text = text.replace(old, new)
                made.writestr(name, text)
        return read_table(tmp_path / 'cell.xlsx', 2, foreign=Foreign(Layout()))

    return read


FORMULA = '<f>1/4</f><v></v>'
LATER = ' fullCalcOnLoad="1"', ''


@pytest.mark.parametrize(
    'replaced',
    [(), (LATER,), (LATER, (FORMULA, '<f>1/4</f>')), ((FORMULA, '<f>1/4</f><v>0</v>'),)],
)
def test_formulas_without_values_are_told(read, replaced):
    """Their rows were skipped as those where nothing was measured."""
    with pytest.raises(InputError, match=r"line 3: y must be .* not '=1/4, not computed: "):
        read('=1/4', *replaced)


@pytest.mark.parametrize('replaced', [(), (LATER,)])
def test_formulas_with_values_are_read(read, replaced):
    assert_same(read('=1/4', (FORMULA, '<f>1/4</f><v>0.25</v>'), *replaced), None)


def test_formulas_of_empty_text_are_empty(read):
    made = (f'r="D3">{FORMULA}', 'r="D3" t="str"><f>1/4</f><v></v>')
    with pytest.raises(InputError, match=r"line 3: y must be a finite number, not ''"):
        read('=1/4', made, LATER)
