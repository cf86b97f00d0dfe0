# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The poses of an identification and of new measurements, with their errors, pose by pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.decision.comparison import Comparison
from calib_ros.decision.residuals import axes_of, by_axes
from calib_ros.decision.result import Identification
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.pixels import samples_of
from calib_ros.estimation.samples import Samples
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report.poses import FITTED, JUDGED, REPEATED, Poses
from calib_ros.settings import Settings

NAMELESS: Mapping[int, str] = {}


def _poses(
    chain: Chain,
    groups: Sequence[tuple[Sequence[Samples], Comparison, NDArray[np.str_], FloatArray]],
    by_line: bool,
    images: Mapping[int, str],
    repeats: bool = False,
) -> Poses:
    """Return the poses of sets with residuals, roles (N,) and sizes (N,), in stamp order."""
    parts: list[dict[str, NDArray[Any]]] = []
    for measured, comparison, role, sizes in groups:
        first, before, after = 0, comparison.before, comparison.after
        for samples in measured:
            each = samples.observations
            rows = slice(first, first + len(each))
            first = rows.stop
            base, turn = chain.frame(each.base).matrix, axes_of(chain, each)
            reached = chain.forward(each.joints, each.approach, each.base, each.tool)
            along = turn if each.distances is None else np.broadcast_to(np.eye(3), turn.shape)
            left = after.position[rows] if each.pixels is None else after.pixels[rows]
            left = left[:, :1] if each.distances is not None else left
            parts_in_sigma = samples.in_sigma(left, after.orientation[rows])
            in_sigma = np.full((len(each), 6), np.nan)
            in_sigma[:, : left.shape[1]], in_sigma[:, 3:] = parts_in_sigma
            part = {
                'joints': each.joints,
                'stamps_ns': each.stamps_ns,
                'position': (reached[:, :3, 3] - base[:3, 3]) @ base[:3, :3],
                'before': by_axes(before.position[rows], along),
                'after': by_axes(after.position[rows], along),
                'turned_before': by_axes(before.orientation[rows], turn),
                'turned_after': by_axes(after.orientation[rows], turn),
                'in_sigma': in_sigma,
                'role': role[rows],
                'outlier': ~comparison.judged[rows],
                'size': sizes[rows],
                'corner': np.full(len(each), each.pixels is not None),
                'set': np.full(len(each), len(parts)),
                'tools': chain.frame(each.tool).matrix[np.newaxis],
            }
            parts.append(part)
    tools = np.concatenate([part.pop('tools') for part in parts])
    order = np.argsort(np.concatenate([part['stamps_ns'] for part in parts]), kind='stable')
    names = list(parts[0])  # let go one by one: of many poses they are large
    ordered = {name: np.concatenate([p.pop(name) for p in parts])[order] for name in names}
    return Poses(**ordered, tools=tools, by_line=by_line, images=images, repeats=repeats)


def poses_of(
    result: Identification, by_line: bool = False, images: Mapping[int, str] = NAMELESS
) -> Poses:
    """Return all poses of an identification, judged ones by a fit without them."""
    sizes = np.concatenate(result.distances)
    judged, problem = result.validation, result.problem
    sets = problem.system(problem.sets).sets
    if judged is None or judged.repeated is not None:
        groups = [(sets, result.fitted, np.full(len(sizes), FITTED), sizes)]
    else:  # each was left out once
        groups = [(sets, judged, np.full(len(sizes), JUDGED), sizes)]
    if judged is not None and judged.repeated is not None:
        role = np.where(judged.repeated, REPEATED, JUDGED)
        sets = problem.system(problem.judging).sets
        groups.append((sets, judged, role, np.full(len(role), np.nan)))
    return _poses(result.chain, groups, by_line, images)


def poses_to_verify(
    chain: Chain, sets: Sequence[Observations], comparison: Comparison, by_line: bool = False
) -> Poses:
    """Return the poses of new measurements, all judged."""
    count = len(comparison.judged)
    samples = [samples_of(each, Settings().sigmas, Settings.sigma_pixel) for each in sets]
    groups = [(samples, comparison, np.full(count, JUDGED), np.full(count, np.nan))]
    repeats = count_distinct(comparison.after.configurations) < count
    return _poses(chain, groups, by_line, NAMELESS, repeats)
