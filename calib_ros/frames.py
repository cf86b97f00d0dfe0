# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Starting values for unknown base and tool frames, without a guess from the user.

With the nominal arm K_i = A_1 ... A_n, a measured pose is M_i = T_world_base K_i T_flange_target.

Poses: the rotations R_M R_F^T = R_B R_K are linear in (R_F^T, R_B); the leading singular vectors
of sum_i R_K^T (x) R_M^T solve them for all samples at once (Shah 2013).
Positions: a point set registration of the flange positions (Umeyama 1991) that leaves the tool
out, and the linear system p = (R_B (x) t^T) vec(R_K) + R_B p_K + b of 13 unknowns a row.
Translations are linear once R_B is known. Every start is polished by least squares on the frames
alone; the best one counts. Where none fits (few or degenerate poses), the 24 rotations of a cube
are tried as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.chain import FRAME_KINDS, Chain, Frame
from calib_ros.leastsquares import Samples, minimise
from calib_ros.observations import Observations
from calib_ros.se3 import FloatArray

SUBSET = 200
CONVINCING = 0.03
"""A start is taken without a search when its RMS error is below this share of the spread."""


def free_frame_parameters(chain: Chain, oriented: bool) -> tuple[str, ...]:
    """Return the parameters of the frames that are not fixed.

    A tool's rotation is left out when no orientation was measured: no position depends on it.
    """
    return tuple(
        f'{key}.{kind}'
        for key in ('base', 'tool')
        if not chain.frame(key).fixed
        for kind in FRAME_KINDS
        if oriented or key == 'base' or not kind.startswith('r')
    )


def start_frames(
    chain: Chain, observations: Observations, sigma_position: float, sigma_orientation: float
) -> Chain:
    """Return the chain with base and tool frames that bring it close to the measurements."""
    names = free_frame_parameters(chain, bool(observations.oriented.any()))
    if not names:
        return chain
    index = np.unique(np.linspace(0, len(observations) - 1, SUBSET).round().astype(int))
    subset = observations.select(index)
    samples = Samples(subset, sigma_position, sigma_orientation)
    arm = replace(chain, base=Frame(), tool=Frame()).forward(subset.joints)
    spread = float(np.sqrt(subset.positions.var(axis=0).sum()))
    best, best_error = chain, np.inf
    for candidates in (_closed_form(chain, arm, subset), _search()):
        for rotation in candidates:
            start = _complete(chain, arm, subset, rotation)
            fitted = minimise(start, names, samples, tolerance=1e-3).chain
            error = _position_rms(fitted, subset)
            if error < best_error:
                best, best_error = fitted, error
        if best_error <= CONVINCING * spread:
            break
    return best


def _position_rms(chain: Chain, observations: Observations) -> float:
    difference = observations.positions - chain.forward(observations.joints)[:, :3, 3]
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def _closed_form(
    chain: Chain, arm: FloatArray, observations: Observations
) -> Iterator[FloatArray]:
    """Yield rotations of the base (3, 3) from what is given and from closed forms."""
    if chain.base is not None:
        yield chain.base.matrix[:3, :3]
        if chain.base.fixed:
            return
    oriented = observations.oriented
    if oriented.any():
        rotations, measured = arm[oriented, :3, :3], observations.rotations[oriented]
        if chain.tool is not None:
            tool = chain.tool.matrix[:3, :3]
            yield se3.nearest_rotation(
                np.einsum('nij,nkj->ik', measured, rotations @ tool) / len(measured)
            )
        system = np.einsum('nji,nlk->ikjl', rotations, measured).reshape(9, 9)
        _, _, right = np.linalg.svd(system)
        for sign in (1.0, -1.0):  # the singular vector's sign is open, its determinant is not
            matrix = sign * right[0].reshape(3, 3, order='F')
            if np.linalg.det(matrix) > 0.0:
                yield se3.nearest_rotation(matrix)
        return
    positions = observations.positions - observations.positions.mean(axis=0)
    tool_point = chain.frame('tool').matrix[:3, 3]
    reached = arm[:, :3, 3] + arm[:, :3, :3] @ tool_point
    yield se3.nearest_rotation(positions.T @ (reached - reached.mean(axis=0)))
    if len(arm) >= 16 and chain.tool is None:
        columns = np.concatenate([arm[:, :3, :3].reshape(-1, 9), arm[:, :3, 3]], axis=1)
        solution = np.linalg.lstsq(columns - columns.mean(axis=0), positions, rcond=1e-9)[0]
        yield se3.nearest_rotation(solution[9:].T)


def _search() -> Iterator[FloatArray]:
    """Yield the 24 rotations of a cube."""
    yield from Rotation.create_group('O').as_matrix()


def _complete(
    chain: Chain, arm: FloatArray, observations: Observations, rotation: FloatArray
) -> Chain:
    """Return the chain with the rest of its frames in closed form, the base's rotation given."""
    base, tool = chain.frame('base'), chain.frame('tool')
    base_matrix, tool_matrix = base.matrix.copy(), tool.matrix.copy()
    oriented = observations.oriented
    if not base.fixed:
        base_matrix[:3, :3] = rotation
    if not tool.fixed and oriented.any():
        turned = rotation @ arm[oriented, :3, :3]
        tool_matrix[:3, :3] = se3.nearest_rotation(
            np.einsum('nji,njk->ik', turned, observations.rotations[oriented])
        )
    # p = R_B p_K + R_B R_K t + b, with b and t unknown unless their frame is fixed
    turned = rotation @ arm[:, :3, :3]
    wanted = observations.positions - arm[:, :3, 3] @ rotation.T
    unknown = []
    if not base.fixed:
        unknown.append(np.broadcast_to(np.eye(3), turned.shape))
    else:
        wanted = wanted - base_matrix[:3, 3]
    if not tool.fixed:
        unknown.append(turned)
    else:
        wanted = wanted - turned @ tool_matrix[:3, 3]
    if unknown:
        columns = np.concatenate(unknown, axis=2).reshape(-1, 3 * len(unknown))
        solution = np.linalg.lstsq(columns, wanted.ravel(), rcond=1e-9)[0]
        if not base.fixed:
            base_matrix[:3, 3] = solution[:3]
        if not tool.fixed:
            tool_matrix[:3, 3] = solution[-3:]
    return replace(
        chain, base=replace(base, matrix=base_matrix), tool=replace(tool, matrix=tool_matrix)
    )
