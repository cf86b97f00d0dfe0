# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of other systems as text columns: files and workbooks with any head.

Guesses (encoding, separator, decimal sign, header line) are reported.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, chain, islice, zip_longest
from pathlib import Path

from calib_ros.errors import MOST_ENTRIES, InputError
from calib_ros.files.columns import (
    Cells,
    Columns,
    cell_number,
    csv_blocks,
    from_rows,
    lines_in_words,
)
from calib_ros.files.encodings import text_and_encoding
from calib_ros.files.headers import name_and_unit, only_index, places
from calib_ros.files.layouts import Layout
from calib_ros.files.names import groups
from calib_ros.files.skipped import refuse_nominal, without_words
from calib_ros.files.summary_rows import without_statistics
from calib_ros.files.vocabulary import (
    DECIMAL_COMMA,
    MISSING,
    POSITION,
    SEPARATORS,
    SHEETS,
    THOUSANDS,
    UNIT_SIGNS,
    UNITS_ARE,
)
from calib_ros.files.workbooks import sheets_of
from calib_ros.shown import some

HEAD_LINES = MOST_ENTRIES // 10
"""Lines searched for the header and the first row of numbers."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """The rows of a table in columns `#1`, `#2` ..., their names, and its lines of words."""

    path: Path
    header: tuple[str, ...]
    words: tuple[str, ...]
    columns: Columns
    notes: tuple[str, ...]
    known: Mapping[str, str]  # theirs that need no option, and ours

    def number(self, name: str) -> str | None:
        """Return `#k` of a column by its name, or by ours if it is known by that; else None."""
        if name.startswith('#'):
            return name if 0 < int(name[1:]) <= len(self.header) else None
        found, low = places(self.header, name), [each.lower() for each in self.header]
        for theirs in [each for each, ours in self.known.items() if ours == name]:
            found = found or places(low, theirs.lower())
        return f'#{only_index(found, name) + 1}' if found else None

    def called(self, number: str) -> str:
        """Return the name of the column `#k`."""
        return self.header[int(number[1:]) - 1]


@dataclass(frozen=True)
class _Content:
    """Rows that are not empty, in blocks, of a text or of the sheet with a title."""

    rows: Iterator[list[Cells]]
    notes: list[str]
    title: str = ''
    comments: Sequence[str] = ()
    blanks: bool = False  # separate the cells
    unclear: str = '.'  # the decimal sign if 1,554 may be thousands


def read_sheet(
    path: Path, layout: Layout, names: Sequence[str], known: Mapping[str, str], unclear: str = '.'
) -> Sheet:
    """Read a table with a known layout; of a workbook the sheet named, or the first that fits.

    The header is the first line with all column `names`; if these are only numbers, the first with
    some of the `known` names.
    """
    if path.suffix.lower() not in SHEETS:
        content = replace(_of_text(path, layout), unclear=unclear)
        return _sheet(path, content, layout, names, known)
    faults: list[str] = []
    found: list[Sheet] = []
    for title, notes, rows in sheets_of(path, layout.sheet):
        content = _Content(iter([rows]), notes, title=title, unclear=unclear)
        try:
            sheet = _sheet(path, content, layout, names, known)
        except InputError as err:
            faults.append(f'sheet "{title}": {err}')
            continue
        lower = [cell.lower() for cell in sheet.header]
        if names or sum(bool(places(lower, name.lower())) for name in known) > 1:
            return sheet
        found.append(sheet)
    if not found:
        raise InputError('; '.join(some(faults)) or f'{path} has no rows in visible sheets')
    return found[0]


def _of_text(path: Path, layout: Layout) -> _Content:
    text, coding = text_and_encoding(path)
    told = f'the text, not UTF-8, is read as {coding}: if its words are wrong, save it as UTF-8'
    notes = [told] if not coding.startswith('utf') else []
    if '\r' in text:
        text = text.replace('\r\n', '\n').replace('\r', '\n')
    comments: list[str] = []
    if layout.comment:
        comment = re.compile(rf'(?m)^[ \t]*{re.escape(layout.comment)}.*$')
        comments, text = comment.findall(text), comment.sub('', text)
    # a header, as numpy and SpatialAnalyzer write it; # before a tab is a name if rows have it
    head = re.match(r'#\t(.*)\n(?!\d+\t)(.*)', text)  # a count may be beside an empty cell
    text = text[2:] if head and head[1].count('\t') == head[2].count('\t') else text
    text = re.sub(r'(?m)^(?!#\t)(?:[#%]+[ \t]+|//[ \t]*)(?=[A-Za-z])', '', text)
    if not re.search(r'(?m)^(?!"[^"\n]*"$)[^\n]', text):  # one cell each
        text = re.sub('(?m)^"|"$', '', text)
        notes.append('whole lines are in quotation marks: read without them')
    guessed = _separator(path, text)
    if guessed != 'comma' and not layout.cut:
        notes.append(f'cells are separated by {guessed}s (--separator)')
    separator = layout.cut or SEPARATORS[guessed]
    narrow = _narrow(text, separator)
    if separator not in narrow and SEPARATORS[guessed] in text.lstrip().partition('\n')[0]:
        raise InputError(
            f'{path} separates its cells by {guessed}s: give --separator {guessed}'
            + ', or to --joints-preset a layout of your own' * bool(layout.source)
        )
    blocks = csv_blocks(path, narrow.encode(), separator)
    bare = ([(line, [*map(str.strip, cells)]) for line, cells in block] for block in blocks)
    rows = ([row for row in block if any(row[1])] for block in bare)
    return _Content(rows, notes, comments=comments, blanks=separator == ' ')


def _sheet(
    path: Path, content: _Content, layout: Layout, names: Sequence[str], known: Mapping[str, str]
) -> Sheet:
    rows, notes = content.rows, content.notes
    whole = list[Cells]()
    while (not whole or whole[-1][0] < HEAD_LINES) and (block := next(rows, None)) is not None:
        whole += block
    head = whole  # all rows of a workbook
    if not content.title:
        head = [(n, [' '.join(c.split()) for c in cells]) for n, cells in whole if n <= HEAD_LINES]
    if not head:
        raise InputError(f'{path} has no rows')
    at, header = _header(path, head, names, known)
    low = {name.lower() for name in known}
    used = [k for name in names if not name.startswith('#') for k in places(header, name)]
    used += [int(name[1:]) - 1 for name in names if name.startswith('#')]
    used += [k for k, cell in enumerate(header) if name_and_unit(cell)[0].lower() in low]
    cells = (row[k] for _, row in head[at + 1 :] for k in used if k < len(row))
    decimal = layout.decimal or decimal_sign(cells, content.unclear)
    if decimal == ',' and not layout.decimal:
        notes.append('numbers have decimal commas (--decimal)')
    first = _first(path, head, at, used, decimal, notes)
    if at < 0:  # columns by their numbers
        header = tuple(f'#{k + 1}' for k in range(len(head[first][1])))
    beside = [cells for _, cells in head[at + 1 : first]]
    for _, over in head[: max(at, 0)][-1:]:
        if not content.blanks or len(over) == len(header):
            beside.append(_over_groups(over, len(header)))
    header = _with_units(header, beside)
    above = head[: first if at < 0 else at]
    left: list[Cells] = []
    again = [cells for _, cells in head[at:first]]
    body = without_words(chain([whole[first:]], rows), again, left)
    columns = from_rows(path, body, [f'#{k + 1}' for k in range(len(header))])
    if at >= 0 and max(used, default=0) < len(header):
        _refuse_shifted(columns, len(header))
    if content.blanks:
        refuse_short(columns, f'#{len(header)}')
    refuse_nominal(columns, [*above, *left])
    if left:
        notes.append(f'there are no numbers in {lines_in_words([n for n, _ in left])}: skipped')
    header = (*header, *[''] * (len(columns.header) - len(header)))
    between = ' ' if content.blanks else '\t'
    words = (*content.comments, *(between.join(cells) for _, cells in (*above, *left)))
    return Sheet(path, header, words, replace(columns, decimal=decimal), tuple(notes), known)


def _refuse_shifted(columns: Columns, width: int) -> None:
    """Refuse a row with a number more than a header of so many names; a remark there is text.

    Text in all rows, with integers in the first column, may be a column whose name is before
    theirs in `# q1 q2`, or follow a decimal comma.
    """
    for name in columns.header[width : width + 1]:
        texts = columns.texts(name)
        first = columns.texts(columns.header[0])
        whole = '' not in texts and all(map(str.isdecimal, first))
        for line, cell in zip(columns.lines.tolist(), texts, strict=True):
            if whole or _is_number(cell, ','):
                raise InputError(
                    f'{columns.path}, line {line}: more cells than the {width} columns of its '
                    'header: name each column there; a doubled separator, a thousands mark or a '
                    'decimal comma also makes one more (save it with semicolons between cells)'
                )


def refuse_short(columns: Columns, last: str) -> None:
    """Refuse a row between blanks without a cell in the last column, unless remarks are there.

    Statistics need not have all columns.
    """
    columns, _ = without_statistics(columns)
    cells = columns.texts(last)
    if '' in cells and all(_is_number(cell, ',') or cell.lower() in MISSING for cell in cells):
        raise InputError(
            f'{columns.path}, line {columns.lines[cells.index("")]}: fewer cells than its header '
            'has names: between blanks no cell may be empty and no name in two words: write NaN '
            'and Pose_name, or save it with commas or tabs'
        )


def text_and_separator(path: Path) -> tuple[str, str, str]:
    """Return the text of a table, the sign between its cells, and the encoding."""
    text, coding = text_and_encoding(path)
    separator = SEPARATORS[_separator(path, text)]
    narrow = _narrow(text, separator)
    if separator in narrow.lstrip().partition('\n')[0]:
        return narrow, separator, coding
    return text, ',', coding  # the header lacks it: it is in the words below


def _narrow(text: str, separator: str) -> str:
    """Return a text with single blanks between cells that blanks separate.

    In lines without numbers, there are none before units.
    """
    if separator != ' ':
        return text
    text = re.sub(r'[ \t]+', ' ', re.sub(r'(?m)^[ \t]+|[ \t]+$', '', text))
    words = r'(?m)^(?!(?:.* )?[-+.\d]+(?:e\S+)?(?: |$)).*[\[(].*'
    # q1 [deg], but no line of units: unit [deg] [deg]
    before = re.compile(r'(?<=\w) (?=[\[(](?:[^\W\d]{1,12}|[°º])[\])](?! [\[(]))')
    return re.sub(words, lambda line: before.sub('', line[0]), text)


def decimal_sign(cells: Iterable[str], unclear: str = '.') -> str:
    """Return the decimal sign in cells of numbers; 1,554 has one where all have such a comma."""
    numbers = [cell for cell in cells if _is_number(cell, ',')]
    decimals = [cell for cell in numbers if DECIMAL_COMMA.fullmatch(cell)]
    clear = len(decimals) == len(numbers) or not all(map(THOUSANDS.fullmatch, decimals))
    return (',' if clear else unclear) if decimals else '.'


def _with_units(header: tuple[str, ...], below: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the names of columns with their units in the lines below, known and unknown ones."""
    for cells in below:
        signs = [cell.strip('[]() ') for cell in cells]
        whole = any(sign.lower() in UNIT_SIGNS for sign in signs)  # are units, not names
        units = [
            name_and_unit(c)[1] or s * (whole and s.lower() not in MISSING)
            for s, c in zip(signs, cells, strict=True)
        ]
        pairs = zip_longest(header, units[: len(header)])
        header = tuple(
            f'{name} [{unit}]' if unit and name and not name_and_unit(name)[1] else name
            for name, unit in pairs
        )
    return header


