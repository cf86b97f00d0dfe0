# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
# PYTHON_ARGCOMPLETE_OK
"""The command line: `calib_ros identify | verify | plan | ...`.

Exit status: 0 done, 1 the input cannot be used, 2 wrong usage, 3 the identification ran but its
result is not accepted, a program has samples that cannot be compensated, or a corrected arm does
not pass; 4 measurements of some robots of a fleet cannot be used; 130 interrupted
or terminated.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import os
import re
import shlex
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress

# matrices are small: a second BLAS thread costs more than it gives, especially on a busy cell
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from calib_ros import __version__
from calib_ros.cli.checks import refuse_alone
from calib_ros.cli.commands import COMMANDS
from calib_ros.cli.common import OF_REPORTS
from calib_ros.cli.parser import overview, parser_of, unknown_word
from calib_ros.cli.screen import Screen
from calib_ros.errors import CalibrationError, UnknownNameError, shortened, trouble


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:  # a program, not a call: `timeout` and systemd end it as Ctrl-C does
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        logging.getLogger('matplotlib').setLevel(logging.ERROR)  # its cache is no one's concern
    for name in ('stdout', 'stderr'):  # closed by the caller: no file may get its number
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))  # noqa: SIM115
    try:
        try:
            options = _options(given)
            for told in {*OF_REPORTS} & {*vars(options)}:  # never paths: these are of the locale
                setattr(options, told, _as_utf8(getattr(options, told)))
            typed = shlex.join(('calib_ros', *map(_as_utf8, given)))
            options.typed = re.sub('://[^/@]*@', '://', typed)  # no password
            refuse_alone(options)
            module, function = options.home.split('.')
            run = getattr(importlib.import_module(f'calib_ros.cli.{module}'), function)
            screen = Screen(options.quiet)
            status: int = run(options, screen)
            for reason in screen.reasons if options.quiet and status else ():
                screen.warn(reason, 'calib_ros')
        finally:  # of a help, too
            sys.stdout.flush()
    except BrokenPipeError:  # the reader has ended
        _drop_output()
        return 128 + 13
    except KeyboardInterrupt:
        return _failed('interrupted: no half-written file remains', 130)
    except MemoryError:
        return _failed('out of memory: give less data, or close other programs')
    except (CalibrationError, OSError) as err:
        _drop_output()
        return _failed(trouble(err))
    return status


def _drop_output() -> None:
    """Drop what standard output does not take, or Python tries again at its end and says so."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _as_utf8(text: str) -> str:
    """Return an argument that Python read in the locale (C, Latin-1) as the terminal wrote it."""
    with suppress(UnicodeError):
        return os.fsencode(text).decode()
    return text


def _failed(text: str, status: int = 1) -> int:
    Screen().warn(shortened(text), 'calib_ros')
    return status


def _options(given: Sequence[str]) -> argparse.Namespace:
    name = given[0] if given else ''
    completed = os.environ.get('COMP_LINE', '') if '_ARGCOMPLETE' in os.environ else ''
    if completed:
        import argcomplete

        argcomplete.autocomplete(parser_of(completed.split()[1:]))
    if name == 'help' and given[1:2] and given[1] in COMMANDS:
        name, *given = given[1], given[1], '--help'
    if name in ('-h', '--help', 'help') or not given:
        print(overview())
        raise SystemExit(0 if given else 2)
    if name == '--version':
        print(f'calib_ros {__version__}')
        raise SystemExit(0)
    if name not in COMMANDS:
        from pathlib import Path  # slow to load, not needed by the overview

        from calib_ros.cli.file_types import proposal

        words = proposal(Path(name))
        if words is None:
            words = str(UnknownNameError('command', name, COMMANDS))
        raise SystemExit(_failed(words, 2))
    parser = parser_of(given)
    options, rest = parser.parse_known_args(given)
    if rest:
        options.parser.error(unknown_word(rest[0], options.parser))
    return options


if __name__ == '__main__':
    sys.exit(main())
