# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Expressions of a layout: sums, differences, products and quotients of columns and numbers."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_ros.errors import LONGEST_NAME, ConfigError
from calib_ros.kinematics.se3 import FloatArray

UNREADABLE = (
    '"{}" is not an expression of columns: give names, {{names with blanks}} or column '
    'numbers (#7) with + - * / and brackets'
)
TOKEN = re.compile(
    r'\s*(?:\{([^{}]+)\}|#([0-9]+)|((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)'
    r'|([^\W\d]\w*(?:\.\w+)*)|([-+*/()]))\s*'
)
"""{any name}, #7 (a column number), a number, a plain name, or an operator."""
SIGNS: dict[type[ast.AST], Callable[..., Any]]
SIGNS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.true_divide}
SIGNS |= {ast.UAdd: np.positive, ast.USub: np.negative}


@dataclass(frozen=True)
class Expression:
    """A sum, difference, product or quotient of columns and numbers."""

    text: str
    terms: tuple[str | float, ...]  # columns by their names (`#7` is the seventh) and numbers
    tree: ast.expr  # with the terms as `_0`, `_1` and so on

    @classmethod
    def parse(cls, text: str) -> Expression:
        """Parse an expression."""
        terms: list[str | float] = []
        code, tokens = '', [*TOKEN.finditer(text[:LONGEST_NAME])]
        if ''.join(each[0] for each in tokens) != text:
            raise ConfigError(UNREADABLE.format(text))
        for braced, column, number, plain, sign in (each.groups() for each in tokens):
            if not sign:
                terms.append(float(number) if number else braced or plain or f'#{column}')
            code += sign or f' _{len(terms) - 1} '
        try:
            found = cls(text, tuple(terms), ast.parse(code.strip(), mode='eval').body)
            found.of(dict.fromkeys(found.names, np.ones(1)))
        except (SyntaxError, ValueError, KeyError, RecursionError, MemoryError) as err:
            raise ConfigError(UNREADABLE.format(text)) from err
        return found

    @classmethod
    def word(cls, text: str) -> Expression:
        """Return the expression of a column of text, by its name or number."""
        braced = text.startswith('{') and text.endswith('}')
        return cls(text, (text[1:-1] if braced else text,), ast.Name('_0'))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns."""
        return tuple(dict.fromkeys(each for each in self.terms if isinstance(each, str)))

    def of(self, columns: Mapping[str, FloatArray]) -> FloatArray:
        """Return the value (N,) for columns (N,) by name."""
        values = [columns[each] if isinstance(each, str) else each for each in self.terms]
        with np.errstate(all='ignore'):
            return np.asarray(_value(self.tree, values))


def _value(tree: ast.expr, terms: Sequence[FloatArray | float]) -> Any:
    if isinstance(tree, ast.BinOp):
        return SIGNS[type(tree.op)](_value(tree.left, terms), _value(tree.right, terms))
    if isinstance(tree, ast.UnaryOp):
        return SIGNS[type(tree.op)](_value(tree.operand, terms))
    if not isinstance(tree, ast.Name):
        raise ValueError(type(tree).__name__)
    return terms[int(tree.id[1:])]


def in_their_names(text: str, known: Mapping[str, str]) -> str:
    """Return an expression with our columns that are `known` written in theirs."""
    return TOKEN.sub(lambda m: f'({known[m[4]]})' if m[4] in known else m[0], text)
