# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Decompression of recordings, and the room that it may take."""

from __future__ import annotations

import importlib
from contextlib import suppress
from functools import cache
from typing import Any

from calib_ros.errors import InputError
from calib_ros.texts import LARGEST_TABLE

ZSTD = b'\x28\xb5\x2f\xfd'  # begins what zstd compressed
MODULES = {'lz4': ('lz4.frame',), 'zstd': ('compression.zstd', 'backports.zstd', 'zstandard')}


class Room:
    """Bytes that may still be unpacked of a recording: a chunk and 1,000 times its size.

    No recorder compresses more; beyond it raises InputError.
    """

    def __init__(self, packed: int) -> None:
        self._left = LARGEST_TABLE + 1000 * packed

    def take(self, size: int) -> None:
        """Count bytes to unpack."""
        self._left -= size
        if self._left < 0:
            raise InputError('it unpacks to 1000 times its size')


def decompressed(data: bytes, compression: str, largest: int) -> bytes:
    """Return decompressed data, as much as there is."""
    module: Any = module_of(compression) if compression else None
    found = data
    if compression == 'lz4':
        found = module.LZ4FrameDecompressor().decompress(data, largest + 1)
    elif hasattr(module, 'ZstdCompressionDict'):  # zstandard
        found = module.ZstdDecompressor().stream_reader(data).read(largest + 1)
    elif compression:
        found = module.ZstdDecompressor().decompress(data, largest + 1)
    if len(found) > largest:
        raise ValueError(f'it unpacks to more than the {largest} bytes that it may have')
    return found


@cache  # searching a missing module takes ten times as long as a message
def module_of(compression: str) -> Any:
    """Return the decompression module: one of those that rosbags requires."""
    for name in MODULES.get(compression, ()):
        with suppress(ImportError):
            return importlib.import_module(name)
    raise OSError(f'no module to decompress {compression}')
