# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files and folders written whole or not at all, and names from outside that may lead to files.

A folder NAME is made as `.NAME.partial/NAME` beside its place. At the end an earlier NAME becomes
`.NAME.partial/NAME.old`, and the new one takes its place: two renames. A killed process leaves
`.NAME.partial` behind, with the earlier folder in it if killed between the two; the next process
that writes NAME restores it and removes the rest. `.NAME.partial` is locked by the process that
writes into it, which distinguishes leftovers from work in progress. Files are made in such a
folder too.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from hashlib import sha256
from pathlib import Path

from calib_ros.errors import LONGEST_NAME, InputError


def write_file(path: Path, content: str | bytes, *, overwrite: bool = False) -> None:
    """Write a file under a temporary name, then move it into place; may `overwrite` one."""
    write_together({path: content}, overwrite=overwrite)


def write_together(contents: Mapping[Path, str | bytes], *, overwrite: bool = False) -> None:
    """Write files as `write_file` does, all of them or none.

    All are on disk before the first is moved into place. If one cannot be moved, the others are
    restored. A process killed meanwhile leaves the first, old or new, and no mismatched others.
    """
    for path in contents:
        refuse_to_replace(path, overwrite)
    path = next(iter(contents))  # the one that was asked for
    placed: list[Path] = []
    try:
        with _beside(path) as mark:
            partials, earlier = (
                {path: Path(f'{mark}.{k}.{what}') for k, path in enumerate(contents)}
                for what in ('partial', 'earlier')
            )
            for path, content in contents.items():
                flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
                with os.fdopen(os.open(partials[path], flags, 0o666), 'wb') as file:
                    file.write(content.encode() if isinstance(content, str) else content)
                    file.flush()
                    os.fsync(file.fileno())
            try:
                for k, path in enumerate(contents if overwrite and len(contents) > 1 else ()):
                    with suppress(FileNotFoundError):  # none, or another process has it
                        (os.replace if k else _link)(path, earlier[path])
                        placed.append(path)
                for path, partial in partials.items():
                    (os.replace if overwrite else _rename_new)(partial, path)
                    placed.append(path)
                placed = []
            finally:
                _put_back({path: earlier[path] for path in placed})
            with suppress(PermissionError):  # of a folder that is only written
                _sync(path.parent)
    except OSError as err:
        raise OSError(err.errno, err.strerror, str(path)) from err


def write_files(folder: Path, contents: Mapping[str, str | bytes]) -> None:
    """Write new files by name into a folder, created if missing."""
    folder.mkdir(exist_ok=True)
    write_together({folder / name: content for name, content in contents.items()})


@contextmanager
def whole_folder(
    path: Path, own: Sequence[str] | None = None, *, overwrite: bool = False
) -> Iterator[Path]:
    """Yield a path for a new folder, which is moved into place when the block ends.

    If the block fails, or the process is killed, there is no folder, or the earlier one. Missing
    parents are created. `own` are glob patterns of the folder's content, which is replaced only if
    `overwrite`; other content of an earlier folder is kept. By default an earlier folder is an
    error; so is another process writing the same folder.
    """
    place = Path(os.path.realpath(path))
    if not place.name:
        raise InputError(f'{path} is the root folder: choose a folder in it')
    place.parent.mkdir(parents=True, exist_ok=True)
    work = place.with_name(f'.{place.name}.partial')
    new, old = work / place.name, work / f'{place.name}.old'
    claim = _claim(work, path)
    try:
        _clean_up(place, new, old)
        _check_place(path, place, own, overwrite)
        try:
            yield new
            _sync(new, *new.rglob('*'))
            if place.exists():
                _carry_over(place, new, own or ())
                place.rename(old)
            new.rename(place)
            _sync(place.parent)
        except OSError as err:  # names the working folder
            name = str(err.filename or path).replace(str(new), str(path))
            raise OSError(err.errno, err.strerror or str(err), name) from err
        finally:
            _clean_up(place, new, old)
    finally:
        with suppress(OSError):  # not empty after a failed clean-up
            work.rmdir()
        os.close(claim)


