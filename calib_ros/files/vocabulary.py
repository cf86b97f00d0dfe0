# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The words of tables: names of our columns, units, separators and cells without a value."""

from __future__ import annotations

import re

import numpy as np

from calib_ros.values import MOST_NAMES

LENGTHS = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'in': 0.0254, 'ft': 0.3048}
"""Metres in units of length."""
ANGLES = {'rad': 1.0, 'deg': np.pi / 180.0}  # radians in units of angle
LONG = {'degree': 'deg', 'radian': 'rad', 'meter': 'm', 'centimeter': 'cm', 'millimeter': 'mm'}
LONG |= {'micrometer': 'um', 'micron': 'um', 'degré': 'deg', 'grado': 'deg', 'grau': 'deg'}
LONG |= {f'{word[:-2]}re': unit for word, unit in LONG.items() if word.endswith('meter')}
UNIT_SIGNS = {word + s: unit for word, unit in LONG.items() for s in ('', 's')}
UNIT_SIGNS |= {'°': 'deg', 'º': 'deg', '˚': 'deg', 'gradi': 'deg'}  # Grad may be gon
UNIT_SIGNS |= {'µm': 'um', 'μm': 'um', 'inch': 'in', 'inches': 'in'}
UNIT_SIGNS |= {'foot': 'ft', 'feet': 'ft'}
UNIT_SIGNS |= {'毫米': 'mm', '厘米': 'cm', '度': 'deg', '弧度': 'rad'}
UNIT_SIGNS |= {unit: unit for unit in (*LENGTHS, *ANGLES)}
"""Units by their signs and words in small letters."""
_ANY = '|'.join(UNIT_SIGNS)
_WORDS = '|'.join(sign for sign in UNIT_SIGNS if sign not in ('m', 'in', 'ft'))
UNIT = re.compile(
    rf'(.*[^\s,/_]) *(?:[\[(\uff08](?![0-9,]+[\])])([^\[\]()\uff08\uff09]+)[\])\uff09]'
    rf'|[,/] *({_ANY})|[-_ ]({_WORDS}))',
    re.I,
)
"""A name with its unit: X [mm], X (mm), X / mm, X_mm, X-mm; brackets may hold something else.

Wide ones of Chinese and Japanese texts count, too.
"""
UNITS_ARE = re.compile(
    r'\b(?:(?:unit[aeéà]?s?|unidade?s?|\w*einheit(?:en)?)(?: (?:of|di|de) \w+)?'
    rf'(?:\W*[:=\t]\W*(?:in \W?(?=(?:{_ANY})(?!\w)))?'
    rf'(?!in (?!(?:and|und|et|e|y)\b)[^\W\d])({_ANY})|\W*(?:are )?(?:in:? )?\W?({_WORDS}))'
    r'|(?:(?:\A|(?<=[^\w ])|(?<=[^\w ] )|all |the |alle |measured )(?:values|werte|angaben)'
    r'|dimensions|coordinates|positions|lengths|angles|längen|winkel)'
    rf'\W*(?:are )?in \W?({_WORDS}))(?!\w)(?:\W+(?:and |und |et |e |y )?({_ANY})(?!\w))?',
    re.I,
)
"""Units in words: `Length Units = m`, `Einheiten: mm, °`, `all values in mm`.

Not `sigma values in mm`, nor `Unit: in Stuttgart`.
"""
SECONDS = ('', 's', 'sec', 'second', 'seconds')

SEPARATORS = {'comma': ',', 'semicolon': ';', 'tab': '\t', 'bar': '|', 'space': ' '}
DECIMAL_COMMA = re.compile(r'\s*[+\u2212-]?[0-9]+,[0-9]+([eE][+-]?[0-9]+)?\s*')
THOUSANDS = re.compile(r"[+\u2212-]?[1-9][0-9]{0,2}([\s.,'\u2019][0-9]{3})+([.,][0-9]*)?")
MISSING = frozenset(('', 'nan', '-nan', 'na', 'n/a', '#n/a', '#nv', 'null', 'none', '-', '--'))
MISSING |= {'---', '----', '***', '?', 'nat', 'n.a.', 'k.a.', 'lost', 'missing', 'undefined'}
MISSING |= {'nan(ind)', '-nan(ind)', '1.#qnan', '-1.#ind', '1.#ind'}
MISSING |= {'#value!', '#div/0!', '#ref!', '#name?', '#num!', '#null!', '#wert!', '#bezug!'}
"""Cells without a value, in small letters."""
SHEETS = ('.xlsx', '.xlsm')

POSITION, QUATERNION = ('x', 'y', 'z'), ('qx', 'qy', 'qz', 'qw')
POSE_COLUMNS = (*POSITION, *QUATERNION)
UPPER = tuple((i, j) for i in range(6) for j in range(i, 6))
COVARIANCE = tuple(f'c{i + 1}{j + 1}' for i, j in UPPER)
TURNS = ('rx', 'ry', 'rz')
"""Angles about x, y, z of three different letters, or a rotation vector."""
IN_TURN = ('r1', 'r2', 'r3')  # Euler angles in the order of the letters
MATRIX = tuple(f'r{i}{j}' for i in (1, 2, 3) for j in (1, 2, 3))
"""Rotation matrices, row by row."""
SIGMAS = ('sx', 'sy', 'sz', 'srx', 'sry', 'srz')
"""Standard deviations of x y z, and of rx ry rz (or about x y z of the device)."""
SOCKETS = ('location', 'socket', 'plane')
WORDS = (
    *('session', 'device', 'target', 'frame_id', 'split', 'valid', 'eye_in_hand', 'stamp_ns'),
    *SOCKETS,
)
"""Columns of text."""
NOT_VALID = ('false', 'f', 'no', 'n', 'invalid')
VALID = ('true', 't', 'yes', 'y', 'valid', 'ok')
"""Words in the column valid, beside numbers."""
NUMBERS = (*POSE_COLUMNS, *TURNS, *IN_TURN, *MATRIX, *SIGMAS, 'distance', 'time', 'delay')
JOINT = re.compile('[qsva][0-9]+')
"""Columns with a number of each joint: values, signs of last moves, and rates."""
KINDS = ('x', 'distance', 'socket', 'plane')
"""Columns whose cells determine what a row measured."""
MEASURED_COLUMNS = (*POSITION, *KINDS[1:])


def joint_columns(joints: int, letters: str = 'q') -> tuple[str, ...]:
    """Return the columns with a number of each joint."""
    return tuple(f'{letter}{k + 1}' for letter in letters for k in range(joints))


IN_ORDER = ('session', 'split', 'stamp_ns', *joint_columns(MOST_NAMES, 'qsva'), *POSE_COLUMNS)
IN_ORDER += ('distance', *COVARIANCE)
"""Columns in the order of a converted table; others follow."""
