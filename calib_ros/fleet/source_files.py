# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The sources of a fleet: files that the plant file names, in any file system."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from calib_ros.errors import CalibrationError, InputError
from calib_ros.files import hashes
from calib_ros.files.history import file_system, is_local
from calib_ros.files.loading import TABLES
from calib_ros.files.unpacked import RECORDED
from calib_ros.fleet.plant import Robot

DATES = ('mtime', 'LastModified', 'last_modified', 'Last-Modified')
SUMS = ('ETag', 'etag', 'CRC')  # names of checksums in file systems


class SourceFile(NamedTuple):
    """A bag or table, a session, and a fingerprint of its content, if any."""

    url: str
    session: str = ''
    fingerprint: str = ''
    modified: datetime | None = None

    @property
    def name(self) -> str:
        """Return the name of the source."""
        return f'{self.url}#{self.session}' if self.session else self.url


def sources(robot: Robot) -> tuple[tuple[SourceFile, ...], dict[str, str]]:
    """Return the sources of a robot, and errors by pattern."""
    found: list[SourceFile] = []
    wrong = {}
    for each in robot.measured:
        try:
            found += _matching(each.files, each.session)
        except CalibrationError as err:
            wrong[each.files] = str(err)
        except Exception as err:  # file systems have their own errors
            wrong[each.files] = f'{each.files} cannot be listed: {err}'
    return tuple(found), wrong


def _matching(url: str, session: str) -> list[SourceFile]:
    files, pattern = file_system(url)
    hidden = _hidden(pattern)  # copies are, until they are whole, and what is half written
    found = []
    for path, info in sorted(files.glob(pattern, detail=True).items()):
        if _hidden(path) == hidden:
            name = path if is_local(files) else files.unstrip_protocol(path)
            name += url[url.find('::') :] if '::' in url else ''
            found.append(SourceFile(name, session, *_state(files, path, info)))
    if not found:
        raise InputError(f'nothing matches {url}')
    return found


@contextmanager
def fetched(url: str) -> Iterator[Path]:
    """Yield a local path, or that of a copy of a remote file or folder.

    Copies lie in the folder of the worker, which dask empties even after the worker was killed.
    """
    from distributed import get_worker

    files, path = file_system(url)
    if is_local(files):
        yield Path(path)
        return
    with TemporaryDirectory(dir=get_worker().local_directory) as folder:
        target = Path(folder) / PurePosixPath(path).name
        files.get(path, str(target), recursive=_is_folder(files, path))
        yield target


def _hidden(path: str) -> int:
    """Return how many folders and files on a path are hidden."""
    return sum(part.startswith('.') for part in PurePosixPath(path).parts)


def _is_folder(files: Any, path: str) -> bool:
    """Tell whether a path is a folder; far names with a file suffix are not asked for."""
    far = not is_local(files) and path.lower().endswith((*TABLES, *RECORDED))
    return not far and bool(files.isdir(path))


def _state(files: Any, path: str, info: dict[str, Any]) -> tuple[str, datetime | None]:
    parts = files.find(path, detail=True) if _is_folder(files, path) else {path: info}
    marks, times = [], []
    for name, part in sorted(parts.items()):
        if not any(part.get(key) for key in (*DATES, *SUMS)):
            part = files.info(name)
        dates, sums = ([part[key] for key in keys if part.get(key)] for keys in (DATES, SUMS))
        if part.get('size') is None or not dates + sums:
            return '', None
        marks.append([name, part['size'], *map(str, dates + sums)])
        dates.append(part.get('date_time'))  # in archives (zip)
        times += [each for each in map(_moment, dates) if each is not None]
    return hashes.digest(marks), max(times, default=None)


def _moment(value: object) -> datetime | None:
    if isinstance(value, int | float):
        return datetime.fromtimestamp(value, timezone.utc)
    if isinstance(value, tuple):  # without a zone; of a month 0, if the archive has no dates
        with suppress(ValueError):
            return datetime(*value).replace(tzinfo=timezone.utc)
    return value if isinstance(value, datetime) and value.tzinfo else None
