# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows that are no measurements: statistics, lost targets, remarks and headers again."""

import numpy as np
import pytest
from test_foreign import JOINTS, NAMES, PLACES, PLAIN, assert_same, text_of

from calib_ros import Chain, Settings, read_table
from calib_ros.errors import InputError
from calib_ros.files import loading
from calib_ros.files.foreign import Foreign
from calib_ros.files.layouts import Layout
from calib_ros.files.programs import read_program
from calib_ros.kinematics.chain import Joint

ARM = Chain('arm', 'standard', (Joint('a'), Joint('b')))
NAMED = PLAIN.replace('q1', 'point,q1', 1).replace('\n', '\np,', 3)


def tables(path, text):
    """Yield the table of a text as the command line reads it, and as that of another system."""
    path.write_text(text)
    yield loading.table(path, ARM, Settings())
    yield read_table(path, 2, foreign=Foreign(Layout(), ARM))


@pytest.mark.parametrize(
    'rows',
    [
        ('Mean,0.1,0.2,0.3,0.4,0.5',),
        ('Mean:,0.1,0.2,0.3,0.4,0.5', 'Std. Dev.,1,1,1,1,1', 'max,1,1,1,1,1', 'RMS,1,1,1,1,1'),
        ('Mittelwert,,,0.3,0.4,0.5', 'Standardabweichung,,,1,1,1'),
        (
            'Mean value,0.1,0.2,0.3,0.4,0.5',
            'Std. error,1,1,1,1,1',
            'StDev,1,1,1,1,1',
            '3 sigma,3,3,3,3,3',
        ),
        ('Variance,0.1,0.2,0.3,0.4,0.5', 'Count,3,3,3,3,3'),
        ('平均値,0.1,0.2,0.3,0.4,0.5', '標準偏差,1,1,1,1,1'),
        ('Mean error [mm],0.1,0.2,0.3,0.4,0.5', 'RMS error (mm),1,1,1,1,1'),
        ('Group 1 Average,0.1,0.2,0.3,0.4,0.5',),
        ('Gesamtmittelwert,0.1,0.2,0.3,0.4,0.5',),
        ('Durchschnitt,0.1,0.2,0.3,0.4,0.5', 'Streuung,1,1,1,1,1', '2\u03c3,1,1,1,1,1'),
        ('Moyenne,0.1,0.2,0.3,0.4,0.5', 'Déviation standard,1,1,1,1,1'),
        ('Valor medio,0.1,0.2,0.3,0.4,0.5', 'Desviación estándar,1,1,1,1,1', 'Máximo,1,1,1,1,1'),
        ('Media,0.1,0.2,0.3,0.4,0.5', 'Deviazione standard,1,1,1,1,1', 'Minimo,1,1,1,1,1'),
        ('Mean of all points,0.1,0.2,0.3,0.4,0.5', 'Std.-Abw.,1,1,1,1,1'),
    ],
)
def test_statistics_below_a_table_are_no_poses(path, rows):
    for table in tables(path, NAMED + '\n'.join(rows) + '\n'):
        assert_same(table, None)
        assert any(note.startswith(f'{path}: statistics in line') for note in table.warnings)


@pytest.mark.parametrize(('yes', 'no'), [('1', '0'), ('True', 'False'), ('y', 'n')])
def test_rows_that_a_column_calls_invalid_are_left_out(path, yes, no):
    """They were outliers: some trackers repeat the last position while the target is hidden."""
    first, *lines = PLAIN.splitlines()
    rows = [*(f'{line},{yes}' for line in lines), f'0.1,0.2,0.3,0.4,0.5,{no}']
    for table in tables(path, '\n'.join([f'{first},valid', *rows, ''])):
        assert_same(table, None)
        told = f'{path}: the column valid says no in line 5: skipped'
        assert [note for note in table.warnings if 'valid' in note] == [told]


