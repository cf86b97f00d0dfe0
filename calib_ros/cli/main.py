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
import os
import re
import shlex
import signal
import sys
import textwrap
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import groupby
from typing import NoReturn

# matrices are small: a second BLAS thread costs more than it gives, especially on a busy cell
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from calib_ros import __version__
from calib_ros.cli.checks import refuse_alone
from calib_ros.cli.commands import COMMANDS, add_options
from calib_ros.cli.common import OF_REPORTS
from calib_ros.cli.screen import Screen, help_width, wrap_line, wrapped
from calib_ros.errors import CalibrationError, UnknownNameError, near, shortened, trouble

WAY = (
    ('calib_ros demo', 'a whole calibration, simulated'),
    ('calib_ros robots', 'the arms supplied'),
    ('calib_ros plan --chain ur10e --out plan.csv', 'the poses to measure'),
    ('calib_ros identify measured.csv --chain ur10e --out result/', ''),
    ('calib_ros compensate program.csv --chain ur10e --calibration result/ ...', ''),
    ('calib_ros verify new.csv --chain ur10e --calibration result/', ''),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:  # a program, not a call: `timeout` and systemd end it as Ctrl-C does
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    for name in ('stdout', 'stderr'):  # closed by the caller: no file may get its number
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))  # noqa: SIM115
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
        sys.stdout.flush()
    except BrokenPipeError:  # the reader has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + 13
    except KeyboardInterrupt:
        return _failed('interrupted: no half-written file remains', 130)
    except MemoryError:
        return _failed('out of memory: give less data, or close other programs')
    except (CalibrationError, OSError) as err:
        return _failed(trouble(err))
    return status


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

        argcomplete.autocomplete(_parser(completed.split()[1:]))
    if name == 'help' and given[1:2] and given[1] in COMMANDS:
        name, *given = given[1], given[1], '--help'
    if name in ('-h', '--help', 'help') or not given:
        print(_overview())
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
    parser = _parser(given)
    options, rest = parser.parse_known_args(given)
    if rest:
        options.parser.error(_unknown(rest[0], options.parser))
    return options


def _unknown(word: str, parser: argparse.ArgumentParser) -> str:
    if not word.startswith('-'):
        hint = ': of several files make one table, with a column session (or target, device)'
        several = hint * ('--session' in parser._option_string_actions)
        return f'unexpected argument "{word}"{several}'
    option = word.partition('=')[0]
    known = (each for action in parser._actions for each in action.option_strings)
    hint = near(option, known, 0.7)
    return f'unknown option "{option}"' + (f': {hint}' if hint else '')


class _Parser(argparse.ArgumentParser):
    """A parser whose errors end with an example."""

    example = ''
    typed: Sequence[str] = ()

    def error(self, message: str) -> NoReturn:
        """Report what is required, what is wrong, and an example."""
        rest = (word for word in self.typed if word.startswith('--') and len(word) > 2)
        known = tuple(self._option_string_actions)
        wrong = [w for w in rest if not any(k.startswith(w.partition('=')[0]) for k in known)]
        if wrong and 'required: ' in message:
            message = _unknown(wrong[0], self)
        for kind, what in (('int', 'a whole number'), ('float', 'a number such as 0.1')):
            message = message.replace(f'invalid {kind} value:', f'must be {what}, not')
        if message.endswith(': --chain'):
            message += ' (calib_ros robots lists the arms supplied)'
        self.print_usage(sys.stderr)
        text = wrap_line(f'{self.prog}: error: {message}', '  ', sys.stderr)
        self.exit(2, f'{text}\nexample: {self.example.lstrip()}\n')


def _parser(given: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of all commands; only the given one has its options."""
    parser = argparse.ArgumentParser(prog='calib_ros', add_help=False)
    names = parser.add_subparsers(required=True, metavar='COMMAND', parser_class=_Parser)
    for name, command in COMMANDS.items():
        if name not in given:
            names.add_parser(name, add_help=False)
            continue
        text = command.text
        added = names.add_parser(
            name,
            add_help=False,
            description=textwrap.fill(f'{text[0].upper()}{text[1:]}.', help_width()),
            epilog='\n'.join(['examples:', *map(_example, command.examples)]),
            formatter_class=partial(
                argparse.RawDescriptionHelpFormatter, max_help_position=26, width=help_width()
            ),
        )
        added.example = _example(command.examples[0])
        added.typed = given
        added.set_defaults(home=command.home, parser=added)
        added._negative_number_matcher = re.compile(r'-\.?\d')  # -1e-5 too, as in Python 3.14
        add_options(added, command.options)
        added.usage = _usage(added)
        add_more = added.add_argument_group('output').add_argument
        text = 'print only warnings, errors and the output asked for'
        add_more('--quiet', action='store_true', help=text)
        add_more('-h', '--help', action='help', help='show this help')
    return parser


def _example(words: str) -> str:
    # an option and its value stay together
    tied = re.sub('(--[a-z-]+) (?!-)', '\\1\xa0', f'calib_ros {words}')
    parts = textwrap.wrap(tied, help_width() - 8, break_on_hyphens=False)
    return ('  ' + ' \\\n      '.join(parts)).replace('\xa0', ' ')


def _usage(parser: argparse.ArgumentParser) -> str:
    """Return what is required; the rest are options."""
    words = ['usage:', parser.prog]
    for each in parser._actions:
        words += each.option_strings if each.required else ()
        if each.required or not each.option_strings:
            form = str(each.metavar or '|'.join(each.choices or ()))
            words.append(form if each.required else f'[{form}]')
    text = ' '.join([*words, '[options]'])
    return textwrap.fill(text, help_width(), subsequent_indent='    ').removeprefix('usage: ')


def _overview() -> str:
    lines = [f'calib_ros {__version__}: kinematic calibration of industrial arms.']
    for group, commands in groupby(COMMANDS.items(), lambda each: each[1].group):
        lines += ['', f'{group}:']
        for name, command in commands:
            lines.append(wrapped(command.text, f'  {name:12}', ' ' * 14, help_width()))
    lines += ['', 'Typical use:', *(f'  {command:45}{words}'.rstrip() for command, words in WAY)]
    lines += ['', '`calib_ros COMMAND --help` lists the options of a command, with examples.']
    return '\n'.join(lines)


if __name__ == '__main__':
    sys.exit(main())
