# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Starting values for unknown base and tool frames, in closed form (docs/model.md).

With the nominal arm K_i = A_1 ... A_n, a measured pose is M_i = T_world_base K_i T_flange_target.
If orientations hardly vary, the tool's translation is the shortest one, the base takes the rest,
and rotations come from a registration. A touched plane: n p_K + n R_K t = d is linear in n, n t^T
and d, or with a given tool it is the plane through the points. Pixels: the pose of the board in
each image (`resection.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.errors import InputError
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.gross_errors import thorough_fit
from calib_ros.estimation.identifiability import (
    DEGENERATE,
    excited,
    independent,
    structurally_independent,
)
from calib_ros.estimation.leastsquares import minimise
from calib_ros.estimation.levels import TELLING
from calib_ros.estimation.normal import factor_of, triangular_factor
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.resection import board_poses
from calib_ros.estimation.robust import robust_fit
from calib_ros.estimation.samples import Samples, residual_arrays
from calib_ros.estimation.system import System
from calib_ros.estimation.visits import numbered
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.lens import require_lens
from calib_ros.kinematics.parameter import IN_A_FRAME, Parameter, parameters_of
from calib_ros.kinematics.se3 import ROUNDS, FloatArray, norms
from calib_ros.settings import EXCEPTION, Settings
from calib_ros.shown import counted


def start_frames(problem: Problem) -> Chain:
    """Return the model with base and tool frames that bring it close to the measurements.

    Sets with more equations come first, as one or two poses of a tool place no device; frames
    found by them are kept. A point seen from the flange turns no base: it follows sets that do.
    """
    chain, sigmas = problem.model, (problem.sigma_position, problem.sigma_orientation)
    found: set[str] = set()
    counts = [count_distinct(each.configurations) * each.width for each in problem.sets]
    pairs = zip(problem.sets, counts, strict=True)
    order = [(not each.seen and count > 2 * IN_A_FRAME, count) for each, count in pairs]
    for number in sorted(range(len(order)), key=order.__getitem__, reverse=True):
        observations = problem.sets[number]
        placed = {name: replace(chain.frame(name), fixed=True) for name in found}
        known = {**chain.all_frames, **placed}
        base, tool = observations.base, observations.tool
        view = replace(chain, base=known[base], tool=known[tool])
        alone = observations.changed(base='base', tool='tool')
        if alone.pixels is not None:
            lens = require_lens(view.frame(alone.camera).lens, alone.camera)
            alone = board_poses(alone.some_images(), lens)
        view = _start_one(view, alone, sigmas, problem.loss)
        for key, name in (('base', base), ('tool', tool)):
            frame = replace(view.frame(key), fixed=chain.frame(name).fixed)
            chain = chain.with_frame(name, frame)
        found |= {base, tool}
    return chain


def in_new_frames(
    problem: Problem, arm: Chain, new: Sequence[str], system: System, needed: bool = True
) -> Chain:
    """Return a known arm in `new` frames fitted to the system of all measurements.

    Raises InputError if these do not show where the frames are, if that is `needed`.
    """
    known = reframed(reframed(arm, arm.frame_names, fixed=True), new, fixed=False)
    own = free_in(known, new)
    found = start_frames(replace(problem, chain=known))
    if needed:
        _check_shown(found, own, problem, system)
    seen = excited(triangular_factor(found, own, system), own)
    placed = minimise(found, seen, system).chain
    for name in new:
        arm = arm.with_frame(name, replace(arm.frame(name), matrix=placed.frame(name).matrix))
    return arm


def reframed(chain: Chain, names: Iterable[str], **changes: Any) -> Chain:
    """Return the chain with other values of some fields of its named frames."""
    for name in names:
        chain = chain.with_frame(name, replace(chain.frame(name), **changes))
    return chain


def _check_shown(
    chain: Chain, names: Sequence[Parameter], problem: Problem, system: System
) -> None:
    """Require that poses show parameters of frames, also without any one of them.

    Frames that fit all poses exactly tell nothing. Nominal axes are parallel, nominal hands level.
    """
    groups = numbered(problem.all_sets)
    folds = min(TELLING, count_distinct(np.concatenate(groups)))
    rests = [system.select([g % folds != k for g in groups]) for k in range(folds)]
    shown = set(excited(triangular_factor(chain, names, system), names)).intersection(
        *(independent(triangular_factor(chain, names, rest), names) for rest in rests)
    )
    nominal = replace(chain, joints=problem.chain.joints, effects=problem.chain.effects)
    if hidden := set(structurally_independent(nominal, names, problem.sets)).difference(shown):
        frames = ' and '.join(dict.fromkeys(name.owner for name in names if name in hidden))
        raise InputError(
            f'{counted(system.count, "pose")} cannot place the new {frames}: measure more, all '
            'over the joint range'
        )


def _start_one(
    chain: Chain, observations: Observations, sigmas: tuple[float, float], loss: str
) -> Chain:
    every = free_in(chain, ('base', 'tool'))
    whole = observations.width == 6 or observations.seen
    names = [name for name in every if whole or name.owner == 'base' or name.is_length]
    if not names:
        return chain
    if observations.socket:
        return next(next(_starts(chain, observations)))
    subset = observations.spread()
    system = System((Samples(subset, *sigmas),))
    if subset.of_wire:
        start = _trilaterated(chain, flange(chain, subset), subset)
        lengths = [name for name in names if name.is_length]
        return thorough_fit(start, lengths, system, loss).fit.chain
    places = subset.given if subset.seen else subset.positions
    spread = float(np.sqrt(np.var(places, axis=0).sum()))
    determined: tuple[str, ...] = ()
    best, least, left = chain, np.inf, np.full_like(subset.positions, np.inf)
    for starts in _starts(chain, subset):
        for start in starts:
            away = norms(residual_arrays(start, subset)[0] - left)
            if np.median(away) <= EXCEPTION * spread:  # the same valley
                continue
            chosen = excited(factor_of(start, names, system), names)
            # the robust fit goes on from the best
            fitted = minimise(start, chosen, system, 1e-3, ROUNDS // 4).chain
            residual = residual_arrays(fitted, subset)[0]
            error = np.median(norms(residual))  # robust
            if error < least:
                best, least, determined, left = fitted, error, chosen, residual
        if least <= EXCEPTION * spread:  # no other valley is as low
            break
    return robust_fit(best, determined, system, loss).fit.chain


def _starts(chain: Chain, observations: Observations) -> Iterator[Iterator[Chain]]:
    """Yield starts to polish in closed form, then further ones if none of those is good."""
    arm = flange(chain, observations)
    if observations.plane:
        yield _on_plane(chain, arm, observations)
        return
    yield _each(chain, closed_frames(chain, observations, arm))
    cube = Rotation.create_group('O').as_matrix()
    yield _each(chain, _complete(chain, arm, observations, cube))


def flange(chain: Chain, observations: Observations) -> FloatArray:
    """Return the poses (..., N, 4, 4) of the bare arm, at joint values (..., N, n)."""
    arm, q, signs = replace(chain, base=Frame(), tool=Frame()), observations.joints, None
    if observations.approach is not None:
        signs = np.broadcast_to(observations.approach, q.shape).reshape(-1, q.shape[-1])
    return arm.forward(q.reshape(-1, q.shape[-1]), signs).reshape(*q.shape[:-1], 4, 4)


def free_in(chain: Chain, frames: Iterable[str]) -> list[Parameter]:
    """Return the parameters of the frames that are not fixed."""
    return [n for each in frames if not chain.frame(each).fixed for n in parameters_of(each)]


def fit_to_arm(
    chain: Chain,
    names: Sequence[str],
    arm: Chain,
    joints: FloatArray,
    sigma_orientation: float = Settings.sigma_orientation,
    iterations: int = 1000,
) -> tuple[Chain, float]:
    """Return a chain fitted to an arm at joint values (N, n), and the RMS distance [m].

    Of redundant parameters the first are fitted, to exact poses; a turn by `sigma_orientation`
    [rad] counts as much as a shift by the default sigma.
    """
    poses = arm.forward(joints)
    seen = Observations.from_arrays(joints, poses[:, :3, 3], poses[:, :3, :3])
    system = System((Samples(seen, Settings.sigma_position, sigma_orientation),))
    independent = structurally_independent(chain, names)
    fitted = minimise(chain, independent, system, iterations=iterations).chain
    left = fitted.forward(joints)[:, :3, 3] - seen.positions
    return fitted, float(np.sqrt((left**2).sum(axis=1).mean()))


def closed_frames(chain: Chain, observations: Observations, arm: FloatArray) -> FloatArray:
    """Return the closed forms of base and tool (2, R, ..., 4, 4), given the bare arm's poses.

    Of measurements stacked as (..., N, 3), with poses (..., N, 4, 4), each has its own frames.
    """
    turns = _closed_form(chain, arm, observations)
    shape = (*arm.shape[:-3], 3, 3)
    every = np.array([np.broadcast_to(turn, shape) for turn in turns])
    return _complete(chain, arm, observations, every)


def _each(chain: Chain, frames: FloatArray) -> Iterator[Chain]:
    """Yield the chain with each pair of base and tool (2, R, 4, 4)."""
    return (_placed(chain, *pair) for pair in zip(*frames, strict=True))


def _on_plane(chain: Chain, arm: FloatArray, observations: Observations) -> Iterator[Chain]:
    """Yield the chain on the plane z = 0 through poses (N, 4, 4), with given and found tool."""
    tool = chain.frame('tool')
    tips = [tool.matrix[:3, 3]]
    columns = np.column_stack([arm[:, :3, 3], arm[:, :3, :3].reshape(-1, 9), np.ones(len(arm))])
    if not tool.fixed and len(columns) > columns.shape[1]:  # one touch more than unknowns
        least = np.linalg.svd(columns, full_matrices=False)[2][-1]
        normal = least[:3]
        tips.append(normal @ least[3:12].reshape(3, 3) / max(float(normal @ normal), 1e-12))
    for tip in tips:
        points = arm[:, :3, 3] + arm[:, :3, :3] @ tip
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        axes[2] = np.cross(axes[0], axes[1])
        place = se3.transform(axes, -axes @ points.mean(axis=0))
        place[2, 3] += np.asarray(observations.distances).mean()
        yield _placed(chain, place, se3.transform(tool.matrix[:3, :3], tip))


def _placed(chain: Chain, base: FloatArray, tool: FloatArray) -> Chain:
    """Return the chain with other matrices (4, 4) for frames that are not fixed."""
    for key, matrix in (('base', base), ('tool', tool)):
        if not chain.frame(key).fixed:
            chain = chain.with_frame(key, replace(chain.frame(key), matrix=matrix))
    return chain


def _trilaterated(chain: Chain, arm: FloatArray, observations: Observations) -> Chain:
    """Return the chain placed by distances from the world's origin.

    L^2 = |p|^2 + 2 p b + |b|^2 is linear in b and |b|^2, which gives the height of b over an arm
    that moves in a plane; distances do not determine the orientation of the base, which stays
    parallel to the world.
    """
    assert observations.distances is not None
    tool = chain.frame('tool').matrix
    points = (arm @ tool)[:, :3, 3]
    columns = np.column_stack([2.0 * points, np.ones(len(points))])
    wanted = observations.distances**2 - (points**2).sum(axis=1)
    *flat, square = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    place = np.array(flat)
    _, sizes, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if sizes[-1] <= DEGENERATE * sizes[0]:  # at height zero nothing would change it
        least = EXCEPTION**2 * np.mean(observations.distances**2)
        place += axes[-1] * np.sqrt(max(square - place @ place, least))
    return _placed(chain, se3.transform(np.eye(3), place), tool)


def _closed_form(
    chain: Chain, arm: FloatArray, observations: Observations
) -> Iterator[FloatArray]:
    """Yield rotations of the base (..., 3, 3) from the given frames and closed forms."""
    if observations.socket or (observations.seen and chain.base is None):
        yield np.eye(3)  # the world's axes are the base's
        return
    if chain.base is not None:
        yield chain.base.matrix[..., :3, :3]
        if chain.base.fixed or observations.seen:
            return
    if observations.oriented.any():
        products = _products(arm, observations)
        if chain.tool is not None:
            tool = chain.tool.matrix[..., :3, :3]
            yield se3.nearest_rotation(np.einsum('...kmij,...mj->...ik', products, tool))
        system = np.einsum('...jilk->...ikjl', products).reshape(*arm.shape[:-3], 9, 9)
        matrix = np.linalg.svd(system)[2][..., 0, :].reshape(*arm.shape[:-3], 3, 3)
        sign = np.sign(np.linalg.det(matrix))  # arbitrary in a singular vector
        yield se3.nearest_rotation(np.swapaxes(sign[..., np.newaxis, np.newaxis] * matrix, -1, -2))
    positions = _centred(observations.positions)
    reached = arm[..., :3, 3] + _applied(arm[..., :3, :3], chain.frame('tool').matrix[..., :3, 3])
    yield se3.nearest_rotation(np.swapaxes(positions, -1, -2) @ _centred(reached))
    if arm.shape[-3] >= 16 and chain.tool is None:
        turns = arm[..., :3, :3].reshape(*arm.shape[:-2], 9)
        columns = _centred(np.concatenate([turns, arm[..., :3, 3]], axis=-1))
        solution = np.linalg.pinv(columns, rcond=1e-9) @ positions
        yield se3.nearest_rotation(np.swapaxes(solution[..., 9:, :], -1, -2))


def _products(arm: FloatArray, observations: Observations) -> FloatArray:
    """Return the products (..., 3, 3, 3, 3) of arm's and measured rotations, over all poses."""
    shape = arm.shape[:-3]
    measured = observations.rotations * observations.oriented[..., np.newaxis, np.newaxis]
    turns = np.swapaxes(arm[..., :3, :3].reshape(*shape, -1, 9), -1, -2)
    return (turns @ measured.reshape(*shape, -1, 9)).reshape(*shape, 3, 3, 3, 3)


def _applied(turns: FloatArray, vector: FloatArray) -> FloatArray:
    """Return a vector (..., 3) turned by rotations (..., N, 3, 3)."""
    flat = turns.reshape(*turns.shape[:-3], -1, 3) @ vector[..., np.newaxis]
    return np.asarray(flat.reshape(*flat.shape[:-2], -1, 3))


def _centred(values: FloatArray) -> FloatArray:
    """Return values (..., N, c) less their mean."""
    return np.asarray(values - values.mean(axis=-2, keepdims=True))


def _complete(
    chain: Chain, arm: FloatArray, observations: Observations, rotation: FloatArray
) -> FloatArray:
    """Return base and tool (2, R, ..., 4, 4) in closed form, for base rotations (R, ..., 3, 3)."""
    base, tool = chain.frame('base'), chain.frame('tool')
    shape = (*rotation.shape[:-2], 4, 4)
    base_matrix, tool_matrix = (np.broadcast_to(f.matrix, shape).copy() for f in (base, tool))
    if not base.fixed:
        base_matrix[..., :3, :3] = rotation
    if not tool.fixed and observations.oriented.any():
        products = _products(arm, observations)
        tool_matrix[..., :3, :3] = se3.nearest_rotation(
            np.einsum('...jm,...mijk->...ik', rotation, products)
        )
    # R_B^T p = p_K + R_K t + R_B^T b, with b and t unknown unless their frame is fixed
    turns = arm[..., :3, :3]
    wanted = observations.positions @ rotation - arm[..., :3, 3]
    known = base_matrix[..., np.newaxis, :3, 3] @ rotation * base.fixed
    if observations.points is not None:  # seen
        if not tool.fixed:
            left = wanted - known
            found = _camera_rotation(turns, observations.points, left, not base.fixed)
            tool_matrix[..., :3, :3] = found
        places = observations.points @ np.swapaxes(tool_matrix[..., :3, :3], -1, -2)
        wanted -= np.einsum('...nij,...nj->...ni', turns, places)
    wanted -= _applied(turns, tool_matrix[..., :3, 3])
    if not tool.fixed:
        shift = _shortest(turns, wanted - known, not base.fixed)
        tool_matrix[..., :3, 3] += shift
        wanted -= _applied(turns, shift)
    if not base.fixed:
        base_matrix[..., :3, 3] = np.einsum('...ij,...j->...i', rotation, wanted.mean(axis=-2))
    return np.array([base_matrix, tool_matrix])


def _camera_rotation(
    turned: FloatArray, given: FloatArray, wanted: FloatArray, free: bool
) -> FloatArray:
    """Return the rotation (..., 3, 3) of a camera that sees one point, `given` (..., N, 3).

    At flange rotations (..., N, 3, 3): R_i (R m_i + t) + b = wanted (..., N, 3) is linear in R, t
    and, if `free`, b.
    """
    shape = turned.shape[:-1]
    parts = [np.einsum('...nij,...nk->...nijk', turned, given).reshape(*shape, 9), turned]
    parts += [np.broadcast_to(np.eye(3), turned.shape)] * free
    columns = np.concatenate(parts, axis=-1)
    columns = columns.reshape(*shape[:-2], -1, columns.shape[-1])
    flat = wanted.reshape(*wanted.shape[:-2], -1, 1)
    found = (np.linalg.pinv(columns, rcond=1e-9) @ flat)[..., :9, 0]
    return se3.nearest_rotation(found.reshape(*found.shape[:-1], 3, 3))


def _shortest(turned: FloatArray, wanted: FloatArray, free: bool) -> FloatArray:
    """Return the shortest t (..., 3) [m] that brings R_i t + b close to wanted (..., N, 3) [m].

    Zero in directions in which rotations (..., N, 3, 3) vary little: well before a fit could take
    the frame for degenerate and leave it where noise put it. b is arbitrary if `free`, else zero.
    """
    if free:
        turned, wanted = turned - turned.mean(axis=-3, keepdims=True), _centred(wanted)
    flat = turned.reshape(*turned.shape[:-3], -1, 3)
    across = np.swapaxes(flat, -1, -2)
    squares, axes = np.linalg.eigh(across @ flat)
    along = np.swapaxes(axes, -1, -2) @ (across @ wanted.reshape(*wanted.shape[:-2], -1, 1))
    known = squares > (DEGENERATE / EXCEPTION) ** 2 * turned.shape[-3]
    along[..., 0] *= known / np.where(known, squares, 1.0)
    return np.asarray((axes @ along)[..., 0])
