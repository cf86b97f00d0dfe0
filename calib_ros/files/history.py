# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Results over time: an append-only Parquet dataset.

A row is a file `robot=SERIAL/KEY.parquet`. KEY is a hash of everything the result depends on, so
filing it again, even by several processes, changes nothing. Files appear whole and are never
changed or removed. `.cache` holds rows read before, a file for each robot; it can be removed at
any time.
"""

from __future__ import annotations

import io
import secrets
from contextlib import suppress
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from calib_ros.atomic import write_file
from calib_ros.errors import CalibrationError, ConfigError, InputError
from calib_ros.files.rows import Row

NEEDS_PYARROW = 'a history needs pyarrow and fsspec: pip install "calib_ros[fleet]"'
FOLDER, ENDING = 'robot=', '.parquet'
AWAY = 'move it away, and its work is repeated'


class History:
    """A dataset of rows in a folder, or at any URL that fsspec can write."""

    def __init__(self, place: str | Path) -> None:
        try:
            import pyarrow  # noqa: F401

            self._files, self._root = file_system(str(place))
        except ImportError:
            raise ConfigError(NEEDS_PYARROW) from None
        self._local = is_local(self._files)
        if self._local and Path(self._root).exists() and not Path(self._root).is_dir():
            raise ConfigError(f'a history must be a folder: {place} is not one')

    def file(self, row: Row) -> bool:
        """Add a row; return False if it exists."""
        import pyarrow as pa

        path = self._path(row.serial, row.key)
        if self._files.exists(path):
            return False
        values = ((each.name, getattr(row, each.name)) for each in fields(row))
        record = {name: x.ravel() if isinstance(x, np.ndarray) else x for name, x in values}
        table = pa.Table.from_pylist([record | {'key': row.key}], schema=_schema())
        self._write(path, _packed(table))
        return True

    def serials(self) -> tuple[str, ...]:
        """Return the robots with rows."""
        names = self._names(self._root)
        return tuple(sorted(unquote(n[len(FOLDER) :]) for n in names if n.startswith(FOLDER)))

    def rows(self, serial: str) -> tuple[Row, ...]:
        """Return the rows of a robot, ordered by time."""
        import pyarrow as pa

        names = self._names(self._folder(serial))
        keys = {n[: -len(ENDING)] for n in names if n.endswith(ENDING) and n[0] != '.'}
        known = self._cached(serial)
        held = known.column('key').to_pylist()
        new = sorted(keys.difference(held))
        table = pa.concat_tables([known, *(self._read(serial, key) for key in new)])
        if len(new) >= 8:  # fewer are quick to read again
            with suppress(OSError, CalibrationError, NotImplementedError):  # cannot be written
                self._write(self._cache(serial), _packed(table))
        known = [each for each in table.to_pylist() if each['key'] in keys]
        rows = [_row_of(each, serial) for each in known]
        return tuple(sorted(rows, key=lambda row: (row.time, row.source, row.key)))

    def _folder(self, serial: str, under: str = '') -> str:
        return f'{self._root}/{under}{FOLDER}{quote(serial, safe="")}'

    def _path(self, serial: str, key: str) -> str:
        return f'{self._folder(serial)}/{key}{ENDING}'

    def _names(self, folder: str) -> list[str]:
        try:
            return [Path(each).name for each in self._files.ls(folder, detail=False, refresh=True)]
        except FileNotFoundError:
            return []
        except OSError as err:
            raise InputError(f'the history {folder} cannot be read: {err}') from err

    def _read(self, serial: str, key: str) -> Any:
        import pyarrow as pa

        path = self._path(serial, key)
        try:
            read = _unpacked(self._files.cat_file(path))
            found = pa.Table.from_pylist(read.to_pylist(), schema=_schema())
            if found.column('key').to_pylist() != [key]:
                raise ValueError('its name is not its key')
            return found
        except Exception as err:  # a damaged file fails in many ways
            raise InputError(f'{path} is not a row of a history ({err}): {AWAY}') from err

    def _write(self, path: str, content: bytes) -> None:
        if self._local:
            place = Path(path)
            place.parent.mkdir(parents=True, exist_ok=True)
            write_file(place, content, overwrite=True)
            return
        folder, _, name = path.rpartition('/')
        partial = f'{folder}/.{name}.{secrets.token_hex(8)}.partial'
        self._files.makedirs(folder, exist_ok=True)
        self._files.pipe_file(partial, content)
        self._files.mv(partial, path)

    def _cache(self, serial: str) -> str:
        return f'{self._folder(serial, ".cache/")}.rows'

    def _cached(self, serial: str) -> Any:
        with suppress(Exception):  # none, or damaged
            table = _unpacked(self._files.cat_file(self._cache(serial)))
            if table.schema.equals(_schema()):
                return table
        return _schema().empty_table()


def _packed(table: Any) -> bytes:
    import pyarrow.parquet as parquet

    buffer = io.BytesIO()
    small = {'use_dictionary': False, 'write_statistics': False}  # most of a file of one row
    parquet.write_table(table, buffer, compression='zstd', write_page_checksum=True, **small)
    return buffer.getvalue()


def _unpacked(data: bytes) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as parquet

    file = parquet.ParquetFile(pa.BufferReader(data), page_checksum_verification=True)
    return file.read(use_threads=False)  # threads of pyarrow abort some processes at their end


def file_system(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it."""
    from fsspec.core import url_to_fs

    try:
        files, path = url_to_fs(url)
    except (ImportError, ValueError) as err:
        raise ConfigError(f'{url} cannot be opened: {err}') from err
    return files, path


def is_local(files: Any) -> bool:
    """Tell whether an fsspec file system is that of this machine."""
    return 'file' in ((files.protocol,) if isinstance(files.protocol, str) else files.protocol)


@cache
def _schema() -> Any:
    import pyarrow as pa

    text, number = pa.string(), pa.float64()
    kinds = {'str': text, 'int': pa.int64(), 'float | None': number}
    kinds |= {'datetime': pa.timestamp('us', tz='UTC')}
    kinds |= {'tuple[str, ...]': pa.list_(text), 'FloatArray': pa.list_(number)}
    columns = [(each.name, kinds[str(each.type)]) for each in fields(Row)]
    return pa.schema([('key', pa.string()), *columns])


def _row_of(record: dict[str, Any], serial: str) -> Row:
    where = f'{record.pop("key")}{ENDING} in the history'
    for each in fields(Row):
        value = record[each.name]
        if str(each.type) == 'FloatArray':
            record[each.name] = np.array(value or (), dtype=float)
        elif str(each.type).startswith('tuple'):
            record[each.name] = tuple(value or ())
        elif value is None and 'None' not in str(each.type):
            raise InputError(f'{where} has no {each.name}: {AWAY}')
    if record['serial'] != serial:
        raise InputError(f'{where} is of robot {record["serial"]}, not {serial}: move it away')
    size = len(record['names'])
    square, offsets, tilts = (record[name] for name in ('covariance', 'offsets', 'tilts'))
    numbers = np.concatenate([square, offsets, tilts])
    fits = (square.size, offsets.size, tilts.size % max(size, 1)) == (size**2, size, 0)
    if not (fits and np.isfinite(numbers).all()):
        raise InputError(f'offsets or covariance of {where} do not match its names: {AWAY}')
    record['covariance'] = square.reshape(size, size)
    record['tilts'] = tilts.reshape(size, tilts.size // max(size, 1))
    return Row(**record)
