# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What turns and tilts of the joints, beyond all parameters, do to poses (docs/model.md).

`unmodelled.py` finds their sizes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from calib_ros.estimation.samples import BLOCK
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.effects import PLAY
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import FloatArray


class Unmodelled(NamedTuple):
    """Errors of joints [rad] that no parameter explains.

    At random each joint turns about its axis (slides along it [m], if prismatic), and the axis
    tilts. The axis also wobbles by waves, which the parameters `names` (P,) follow by `followed`
    (P, T) a unit; waves that are not `shown` by the data are assumed, turns and tilts that are not
    `random` by a test may be the device's noise.
    """

    turns: float = 0.0
    tilts: float = 0.0
    waves: float = 0.0
    names: tuple[str, ...] = ()
    followed: FloatArray = np.zeros((0, 1))
    shown: bool = False
    random: bool = False

    @property
    def sizes(self) -> dict[str, float]:
        """Return the sizes by name; without them nothing is lacking."""
        return {'turns': self.turns, 'tilts': self.tilts, 'waves': self.waves}

    @property
    def square(self) -> FloatArray:
        """Return the covariance (P, P) of the parameters by waves."""
        return np.asarray(self.waves**2 * self.followed @ self.followed.T)

    def for_names(self, names: Sequence[str]) -> Unmodelled:
        """Return the same of other parameters, of which only its own follow."""
        rows = dict(zip(self.names, self.followed, strict=True))
        none = np.zeros(self.followed.shape[1])
        followed = np.array([rows.get(name, none) for name in names])
        return self._replace(names=tuple(names), followed=followed.reshape(-1, len(none)))

    def columns(
        self, chain: Chain, names: Sequence[str], joints: FloatArray, rows: FloatArray
    ) -> FloatArray:
        """Return the columns (K, c, N) at joint values (N, n), waves last.

        Rows as in `turns_and_tilts`.
        """
        turns, tilts = turns_and_tilts(chain, names, rows)
        own = rows[[names.index(name) for name in self.names]]
        left = wobble_columns(tilts, joints) - np.tensordot(self.followed, own, (0, 0))
        return np.concatenate([self.turns * turns, self.tilts * tilts, self.waves * left])

    def expected(
        self,
        model: ErrorModel,
        square: FloatArray,
        joints: FloatArray,
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Return the expected squares (N, 6, 6) of pose errors [m, rad] at joint values (N, n).

        In world axes, with expected squares (P, P) of the model's parameters. `approach` (N, n)
        holds the signs of the preceding moves; without it, and where it is 0, joints come from
        either side, and are off by their play.
        """
        play, sizes = _play_of(model)
        either = np.diag(square)[play] + sizes**2
        found = [
            own @ square @ np.swapaxes(own, 1, 2)
            + (sided * either) @ np.swapaxes(sided, 1, 2)
            + off @ np.swapaxes(off, 1, 2)
            for own, sided, off in self._seen(model, joints, approach)
        ]
        return np.concatenate(found)

    def variances(
        self,
        model: ErrorModel,
        square: FloatArray,
        joints: FloatArray,
        part: slice,
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Return the traces (3, N) of a `part` of `expected`.

        By the uncertainty of the parameters, by fitted play from either side, and by the rest.
        """
        (play, sizes), found = _play_of(model), []
        for own, sided, off in self._seen(model, joints, approach):
            rows, squares = own[:, part], (sided[:, part] ** 2).sum(axis=1)
            along = (rows.reshape(-1, len(square)) @ square).reshape(rows.shape)
            known = np.einsum('ncp,ncp->n', along, rows) + squares @ np.diag(square)[play]
            found.append([known, squares @ sizes**2, (off[:, part] ** 2).sum(axis=(1, 2))])
        return np.concatenate(found, axis=1)

    def _seen(
        self, model: ErrorModel, joints: FloatArray, approach: FloatArray | None = None
    ) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """Yield the columns (B, 6, P) of a model, of its play, and of the joints, in blocks.

        Play has a column of its own where its side is not known, and one of the model where it is.
        """
        chain, count, some = model.chain, len(model.names), any(self.sizes.values())
        play, _ = _play_of(model)
        driven = [chain.joint_names.index(Parameter(model.names[k]).owner) for k in play]
        every = tuple(dict.fromkeys((*model.names, *(axis_parameters(chain) if some else ()))))
        joints, model = chain.joint_values(joints), ErrorModel(chain, every, *model.ends)
        signs = np.zeros_like(joints) if approach is None else approach
        for first in range(0, max(len(joints), 1), BLOCK):
            block = np.s_[first : first + BLOCK]
            unknown = signs[block] == 0.0
            jacobian = model.jacobian(joints[block], np.where(unknown, 1.0, signs[block]))
            off = self.columns(chain, every, joints[block], jacobian.T) if some else jacobian.T[:0]
            sided = jacobian[..., play] * unknown[:, np.newaxis, driven]
            jacobian[..., play] -= sided
            yield jacobian[..., :count], sided, off.T


def _play_of(model: ErrorModel) -> tuple[list[int], FloatArray]:
    """Return the numbers (K,) of the parameters that are play, and their values (K,)."""
    known = dict(model.chain.effects)
    play = [k for k, name in enumerate(model.names) if Parameter(name).kind in PLAY]
    return play, np.array([known[model.names[k]] for k in play])


NOTHING = Unmodelled()


def axis_parameters(chain: Chain) -> list[Parameter]:
    """Return the parameters that turn joints about their axes, and those that tilt the axes.

    The latter are those of rows, and turns of bases.
    """
    bases = [frame for frame in chain.frame_names if frame.startswith('base')]
    turns = [name for frame in bases for name in parameters_of(frame)[3:]]
    tilts = (Parameter(name, kind) for name in chain.joint_names for kind in ('alpha', 'beta'))
    return [*turns, *tilts, *(joint.driven for joint in chain.joints)]


def turns_and_tilts(
    chain: Chain, names: Sequence[str], rows: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the columns of turns (n, c, N) about the axes, and of two tilts (2 n, c, N) of each.

    `rows` (P, c, N) are those of the names, with all `axis_parameters`. In the standard convention
    the row before a joint tilts its axis, or the base does.
    """
    own = dict(zip(names, rows, strict=False))
    tilts = [own[f'{name}.{kind}'] for name in chain.joint_names for kind in ('alpha', 'beta')]
    if chain.convention == 'standard':
        bases = [frame for frame in chain.frame_names if frame.startswith('base')]
        turns = [[own[name] for name in parameters_of(frame)[3:]] for frame in bases]
        axes = [chain.frame(frame).matrix[:3, :2] for frame in bases]
        tilts = [*np.tensordot(axes, turns, ((0, 1), (0, 1))), *tilts[:-2]]
    return np.array([own[joint.driven] for joint in chain.joints]), np.array(tilts)


def wobble_columns(tilts: FloatArray, joints: FloatArray) -> FloatArray:
    """Return the columns (8 n, c, N) of wobbling axes at joint values (N, n).

    Each tilt (2 n, c, N) follows sine and cosine of the first and second harmonic of its joint.
    """
    angles = np.multiply.outer(joints.T, (1.0, 2.0))  # (n, N, 2)
    waves = np.concatenate([np.cos(angles), np.sin(angles)], axis=2).repeat(2, axis=0)
    found = tilts[:, np.newaxis] * waves.transpose(0, 2, 1)[:, :, np.newaxis]
    return np.asarray(found.reshape(4 * len(tilts), *tilts.shape[1:]))
