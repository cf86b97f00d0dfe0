# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Hashes of what a result depends on: files, settings, samples."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import chain_document
from calib_ros.settings import Settings


def digest(content: object) -> str:
    """Return the SHA-256 of plain values."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def settings_hash(nominal: Chain, settings: Settings, *more: object) -> str:
    """Return the hash of what a result depends on besides the measurements."""
    return digest([chain_document(nominal), asdict(settings), *more])


@dataclass(frozen=True)
class Input:
    """An input file."""

    name: str
    size: int
    sha256: str


def files_of(path: Path) -> list[Path]:
    """Return a file, or those of a folder; none for a pipe, which cannot be read twice."""
    return sorted(each for each in (path, *path.rglob('*')) if each.is_file())


def inputs_of(*paths: Path | None) -> tuple[Input, ...]:
    """Return all files at some paths, or in folders such as bags, with size and hash."""
    found = []
    for path in filter(None, paths):
        for each in files_of(path):
            digest = hashlib.sha256()
            with each.open('rb') as file:
                while block := file.read(1 << 20):
                    digest.update(block)
            name, size = str(each.relative_to(path.parent)), each.stat().st_size
            found.append(Input(name, size, digest.hexdigest()))
    return tuple(found)


def content_hash(files: Sequence[str], session: str = '') -> str:
    """Return the hash of files, by their own hashes, or of a session in them."""
    return digest([session, *sorted(files)])


def samples_hash(sets: Sequence[Observations]) -> str:
    """Return the hash of samples without a file, by all that was measured."""
    found = hashlib.sha256()
    for each in sets:
        for part in fields(each):
            value = getattr(each, part.name)
            data = value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            found.update(data)
    return found.hexdigest()
