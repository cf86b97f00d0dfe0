# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that say what was wrong, what was expected and what to do."""

from __future__ import annotations

import errno
from collections.abc import Iterable
from itertools import islice
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

LONGEST = 400
"""Characters of a message; quotes from files may have any length. A convention."""
LONGEST_NAME = LONGEST // 2  # characters of a name, number or expression, to fit a message
MOST_ENTRIES = 1000
"""Entries of a list, columns, and characters of an entry in input: a convention; other limits are
multiples."""


def shortened(text: str, longest: int = LONGEST) -> str:
    """Return a text without its middle if too long: the fault is first, the remedy last."""
    if len(text) <= longest:
        return text
    gap = f' ... ({len(text)} characters) ... '
    end = (longest - len(gap)) // 3
    return text[: longest - len(gap) - end] + gap + text[len(text) - end :]


_ADVICE = {
    errno.ENOSPC: 'the disk is full: make room, or write to another place',
    errno.EDQUOT: 'your share of the disk is full: make room, or write to another place',
    errno.EROFS: 'this disk is read-only: choose another place',
    errno.EACCES: 'permission denied: choose another place, or ask its owner',
    errno.EFBIG: 'the file would be too large for this disk: write to another place',
    errno.EEXIST: 'something else is there already: choose another name',
    errno.ENOTDIR: 'a file is where a folder should be: choose another place',
    errno.ENAMETOOLONG: 'the name is too long: choose a shorter one',
    errno.EMFILE: 'too many files are open: close programs, or raise the limit (ulimit -n)',
}


class CalibrationError(Exception):
    """Base of all intentional errors."""

    def __init__(self, message: str = '') -> None:
        super().__init__(shortened(message))


class ConfigError(CalibrationError):
    """An unusable chain file, setting or command line."""


class InputError(CalibrationError):
    """An unusable bag, table or message."""


class UnknownNameError(ConfigError):
    """A name that does not exist, with the valid alternatives: the nearest, or what to do."""

    def __init__(
        self, what: str, name: str, alternatives: Iterable[str], otherwise: str = ''
    ) -> None:
        self.what = what
        self.name = name
        self.alternatives = tuple(alternatives)
        hint, listed = near(str(name), self.alternatives), ', '.join(self.alternatives)
        if otherwise:
            hint = f'valid: {listed}; {otherwise}'
        elif not hint or len(listed) <= LONGEST_NAME:
            hint = f'{hint} valid: {listed}'.strip()
        *place, of = what.rpartition(': ')
        super().__init__(f'{"".join(place)}unknown {of} "{name}": {hint}')


class ColumnsError(InputError):
    """A table without our columns; it may have another layout."""


class TooFewObservationsError(InputError):
    """Too few matched pairs for the requested parameters; `account` says what was received."""

    def __init__(self, configurations: int, needed: int, why: str, account: str = '') -> None:
        self.configurations, self.needed, self.why = configurations, needed, why
        self.brief = (
            f'too few different poses: {configurations} measured, at least {needed} needed'
        )
        self.advice = f'measure {max(30, 2 * needed)} or more, or hold parameters (fixed)'
        super().__init__(f'{self.brief} ({why}){account and f" ({account})"}; {self.advice}')

    def after(self, account: str) -> TooFewObservationsError:
        """Return the error with what was received."""
        return TooFewObservationsError(self.configurations, self.needed, self.why, account)


def near(name: str, alternatives: Iterable[str], least: float = 0.51) -> str:
    """Return 'did you mean "...?"' with the most similar alternative, if any."""
    small = {each.lower(): each for each in list(alternatives)[:MOST_ENTRIES]}
    if not small or len(name) > MOST_ENTRIES:
        return ''
    import difflib  # slow to load

    found = difflib.get_close_matches(name.lower(), small, n=1, cutoff=least)
    return f'did you mean "{small[found[0]]}"?' if found else ''


def unreadable(path: Path, err: OSError, what: str = '') -> str:
    """Return why a file, described by `what`, is not read, and a similar name."""
    text = f'cannot read {what}{path}: {err.strerror or err}'
    if path.is_symlink():
        return f'{text} (the link leads to {path.readlink()})'
    if not isinstance(err, FileNotFoundError) or not path.parent.is_dir():
        return text
    some = islice(path.parent.iterdir(), MOST_ENTRIES)
    likely = (each.name for each in some if near(path.stem, [each.stem], 0.7))
    hint = near(path.name, likely, 0.7)  # any two tables share their ending
    return f'{text}: {hint}' if hint else text


def trouble(err: Exception) -> str:
    """Return what an error says; of the system's the file, why, and what to do if known."""
    if not isinstance(err, OSError):
        return str(err)
    why = _ADVICE.get(err.errno or 0) or err.strerror or str(err)
    return f'{err.filename}: {why}' if err.filename else why
