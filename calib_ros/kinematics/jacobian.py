# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The differential model of the target's pose errors, one analytic column per parameter.

Vacarescu et al. write the error of one link as dA_i = Delta_i A_i with a twist Delta_i in frame
i - 1 (their eq. 3 and 4). Moved to the world, the link errors add up to the pose error:

    dT T^-1 = sum_i T_{i-1} Delta_i T_{i-1}^-1        T_{i-1} = T_world_base A_1 ... A_{i-1}

(eq. 6 as printed adds the Delta_i without moving them; `docs/model.md` lists the errata). Every
Denavit-Hartenberg parameter is one elementary motion along or about one axis u through a point c,
both met by a walk along the chain. So the twist needs no table, for either convention:

    translation (a, b, d)           dp = u              domega = 0
    rotation (alpha, theta, beta)   dp = u x (p - c)    domega = u

with p the target's position, all in world coordinates. For the standard convention this is the
paper's eq. (4), and the row for beta that the paper does not print.

Arrays are laid out (parameter, component, sample): each operation runs over many samples at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np

from calib_ros.errors import UnknownNameError
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import (
    DELAY,
    DH_ANGLES,
    LENS_KINDS,
    ROW_KINDS,
    Parameter,
    parameters_of,
)
from calib_ros.kinematics.se3 import FloatArray, Index
from calib_ros.kinematics.walk import Walk


