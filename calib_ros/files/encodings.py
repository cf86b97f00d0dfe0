# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The text of a table, and its encoding."""

from __future__ import annotations

import codecs
import re
from contextlib import suppress
from pathlib import Path

from calib_ros.errors import InputError
from calib_ros.files.vocabulary import SHEETS
from calib_ros.texts import LARGEST_TABLE, read_bytes

WESTERN = ('Windows-1252', 'Latin-1')  # the last has all bytes
NOT_CHINESE = re.compile(
    rb'(?<![\x80-\xff])(?!(?:[\xa1-\xd7][\xa1-\xfe])+(?![\x80-\xff]))[\x80-\xff]'
    rb'|(?<=[A-Za-z]{2})[\x80-\xff]{2}(?=[A-Za-z])'
)
"""Bytes that are no pairs of usual Chinese characters, or one within a word: POSIÇÃO."""


def text_and_encoding(path: Path) -> tuple[str, str]:
    """Return the text of a table and its encoding, by which all of its bytes are written again."""
    data = read_bytes(path, LARGEST_TABLE, InputError)
    if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        try:
            return data.decode('utf-16'), 'utf-16'
        except UnicodeDecodeError as err:
            raise InputError(f'cannot read {path}: {err}') from err
    if b'\0' in data:
        told = 'is not UTF-8 text, nor a workbook by its name: save it as CSV in UTF-8, or .xlsx'
        if path.suffix.lower() in SHEETS:
            told = 'is a workbook, expected a table as text: save the sheet as CSV'
        raise InputError(f'cannot read {path}: it {told}')
    marked = data.startswith(codecs.BOM_UTF8)
    for coding in ('utf-8-sig' if marked else 'utf-8', 'GB18030', *WESTERN[:-1]):
        if coding == 'GB18030' and NOT_CHINESE.search(data):
            continue
        with suppress(UnicodeDecodeError):
            return data.decode(coding), coding
    return data.decode(WESTERN[-1]), WESTERN[-1]
