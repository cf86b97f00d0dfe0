# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Results over time: an append-only Parquet dataset.

A row is a file `robot=SERIAL/KEY.parquet`. KEY is a hash of everything the result depends on, so
filing it again, even by several processes, changes nothing. Files appear whole and are never
changed or removed. `.cache` holds rows read before, a file for each robot; it can be removed at
any time.
"""

from __future__ import annotations

import hashlib
import io
import json
import secrets
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

import calib_ros
from calib_ros.apply.confidence import interval_of
from calib_ros.apply.verification import Verification
from calib_ros.atomic import write_file
from calib_ros.decision.result import Identification
from calib_ros.decision.validation import ErrorFigures
from calib_ros.errors import LONGEST_NAME, CalibrationError, ConfigError, InputError
from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import chain_document, parse_chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.settings import Settings
from calib_ros.shown import Shown
from calib_ros.values import parse_name

MISSING = 'a history needs pyarrow and fsspec: pip install "calib_ros[fleet]"'
FOLDER, ENDING = 'robot=', '.parquet'
AWAY = 'move it away, and its work is repeated'


@dataclass(frozen=True)
class Filing:
    """Robot, time and source of a filed result."""

    serial: str
    time: datetime
    inputs: str  # a hash
    settings: str  # a hash
    source: str = ''
    fingerprint: str = ''  # cheap test that the source is unchanged

    def __post_init__(self) -> None:
        """Refuse a serial number that cannot name a folder."""
        parse_serial(self.serial, 'the serial number')


def parse_serial(value: object, where: str) -> str:
    """Return a serial number that can name a folder; errors name it `where`."""
    if not isinstance(value, str) or value in ('', '.', '..'):
        raise ConfigError(f'{where} must be text ("0042" in quotes), not {value!r}')
    if len(quote(parse_name(value, where), safe='')) > LONGEST_NAME:
        raise ConfigError(f'{where} is too long to name a folder: {value}')
    return value


@dataclass(frozen=True, eq=False, repr=False)
class Row(Shown):
    """A filed result; docs/fleet.md describes the columns.

    Figures are in mm and mrad; offsets and covariance (P, P) of the parameters `names` in m and
    rad; the parameters follow T waves of wobble of size `tilt` by `tilts` (P, T).
    """

    serial: str
    kind: str
    time: datetime
    verdict: str
    inputs: str
    settings: str
    source: str = ''
    fingerprint: str = ''
    software: str = calib_ros.__version__
    filed: datetime = field(default_factory=lambda: datetime.now(timezone.utc))
    model: str = ''
    reasons: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    poses: int = 0
    rms_before_mm: float | None = None
    rms_mm: float | None = None
    lower_mm: float | None = None
    upper_mm: float | None = None
    mean_mm: float | None = None
    max_mm: float | None = None
    rms_mrad: float | None = None
    rms_freedom: float | None = None
    freedom: float | None = None
    names: tuple[str, ...] = ()
    offsets: FloatArray = field(default_factory=lambda: np.zeros(0))
    covariance: FloatArray = field(default_factory=lambda: np.zeros(0))
    tilt: float | None = None
    tilts: FloatArray = field(default_factory=lambda: np.zeros(0))
    chain: str = ''

    @property
    def key(self) -> str:
        """Return the name of the result: the same for the same work."""
        return digest([self.serial, self.kind, self.inputs, self.settings, self.software])

    @property
    def accepted(self) -> bool:
        """Tell whether it is an accepted identification."""
        return self.verdict == 'accepted'

    def corrected(self) -> Chain:
        """Return the corrected chain with its frames."""
        return parse_chain(self.chain, f'the chain of {self.serial} in the history')


def digest(content: object) -> str:
    """Return the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def settings_hash(nominal: Chain, settings: Settings, *more: object) -> str:
    """Return the hash of what a result depends on besides the measurements."""
    return digest([chain_document(nominal), asdict(settings), *more])


def content_hash(files: Sequence[str], session: str = '') -> str:
    """Return the hash of files, by their own hashes, or of a session in them."""
    return digest([session, *sorted(files)])


def samples_hash(sets: Sequence[Observations]) -> str:
    """Return the hash of samples without a file, by all that was measured."""
    found = hashlib.sha256()
    for each in sets:
        for part in fields(each):
            value = getattr(each, part.name)
            data = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            found.update(data)
    return found.hexdigest()


def is_time(stamp_ns: int) -> bool:
    """Tell whether a stamp is a time (from 1973), not since a start or from lines."""
    return stamp_ns >= 10**17


def measured_at(sets: Sequence[Observations], otherwise: datetime | None = None) -> datetime:
    """Return the time of the last pose, or `otherwise` if stamps are no times."""
    last = max((int(each.stamps_ns.max()) for each in sets if len(each)), default=0)
    if not is_time(last):
        return otherwise or datetime.now(timezone.utc)
    return datetime.fromtimestamp(last / 1e9, timezone.utc)


def identified(result: Identification, about: Filing, warnings: Sequence[str] = ()) -> Row:
    """Return the row of an identification; `warnings` are of the measurements."""
    offsets = {str(each.name): each.offset for each in result.parameters}
    names = tuple(map(str, result.names))
    which = result.validation or result.fitted
    freedom = result.uncertainty.overall
    return _row(
        about,
        'identify',
        result.chain,
        'accepted' if result.accepted else 'refused',
        which.figures,
        interval_of(which, 1),
        reasons=tuple(map(str, result.refusals)),
        remarks=tuple(map(str, (*warnings, *result.remarks))),
        freedom=freedom if np.isfinite(freedom) else None,
        names=names,
        offsets=np.array([offsets[name] for name in names]),
        covariance=result.covariance,
        tilt=result.posterior.tilts.size,
        tilts=np.float32(result.posterior.tilts.followed),
    )


