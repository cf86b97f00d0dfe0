# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Output of a command: results on standard output; progress and warnings on standard error.

On a terminal with rich in colour, with a bar; else plain, in 80 columns. Only printable characters
are written: a topic or a joint may have any name.
"""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

from calib_ros.progress import Progress
from calib_ros.texts import capitalised

WIDTH = 80  # columns of help and of non-terminals, by convention
EVERY_S = 2.0
"""Time between two progress lines, doubled each time if they stay, as in a log. A convention."""
FIRST_S = EVERY_S / 4.0  # time before a bar appears on a terminal
GOOD_OR_BAD = {'good': True, 'bad': False}  # of verdicts; others are neither
STYLES = {True: 'bold green', False: 'bold red', None: 'bold'}


class Screen:
    """Output of a command; if `quiet`, only data, warnings and errors."""

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self.reasons: list[str] = []  # if quiet: the verdict, and why, with what to do first
        self._bar: Any = None  # the console of a bar: what else is printed there goes above it

    def data(self, text: str) -> None:
        """Print requested data, even if quiet."""
        print(_printable(text))

    def say(self, text: str) -> None:
        """Print lines; on a terminal, long ones are wrapped."""
        if self.quiet:
            return
        for line in text.splitlines() or ['']:
            indent = ' ' * (len(line) - len(line.lstrip()) + 2)
            print(wrap_line(line, indent, sys.stdout), flush=True)

    def title(self, text: str, good: bool | None = None) -> None:
        """Print a verdict; the colour never says more than the words."""
        self.reasons = [text]
        console = None if self.quiet else _console(sys.stdout)
        if console is None:
            self.say(text)
        else:
            console.print(_rich_text(text, STYLES[good]))

    def table(self, rows: Mapping[str, str]) -> None:
        """Print a table of names and values, without empty ones."""
        if self.quiet:
            return
        rows = {name: value for name, value in rows.items() if value}
        console = _console(sys.stdout)
        if console is not None:
            from rich.box import ROUNDED
            from rich.table import Table

            shown = Table(box=ROUNDED, show_header=False, border_style='dim')
            for name, value in rows.items():
                shown.add_row(_rich_text(name, 'bold'), _rich_text(value))
            console.print(shown)
            return
        width = max(map(len, rows)) + 4
        for name, value in rows.items():
            _print(value, f'  {name}'.ljust(width))

    def bullet(self, text: str, steps: Sequence[str] = ()) -> None:
        """Print a reason or note, and what to do, in steps if several."""
        if self.quiet:
            self.reasons += [f'{text.removesuffix(":")} -> {step}' for step in steps[:1]]
            return
        _print(capitalised(text), '- ')
        for k, step in enumerate(steps):
            _print(capitalised(step), f'  {k + 1}. ' if len(steps) > 1 else '  -> ')

    def warn(self, text: str, kind: str = 'warning') -> None:
        """Print a warning; to a file as one line."""
        line = wrap_line(f'{kind}: {text}', '  ', sys.stderr)
        console = self._bar or _console(sys.stderr)
        if console is not None:
            console.print(_rich_text(line, 'yellow'))
        else:
            print(line, file=sys.stderr)

    @contextmanager
    def work(self, what: str) -> Iterator[Work]:
        """Show progress in a `with` block, and the time left if known."""
        work = Work(what)
        if self.quiet:
            yield work
            return
        watch = threading.Thread(target=work.watch, daemon=True)
        watch.start()
        self._bar = work.console
        try:
            yield work
        finally:
            work.done.set()
            watch.join()
            self._bar = None


class Work(Progress):
    """Work that begins now, watched by another thread until done."""

    def __init__(self, what: str) -> None:
        super().__init__(what)
        self.done = threading.Event()
        self.console = _console(sys.stderr)
        self.begin()

    def watch(self) -> None:
        """Show progress until the work is done."""
        if self.console is None:
            pause = EVERY_S
            while not self.done.wait(pause):
                print(f'calib_ros: {_printable(str(self))}', file=sys.stderr, flush=True)
                pause = min(2.0 * pause, 16.0 * EVERY_S)
        elif not self.done.wait(FIRST_S):
            self._as_bar()

    def _as_bar(self) -> None:
        from rich import progress

        columns = (
            progress.SpinnerColumn(),
            progress.TextColumn('{task.description}', markup=False),
            progress.BarColumn(bar_width=20),
            progress.TextColumn('{task.fields[times]}'),
        )
        with progress.Progress(*columns, console=self.console, transient=True) as bar:
            task = bar.add_task('', total=None, times='')
            while True:
                total = 1.0 if 0.0 < self.share < 1.0 else None
                bar.update(task, total=total, completed=self.share, times=self.times)
                bar.update(task, description=_printable(self.words))
                if self.done.wait(FIRST_S / 5):
                    break


def _print(text: str, head: str) -> None:
    print(wrapped(text, head, ' ' * len(head), _width(sys.stdout)))


def _console(stream: TextIO) -> Any:
    if not stream.isatty() or os.environ.get('TERM') == 'dumb':
        return None
    try:
        from rich.console import Console
    except ImportError:
        return None
    return Console(file=stream, width=_width(stream), highlight=False)


def _rich_text(text: str, style: str = '') -> Any:
    from rich.text import Text

    return Text(_printable(text), style)


def _width(stream: TextIO) -> int:
    return min(shutil.get_terminal_size((WIDTH, 24)).columns, 100) if stream.isatty() else WIDTH


def help_width() -> int:
    """Return the columns of help: fewer on a narrow terminal."""
    return min(WIDTH, _width(sys.stdout))


def _printable(text: str) -> str:
    return ''.join(c if c.isprintable() or c == '\n' else '?' for c in text)


def wrap_line(line: str, indent: str, stream: TextIO) -> str:
    """Return a line wrapped for a terminal; in a file it stays one."""
    return wrapped(line, '', indent, _width(stream)) if stream.isatty() else _printable(line)


def wrapped(text: str, head: str, indent: str, width: int) -> str:
    """Return a text after a head, wrapped to `width` columns except longer words."""
    text = _printable(text)
    if len(head) + len(text) <= width and '\n' not in text:
        return head + text
    whole: dict[str, Any] = {'break_long_words': False, 'break_on_hyphens': False}
    return textwrap.fill(text, width, initial_indent=head, subsequent_indent=indent, **whole)
