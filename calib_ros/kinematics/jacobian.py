# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The differential model of the target's pose errors, one analytic column per parameter.

Vacarescu et al. write the error of one link as dA_i = Delta_i A_i with a twist Delta_i in frame
i - 1 (their eq. 3 and 4). Moved to the world, the link errors add up to the pose error:

    dT T^-1 = sum_i T_{i-1} Delta_i T_{i-1}^-1        T_{i-1} = T_world_base A_1 ... A_{i-1}

(eq. 6 as printed adds the Delta_i without moving them; `docs/model.md` lists the errata). Every
Denavit-Hartenberg parameter is one elementary motion along or about one axis u through a point c,
both met by `Chain.trace`. So the twist needs no table, for either convention:

    translation (a, d)              dp = u              domega = 0
    rotation (alpha, theta, beta)   dp = u x (p - c)    domega = u

with p the target's position, all in world coordinates. For the standard convention this is the
paper's eq. (4), and the row for beta that the paper does not print.

Arrays are laid out (parameter, component, sample): each operation runs over many samples at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import UnknownNameError
from calib_ros.kinematics import effects, se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import (
    ANGLES,
    DELAY,
    DH_KINDS,
    LENS_KINDS,
    Parameter,
    parameters_of,
)
from calib_ros.kinematics.se3 import FloatArray


class ErrorModel:
    """The pose and its derivatives with respect to named parameters of a chain.

    Parameters
    ----------
    chain : Chain
        The point of linearisation.
    names : sequence of str
        Parameters, one column each, in this order. Frames other than `base` and `tool` may be
        among them; their columns are zero.
    base, tool : str
        Frames at the ends of the chain.

    """

    def __init__(
        self, chain: Chain, names: Sequence[str], base: str = 'base', tool: str = 'tool'
    ) -> None:
        self.chain = chain
        self.names = tuple(names)
        self._ends = (base, tool)
        driven = tuple(joint.driven for joint in chain.joints)
        fitted = tuple(name for name, _ in chain.effects if name in self.names)
        self._layout = _layout(
            self.names, chain.joint_names, driven, chain.frame_names, fitted, self._ends
        )
        self._signs = {joint.name: joint.sign for joint in chain.joints}
        self.rotations = self._layout.rotations
        """Number of rotational parameters; they come first in the arrays of `linearise`."""
        self.order = self._layout.order
        """Row of each named parameter in the arrays of `linearise`."""

    def linearise(
        self,
        q: FloatArray,
        approach: FloatArray | None = None,
        velocity: FloatArray | None = None,
    ) -> tuple[list[FloatArray], FloatArray, FloatArray, FloatArray]:
        """Return pose and derivatives for one block of samples.

        Parameters
        ----------
        q : (n, B)
            Joint values [rad or m], a row per joint.
        approach : (n, B), optional
            Signs of the velocities before, for backlash.
        velocity : (n, B), optional
            Velocities of the joints, for the delay of the measuring device.

        Returns
        -------
        axes : list of three (3, B)
            The target's x, y and z axis.
        origin : (3, B)
            Its position [m].
        shift : (P + 1, 3, B)
            Derivative of the position, rotational parameters first. The last row is left free
            for the caller, who can put the residual there.
        turn : (P_rotational + 1, 3, B)
            Derivative of the orientation as a rotation vector in the world. Likewise.

        """
        samples, rotations, row = q.shape[1], self.rotations, self._layout.row
        shift = np.empty((len(row) + 1, 3, samples))
        turn = np.empty((rotations + 1, 3, samples))
        arm = np.empty((rotations, 3, samples))
        for k in self._layout.still:
            (turn if k < rotations else shift)[k] = 0.0
            if k < rotations:
                arm[k] = 0.0
        fitted = self._layout.effects
        phi: dict[str, FloatArray] = {}
        if fitted:
            rows = effects.basis(self.chain, fitted, q, approach)
            phi = dict(zip(fitted, rows, strict=True))

        late = None
        delay = Parameter(self._ends[0], DELAY)
        if velocity is not None and delay in row:
            late = _Twist(self.chain, velocity)

        def put(k: int, rotates: bool, axis: FloatArray, point: FloatArray) -> None:
            if rotates:
                turn[k] = axis
                arm[k] = point
            else:
                shift[k] = axis

        def record(name: Parameter, rotates: bool, axis: FloatArray, point: FloatArray) -> None:
            k = row.get(name)
            if k is not None:
                put(k, rotates, axis, point)
            for effect in self._layout.driven.get(name, ()):
                sign = self._signs[Parameter(effect).owner]
                put(row[effect], rotates, axis * (sign * phi[effect]), point)
            if late is not None:
                late.add(name, rotates, axis, point)

        effective = self.chain.effective(q, approach)
        axes, origin = self.chain.trace(effective, record, *self._ends)
        np.subtract(origin, arm, out=arm)
        cross(turn[:-1], arm, shift[:rotations])
        if late is not None:
            k = row[delay]
            turn[k], shift[k] = late.of(origin)
        return axes, origin, shift, turn

    def jacobian(
        self,
        q: FloatArray,
        approach: FloatArray | None = None,
        velocity: FloatArray | None = None,
    ) -> FloatArray:
        """Return the Jacobian (N, 6, P) of position [m] and orientation [rad] at poses q (N, n).

        Rows 0-2 are the target's position in the world. Rows 3-5 are its rotation as a vector
        in world axes: the turned orientation is exp(J[3:] dx) R.
        """
        rows = np.ascontiguousarray(np.asarray(q, dtype=float).T)
        came = None if approach is None else np.ascontiguousarray(approach.T)
        moving = None if velocity is None else np.ascontiguousarray(velocity.T)
        _, _, shift, turn = self.linearise(rows, came, moving)
        full = np.zeros((len(q), 6, len(self.names)))
        full[:, :3] = shift[self.order].transpose(2, 1, 0)
        rotational = self.order < self.rotations
        full[:, 3:, rotational] = turn[self.order[rotational]].transpose(2, 1, 0)
        return full