def test_words_of_a_column_valid_are_told_if_unknown_and_all_are_not_left_out(path):
    """They were read without a word, or a table needed x, y, z that it has."""
    first, *lines = PLAIN.splitlines()
    for said in ('1', 'NOK', '0'):
        text = '\n'.join([f'{first},valid', *(f'{line},{said}' for line in lines), ''])
        if said == '0':
            with pytest.raises(InputError, match='rename it if it means something else'):
                next(tables(path, text))
            continue
        for table in tables(path, text):
            assert_same(table, None)
            told = [note for note in table.warnings if 'column valid' in note]
            assert len(told) == (said == 'NOK')
            assert not told or "says 'nok' in lines 2, 3" in told[0]


MANY = np.random.default_rng(7).normal(0.1, 0.8, (20, 5)).round(4)
SUMMARIES = {
    'mean': (np.mean,),
    'mean and deviation': (np.mean, lambda rows, axis: rows.std(axis, ddof=1)),
    'mean and deviation of all': (np.mean, np.std),
    'sum': (np.sum,),
    'range': (np.min, np.max, np.mean),
    'count': (lambda rows, axis: np.full(5, len(rows)), np.median, np.std),
}


@pytest.mark.parametrize('kinds', SUMMARIES)
@pytest.mark.parametrize('above', [False, True])
def test_rows_computed_of_all_others_are_no_poses(path, kinds, above):
    """Without a name they were outliers, and told as what moved."""
    more = [kind(MANY, axis=0).round(4) for kind in SUMMARIES[kinds]]
    text = text_of(np.vstack([*more, MANY] if above else [MANY, *more]), names=NAMES)
    for table in tables(path, text):
        np.testing.assert_allclose(table.fitted[0].positions, MANY[:, 2:], atol=1e-12)
        assert any(f'of all others in line{"s" * (len(more) > 1)}' in w for w in table.warnings)


def test_poses_that_are_hardly_computed_are_kept(path):
    """A pose in the middle of the others has another measured place; repeats have one."""
    middle = np.array([*MANY[:, :2].mean(axis=0), *MANY[:, 2:].mean(axis=0) + 1e-3])
    again = np.tile(MANY[:1], (8, 1))
    again[::2, 2:] += 2e-5
    again[-1, 2:] += 1e-5
    for rows in (np.vstack([MANY, middle]), again, np.vstack([MANY, MANY])):
        for table in tables(path, text_of(rows, names=NAMES)):
            assert len(table.fitted[0]) == len(rows)


def test_statistics_without_a_table_are_refused(path):
    """Of stamps it was an IndexError."""
    path.write_text('point,time,q1,q2,x,y,z\nmean,1,0.1,0.2,0.3,0.4,0.5\n')
    for foreign in (None, Foreign(Layout(), ARM)):
        with pytest.raises(InputError, match='no rows'):
            read_table(path, 2, foreign=foreign)


@pytest.mark.parametrize('place', [1, 2, 3])
def test_means_between_poses_are_no_poses(path, place):
    """Of each group of measurements, and what stands beside them; they were read as poses."""
    lines = NAMED.splitlines()
    lines.insert(place, 'Average:,0.1,0.2,0.3,0.4,0.5\nStd. Dev.,1,1,1,1,1')
    lines.append('P2 Average,0.1,0.2,0.3,0.4,0.5\nmax,1,1,1,1,1')
    for text in ('\n'.join(lines), '\n'.join(lines[:-1])):
        for table in tables(path, text + '\n'):
            assert_same(table, None)


@pytest.mark.parametrize(
    'names',
    [
        ('mean',) * 3,
        ('std', 'alt', 'alt'),
        ('average speed', 'p'),
        ('P1 mean', 'P2 mean', 'P3 mean'),
        ('Schmiermittel', 'dry', 'wet'),
        ('better than average', 'p'),
        ('above average', 'p'),
        ('taken as the mean', 'p'),
        ('low', 'media', 'high'),
        ('alta', 'media', 'bassa'),
    ],
)
def test_poses_with_such_names_are_kept(path, names):
    for table in tables(path, NAMED.replace('\np,', '\n{},').format(*names, *'pp')):
        assert_same(table, None)


def test_poses_may_be_means_with_their_deviations(path):
    head, *poses = NAMED.splitlines()
    rows = [f'P{k} mean{each[1:]}\nP{k} std,0,0,1,2,3' for k, each in enumerate(poses)]
    for table in tables(path, '\n'.join([head, *rows]) + '\n'):
        assert_same(table, None)


