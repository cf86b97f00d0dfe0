# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The folder with the journals and calibrations of one robot.

Rows that cannot be written, as on a full disk, wait in memory.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from tempfile import TemporaryFile, mkdtemp
from typing import Any
from urllib.parse import quote

from calib_ros.atomic import (
    remove_leftovers,
    short_name,
    whole_folder,
    write_file,
    write_files,
    write_together,
)
from calib_ros.errors import InputError, trouble
from calib_ros.files.journal import (
    Journal,
    joints_line,
    locked,
    read_journal,
    refuse_other_joints_than,
    settings_beside,
    whole_journal,
)
from calib_ros.sampling.sample import Sample

_CALIBRATION, _JOURNAL = '.yaml', '.csv'


class Archive:
    """Files ROBOT_TIME of one robot in a folder, created if missing.

    The robot is CHAIN or CHAIN/NAME, unique among its kind; `tip` is the last link of one of its
    arms. `joints` are the names of q1, q2, ...; they and the text of `configuration` are written
    beside a journal.
    """

    def __init__(
        self,
        folder: Path,
        robot: str,
        joints: Sequence[str],
        configuration: Callable[[], str],
        tip: str = '',
    ) -> None:
        self.folder = folder
        self.error = ''  # why poses are in memory only; empty if all are in the journal
        names = filter(None, (*robot.split('/', 1), tip))
        words = (re.sub(r'[^\w.-]', lambda m: quote(m[0], ''), name) for name in names)
        self._robot = short_name('+'.join(words))  # no two robots alike: + is escaped in words
        self._joints = joints
        self._configuration = configuration
        self._journal: Journal | None = None
        self._mark: int | None = None  # the file of a journal that has no poses yet
        self._waiting: list[tuple[Sample, bool]] = []
        self._written: list[tuple[Sample, bool]] = []  # to the journal that is open
        self._due = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with TemporaryFile(dir=folder):
                pass
            remove_leftovers(folder, f'{self._robot}_')
        except OSError as err:
            why = f'poses cannot be kept in {folder} ({err.strerror})'
            raise InputError(f'{why}: set data_dir to a writable folder') from err
        self.path = self._new_path(_JOURNAL)
        """The journal, begun or not."""

    @property
    def trouble(self) -> str:
        """Return that samples are in memory only; empty if all are on disk."""
        return f'poses are in memory only: {self.error}; ' if self.error else ''

    @property
    def _unsafe(self) -> bool:
        """Tell whether samples would be lost if the files were closed."""
        return bool(self.error and (self._waiting or self._journal))

    @property
    def journal(self) -> Path | None:
        """Return the path of the journal, if any."""
        return None if self._journal is None else self._journal.path

    def begin(self, log: Any) -> None:
        """Show that a session begins, so that the journal before is not resumed; log that."""
        with suppress(OSError):  # told with the first pose
            self._mark = locked(self.path)
        if (earlier := self.newest_journal()) is None:
            return
        try:
            with suppress(OSError):  # told when it is read
                os.close(locked(earlier, create=0))
            log.info(f'a new session begins: to continue {earlier}, start with resume:=true')
        except InputError as err:
            log.warning(str(err))

    def add(self, sample: Sample) -> None:
        """Keep a sample."""
        self._waiting.append((sample, False))
        self.write()

    def remove(self, sample: Sample) -> None:
        """Record the removal of a sample."""
        if (sample, False) in self._waiting:
            self._waiting.remove((sample, False))
        else:
            self._waiting.append((sample, True))
        self.write()

    def write(self) -> None:
        """Write waiting rows if possible; a journal that is gone begins anew as another."""
        try:
            if self._journal is not None and self._journal.gone:
                if self.path == self._journal.path:
                    self.path = self._new_path(_JOURNAL)
                self._begin()
            elif self._journal is None and (self._waiting or self._due):
                self._begin()
            while self._journal is not None and self._waiting:
                self._journal.add(*self._waiting[0])
                self._written.append(self._waiting.pop(0))
        except OSError as err:
            self.error = trouble(OSError(err.errno, err.strerror))  # without the path: known
        except InputError as err:  # another process writes it
            self.error = str(err)
        else:
            self.error = ''

    def _begin(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        beside = joints_line(self._joints) + self._configuration()
        write_file(settings_beside(self.path), beside, overwrite=True)
        if self._written:
            whole = whole_journal(self._written, len(self._joints))
            write_file(self.path, whole, overwrite=True)
        self._unmark()
        before, self._journal = self._journal, Journal(self.path, len(self._joints))
        if before is not None:
            before.close()
        self._due = False

    def start_new(self) -> Path | None:
        """Start another journal, on disk at once; return the path of the old one."""
        self.write()
        if self._unsafe:
            raise InputError(
                f'poses are in memory only and would be lost: {self.error}; make room, or start '
                'the node again with another data_dir'
            )
        old = self.journal
        if old is not None:
            self.close()
            self.path = self._new_path(_JOURNAL)
            self._due = True
            self.write()
        return old

    def resume(self) -> tuple[tuple[Sample, ...], tuple[str, ...]]:
        """Continue the newest journal, if any; return its samples, and warnings."""
        newest = self.newest_journal()
        if newest is None:
            return (), (f'nothing to resume in {self.folder}: a new session begins',)
        last = self._files(_JOURNAL, 0)[-1]
        if last != newest:
            with suppress(OSError):  # told with the first pose
                self._mark = locked(last)
            self.path = last
            told = f'the last session had no poses: to continue {newest} instead, delete {last}'
            return (), (told,)
        self.path = newest
        refuse_other_joints_than(self._joints, newest)
        try:
            samples, warnings = read_journal(newest, len(self._joints))
        except InputError as err:
            raise InputError(
                f'{err}. It is left untouched: repair it, move it away to continue the one '
                'before, or start without resume to begin another'
            ) from err
        self._journal = Journal(self.path, len(self._joints))
        self._written = [(each, False) for each in samples]
        return samples, warnings

    def newest_journal(self) -> Path | None:
        """Return the journal begun last."""
        return next(reversed(self._files(_JOURNAL)), None)

    def newest_calibration(self) -> Path | None:
        """Return the calibration saved last."""
        return next(reversed(self._files(_CALIBRATION)), None)

    def save(self, text: str, configuration: str, path: Path | None = None) -> Path:
        """Write a calibration with its configuration, if known; return its path."""
        path = path or self._new_path(_CALIBRATION)
        beside = {settings_beside(path): configuration} if configuration else {}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_together({path: text, **beside})
        return path

    def export(self, files: Mapping[str, str]) -> Path:
        """Write files into a new folder, all of them or none; return its path."""
        folder = self._new_path('')
        with whole_folder(folder) as partial:
            write_files(partial, files)
        return folder

    def note(self, text: str, journal: Path, ending: str = '.txt') -> Path | None:
        """Write the result of the last identification beside its journal; return its path."""
        path = journal.with_suffix(f'.identified{ending}').absolute()
        try:
            write_file(path, text, overwrite=True)
        except (OSError, InputError):
            return None
        return path

    def close(self) -> str:
        """Close the journal; return what could not be written to it, and where it is."""
        self.write()
        words = ''
        if self._unsafe:
            why, before = self.error, self.journal
            with suppress(OSError):
                self.path = Path(mkdtemp(prefix='calib_ros_')) / self.path.name
                self._begin()
                self.write()
            where = f'are in {self.path}, not in {self.folder}'
            if self._unsafe:
                others = f'other than those in {before} ' if before and before.is_file() else ''
                where = f'{others}are lost'
            words = f'poses {where}: {why}'
        if self._journal is not None:
            self._journal.close()
            self._journal, self._written = None, []
        elif not words and self.path in {*self._files(_JOURNAL, 0)} - {*self._files(_JOURNAL)}:
            with suppress(OSError):
                self.path.unlink()  # as `begin` made it
        self._unmark()
        return words

    def _unmark(self) -> None:
        if self._mark is not None:
            os.close(self._mark)
        self._mark = None

    def _new_path(self, ending: str) -> Path:
        """Return a path that sorts behind all others, even if the clock was set back."""
        now = f'{datetime.now(timezone.utc):%Y%m%d%H%M%S%f}'
        last = max((digits for digits, _, _ in self._dated()), default='0')
        digits = max(now, f'{int(last) + 1:020}')
        return self.folder / f'{self._robot}_{digits[:8]}T{digits[8:]}Z{ending}'

    def _dated(self) -> list[tuple[str, str, Path]]:
        name = re.compile(rf'{re.escape(self._robot)}_([0-9]{{8}})T([0-9]{{12}})Z(.*)')
        found = ((name.fullmatch(path.name), path) for path in self.folder.glob('*'))
        return [(match[1] + match[2], match[3], path) for match, path in found if match]

    def _files(self, ending: str, least: int = 1) -> list[Path]:
        found = (path for _, ends, path in sorted(self._dated()) if ends == ending)
        return [path for path in found if _holds(path, least)]


def _holds(path: Path, least: int) -> bool:
    """Tell whether a path is a file of so many bytes; a link to a lost one may be."""
    try:
        found = path.stat()
    except OSError:
        return True
    return stat.S_ISREG(found.st_mode) and found.st_size >= least