class _Layout(NamedTuple):
    """Where the columns of parameters stand.

    `row` of each parameter, rotations first, of which there are so many; `order` of the rows in
    the order of the names; the `effects` among them, and which of them every joint's parameter
    drives; `still` the rows of what does not move a target between these frames.
    """

    row: Mapping[str, int]
    rotations: int
    order: NDArray[np.intp]
    effects: tuple[str, ...]
    driven: Mapping[str, Sequence[str]]
    still: tuple[int, ...]


@lru_cache(maxsize=64)
def _layout(
    names: tuple[str, ...],
    joints: tuple[str, ...],
    driven: tuple[Parameter, ...],
    frames: tuple[str, ...],
    fitted: tuple[str, ...],
    ends: tuple[str, str],
) -> _Layout:
    """Return the layout of named parameters; each joint drives one of its own."""
    rotates: dict[str, bool] = {}
    for frame in frames:
        rotates |= {name: name.kind.startswith('r') for name in parameters_of(frame)}
        rotates[Parameter(frame, DELAY)] = True
        rotates |= dict.fromkeys(parameters_of(frame, LENS_KINDS), False)
    for joint in joints:
        rotates |= {name: name.kind in ANGLES for name in parameters_of(joint, DH_KINDS)}
    moves: dict[str, list[str]] = {}
    for name in fitted:
        drives = driven[joints.index(Parameter(name).owner)]
        rotates[name] = rotates[drives]
        moves.setdefault(drives, []).append(name)
    for name in names:
        if name not in rotates:
            raise UnknownNameError('parameter', name, rotates)
    turning = [name for name in names if rotates[name]]
    shifting = [name for name in names if not rotates[name]]
    row = {name: k for k, name in enumerate(turning + shifting)}
    elsewhere = set(frames) - set(ends)
    still = [
        k
        for name, k in row.items()
        if Parameter(name).kind in (DELAY, *LENS_KINDS) or Parameter(name).owner in elsewhere
    ]
    order = np.array([row[name] for name in names], dtype=np.intp)
    order.setflags(write=False)
    return _Layout(row, len(turning), order, fitted, moves, tuple(still))


class _Twist:
    """The target's velocity, with the sign reversed: what a delay of one second would change."""

    def __init__(self, chain: Chain, velocity: FloatArray) -> None:
        self._rates: dict[str, FloatArray] = {
            joint.driven: -joint.sign * values
            for joint, values in zip(chain.joints, velocity, strict=True)
        }
        self._turn, self._shift = np.zeros((2, 3, velocity.shape[1]))

    def add(self, name: str, rotates: bool, axis: FloatArray, point: FloatArray) -> None:
        """Add what the motion of one joint does."""
        rate = self._rates.get(name)
        if rate is None:
            return
        if not rotates:
            self._shift += rate * axis
            return
        self._turn += rate * axis
        moment = np.empty_like(self._shift)
        cross(np.broadcast_to(axis, moment.shape), np.broadcast_to(point, moment.shape), moment)
        self._shift -= rate * moment

    def of(self, origin: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return turn and shift (3, B) of a target at a position (3, B)."""
        shift = np.empty_like(self._shift)
        cross(self._turn, np.broadcast_to(origin, shift.shape), shift)
        return self._turn, shift + self._shift


def cross(first: FloatArray, second: FloatArray, out: FloatArray) -> None:
    """Write the cross product of (..., 3, B) arrays into `out`."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        np.multiply(first[..., i, :], second[..., j, :], out=out[..., k, :])
        out[..., k, :] -= first[..., j, :] * second[..., i, :]


def orientation_error(measured: FloatArray, axes: Sequence[FloatArray]) -> FloatArray:
    """Return the rotation vector (3, B) in world axes that turns the model onto the measurement.

    Parameters
    ----------
    measured : (3, 3, B)
        Measured rotation matrices; the first index counts their columns.
    axes : three (3, B)
        Columns of the model's rotation matrices.

    Notes
    -----
    E = R_measured R^T is summed from its columns; its vector is log E = angle / sin(angle) *
    1/2 sum_k r_k x m_k, which is as long as log(R^T R_measured).

    """
    model = np.stack([np.broadcast_to(axis, measured.shape[1:]) for axis in axes])
    parts = np.empty_like(model)
    cross(model, measured, parts)
    sine_vector = 0.5 * parts.sum(axis=0)
    cosine = 0.5 * (np.einsum('kib,kib->b', model, measured) - 1.0)
    sine = np.sqrt(np.einsum('ib,ib->b', sine_vector, sine_vector))
    angle = np.arctan2(sine, cosine)
    error: FloatArray = sine_vector * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)
    half_turn = np.flatnonzero(cosine < -0.99)  # the sine loses the axis near 180 degrees
    if half_turn.size:
        turned = np.einsum('kib,kjb->bij', measured[..., half_turn], model[..., half_turn])
        error[:, half_turn] = se3.log_rotation(turned).T
    return error