@pytest.mark.parametrize('count', [1, 3])
def test_a_name_that_comes_again_or_before_others_is_no_statistic(path, count):
    for table in tables(path, NAMED.replace('\np,', '\nmax,', count)):
        assert_same(table, None)


@pytest.mark.parametrize('lost', ['0', '0.000', '-9999', '-9999.0', '99999', '-99999,'])
def test_a_lost_target_is_no_position(path, lost):
    semicolons = lost.endswith(',')
    text = f'{PLAIN}0.2,0.3,' + ','.join([lost.rstrip(',')] * 3) + '\n'
    for table in tables(path, text.replace(',', ';') if semicolons else text):
        assert_same(table, None)
        assert any('no target (x = y = z) in line 5' in note for note in table.warnings)
    path.write_text(f'{PLAIN}0.2,0.3,0.0,-9999,0.0\n')
    assert len(read_table(path, 2).fitted[0]) == 4
    path.write_text('q1,q2,x,y,z\n' + '0.2,0.3,0,0,0\n' * 3)
    with pytest.raises(InputError, match='no target'):
        read_table(path, 2)


def test_joint_values_and_measurements_in_rows_of_their_own_are_told(path):
    """As two recordings merged by time are written."""
    rows = ''.join(f'{k},0.{k},0.2,,,\n{k}.5,,,1,2,3\n' for k in range(4))
    path.write_text(f'stamp,q1,q2,x,y,z\n{rows}')
    for foreign in (None, Foreign(Layout(), ARM)):
        with pytest.raises(InputError, match=r'line 3: q1 must not be empty: .* give a bag'):
            read_table(path, 2, foreign=foreign)


def test_lost_targets_are_known_in_any_unit(path):
    path.write_text(f'{PLAIN}0.2,0.3,-9999,-9999,-9999\n'.replace('x,y,z', 'x [mm],y [mm],z [mm]'))
    (found,) = read_table(path, 2, foreign=Foreign(Layout())).fitted
    assert len(found) == 3


@pytest.mark.parametrize(
    'row',
    [
        '# moved the target',
        '% moved it, again',
        '// lost',
        'End of file',
        'Operator: Smith, 3 Nov',
        'Run 2',
        '# page 2',
        'q1,q2,x,y,z',
        'rad,rad,m,m,m',
        '----',
    ],
)
@pytest.mark.parametrize('place', [2, 3])
def test_remarks_and_headers_again_are_no_rows(path, row, place):
    """Each was refused, as a value that is no number."""
    lines = PLAIN.replace('z\n', 'z\nrad,rad,m,m,m\n', 1).splitlines()
    lines.insert(place + 2, row)
    for table in tables(path, '\n'.join(lines) + '\n'):
        assert_same(table, None)
        assert any(f'line {place + 3}' in note for note in table.warnings)


def test_remarks_below_names_of_poses_are_no_rows(guessed, path):
    """Between commas they were refused: q1 was empty. Values that were cut off still are."""
    for row in ('moved the target', '# end', 'nominal load'):
        for table in tables(path, f'{NAMED}{row}\n'):
            assert_same(table, None)
            assert any('line 5' in note for note in table.warnings)
    with pytest.raises(InputError, match='the rows below "Nominal" may be nominal'):
        guessed(f'{NAMED}Nominal\np,0.1,0.2,1,2,3\n')
    with pytest.raises(InputError, match='line 5: q2 must be'):
        guessed(f'{NAMED}p,0.1\n')


