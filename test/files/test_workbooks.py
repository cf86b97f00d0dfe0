# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Workbooks: their sheets, and formulas."""

import re
import sys
import zipfile

import numpy as np
import pytest
from test_foreign import JOINTS, NAMES, PLACES, assert_same

from calib_ros import read_table
from calib_ros.errors import MOST_ENTRIES, InputError
from calib_ros.files import workbooks
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
                text = source.read(name).decode().replace('<v />', '<v></v>')  # as lxml has it
                for old, new in replaced:
                    text, name = text.replace(old, new), name.replace(old, new)
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


@pytest.mark.parametrize('replaced', [(), (LATER,), (('workbook.xml', 'workbook2.xml'),)])
def test_formulas_with_values_are_read(read, replaced):
    assert_same(read('=1/4', (FORMULA, '<f>1/4</f><v>0.25</v>'), *replaced), None)


def test_formulas_of_empty_text_are_empty(read):
    made = (f'r="D3">{FORMULA}', 'r="D3" t="str"><f>1/4</f><v></v>')
    with pytest.raises(InputError, match=r'line 3: y must be a finite number, not empty'):
        read('=1/4', made, LATER)


def test_workbooks(tmp_path, monkeypatch):
    openpyxl = pytest.importorskip('openpyxl')
    book = openpyxl.Workbook()
    book.active.title = 'first'
    sheet = book.create_sheet('measured')
    for row in (
        ['a title'],
        [*NAMES, None, 'note'],
        ['rad', 'rad', 'm', 'm', 'm'],
        *np.column_stack([JOINTS, PLACES]).tolist(),
    ):
        sheet.append(row)
    path = tmp_path / 'cell.xlsx'
    book.save(path)
    assert_same(read_table(path, 2, foreign=Foreign(Layout(sheet='measured'))), None)
    with pytest.raises(InputError, match='no sheet "other"; it has first, measured'):
        read_table(path, 2, foreign=Foreign(Layout(sheet='other')))
    with pytest.raises(InputError, match=r'sheet "measured".* no column J1; line 2 has "q1'):
        read_table(path, 2, foreign=Foreign(Layout(columns={'q1': 'J1', 'q2': 'q2'})))
    other = book.create_sheet('later')
    other.append(NAMES)
    book['first'].sheet_state = 'hidden'
    book.save(path)
    found = read_table(path, 2, foreign=Foreign(Layout()))
    assert_same(found, None)
    assert 'there are no numbers in line 3: only units are read' in str(found.warnings)
    assert 'columns not read: note ' in str(found.warnings)
    assert 'sheet "measured" of 2 is read (--sheet)' in str(found.warnings)
    book['first'].sheet_state = 'visible'
    book['first'].append(['a protocol', 1])
    points, log = book.create_sheet('points'), book.create_sheet('log')
    for row in (['X [mm]', 'Y (mm)', 'Z / mm'], *(1e3 * PLACES).tolist()):
        points.append(row)
    for row in (['J1', 'J2'], ['deg', '°'], *np.rad2deg(JOINTS).tolist()):
        log.append(row)
    book.save(path)
    assert_same(read_table(path, 2, foreign=Foreign(Layout())), None)
    of_joints = Layout(columns={'q1': 'J1', 'q2': 'J2'})
    apart = Foreign(Layout(sheet='points'), None, path, of_joints)
    assert_same(read_table(path, 2, foreign=apart), None)
    del book['points'], book['log']
    book['first'].sheet_state = 'hidden'
    book.save(path)
    smaller = zipfile.ZipFile(tmp_path / 'smaller.xlsx', 'w')
    with zipfile.ZipFile(path) as whole, smaller:
        for name in whole.namelist():
            text = re.sub(rb'<dimension ref="[^"]*"', b'<dimension ref="A1:E3"', whole.read(name))
            smaller.writestr(name, text)
    assert_same(read_table(tmp_path / 'smaller.xlsx', 2, foreign=Foreign(Layout())), None)
    path.write_bytes(b'no workbook')
    with pytest.raises(InputError, match='no workbook, or damaged: save it as'):
        read_table(path, 2, foreign=Foreign(Layout()))
    columns = {'eye_in_hand': 'e'} | {f'q{k}': f'q{k}' for k in (1, 2)}
    for rows, said in (
        ([], 'has no rows'),
        ([['q'] * (MOST_ENTRIES + 1)], f'has {MOST_ENTRIES + 1} columns, more than'),
        ([[*NAMES, 'e'], [1, 2, 3, 4, 5, 'no']], 'eye_in_hand'),
    ):
        book = openpyxl.Workbook()
        for row in rows:
            book.active.append(row)
        book.save(path)
        with pytest.raises(InputError, match=said):
            read_table(path, 2, foreign=Foreign(Layout(columns=columns)))
    monkeypatch.setattr(workbooks, 'LARGEST_SHEET', 100)
    with pytest.raises(InputError, match='MB when unpacked'):
        read_table(path, 2, foreign=Foreign(Layout()))
    monkeypatch.setitem(sys.modules, 'openpyxl', None)
    with pytest.raises(InputError, match=r'needs openpyxl: pip install "calib_ros\[xlsx\]"'):
        read_table(path, 2, foreign=Foreign(Layout()))


@pytest.mark.parametrize('hidden', [False, True])
def test_hidden_rows_are_told(tmp_path, hidden):
    """Those that were filtered out in a spreadsheet program were read without a word."""
    book = pytest.importorskip('openpyxl').Workbook()
    for row in (NAMES, *np.column_stack([JOINTS, PLACES]).tolist()):
        book.active.append([*row])
    book.active.row_dimensions[3].hidden = hidden
    book.save(tmp_path / 'cell.xlsx')
    table = read_table(tmp_path / 'cell.xlsx', 2, foreign=Foreign(Layout()))
    assert_same(table, None)
    assert ('hidden and filtered rows are read' in str(table.warnings)) == hidden
