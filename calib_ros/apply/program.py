# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot's program, with velocities and accelerations, corrected sample by sample."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.annotated import check_fields
from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensation, Compensator, Refusal
from calib_ros.apply.refused import add_refusals, too_fast
from calib_ros.errors import InputError, UnknownNameError
from calib_ros.estimation.visits import approaches
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray, Index
from calib_ros.progress import Notify, quiet
from calib_ros.shown import Shown

NUDGE = HALF_THE_DIGITS**0.25
"""Step of differences, in units of the largest correction: optimal for second differences of
values accurate to half the digits."""


@dataclass(frozen=True, eq=False, repr=False)
class Program(Shown):
    """A robot's program as joint values by name."""

    names: tuple[str, ...]
    """Columns of the arrays; they may include joints outside the arm, and lack held ones."""
    positions: FloatArray
    """(N, m) joint values [rad or m], in their order of execution."""
    velocities: FloatArray | None = None
    accelerations: FloatArray | None = None
    approach: FloatArray | None = None
    """(N, n) signs of the velocities with which the arm's joints reach their values, for backlash.
    By default from the order of the positions."""

    def __post_init__(self) -> None:
        check_fields(self)


def compensate_program(
    compensator: Compensator, program: Program, progress: Notify = quiet
) -> tuple[Program, Compensation]:
    """Return a program with corrected joint values, and the outcome at each point.

    Velocities and accelerations follow the corrected path; times and other joints do not change.
    Refused points are NaN; `progress` receives the share done.

    Raises InputError or UnknownNameError as `joint_values`.
    """
    positions, columns = joint_values(compensator.nominal, program)
    approach = approaches(positions) if program.approach is None else program.approach
    result = compensate(compensator, positions, approach, progress)
    if program.velocities is None:
        return replace(program, positions=_put(program.positions, columns, result.joints)), result
    given = program.accelerations
    curve = np.zeros_like(program.velocities) if given is None else given
    speeds, bends = (
        np.where(columns < 0, 0.0, each[:, columns]) for each in (program.velocities, curve)
    )
    velocities, accelerations = _derivatives(compensator, result, speeds, bends, approach)
    held = result.limited.any(axis=1) & ~np.isnan(result.joints).any(axis=1)
    reason = 'a joint is held at its limit, where its velocity is not defined'
    result = add_refusals(result, [Refusal(k, reason) for k in np.flatnonzero(held).tolist()])
    swings = np.where(np.isnan(result.joints), 0.0, np.abs(velocities - speeds))
    words = 'moves at {:.4g} while the joints move at {:.4g} a second at most'
    result = add_refusals(result, too_fast(compensator, swings, np.abs(speeds), words))
    gaps = np.where(np.isnan(result.joints), np.nan, 0.0)
    return (
        replace(
            program,
            positions=_put(program.positions, columns, result.joints),
            velocities=_put(program.velocities, columns, velocities + gaps),
            accelerations=None if given is None else _put(given, columns, accelerations + gaps),
        ),
        result,
    )


def _derivatives(
    compensator: Compensator,
    result: Compensation,
    velocities: FloatArray,
    accelerations: FloatArray,
    approach: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return velocities and accelerations (N, n) along the corrected path.

    Central differences of the correction along q + v t + a t^2 / 2, with a time step in which the
    command moves by a small part of the largest correction.
    """
    speed, bend = (
        np.abs(rates / compensator.largest).max(axis=1) for rates in (velocities, accelerations)
    )
    moving = speed + np.sqrt(speed**2 + 2.0 * NUDGE * bend)
    step = np.where(moving > 0.0, 2.0 * NUDGE / np.where(moving > 0.0, moving, 1.0), 1.0)
    step = step[:, np.newaxis]

    def correction(time: FloatArray) -> FloatArray:
        joints = result.command + time * velocities + 0.5 * time**2 * accelerations
        return compensator.follower.solve(joints, approach, bounded=False).change

    ahead, here, behind = correction(step), correction(0.0 * step), correction(-step)
    return (
        velocities + (ahead - behind) / (2.0 * step),
        accelerations + (ahead - 2.0 * here + behind) / step**2,
    )


def joint_values(chain: Chain, program: Program) -> tuple[FloatArray, Index]:
    """Return the joint values (N, n) [rad or m] of a program for an arm, and their columns (n,).

    Held joints may be missing: the column is then -1, the value their limit.

    Raises InputError or UnknownNameError for a missing joint that can move, and arrays that do not
    match the names.
    """
    names = chain.joint_names
    shape = program.positions.shape
    if len(shape) != 2 or shape[1] != len(program.names):
        raise InputError(f'{len(program.names)} joint names do not fit positions of shape {shape}')
    for rates in (program.velocities, program.accelerations):
        if rates is not None and rates.shape != shape:
            raise InputError(f'rates of shape {rates.shape} do not fit positions of shape {shape}')
        if rates is not None and not np.isfinite(rates).all():
            raise InputError('velocities and accelerations must be finite numbers')
    if program.accelerations is not None and program.velocities is None:
        raise InputError('a program with accelerations needs velocities as well')
    for name in names:
        if program.names.count(name) > 1:
            raise InputError(f'joint "{name}" comes twice in the program')
    moving = [name for k, name in enumerate(names) if k not in chain.held]
    missing = [name for name in moving if name not in program.names]
    others = [name for name in program.names if name not in names]
    if missing and others:
        (strange,) = difflib.get_close_matches(missing[0], others, n=1, cutoff=0.0)
        raise UnknownNameError('joint in the program', strange, names)
    if missing:
        raise InputError(f'the program has no values of {", ".join(missing)}')
    known = {name: k for k, name in enumerate(program.names)}
    columns = np.array([known.get(name, -1) for name in names])
    ends = [chain.held.get(k, 0.0) for k in range(len(names))]
    return np.where(columns < 0, ends, program.positions[:, columns]), columns


def _put(values: FloatArray, columns: Index, new: FloatArray) -> FloatArray:
    replaced = values.copy()
    replaced[:, columns[columns >= 0]] = new[:, columns >= 0]
    return replaced
