# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parser of the command line, its help and its errors."""

from __future__ import annotations

import argparse
import re
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from itertools import groupby
from typing import NoReturn

from calib_ros import __version__
from calib_ros.cli.commands import COMMANDS, add_options
from calib_ros.cli.terminal import help_width, wrap_line, wrapped
from calib_ros.errors import near

WAY = (
    ('calib_ros demo', 'a whole calibration, simulated'),
    ('calib_ros robots', 'the arms supplied'),
    ('calib_ros plan --chain ur10e --out plan.csv', 'the poses to measure'),
    ('calib_ros identify measured.csv --chain ur10e --out result/', ''),
    ('calib_ros compensate program.csv --chain ur10e --calibration result/ ...', ''),
    ('calib_ros verify new.csv --chain ur10e --calibration result/', ''),
)
READING = ('--columns', '--length', '--angle', '--joint-angle', '--decimal', '--separator')
"""Options of commands that read tables of other systems, missed with programs."""
PROGRAMS = ('compensate', 'plan', 'workspace')
"""Commands that read programs and poses."""


def unknown_word(word: str, parser: argparse.ArgumentParser) -> str:
    """Return what is wrong with a word that the parser does not know."""
    if not word.startswith('-'):
        hint = ': join several files in one table, with a column session (or target, device)'
        several = hint * ('--session' in parser._option_string_actions)
        return f'unexpected argument "{word}"{several}'
    option = word.partition('=')[0]
    known = (each for action in parser._actions for each in action.option_strings)
    hint = near(option, known, 0.7)
    bare = {action.metavar for action in parser._actions if not action.option_strings}
    if option == '--calibration' and (first := bare & {'RESULT', 'CALIBRATION'}):
        hint = f'give {first.pop()} first, without an option'
    if option in READING and parser.prog.endswith(PROGRAMS):
        hint = 'name columns and units in the first line of the file: q1 [deg]'
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
            message = unknown_word(wrong[0], self)
        action = self._option_string_actions.get(message.split(':')[0].removeprefix('argument '))
        unit = ''.join(re.findall(r' \[.+?\]', str(action and action.help))[:1])
        for kind, what in (('int', 'a whole number'), ('float', f'a plain number{unit}')):
            message = message.replace(f'invalid {kind} value:', f'must be {what}, not')
        if message.endswith(': --chain'):
            message += ' (calib_ros robots lists the arms supplied)'
        self.print_usage(sys.stderr)
        text = wrap_line(f'{self.prog}: error: {message}', '  ', sys.stderr)
        self.exit(2, f'{text}\nexample: {self.example.lstrip()}\n')


def parser_of(given: Sequence[str]) -> argparse.ArgumentParser:
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
        text = 'print only warnings, errors and requested output'
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


def overview() -> str:
    """Return the help of all commands, by groups."""
    lines = [f'calib_ros {__version__}: kinematic calibration of industrial arms.']
    for group, commands in groupby(COMMANDS.items(), lambda each: each[1].group):
        lines += ['', f'{group}:']
        for name, command in commands:
            lines.append(wrapped(command.text, f'  {name:12}', ' ' * 14, help_width()))
    lines += ['', 'Typical use:', *(f'  {command:45}{words}'.rstrip() for command, words in WAY)]
    lines += ['', '`calib_ros COMMAND --help` lists the options of a command, with examples.']
    return '\n'.join(lines)