def remove_leftovers(folder: Path, begin: str) -> None:
    """Remove what killed processes left of new files and folders, by the start of their names.

    What was moved aside stays, and what another process writes.
    """
    for work in folder.iterdir():
        if not (work.name.startswith(f'.{begin}') and work.suffix == '.partial'):
            continue
        with suppress(OSError, InputError), ExitStack() as stack:
            stack.callback(os.close, _claim(work, work))
            if not {'.old', '.earlier'} & {each.suffix for each in work.iterdir()}:
                shutil.rmtree(work)


def refuse_to_replace(path: Path, overwrite: bool = False, cure: str = 'move it') -> None:
    """Refuse a path in use, except a file to `overwrite`; the message offers a `cure`."""
    try:
        mode = path.stat().st_mode  # once: another process may move it meanwhile
    except OSError:  # nothing is there
        return
    if not stat.S_ISREG(mode):
        raise InputError(f'{path} is not a file: choose another name')
    if not overwrite:
        raise InputError(f'{path} exists already: choose another name or {cure}')


def given_path(name: str) -> Path:
    """Return the absolute path of a file named in a parameter, which no shell expands."""
    try:
        return Path(name).expanduser().absolute()
    except RuntimeError as err:
        raise InputError(f'{name}: there is no such home folder') from err


def confined(name: str, folders: Iterable[Path], allowed_by: str) -> Path:
    """Return the real path of a file named from outside, if it is in one of some folders.

    Relative names are in the first folder. `allowed_by` names the setting for others. Whether a
    file exists elsewhere, as by `..` or a symbolic link, is not disclosed.
    """
    places = [Path(os.path.realpath(folder)) for folder in folders]
    try:
        path = Path(os.path.realpath(places[0] / Path(name).expanduser()))
    except (RuntimeError, ValueError):  # no such home, a zero byte
        path = Path('/')
    if not any(path.is_relative_to(place) for place in places):
        raise InputError(f'{name!r:.200} is outside the folders of the node: {allowed_by}')
    return path


def short_name(name: str) -> str:
    """Return a name with room for a suffix [bytes]; a long one ends with its hash."""
    data = os.fsencode(name)
    if len(data) <= LONGEST_NAME:
        return name
    return f'{data[: LONGEST_NAME - 17].decode(errors="ignore")}_{sha256(data).hexdigest()[:16]}'


def _put_back(earlier: Mapping[Path, Path]) -> None:
    for path, before in earlier.items():
        try:
            if before.exists():
                before.replace(path)  # which leaves it where both are names of one file
                _remove(before.parent, before.name)
            else:
                path.unlink(missing_ok=True)
        except OSError as err:
            words = f'{path} is new, but files that belong to it are not: do not use it ({err})'
            raise InputError(words) from err


def _rename_new(partial: Path, path: Path) -> None:
    try:
        os.link(partial, path)
    except FileExistsError:
        raise InputError(f'{path} exists already: choose another name or move it') from None
    except OSError:  # a file system without hard links
        refuse_to_replace(path)
        partial.rename(path)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """Yield the common start of temporary names, in a hidden folder beside a file.

    The folder goes at the end. Processes that write one file wait for each other, and leftovers of
    a killed one are removed. Without locks the names are beside the file, and leftovers stay.
    """
    work = path.with_name(f'.{short_name(path.name)}.partial')
    mark = work / secrets.token_hex(8)
    claim = _claim(work, path, wait=True)
    try:
        try:
            fcntl.flock(claim, fcntl.LOCK_EX)
        except OSError:
            mark = path.with_name(f'{work.name}.{mark.name}')
        else:
            _remove(work)
        yield mark
        _remove(mark.parent, mark.name, '.earlier')
    finally:
        _remove(mark.parent, mark.name, '.partial')
        with suppress(OSError):  # it holds what could not be put back
            work.rmdir()
        os.close(claim)