def _over_groups(cells: Sequence[str], width: int) -> list[str]:
    """Return the line above a header, cells over blank ones too; empty without several units."""
    units = [UNIT_SIGNS.get(c.strip('[]() ').lower()) or name_and_unit(c)[1] for c in cells]
    told = UNITS_ARE.search('\t'.join(cells)) and len(cells) - cells.count('') < width  # in words
    if told or sum(u in UNIT_SIGNS for u in units) < 2 or any(_is_number(c, ',') for c in cells):
        return []
    whole: Iterator[str] = accumulate(cells, lambda before, cell: cell or before)
    return [*whole]


def _separator(path: Path, text: str) -> str:
    head = text.split('\n', HEAD_LINES)[:HEAD_LINES]
    cut = re.sub('"[^"\n]*"', '0', '\n'.join(head)).split('\n')  # cells in quotes
    lines = [line for line in cut if line.strip()][-30:]  # mostly below the header
    if not lines:
        raise InputError(f'{path} has no rows')
    best, most, cells = 'comma', 0, 1
    for name in ('tab', 'semicolon', 'bar', 'comma', 'space'):
        rows = [line.split(None if name == 'space' else SEPARATORS[name]) for line in lines]
        counts = [len(row) for row in rows]
        usual = max(set(counts), key=counts.count)
        agreed = counts.count(usual) if usual > 1 else 0
        finer = agreed == len(lines) and usual > cells  # as if tabs are mixed with blanks
        below = [cell for row in rows[len(rows) // 2 :] for cell in row]  # the header
        told = [_is_number(cell, ',') for cell in below if cell.strip()]
        if name == 'bar' and 2 * sum(told) <= len(told):  # it is in names
            continue
        inner = [re.search(r'[0-9][ \t]+[-+]?[0-9]', cell) is not None for cell in below]
        if name == 'comma' and 2 * sum(inner) > len(below):  # it is in numbers
            continue
        if agreed > 1.2 * most or (finer and all(_is_number(cell, '.') for cell in below)):
            best, most, cells = name, agreed, usual
    return best


def _header(
    path: Path, rows: Sequence[Cells], names: Sequence[str], known: Mapping[str, str]
) -> tuple[int, tuple[str, ...]]:
    """Return the row index of the header, and its names; -1 if there is none."""
    rows = rows[:HEAD_LINES]
    words = [sum(not _is_number(c, ',') for c in cells if c) for _, cells in rows]
    at = words.index(max(words))  # title and data have fewer
    bare = [{*cells, *(name_and_unit(cell)[0] for cell in cells)} for _, cells in rows]
    wanted = {name for name in names if not name.startswith('#')}
    if wanted:
        ours = {theirs.lower(): name for theirs, name in known.items()}
        missing = [wanted - each - {ours.get(name.lower()) for name in each} for each in bare]
        fewest = min(missing, key=len)
        if len(fewest) < len(wanted):
            at = missing.index(fewest)
        if fewest:
            has = ', '.join(f'"{cell}"' for cell in rows[at][1] if cell)
            raise InputError(
                f'{path} has no column {", ".join(sorted(missing[at]))}; line {rows[at][0]} has '
                f'{has}: name its columns (--columns OURS=NAME or OURS=#NUMBER)'
            )
        return at, tuple(rows[at][1])
    low = {name.lower() for name in known}
    for k, (_, cells) in enumerate(rows):
        if len(low & {name.lower() for name in bare[k]}) > 1:
            numbered = [cells[int(n[1:]) - 1] for n in names if int(n[1:]) <= len(cells)]
            of_data = any(_is_number(cell, ',') for cell in numbered)
            return (-1, ()) if of_data else (k, tuple(cells))
    aside = () if groups(rows[at][1], POSITION, without=frozenset()) else rows
    for column in islice(zip_longest(*(cells for _, cells in aside), fillvalue=''), 9):
        if {*POSITION} <= {name_and_unit(cell)[0].lower() for cell in column}:
            raise InputError(
                f'{path} has x, y, z below each other, expected a row for each pose, with all its '
                'coordinates in columns of their own: exchange rows and columns (in a spreadsheet '
                'program: paste transposed), or export one line for each point'
            )
    return (-1, ()) if names else (at, tuple(rows[at][1]))


def _first(
    path: Path, rows: Sequence[Cells], at: int, used: Sequence[int], decimal: str, notes: list[str]
) -> int:
    """Return the row index of the first row of numbers in the columns `used`."""
    limit = HEAD_LINES if at < 0 else at + 4  # three lines of units at most
    for k in range(at + 1, min(len(rows), limit + 1)):
        cells = [rows[k][1][i] for i in used if i < len(rows[k][1])]
        if not used or any(_is_number(cell, decimal) for cell in cells):
            if k > at + 1:
                left = lines_in_words([line for line, _ in rows[at + 1 : k]])
                notes.append(f'there are no numbers in {left}: only units are read')
            return k
    none = [f'{path} has no rows of numbers in the columns named']
    none += [
        f'line {line} has "{cells[i]}": numbers without units are expected there; other columns '
        'are named by --columns OURS=NAME or OURS=#NUMBER'
        + '; if the comma is a decimal one, give --decimal comma'
        * (',' in cells[i])
        for line, cells in rows[at + 1 : at + 2]
        for i in used[:1]
        if i < len(cells)
    ]
    raise InputError('; '.join([*none, *notes]))


def _is_number(cell: str, decimal: str) -> bool:
    return math.isfinite(cell_number(cell, decimal))
