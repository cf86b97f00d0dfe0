# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Docstrings of dataclasses with their fields."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import Field
from itertools import chain, pairwise, takewhile


class WithFields:
    """The docstring of a dataclass with its fields as they are written, for help().

    The source is read only when it is asked for; what cannot be found is left out.
    """

    def __init__(self, documented: type) -> None:
        self._of, self._text = documented, documented.__doc__ or ''

    def __get__(self, instance: object, owner: type) -> str:
        """Return the text."""
        with suppress(OSError):
            each = (of for of in reversed(self._of.__mro__) if '__dataclass_fields__' in vars(of))
            return '\n'.join([self._text, *chain.from_iterable(map(_fields, each))])
        return self._text


def _fields(of: type) -> Iterator[str]:
    """Yield the lines of the fields of a dataclass, without those that it inherits."""
    lines = inspect.getsource(of).splitlines()
    (found,) = ast.parse(textwrap.dedent('\n'.join(lines))).body
    assert isinstance(found, ast.ClassDef)
    body = list(takewhile(lambda x: isinstance(x, ast.AnnAssign | ast.Expr), found.body))
    known: dict[str, Field[object]] = vars(of)['__dataclass_fields__']
    for before, each in pairwise(body):
        name = ast.unparse(each.target) if isinstance(each, ast.AnnAssign) else ''
        yield from lines[before.end_lineno or 0 : each.lineno - 1]
        if name and 'text' in known[name].metadata:
            yield f'    {name}: {known[name].type} = {known[name].default!r}'
            yield f'    """{known[name].metadata["text"]}"""'
        else:
            yield from lines[each.lineno - 1 : each.end_lineno]
