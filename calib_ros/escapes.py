# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Names and texts of others, written so that no reader takes them for more than text.

A joint, a frame or a robot may be called `<script>`, `| x |` or `=cmd|...`: in a report that is
markup, in a spreadsheet a formula.
"""

from __future__ import annotations

import re

MARKUP = re.compile(r'[\\`*\[\]|]|(?<![^\W_])_|_(?![^\W_])|^[>#+-]')
"""What Markdown takes for more than text; underscores only where they may begin emphasis."""
FORMULA = re.compile(r"'*[=+\-@\t\r]")
"""How a cell begins that a spreadsheet computes, whatever apostrophes are before it."""


def one_line(text: str) -> str:
    """Return a text without line breaks and characters that cannot be seen."""
    return ' '.join(''.join(c if c.isprintable() else ' ' for c in text).split())


def in_markdown(value: object) -> str:
    """Return a value as text within a line of Markdown, free of HTML."""
    text = MARKUP.sub(r'\\\g<0>', one_line(str(value)))
    return text.replace('&', '&amp;').replace('<', '&lt;')


def to_cell(text: str) -> str:
    """Return a text as a cell of a table, which is no formula."""
    return f"'{text}" if FORMULA.match(text) else text


def from_cell(cell: str) -> str:
    """Return the text of a cell by `to_cell`."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell
