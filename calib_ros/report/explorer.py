# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The poses for the page to explore: single ones, above SINGLE bins, cells and quantiles."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.estimation.gross_errors import MANY
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import ROW_KINDS
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.report.poses import FITTED, JUDGED, REPEATED, WHEN, Poses, numbers, unit_of
from calib_ros.texts import one_line

SINGLE = MANY
"""Poses shown one by one; of more, this many evenly spread ones give the quantiles."""
WORST = 2 * SOME_POSES  # poses with the largest errors, and outliers, listed of more
BANDS = 60  # parts of the session, and of each joint's values, with quantiles; a convention
CELLS = round(SINGLE ** (1 / 3))
"""Cells along the longest edge of the workspace: in total no more than single poses."""
SHARES = (1.0 - CONFIDENT, 0.5, CONFIDENT)
ROLES = {FITTED: 'fitted', JUDGED: 'judged', REPEATED: 'not judged: pose fitted too'}


def explorer(chain: Chain, poses: Poses) -> dict[str, Any]:
    """Return the poses as plain values; errors in mm and mrad, positions in m."""
    many = len(poses) > SINGLE
    rows = _worst(poses) if many else np.arange(len(poses))
    shown = poses.select(rows)
    kinds = [['length', 'position error [mm]']]
    kinds += [[axis, f'position error along {axis} [mm]'] for axis in 'xyz']
    kinds += [['angle', 'orientation error [mrad]']] if poses.oriented else []
    lengths = {when: _values(poses, 'length', when)[poses.judged] for when in WHEN}
    reach = float(np.linalg.norm(poses.position, axis=1).max())
    usual = 1e-3 * float(np.median(lengths['after'])) if lengths['after'].size else 0.0
    arrays = {
        'joints': shown.joints,
        'position': shown.position,
        'before': 1e3 * shown.before,
        'after': 1e3 * shown.after,
        'turned_before': _values(shown, 'angle', 'before'),
        'turned_after': _values(shown, 'angle', 'after'),
        'size': shown.size,
    }
    if chain.effects or chain.held:  # a palletiser's hand is level
        arrays['effective'] = chain.effective(shown.joints.T).T
    return {
        'joints': [one_line(name) for name in chain.joint_names],
        'show': [list(unit_of(joint)) for joint in chain.joints],
        'convention': str(chain.convention),
        'table': [
            [float(getattr(j, k)) for k in ROW_KINDS] + [j.sign, j.type != 'revolute']
            for j in chain.joints
        ],
        'tools': poses.tools.tolist(),
        'reach': reach,
        'largest': {w: float(np.quantile(x, 0.98)) if x.size else 1.0 for w, x in lengths.items()},
        # log10 of the factor that draws the usual error as 0.05 of the reach
        'enlarge': round(float(np.log10(max(1.0, 0.05 * reach / max(usual, 1e-9)))), 2),
        'total': len(poses),
        'oriented': poses.oriented,
        'kinds': kinds,
        'number': (rows + 1).tolist() if many else None,
        'lines': poses.by_line,
        'clock': poses.timed,
        'things': poses.things,
        'images': [poses.source(row) if poses.corner[row] else '' for row in rows.tolist()]
        if poses.images
        else [],
        'stamps': _packed(shown.stamps_ns, '<i8'),
        'roles': list(ROLES.values()),
        'role': [list(ROLES).index(role) for role in shown.role.tolist()],
        'outlier': shown.outlier.astype(int).tolist(),
        'set': shown.set.tolist(),
        'arrays': {name: _packed(values, '<f4') for name, values in arrays.items()},
        'bins': _bins(chain, poses, [kind for kind, _ in kinds]) if many else None,
        'cells': _cells(poses) if many else None,
    }


def _packed(values: NDArray[Any], kind: str) -> str:
    return base64.b64encode(values.astype(kind).tobytes()).decode()


def _worst(poses: Poses) -> Index:
    error = np.linalg.norm(poses.after, axis=1)
    good = np.argsort(np.where(poses.outlier, -1.0, error))[-WORST:]
    gross = np.argsort(np.where(poses.outlier, error, -1.0))[-WORST:]
    return np.union1d(good[~poses.outlier[good]], gross[poses.outlier[gross]])


def _values(poses: Poses, kind: str, when: str) -> FloatArray:
    if kind == 'angle':
        return 1e3 * np.asarray(np.linalg.norm(getattr(poses, f'turned_{when}'), axis=1))
    errors = 1e3 * getattr(poses, when)
    if kind == 'length':
        return np.asarray(np.linalg.norm(errors, axis=1))
    return np.asarray(errors[:, 'xyz'.index(kind)])


def _bins(chain: Chain, poses: Poses, kinds: list[str]) -> dict[str, Any]:
    good = np.flatnonzero(~poses.outlier)
    good = good[:: 1 + len(good) // SINGLE]
    axes = {'session': good + 1.0}
    for k, joint in enumerate(chain.joints):
        axes[f'joint{k}'] = unit_of(joint)[0] * poses.joints[good, k]
    chosen = poses.select(good)
    errors = {kind: {when: _values(chosen, kind, when) for when in WHEN} for kind in kinds}
    found: dict[str, Any] = {}
    for key, values in axes.items():
        edges = np.linspace(values.min(), values.max(), BANDS + 1)
        place = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, BANDS - 1)
        middle = numbers(0.5 * (edges[1:] + edges[:-1]))
        found[key] = {
            kind: {'x': middle}
            | {when: _quantiles(each, place) for when, each in errors[kind].items()}
            for kind in kinds
        }
    return found


def _quantiles(values: FloatArray, place: Index) -> list[Any]:
    """Return the SHARES (3, B) of values (N,) in bins (N,), None for empty ones."""
    known = np.flatnonzero(~np.isnan(values))
    order = known[np.lexsort((values[known], place[known]))]
    counts = np.bincount(place[known], minlength=BANDS)
    rows = np.cumsum(counts) - counts + np.rint(np.outer(SHARES, counts - 1)).astype(int)
    nearest = np.append(values[order], np.nan).take(rows, mode='clip')
    return numbers(np.where(counts > 0, nearest, np.nan), 4)


def _cells(poses: Poses) -> dict[str, Any]:
    good = ~poses.outlier  # no selection of all columns: with many poses that is large
    position = poses.position[good]
    low = position.min(axis=0)
    edge = max(float(np.ptp(position, axis=0).max()) / CELLS, 1e-9)
    cell = ((position - low) / edge).astype(int)
    number = cell @ (1, CELLS + 1, (CELLS + 1) ** 2)
    _, index, count = np.unique(number, return_inverse=True, return_counts=True)

    def mean(values: FloatArray) -> FloatArray:
        columns = np.atleast_2d(values.T)
        sums = [np.bincount(index, column, len(count)) for column in columns]
        return np.stack(sums, axis=1) / count[:, np.newaxis]

    found: dict[str, Any] = {'count': count.tolist(), 'position': numbers(mean(position), 4)}
    for when in WHEN:
        errors = 1e3 * getattr(poses, when)[good]
        squares = mean((errors**2).sum(axis=1))[:, 0]
        found[f'rms_{when}'] = numbers(np.sqrt(squares), 4)
        found[f'mean_{when}'] = numbers(mean(errors), 4)
    return found