@pytest.mark.parametrize('again', ['q1,q2,x,y,z\n', ''])
@pytest.mark.parametrize(
    ('titles', 'said'),
    [
        (('', 'Nominal'), 'line 5: the rows below "Nominal" may be nominal'),
        (('Measured', 'Soll-Positionen'), 'line 6: the rows below "Soll-Positionen"'),
        (('Commanded', 'Actual values'), 'line 1: the rows below "Commanded" may be nominal'),
        (('', 'Robot 2'), ''),
        (('Measured', 'Measured'), ''),
        (('Nominal', 'Nominal, page 2'), ''),
        (('', 'nominal speed'), ''),
        (('', 'still at its nominal speed'), ''),
        (('', 'goal reached'), ''),
        (('', '# planned break'), ''),
        (('', 'Theo'), ''),
    ],
)
def test_rows_below_a_title_that_calls_them_nominal_are_refused(path, titles, said, again):
    """A table of nominal poses below the measured ones was read as more of these."""
    first, second = (f'{title}\n' * bool(title) for title in titles)
    rows = PLAIN.partition('\n')[2].replace('0.25', '0.26')
    path.write_text(f'{first}{PLAIN}{second}{again}{rows}')
    if said:
        with pytest.raises(InputError, match=said):
            loading.table(path, ARM, Settings())
    else:
        assert len(loading.table(path, ARM, Settings()).fitted[0]) == 6


def test_a_row_of_words_in_place_of_numbers_is_refused(guessed):
    for row in ('a,b,c,d,e', '0.1,b,1,2,3', 'q2,q1,x,y,z'):
        with pytest.raises(InputError, match=r'line 5: .* must be a finite number'):
            guessed(f'{PLAIN}{row}\n')


@pytest.mark.parametrize(
    ('old', 'new', 'said'),
    [
        (' 0.25 ', '      ', 'line 3: fewer cells than its header'),
        ('q1 ', 'the q1 ', 'line 2: fewer cells than its header'),
        ('q1 q2 x', 'q1 (rad) q2 [rad] x', ''),
        ('rms', 'note', 'line 4: fewer cells'),
        (' 0.01\n', ' moved\n', ''),
    ],
)
def test_between_blanks_no_cell_is_empty(tmp_path, old, new, said):
    """The values behind an empty cell, or a name in two words, were read in other columns."""
    path = tmp_path / 'cell.txt'
    columns = [JOINTS, PLACES, np.full(3, 0.01)]
    text = text_of(*columns, names=[*NAMES, 'rms'], separator=' ').replace(old, new)
    if old in ('rms', ' 0.01\n'):  # the last cell
        text = text.rstrip().rpartition(' ')[0] + '\n'
    path.write_text(text)
    if said:
        with pytest.raises(InputError, match=said):
            loading.table(path, ARM, Settings())
        with pytest.raises(InputError, match=said):
            read_program(path.rename(tmp_path / 'cell.csv'), ARM)
    else:
        assert_same(loading.table(path, ARM, Settings()), None)


@pytest.mark.parametrize('row', ['RMS 0.05', 'Mean 0.1 0.2 0.3', 'Std Dev 0.1'])
@pytest.mark.parametrize('cell', ['(ok)', '[left]', 'P1'])
def test_between_blanks_statistics_are_short_and_remarks_in_brackets(guessed, row, cell):
    """The first were refused as short rows, the second read as units of the names of poses."""
    text = text_of(JOINTS, PLACES, names=NAMES, separator=' ')
    names, *rows = text.splitlines()
    rows = [f'P{k} {cell} {numbers}' for k, numbers in enumerate(rows)]
    assert_same(guessed('\n'.join([f'name state {names}', *rows, row, '']), 'cell.txt'), None)


def test_between_blanks_a_line_of_units_has_a_cell_for_each_name(tmp_path):
    """Its first one became one cell with the word before it, and the others moved."""
    path = tmp_path / 'cell.txt'
    names, *rows = text_of(JOINTS, PLACES, names=NAMES, separator=' ').splitlines()
    rows = [f'P{k} {numbers}' for k, numbers in enumerate(rows)]
    path.write_text('\n'.join([f'name {names}', 'unit (rad) (rad) (m) (m) (m)', *rows, '']))
    assert_same(loading.table(path, ARM, Settings()), None)


@pytest.mark.parametrize('cell', ['---', '***', '#VALUE!', '1.#QNAN', '-nan(ind)', 'lost', 'n.a.'])
def test_cells_without_a_value_are_empty(path, cell):
    for table in tables(path, f'{PLAIN}0.2,0.3,{cell},{cell},{cell}\n'):
        assert_same(table, None)
