# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Text files, tables and YAML, within limits; foreign text stays text.

A few hundred bytes of YAML can expand to any amount of data: aliases of aliases, nesting, numbers
with any number of digits. Its events are checked before they are loaded. A joint, a frame or a
robot may be named `<script>`, `| x |` or `=cmd|...`, which is markup in a report and a formula in
a spreadsheet.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from calib_ros.errors import (
    LONGEST_NAME,
    MOST_ENTRIES,
    CalibrationError,
    ConfigError,
    InputError,
    unreadable,
)

LARGEST_TEXT = 10 * MOST_ENTRIES**2
"""Bytes of a chain file, calibration, URDF or YAML program."""
LARGEST_TABLE = 10 * LARGEST_TEXT  # bytes of a table
MOST_ROWS = LARGEST_TABLE // 100  # rows of a table
DEEPEST = MOST_ENTRIES // 50  # levels of nested YAML
NESTED = (Mapping, list, tuple)
MOST_NODES = LARGEST_TEXT // 20
"""Values in a YAML document with expanded aliases; 20 characters count as one."""
MARKUP = re.compile(r'[\\`*\[\]|]|(?<![^\W_])_|_(?![^\W_])|^(?:[>#]|[+-](?!\d))')
"""Markdown markup; underscores only where they may start emphasis."""
TABS = re.compile(r'^ *\t', re.MULTILINE)
FORMULA = re.compile(r"'*[=+\-@\t\r]")
"""Start of a spreadsheet formula, after any apostrophes."""


def read_text(
    path: Path,
    largest: int = LARGEST_TEXT,
    error: type[CalibrationError] = ConfigError,
    what: str = '',
) -> str:
    """Return the text of a UTF-8 file, described by `what`; raise `error` if that fails."""
    return as_text(read_bytes(path, largest, error, what), f'{what}{path}', error)


def read_bytes(path: Path, largest: int, error: type[CalibrationError], what: str = '') -> bytes:
    """Return the content of a file, as `read_text`.

    Pipes are read only from the shell (standard input, process substitution): one in a folder may
    have no writer and would block for ever.
    """
    if path.is_fifo() and path.parts[:2] not in (('/', 'dev'), ('/', 'proc')):
        raise error(f'{what}{path} is a pipe: give a file, or /dev/stdin')
    try:
        with path.open('rb') as file:
            data = file.read(largest + 1)
    except OSError as err:
        raise error(unreadable(path, err, what)) from err
    if len(data) > largest:
        raise error(f'{what}{path} is larger than {largest // 10**6} MB: is it the right file?')
    return data


def as_text(data: bytes, where: str, error: type[CalibrationError]) -> str:
    """Return bytes as text."""
    try:
        return data.decode('utf-8-sig')
    except UnicodeDecodeError as err:
        raise error(
            f'{where} is not UTF-8 text: save it as UTF-8, or is it the wrong file?'
        ) from err


def csv_lines(data: bytes, where: str) -> io.TextIOWrapper:
    """Return the lines of a table in UTF-8 for csv, which reads lines of any length."""
    most = MOST_ENTRIES**2
    csv.field_size_limit(most)  # of the whole process
    end = 0
    while len(data) - end > most:
        end = 1 + max(data.rfind(mark, end, end + most) for mark in (b'\n', b'\r'))
        if not end:
            raise InputError(f'{where} has a line of more than {most} bytes: is it a table?')
    return io.TextIOWrapper(io.BytesIO(data), encoding='utf-8-sig', newline='')


def dump_json(value: Any, indent: str = '') -> str:
    """Return plain values as JSON: lists and mappings without nested ones on one line."""
    inside = list(value.values()) if isinstance(value, Mapping) else value
    if not isinstance(value, NESTED) or not any(isinstance(each, NESTED) for each in inside):
        return json.dumps(value)
    lines = [dump_json(each, f'{indent}  ') for each in inside]
    first, last = '[]'
    if isinstance(value, Mapping):
        lines = [f'{json.dumps(name)}: {line}' for name, line in zip(value, lines, strict=True)]
        first, last = '{}'
    return f'{first}\n{indent}  ' + f',\n{indent}  '.join(lines) + f'\n{indent}{last}'


def csv_text(rows: Iterable[Iterable[object]], separator: str = ',', end: str = '\n') -> str:
    """Return rows as the text of a table, each with that end."""
    text = io.StringIO(newline='')
    csv.writer(text, delimiter=separator, lineterminator=end).writerows(rows)
    return text.getvalue()


