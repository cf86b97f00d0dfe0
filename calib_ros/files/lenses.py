# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Lenses from files of intrinsics, and from a camera matrix with its distortion."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calib_ros.errors import ConfigError, InputError
from calib_ros.files.detections import SIZE, Detections
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.parameter import LENS_KINDS
from calib_ros.texts import parse_yaml, read_text
from calib_ros.values import parse_number

DISTORTION = ('distortion_model', 'distortion_coefficients')
DISTORTED = ('plumb_bob', 'rational_polynomial')
DO_INSTEAD = (
    'calibrate the camera as plumb_bob (k1 k2 p1 p2 k3), or fit the lens (--lens fitted; in '
    'sources lens=fitted)'
)


def read_lens(path: Path, found: Detections | None = None, fitted: bool = False) -> Lens:
    """Read intrinsics as written by camera_calibration or OpenCV, or as plain keys.

    Refuses another image size than that of the corners `found`; `fitted` as for `lens_of`.
    """
    text = re.sub('^%YAML:1.0|!!opencv-matrix', '', read_text(path, what='intrinsics '))
    content = parse_yaml(text, str(path))
    if not isinstance(content, dict):
        raise ConfigError(f'{path} must be a mapping, as camera_calibration writes it')
    for key in content:
        if re.search('^dist|distor|coef|^[kp][1-6]$', str(key).lower()) and key not in DISTORTION:
            raise ConfigError(f'{path}: unknown key "{key}": call it {DISTORTION[1]}')
    if found is not None:
        _require_size(path, content, found)
    matrix = _numbers(content, ('camera_matrix', 'k', 'K'), path)
    distortion = _numbers(content, (DISTORTION[1], 'd', 'D'), path, required=False)
    model = content.get('distortion_model', DISTORTED[0])
    return lens_of(model, matrix, distortion, str(path), fitted)


def _require_size(path: Path, content: Mapping[str, Any], found: Detections) -> None:
    keys = [next((k for k in (f'image_{each}', each) if k in content), '') for each in SIZE]
    if not all(keys):
        return
    size = tuple(parse_number(content[key], f'{path}: {key}') for key in keys)
    farthest, what = found.pixels.max(axis=0), ''
    if found.size not in (None, size):
        what = 'of images of {} x {} px'.format(*found.size)
    elif not (farthest < size).all():
        what = 'reach {:.1f}, {:.1f} (is u to the right, v down?)'.format(*farthest)
    if what:
        raise InputError(
            f'{path} is of images of {size[0]:g} x {size[1]:g} px, the corners {what}: give the '
            'intrinsics for these images'
        )


def lens_of(
    model: str, matrix: Sequence[float], distortion: Sequence[float], where: str, fitted: bool
) -> Lens:
    """Return the lens of a camera matrix (9), row by row, and its distortion k1 k2 p1 p2 k3.

    Of another distortion one to be `fitted` starts at zero; else it is refused.
    """
    other = f'distortion_model {model!r}' * (model not in DISTORTED)
    if other := other or 'distortion beyond k3' * any(distortion[5:]):
        if not fitted:
            raise ConfigError(f'{where}: {other} is not supported: {DO_INSTEAD}')
        distortion = ()
    if len(matrix) != 9:
        raise ConfigError(f'{where}: camera_matrix must hold 9 numbers, not {len(matrix)}')
    fx, skew, cx, under, fy, cy, *last = matrix
    if skew or under or last != [0.0, 0.0, 1.0] or fx <= 0.0 or fy <= 0.0:
        raise ConfigError(f'{where}: camera_matrix must be [fx 0 cx; 0 fy cy; 0 0 1]')
    distorted: dict[str, Any] = dict(zip(LENS_KINDS[4:], distortion, strict=False))
    return Lens(fx, fy, cx, cy, **distorted)


def _numbers(
    content: Mapping[str, Any], keys: Sequence[str], path: Path, required: bool = True
) -> list[float]:
    value = next((content[key] for key in keys if key in content), None)
    if isinstance(value, dict):
        value = value.get('data')
    if value is None and not required:
        return []
    if not isinstance(value, list):
        form = '[fx, 0, cx, 0, fy, cy, 0, 0, 1]' if 'k' in keys else '[k1, k2, p1, p2, k3]'
        raise ConfigError(f'{path}: {keys[0]} must be numbers: {form}')
    rows = [row if isinstance(row, list) else [row] for row in value]
    return [parse_number(each, f'{path}: {keys[0]}') for row in rows for each in row]
