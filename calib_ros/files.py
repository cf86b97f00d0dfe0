# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files written as a whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from calib_ros.errors import InputError


def write_file(path: Path, content: str | bytes, *, overwrite: bool = False) -> None:
    """Write a file under a temporary name beside it, then rename it.

    Raises
    ------
    InputError
        When there is a file already and `overwrite` is False.

    """
    if path.exists() and not overwrite:
        raise InputError(f'{path} exists already: move it or choose another name')
    partial = path.with_name(f'.{path.name}.{os.getpid()}.partial')
    data = content.encode() if isinstance(content, str) else content
    try:
        with partial.open('wb') as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