def parse_yaml(text: str, where: str, error: type[CalibrationError] = ConfigError) -> Any:
    """Return the content of a YAML document, None if empty; `where` names it in errors.

    Raises `error` for invalid YAML, several documents, duplicate keys, or a document that is too
    large or too deep with its aliases expanded.
    """
    import yaml

    try:
        _Scales(yaml.parse(text, _loader()), where, error).weigh()
        documents = [each for each in yaml.load_all(text, _loader()) if each is not None]
    except CalibrationError:
        raise
    except Exception as err:  # explicit tags fail in many ways
        words = ' '.join(str(err).split()).replace(' in "<unicode string>"', '')
        words += ': indent with blanks, not tabs' * bool(TABS.search(text))
        raise error(f'{where} is not valid YAML: {words}') from err
    if len(documents) > 1:
        raise error(f'{where} must hold one YAML document, not {len(documents)}')
    return documents[0] if documents else None


def dump_yaml(document: Mapping[str, Any]) -> str:
    """Return plain values as YAML; str subclasses, as names of parameters, as text."""
    import yaml

    class Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
        """The C dumper if available: a tenth of the time."""

    Dumper.add_multi_representer(str, lambda dumper, text: dumper.represent_str(str(text)))
    text = yaml.dump(document, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=1000)
    return str(text)


@cache
def _loader() -> Any:
    """Return the C loader if available; long numbers stay text."""
    import yaml

    class Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
        """Makes numbers of reasonable length only: their conversion is quadratic."""

    for kind in ('int', 'float'):
        convert = getattr(Loader, f'construct_yaml_{kind}')

        def number(loader: Any, node: Any, convert: Any = convert) -> Any:
            return convert(loader, node) if len(node.value) <= LONGEST_NAME else node.value

        Loader.add_constructor(f'tag:yaml.org,2002:{kind}', number)
    return Loader


class _Scales:
    """Refuses documents that would not fit into memory with their aliases expanded.

    Scalar events have a value, lists and mappings a tag, aliases only an anchor, ends none.
    """

    def __init__(self, events: Iterator[Any], where: str, error: type[CalibrationError]) -> None:
        self._events, self._where, self._error = events, where, error
        self._anchors: dict[str, tuple[int, int]] = {}

    def weigh(self) -> None:
        for event in self._events:
            if hasattr(event, 'anchor'):
                self._node(event, 0)

    def _node(self, event: Any, above: int) -> tuple[int, int]:
        """Return the number of values of a node, and its levels."""
        if hasattr(event, 'value'):
            nodes, height = 1 + len(event.value) // 20, 0
        elif hasattr(event, 'tag'):
            nodes, height = self._collection(event, above)
        elif event.anchor in self._anchors:
            nodes, height = self._anchors[event.anchor]
        else:
            raise self._error(f'{self._where}: alias "{event.anchor}" is not defined before it')
        if above + height > DEEPEST:
            raise self._error(f'{self._where} is nested deeper than {DEEPEST} levels')
        if event.anchor:
            self._anchors[event.anchor] = nodes, height
        return nodes, height

    def _collection(self, event: Any, above: int) -> tuple[int, int]:
        nodes, height, keys = 1, 1, set()
        keyed = type(event).__name__ == 'MappingStartEvent'
        for k, inner in enumerate(self._events if above < DEEPEST else ()):
            if not hasattr(inner, 'anchor'):
                break
            key = getattr(inner, 'value', '<<')
            if keyed and k % 2 == 0 and key != '<<':
                if key in keys:
                    raise self._error(f'{self._where}: key "{key}" appears twice')
                keys.add(key)
            more, levels = self._node(inner, above + 1)
            nodes, height = nodes + more, max(height, levels + 1)
            if nodes > MOST_NODES:
                raise self._error(f'{self._where} has more than {MOST_NODES} values')
        return nodes, height


def one_line(text: str) -> str:
    """Return a text without line breaks and invisible characters."""
    return ' '.join(''.join(c if c.isprintable() else ' ' for c in text).split())


def capitalised(text: str) -> str:
    """Return a text whose first word, but no name of the input, begins with a capital."""
    return re.sub(r'\A[a-z](?=[a-z]*:? )', lambda letter: letter[0].upper(), text)


def in_markdown(value: object) -> str:
    """Return a value as text within a line of Markdown, free of HTML."""
    text = MARKUP.sub(r'\\\g<0>', one_line(str(value)))
    return text.replace('&', '&amp;').replace('<', '&lt;')


def to_cell(text: str) -> str:
    """Return a text as a table cell that is not a formula."""
    return f"'{text}" if FORMULA.match(text) else text


def from_cell(cell: str) -> str:
    """Return the text of a cell written by `to_cell`."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell
