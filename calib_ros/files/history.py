# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Results over time: a Parquet dataset to which rows are added, read by anything that reads one.

A row is a file `robot=SERIAL/KEY.parquet`. KEY is a hash of the robot, of what was done, of the
content of the inputs, of the settings and of the software: the same result has the same name, so
it is there once however often and by however many processes it is filed. A file is written under a
temporary name and renamed: it is there as a whole or not at all. Nothing is changed or removed.

`.cache` holds what was read before, a file for each robot; it can be removed at any time.
"""

from __future__ import annotations

import io
import secrets
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from calib_ros.atomic import write_file
from calib_ros.errors import CalibrationError, ConfigError, InputError
from calib_ros.files.rows import Row

MISSING = 'a history needs pyarrow and fsspec: pip install "calib_ros[fleet]"'
FOLDER, ENDING = 'robot=', '.parquet'


class History:
    """A dataset of rows in a folder, or at any URL that fsspec can write."""

    def __init__(self, place: str | Path) -> None:
        try:
            import pyarrow  # noqa: F401
            from fsspec.core import url_to_fs
        except ImportError:
            raise ConfigError(MISSING) from None
        try:
            self._files, self._root = url_to_fs(str(place))
        except (ImportError, ValueError) as err:
            raise ConfigError(f'a history cannot be at {place}: {err}') from err
        self._local = is_local(self._files)

    def file(self, row: Row) -> bool:
        """Add a row; return False where it was there already."""
        import pyarrow.parquet as parquet

        path = self._path(row.serial, row.key)
        if self._files.exists(path):
            return False
        buffer = io.BytesIO()
        small = {'use_dictionary': False, 'write_statistics': False}  # most of a file of one row
        parquet.write_table(_table_of(row), buffer, compression='zstd', **small)
        self._write(path, buffer.getvalue())
        return True

    def serials(self) -> tuple[str, ...]:
        """Return the robots that have rows."""
        names = (Path(each).name for each in self._names(self._root))
        return tuple(sorted(unquote(n[len(FOLDER) :]) for n in names if n.startswith(FOLDER)))

    def keys(self, serial: str) -> frozenset[str]:
        """Return the keys of the rows of a robot."""
        names = (Path(each).name for each in self._names(self._folder(serial)))
        return frozenset(
            name[: -len(ENDING)]
            for name in names
            if name.endswith(ENDING) and not name.startswith('.')
        )

    def rows(self, serial: str) -> tuple[Row, ...]:
        """Return the rows of a robot in the order of their times."""
        import pyarrow as pa

        keys = self.keys(serial)
        known = self._cached(serial)
        held = known.column('key').to_pylist()
        new = sorted(keys.difference(held))
        table = pa.concat_tables([known, *(self._read(serial, key) for key in new)])
        if len(new) >= 8:  # fewer are read one by one every time
            self._cache(serial, table)
        rows = [row for row in _rows_of(table) if row.key in keys]
        return tuple(sorted(rows, key=lambda row: (row.time, row.source, row.key)))

    def _folder(self, serial: str) -> str:
        return f'{self._root}/{FOLDER}{quote(serial, safe="")}'

    def _path(self, serial: str, key: str) -> str:
        return f'{self._folder(serial)}/{key}{ENDING}'

    def _names(self, folder: str) -> list[str]:
        try:
            return [str(each) for each in self._files.ls(folder, detail=False, refresh=True)]
        except FileNotFoundError:
            return []
        except OSError as err:
            raise InputError(f'the history {folder} cannot be read: {err}') from err

    def _read(self, serial: str, key: str) -> Any:
        import pyarrow.parquet as parquet

        path = self._path(serial, key)
        try:
            with self._files.open(path, 'rb') as file:
                table = parquet.ParquetFile(file).read()
            return _conformed(table, key)
        except Exception as err:  # a damaged file fails in many ways
            raise InputError(
                f'{path} is no row of a history ({err}): move it away, its work is done again'
            ) from err

    def _write(self, path: str, content: bytes) -> None:
        """Write a file that others see as a whole or not at all."""
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

    def _cache_path(self, serial: str) -> str:
        return f'{self._root}/.cache/{FOLDER}{quote(serial, safe="")}.arrow'

    def _cached(self, serial: str) -> Any:
        """Return the rows of a robot that were read before, as far as they can be used."""
        import pyarrow as pa

        try:
            with self._files.open(self._cache_path(serial), 'rb') as file:
                table = pa.ipc.open_file(io.BytesIO(file.read())).read_all()
        except (OSError, pa.ArrowException):
            return _schema().empty_table()
        return table if table.schema.equals(_schema()) else _schema().empty_table()

    def _cache(self, serial: str, table: Any) -> None:
        """Keep what was read; a history that cannot be written is read without."""
        import pyarrow as pa

        buffer = io.BytesIO()
        with pa.ipc.new_file(buffer, table.schema) as writer:
            writer.write_table(table.combine_chunks())
        try:
            self._write(self._cache_path(serial), buffer.getvalue())
        except (OSError, CalibrationError, NotImplementedError):
            return


def is_local(files: Any) -> bool:
    """Tell whether a file system of fsspec is that of this machine."""
    return 'file' in ((files.protocol,) if isinstance(files.protocol, str) else files.protocol)


@cache
def _schema() -> Any:
    """Return the columns: the key, and the fields of a row."""
    import pyarrow as pa

    kinds = {
        'str': pa.string(),
        'int': pa.int64(),
        'float | None': pa.float64(),
        'datetime': pa.timestamp('us', tz='UTC'),
        'tuple[str, ...]': pa.list_(pa.string()),
        'FloatArray': pa.list_(pa.float64()),
    }
    columns = [(each.name, kinds[str(each.type)]) for each in fields(Row)]
    return pa.schema([('key', pa.string()), *columns])


def _table_of(row: Row) -> Any:
    """Return a row as a table; matrices row by row."""
    import pyarrow as pa

    record: dict[str, Any] = {'key': row.key}
    for each in fields(row):
        value = getattr(row, each.name)
        record[each.name] = value.ravel() if isinstance(value, np.ndarray) else value
    return pa.Table.from_pylist([record], schema=_schema())


def _conformed(table: Any, key: str) -> Any:
    """Return a table of the file of a key with the columns of today: empty where it has none."""
    import pyarrow as pa

    if table.column('key').to_pylist() != [key]:
        raise ValueError('its name is not its key')
    columns = [
        table.column(each.name).cast(each.type)
        if each.name in table.column_names
        else pa.nulls(len(table), each.type)
        for each in _schema()
    ]
    return pa.Table.from_arrays(columns, schema=_schema())


def _rows_of(table: Any) -> list[Row]:
    """Return the rows of a table."""
    rows = []
    for record in table.drop_columns(['key']).to_pylist():
        for each in fields(Row):
            value = record[each.name]
            if str(each.type) == 'FloatArray':
                record[each.name] = np.array(value or (), dtype=float)
            elif str(each.type).startswith('tuple'):
                record[each.name] = tuple(value or ())
        size = len(record['names'])
        square = record['covariance']
        if square.size != size * size or not np.isfinite(square).all():
            raise InputError(
                f'the covariance of {record["serial"]} in the history is not one of {size} names'
            )
        record['covariance'] = square.reshape(size, size)
        rows.append(Row(**record))
    return rows