def judged(
    chain: Chain, before: ErrorFigures | None, after: ErrorFigures, verdict: str, about: Filing
) -> Row:
    """Return the row of a validation: a calibration on later poses."""
    return _row(about, 'validate', chain, verdict, (before, after))


def verified(chain: Chain, found: Verification, about: Filing) -> Row:
    """Return the row of a verification; without freedom, and so in no chart, of fitted poses."""
    before, after = found.comparison.figures
    figures = before, replace(after, rms_mm=1e3 * found.rms)
    limits = found.lower, found.upper
    freedom = None if found.reused else found.freedom
    return _row(about, 'verify', chain, found.verdict, figures, limits, rms_freedom=freedom)


def _row(
    about: Filing,
    kind: str,
    chain: Chain,
    verdict: str,
    figures: tuple[ErrorFigures | None, ErrorFigures],
    limits: tuple[float, float] | None = None,
    **more: Any,
) -> Row:
    before, after = figures
    more |= {name: getattr(after, name) for name in ('rms_mm', 'mean_mm', 'max_mm', 'rms_mrad')}
    if limits is not None and np.isfinite(limits).all():
        more |= {'lower_mm': 1e3 * limits[0], 'upper_mm': 1e3 * limits[1]}
    return Row(
        **asdict(about),
        kind=kind,
        model=chain.name,
        chain=json.dumps(chain_document(chain)),
        verdict=verdict,
        poses=after.count,
        rms_before_mm=None if before is None else before.rms_mm,
        **more,
    )


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
        if self._local and Path(self._root).exists() and not Path(self._root).is_dir():
            raise ConfigError(f'a history cannot be at {place}: that is no folder')

    def file(self, row: Row) -> bool:
        """Add a row; return False if it exists."""
        import pyarrow as pa
        import pyarrow.parquet as parquet

        path = self._path(row.serial, row.key)
        if self._files.exists(path):
            return False
        values = ((each.name, getattr(row, each.name)) for each in fields(row))
        record = {name: x.ravel() if isinstance(x, np.ndarray) else x for name, x in values}
        table = pa.Table.from_pylist([record | {'key': row.key}], schema=_schema())
        buffer = io.BytesIO()
        small = {'use_dictionary': False, 'write_statistics': False}  # most of a file of one row
        parquet.write_table(table, buffer, compression='zstd', **small)
        self._write(path, buffer.getvalue())
        return True

    def serials(self) -> tuple[str, ...]:
        """Return the robots with rows."""
        names = self._names(self._root)
        return tuple(sorted(unquote(n[len(FOLDER) :]) for n in names if n.startswith(FOLDER)))

    def keys(self, serial: str) -> frozenset[str]:
        """Return the keys of a robot's rows."""
        names = self._names(self._folder(serial))
        return frozenset(n[: -len(ENDING)] for n in names if n.endswith(ENDING) and n[0] != '.')

    def rows(self, serial: str) -> tuple[Row, ...]:
        """Return the rows of a robot, ordered by time."""
        import pyarrow as pa

        keys = self.keys(serial)
        known = self._cached(serial)
        held = known.column('key').to_pylist()
        new = sorted(keys.difference(held))
        table = pa.concat_tables([known, *(self._read(serial, key) for key in new)])
        if len(new) >= 8:  # fewer are quick to read again
            self._cache(serial, table)
        rows = [row for row in _rows_of(table) if row.key in keys]
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
        import pyarrow.parquet as parquet

        path = self._path(serial, key)
        try:
            data = pa.BufferReader(self._files.cat_file(path))
            # threads of pyarrow abort some processes at their end
            read = parquet.ParquetFile(data).read(use_threads=False)
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

    def _cached(self, serial: str) -> Any:
        import pyarrow as pa

        with suppress(OSError, pa.ArrowException):
            data = self._files.cat_file(f'{self._folder(serial, ".cache/")}.arrow')
            alone = pa.ipc.IpcReadOptions(use_threads=False)  # see `_read`
            table = pa.ipc.open_file(data, options=alone).read_all()
            if table.schema.equals(_schema()):
                return table
        return _schema().empty_table()

    def _cache(self, serial: str, table: Any) -> None:
        """Cache the rows, if the history can be written."""
        import pyarrow as pa

        buffer = io.BytesIO()
        with pa.ipc.new_file(buffer, table.schema) as writer:
            writer.write_table(table.combine_chunks())
        with suppress(OSError, CalibrationError, NotImplementedError):
            self._write(f'{self._folder(serial, ".cache/")}.arrow', buffer.getvalue())


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


def _rows_of(table: Any) -> list[Row]:
    rows = []
    for record in table.to_pylist():
        key = record.pop('key')
        for each in fields(Row):
            value = record[each.name]
            if str(each.type) == 'FloatArray':
                record[each.name] = np.array(value or (), dtype=float)
            elif str(each.type).startswith('tuple'):
                record[each.name] = tuple(value or ())
            elif value is None and 'None' not in str(each.type):
                raise InputError(f'{key}{ENDING} in the history has no {each.name}: {AWAY}')
        size = len(record['names'])
        square, offsets, tilts = (record[name] for name in ('covariance', 'offsets', 'tilts'))
        numbers = np.concatenate([square, offsets, tilts])
        fits = (square.size, offsets.size, tilts.size % max(size, 1)) == (size**2, size, 0)
        if not (fits and np.isfinite(numbers).all()):
            raise InputError(
                f'the offsets or covariance of {key}{ENDING} in the history are not those of '
                f'{size} names: {AWAY}'
            )
        record['covariance'] = square.reshape(size, size)
        record['tilts'] = tilts.reshape(size, tilts.size // max(size, 1))
        rows.append(Row(**record))
    return rows
