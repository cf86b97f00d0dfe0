# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Output of a command: results on standard output; progress and warnings on standard error.

On a terminal with rich in colour, with a bar; else plain, in 80 columns.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from calib_ros.cli.terminal import console_of, printable, rich_text, width_of, wrap_line, wrapped
from calib_ros.progress import Progress
from calib_ros.texts import capitalised

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
        print(printable(text))

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
        console = None if self.quiet else console_of(sys.stdout)
        if console is not None:
            console.print(rich_text(text, STYLES[good]))
        elif not self.quiet:
            print(wrapped(text, '', '  ', width_of(sys.stdout)))

    def table(self, rows: Mapping[str, str]) -> None:
        """Print a table of names and values, without empty ones."""
        if self.quiet:
            return
        rows = {name: value for name, value in rows.items() if value}
        console = console_of(sys.stdout)
        if console is not None:
            from rich.box import ROUNDED
            from rich.table import Table

            shown = Table(box=ROUNDED, show_header=False, border_style='dim')
            for name, value in rows.items():
                shown.add_row(rich_text(name, 'bold'), rich_text(value))
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
        console = self._bar or console_of(sys.stderr)
        if console is not None:
            console.print(rich_text(line, 'yellow'))
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
        self.console = console_of(sys.stderr)
        self.begin()

    def watch(self) -> None:
        """Show progress until the work is done."""
        if self.console is None:
            pause = EVERY_S
            while not self.done.wait(pause):
                print(f'calib_ros: {printable(str(self))}', file=sys.stderr, flush=True)
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
                bar.update(task, description=printable(self.words))
                if self.done.wait(FIRST_S / 5):
                    break


def _print(text: str, head: str) -> None:
    print(wrapped(text, head, ' ' * len(head), width_of(sys.stdout)))