class ErrorModel:
    """The pose and its derivatives with respect to named parameters of a `chain`.

    There is one column for each of the `names`, in order; it is zero for frames other than `base`
    and `tool`, which are at the ends.
    """

    def __init__(
        self, chain: Chain, names: Sequence[str], base: str = 'base', tool: str = 'tool'
    ) -> None:
        self.chain = chain
        self.names = tuple(names)
        self.ends = (base, tool)
        self._base = chain.frame(base).matrix
        self._origin = np.append(np.eye(3), self._base[:3, 3]).reshape(4, 3, 1)
        turning = tuple(bool(turns) for turns in chain.walk.turning)
        known = dict(chain.effects)
        fitted = tuple(name for name in self.names if name in known)
        standard = chain.convention == 'standard'
        joints = tuple(zip(chain.joint_names, turning, strict=True))
        self._layout = _layout(self.names, joints, standard, chain.frame_names, fitted, self.ends)
        self.rotations = self._layout.rotations
        """Number of rotations; they come first in the arrays of `linearise`."""
        self.motions = self.rotations + len(self._layout.shifts)
        """Number of all motions."""
        self.order = self._layout.order
        """Row of each named parameter in the arrays of `linearise`; of effects, to be multiplied
        by phi."""
        self.spread = self._layout.spread
        """Numbers (E,) of the effects among the names."""

    def linearise(
        self,
        q: FloatArray,
        approach: FloatArray | None = None,
        velocity: FloatArray | None = None,
        out: tuple[FloatArray, FloatArray] | None = None,
        points: FloatArray | None = None,
        circle: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return axes (3, 3, B), origin (3, B) [m] and derivatives of the target for one block.

        `q` (n, B) [rad or m] are joint values, `approach` (n, B) signs of the preceding
        velocities, for backlash, `velocity` (n, B) those for the delay of the device, `points` (3,
        B) [m] the target in the frame of the tool, `circle` as in `Walk.frames`. The
        first index of the axes counts them. The derivatives are `shift` (K + 1, 3, B) of the
        position, rotations first, and `turn` (K_rotational + 1, 3, B) of the orientation as a
        rotation vector in the world; their last row is free for the residual. They are written to
        `out`, if given, to reuse memory. All effects of a joint share the row of its motion, to be
        multiplied by their `phi` (E, B).
        """
        layout, walk, samples = self._layout, self.chain.walk, q.shape[1]
        names = tuple(dict.fromkeys((*layout.effects, *(n for n, v in self.chain.effects if v))))
        phi = effects.basis(self.chain, names, q, approach)
        moved = effects.moved_joints(self.chain, names, phi, q)
        frames, target = self._frames(moved, circle if moved is q else None)
        if points is not None:
            target[3] += np.einsum('kcb,kb->cb', target[:3], points)
        flat = frames.reshape(4 * len(frames), 3, samples)
        shift, turn = out or (
            np.empty((self.motions + 1, 3, samples)),
            np.empty((self.rotations + 1, 3, samples)),
        )
        np.take(flat, layout.turns, axis=0, out=turn[:-1], mode='clip')
        se3.cross(turn[:-1], target[3] - flat[layout.points], shift[: self.rotations])
        np.take(flat, layout.shifts, axis=0, out=shift[self.rotations : -1], mode='clip')
        shift[layout.still], turn[layout.unturned] = 0.0, 0.0
        if velocity is not None and layout.delay is not None:
            rates = effects.couple_held(self.chain, velocity, rates=True)
            turn[layout.delay], shift[layout.delay] = _twist(walk, rates, frames, target[3])
        phi = phi[: len(layout.effects)] * walk.signs[layout.joints]
        return target[:3], target[3], shift, turn, phi

    def _frames(self, q: FloatArray, circle: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return frames (F, 4, 3, B) along the chain and the target's (4, 3, B).

        Those before the joints, of the flange, of the world at the base, the flange's axes at the
        target, and the y axes that b shifts along; q (n, B) holds effective joint values.
        """
        count, samples = q.shape
        walk, behind = self.chain.walk, self._layout.behind
        frames = np.empty((count + 3 + self._layout.beside * count, 4, 3, samples))
        walk.frames(q, self._base, frames[: count + 1], circle=circle)
        target = self.chain.at_the_tool(frames[count], self.ends[1])
        frames[count + 1] = self._origin
        frames[count + 2, :3], frames[count + 2, 3] = frames[count, :3], target[3]
        if self._layout.beside:
            after = frames[behind, :3]
            frames[count + 3 :, 1] = np.einsum('jk,jkcb->jcb', walk.beside, after)
        if walk.beta.any():  # a and alpha come before beta
            frames[behind, 0] *= walk.cos[:, np.newaxis, np.newaxis]
            frames[behind, 0] += walk.sin[:, np.newaxis, np.newaxis] * frames[behind, 2]
        return frames, target

    def jacobian(
        self,
        q: FloatArray,
        approach: FloatArray | None = None,
        velocity: FloatArray | None = None,
        seen: bool = False,
    ) -> FloatArray:
        """Return the Jacobian (N, 6, P) of position [m] and orientation [rad] at poses q (N, n).

        Rows 0-2 are the target's position in the world, rows 3-5 its rotation vector in world
        axes: the orientation becomes exp(J[3:] dx) R. If `seen` rows 0-2 are the world's origin in
        the frame of the target, with the sign and axes of the others.
        """
        rows = np.ascontiguousarray(self.chain.joint_values(q).T)
        signs = None if approach is None else np.ascontiguousarray(approach.T)
        moving = None if velocity is None else np.ascontiguousarray(velocity.T)
        _, places, *found = self.linearise(rows, signs, moving)
        twists = self.twists(*found).transpose(2, 1, 0)
        if seen:
            twists[:, :3] += se3.skew(places.T) @ twists[:, 3:]
        return np.ascontiguousarray(twists)

    def twists(self, shift: FloatArray, turn: FloatArray, phi: FloatArray) -> FloatArray:
        """Return the derivatives (P, 6, B) by the named parameters from those of `linearise`."""
        found = np.zeros((len(self.names), 6, shift.shape[2]))
        turning = self.order < self.rotations
        found[:, :3], found[turning, 3:] = shift[self.order], turn[self.order[turning]]
        self.multiply(found, phi)
        return found

    def multiply(self, rows: FloatArray, phi: FloatArray) -> None:
        """Multiply those of the rows (P, c, B) that belong to effects by their phi (E, B)."""
        own = self.spread
        together = len(own) > 0 and own[-1] - own[0] == len(own) - 1  # a slice makes no copy
        rows[slice(own[0], own[-1] + 1) if together else own] *= phi[:, np.newaxis]


class _Layout(NamedTuple):
    """Rows of the columns, rotations first, and that of each name in `order`.

    Of the rows of all frames, four each, `turns` and `points` belong to rotations, `shifts` to the
    others; `still` ones move nothing, `unturned` are the rotations among them. `behind` are the
    frames after the constant part of each link, `beside` if b moves along y before it. `effects`,
    with numbers `spread` among the names, share the columns of the motion of their `joints`;
    `delay` is the row of a delay.
    """

    rotations: int
    order: Index
    turns: Index
    points: Index
    shifts: Index
    still: Index
    unturned: Index
    behind: slice
    beside: bool
    effects: tuple[str, ...]
    spread: Index
    joints: Index
    delay: int | None


Line: TypeAlias = tuple[int | None, int, bool]
"""Frame of a walk, or None; axis of the motion; whether it is a rotation."""


def _lines(
    joints: Mapping[str, int], standard: bool, frames: Sequence[str], ends: tuple[str, str]
) -> dict[str, Line]:
    """Return the line of a walk that each parameter of joints and frames moves along or about."""
    at = {ends[0]: len(joints) + 1, ends[1]: len(joints) + 2}
    found: dict[str, Line] = {}
    for frame in frames:
        for k, name in enumerate(parameters_of(frame)):
            found[name] = (at.get(frame), k % 3, k > 2)
        found[Parameter(frame, DELAY)] = (None, 0, True)
        found |= dict.fromkeys(parameters_of(frame, LENS_KINDS), (None, 0, False))
    along = {'a': 0, 'alpha': 0, 'beta': 1, 'b': 1}
    for joint, i in joints.items():
        for name in parameters_of(joint, ROW_KINDS):
            frame_row = i + 1 if standard and name.kind in along else i
            frame_row = i + 3 + len(joints) if name.kind == 'b' else frame_row
            found[name] = (frame_row, along.get(name.kind, 2), name.kind in DH_ANGLES)
    return found


@lru_cache(maxsize=1024)
def _layout(
    names: tuple[str, ...],
    joints: tuple[tuple[str, bool], ...],
    standard: bool,
    frames: tuple[str, ...],
    fitted: tuple[str, ...],
    ends: tuple[str, str],
) -> _Layout:
    """Return the layout of named parameters of joints (name, turning), frames and effects."""
    number = {joint: i for i, (joint, _) in enumerate(joints)}
    lines = _lines(number, standard, frames, ends)
    own = {name: number[Parameter(name).owner] for name in fitted}
    driving = [Parameter(joint, 'theta' if turns else 'd') for joint, turns in joints]
    driven = {name: driving[i] for name, i in own.items()}
    for name in names:
        if name not in lines and name not in own:
            raise UnknownNameError('parameter', name, lines | own)
    columns = dict.fromkeys(driven.get(name, name) for name in names)
    ordered = sorted(columns, key=lambda name: not lines[name][2])
    row = {name: k for k, name in enumerate(ordered)}
    rotations = sum(lines[name][2] for name in ordered)
    taken = [4 * (lines[name][0] or 0) + lines[name][1] for name in ordered]
    still = [k for k, name in enumerate(ordered) if lines[name][0] is None]
    return _Layout(
        rotations,
        _indices(row[driven.get(name, name)] for name in names),
        _indices(taken[:rotations]),
        _indices(k // 4 * 4 + 3 for k in taken[:rotations]),
        _indices(taken[rotations:]),
        _indices(still),
        _indices(k for k in still if k < rotations),
        slice(1, len(joints) + 1) if standard else slice(0, len(joints)),
        any(Parameter(name).kind == 'b' for name in names),
        fitted,
        _indices(k for k, name in enumerate(names) if name in own),
        _indices(own.values()),
        row.get(Parameter(ends[0], DELAY)),
    )


def _twist(
    walk: Walk, velocity: FloatArray, frames: FloatArray, origin: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the effect of a delay of one second: turn and shift (3, B) of a target."""
    rates, turning = -walk.signs * velocity, walk.turning
    driven, points = frames[: len(rates), 2], frames[: len(rates), 3]
    moved = se3.cross(driven, origin - points)
    moved[~turning] = driven[~turning]
    return (
        np.einsum('jb,jcb->cb', rates[turning], driven[turning]),
        np.einsum('jb,jcb->cb', rates, moved),
    )


def _indices(numbers: Iterable[int]) -> Index:
    found = np.array([*numbers], dtype=np.intp)
    found.setflags(write=False)
    return found


def orientation_error(measured: FloatArray, model: FloatArray) -> FloatArray:
    """Return the rotation vector (3, B) in world axes from the model to the measurement.

    Both are (3, 3, B) rotation matrices; the first index counts their columns. E = R_measured R^T
    is summed from its columns; its vector is log E, as long as log(R^T R_measured): angle /
    sin(angle) times half the difference of E and its transpose.
    """
    turn = np.einsum('kib,kjb->ijb', measured, model)
    sine_vector = 0.5 * (turn[[2, 0, 1], [1, 2, 0]] - turn[[1, 2, 0], [2, 0, 1]])
    cosine = 0.5 * (np.einsum('iib->b', turn) - 1.0)
    sine = np.sqrt(np.einsum('ib,ib->b', sine_vector, sine_vector))
    angle = np.arctan2(sine, cosine)
    least = np.maximum(sine, se3.ROUNDING)
    error: FloatArray = sine_vector * np.where(sine > se3.ROUNDING, angle / least, 1.0)
    half_turn = np.flatnonzero(cosine < -0.99)  # the sine loses the axis near 180 degrees
    if half_turn.size:
        error[:, half_turn] = se3.log_rotation(turn[..., half_turn].transpose(2, 0, 1)).T
    return error
