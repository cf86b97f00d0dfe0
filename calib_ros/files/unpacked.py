# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The files of a recording, unpacked if compressed as a whole, and with their logs applied."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from calib_ros.errors import ConfigError, InputError
from calib_ros.files import compression
from calib_ros.texts import read_text

UNPACKED = ('.mcap', '.db3')  # suffixes of the files of a recording
RECORDED = (*UNPACKED, '.zstd')  # also if it is compressed as a whole


def recorded_files(path: Path, kinds: Sequence[str] = UNPACKED) -> tuple[Path, ...]:
    """Return the files of a recording, in order: those of a folder, or the file itself."""
    files = path.iterdir() if path.is_dir() else [path]
    ordered = sorted(files, key=lambda file: (len(file.name), file.name))  # bag_9 before bag_10
    return tuple(file for file in ordered if file.suffix in kinds)


@contextmanager
def unpacked_files(path: Path) -> Iterator[Path]:
    """Provide a bag whose files are neither compressed nor partly in a write-ahead log."""
    if not (path.is_dir() or path.is_file()):
        raise InputError(f'there is no bag at {path}: give its folder or one of its files')
    files = recorded_files(path, RECORDED)
    if not any(file.suffix == '.zstd' or _log(file).is_file() for file in files):
        yield path
        return
    with TemporaryDirectory() as name:
        folder = Path(name)
        for file in files:
            if file.suffix != '.zstd':
                _with_log(file, folder / file.name)
            elif not (folder / file.stem).exists():
                _unpack_file(file, folder / file.stem)
        with suppress(ConfigError):
            text = read_text((path if path.is_dir() else path.parent) / 'metadata.yaml')
            text = re.sub(r'(?m)^(\s*compression_mode:).*$', r'\1 ""', text).replace('.zstd', '')
            (folder / 'metadata.yaml').write_text(text, encoding='utf-8')
        yield folder if path.is_dir() else folder / path.name.removesuffix('.zstd')


def _log(file: Path) -> Path:
    return file.with_name(f'{file.name}-wal')


def _with_log(file: Path, target: Path) -> None:
    """Copy a file with its log applied; link to one without."""
    if not _log(file).is_file():
        target.symlink_to(file.resolve())
        return
    shutil.copyfile(file, target)
    shutil.copyfile(_log(file), _log(target))
    try:
        with closing(sqlite3.connect(target)) as connection:
            _, pages, _ = connection.execute('PRAGMA wal_checkpoint').fetchone()
    except sqlite3.OperationalError as err:  # full disk
        raise InputError(f'{_log(file)} cannot be applied to a copy of {file}: {err}') from err
    except sqlite3.DatabaseError:  # no database; reported later
        return
    if pages == 0 and _log(file).stat().st_size > 32:  # more than its header
        raise InputError(
            f'{_log(file)} is damaged, so the last messages cannot be read: copy it again, or '
            'move it away to use the rest'
        )


def _unpack_file(file: Path, target: Path) -> None:
    room = compression.Room(file.stat().st_size)
    try:
        with target.open('wb') as out, compression.module_of('zstd').open(file, 'rb') as packed:
            while part := packed.read(1 << 20):
                room.take(len(part))
                out.write(part)
    except InputError as err:
        raise InputError(f'{file} is too large: {err}') from err
    except OSError:  # full disk
        raise
    except Exception:  # decompressors have their own errors; losses are reported later
        return
