# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Text for a terminal, wrapped and with rich in colour, or for a file.

Only printable characters are written: a topic or a joint may have any name.
"""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
from typing import Any, TextIO

WIDTH = 80  # columns of help and of non-terminals, by convention


def console_of(stream: TextIO) -> Any:
    """Return the console of a terminal, or None for a file or without rich."""
    if not stream.isatty() or os.environ.get('TERM') == 'dumb':
        return None
    try:
        from rich.console import Console
    except ImportError:
        return None
    return Console(file=stream, width=width_of(stream), highlight=False)


def rich_text(text: str, style: str = '') -> Any:
    """Return a text for a console."""
    from rich.text import Text

    return Text(printable(text), style)


def width_of(stream: TextIO) -> int:
    """Return the columns of a terminal, at most 100, or those of a file."""
    return min(shutil.get_terminal_size((WIDTH, 24)).columns, 100) if stream.isatty() else WIDTH


def help_width() -> int:
    """Return the columns of help: fewer on a narrow terminal."""
    return min(WIDTH, width_of(sys.stdout))


def printable(text: str) -> str:
    """Return a text with ? for other characters."""
    return ''.join(c if c.isprintable() or c == '\n' else '?' for c in text)


def wrap_line(line: str, indent: str, stream: TextIO) -> str:
    """Return a line wrapped for a terminal; in a file it stays one."""
    return wrapped(line, '', indent, width_of(stream)) if stream.isatty() else printable(line)


def wrapped(text: str, head: str, indent: str, width: int) -> str:
    """Return a text after a head, wrapped to `width` columns except longer words."""
    text = printable(text)
    if len(head) + len(text) <= width and '\n' not in text:
        return head + text
    whole: dict[str, Any] = {'break_long_words': False, 'break_on_hyphens': False}
    return textwrap.fill(text, width, initial_indent=head, subsequent_indent=indent, **whole)