def _remove(folder: Path, begin: str = '', end: str = '') -> None:
    """Remove leftover files, if possible, by the start and end of their names."""
    with suppress(OSError):  # a disk that cannot be written
        for path in folder.iterdir():
            if path.name.startswith(begin) and path.name.endswith(end):
                path.unlink(missing_ok=True)


def _claim(work: Path, path: Path, wait: bool = False) -> int:
    """Claim a working folder, new or left by a dead process, until its handle is closed."""
    while True:
        try:
            work.mkdir(mode=0o700)
            made = True
        except FileExistsError:
            made = False
        except OSError as err:
            raise OSError(err.errno, err.strerror, str(path)) from err
        with suppress(FileNotFoundError), ExitStack() as stack:
            handle = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            stack.callback(os.close, handle)
            _lock(handle, work, path, made, wait)
            if os.path.samestat(os.fstat(handle), os.lstat(work)):
                stack.pop_all()
                return handle  # else its owner has just ended: try again


def _lock(handle: int, work: Path, path: Path, made: bool, wait: bool) -> None:
    if os.fstat(handle).st_uid != os.geteuid():
        raise InputError(f'{work} belongs to another user: choose another place for {path}')
    other = f'another process is writing {path}'
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        raise InputError(f'{other}: wait for it, or choose another name') from None
    except OSError:  # a file system without locks: owned by its creator
        if not (made or wait):
            raise InputError(f'{other}, or was killed: remove {work} if none runs') from None


def _clean_up(place: Path, new: Path, old: Path) -> None:
    """Restore an earlier folder that was not replaced, and remove leftovers."""
    if old.exists() and new.exists():
        try:
            old.rename(place)
        except OSError as err:
            raise InputError(f'{old} is the earlier {place}: move it away ({err})') from err
    for folder in (old, new):
        for inner, _, _ in os.walk(folder):
            os.chmod(inner, 0o700)
        if folder.exists():
            shutil.rmtree(folder)


def _check_place(path: Path, place: Path, own: Sequence[str] | None, overwrite: bool) -> None:
    if not os.path.lexists(place):
        return
    if own is None:
        raise InputError(f'{path} exists already: remove it or choose another name')
    if not place.is_dir():
        raise InputError(f'{path} is not a folder: choose another name')
    if os.path.ismount(place) or Path.cwd().is_relative_to(place):
        raise InputError(
            f'{path} is the current folder or a mount point, which cannot be replaced: choose a '
            f'folder in it, such as {path / "result"}'
        )
    existing = sorted(str(each.relative_to(place)) for each in _matching(place, own))
    if existing and not overwrite:
        from calib_ros.shown import some  # loads numpy, not needed by --help

        held = ', '.join(some(existing))
        raise InputError(f'{path} already holds {held}: choose another folder or --force')


def _carry_over(source: Path, target: Path, own: Sequence[str]) -> None:
    """Copy the content of an earlier folder, without `own` and replacing nothing."""
    owned = _matching(source, own)

    def left_out(folder: str, names: list[str]) -> list[str]:
        return [name for name in names if Path(folder, name) in owned]

    shutil.copytree(source, target, True, left_out, _link, dirs_exist_ok=True)


def _link(first: str | Path, second: str | Path) -> None:
    """Hard-link a file to another name, or copy it, unless that exists."""
    try:
        os.link(first, second, follow_symlinks=False)
    except FileExistsError:
        pass
    except OSError:  # no hard links here, or not to this file
        shutil.copy2(first, second)


def _matching(folder: Path, patterns: Sequence[str]) -> set[Path]:
    return {path for each in patterns for path in folder.glob(each)}


def _sync(*paths: Path) -> None:
    for path in paths:
        if not (path.is_file() or path.is_dir()):
            continue
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError:
            if path.is_file():  # some file systems cannot sync folders
                raise
        finally:
            os.close(handle)
