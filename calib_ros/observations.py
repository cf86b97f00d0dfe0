# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Stamped joint values and stamped poses to matched pairs, by header stamps only.

A pose is matched when two joint samples bracket it within `max_gap`; the joint values are
interpolated linearly at the pose's stamp. Matching is a function of the set of samples in the
buffers, evaluated when it is asked for, so the order of arrival cannot change it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from calib_ros import se3
from calib_ros.errors import InputError
from calib_ros.se3 import FloatArray

TURN = 2.0 * np.pi
STILL = 1e-3
"""Joint values [rad or m] that differ by less are one configuration."""


@dataclass(frozen=True, eq=False)
class Observations:
    """N matched pairs of joint values and measured poses, in the order of their stamps.

    Parameters
    ----------
    stamps_ns : (N,) int64
    joints : (N, n) [rad or m]
    positions : (N, 3) [m]
        Of the target in the measuring device's frame, the world.
    rotations : (N, 3, 3)
        Of the target in the world; the identity where none was measured.
    oriented : (N,) bool
        True where the orientation was measured.
    covariance : (N, 6, 6), optional
        Of x, y, z [m] and the rotation about the world's x, y, z axes [rad], as in
        PoseWithCovariance; NaN rows where the measurement brought none.
    approach : (N, n), optional
        Signs of the velocities with which the joints came to their values, for backlash.
    distances : (N,), optional
        Distances [m] from the origin of the world to the target, for draw-wires and ball-bars.
        Positions and rotations count for nothing then.
    base, tool : str
        Frames of the chain that hold for these pairs.
    socket : bool
        The target, a ball, sat in a socket of unknown place: it was at the origin of the world all
        the time, and the world's axes are those of the arm's base.

    """

    stamps_ns: NDArray[np.int64]
    joints: FloatArray
    positions: FloatArray
    rotations: FloatArray
    oriented: NDArray[np.bool_]
    covariance: FloatArray | None = None
    approach: FloatArray | None = None
    distances: FloatArray | None = None
    base: str = 'base'
    tool: str = 'tool'
    socket: bool = False

    def __post_init__(self) -> None:
        """Check that the arrays fit together and hold only numbers."""
        count = len(self.stamps_ns)
        shapes = {
            'joints': (count, *self.joints.shape[1:]),
            'positions': (count, 3),
            'rotations': (count, 3, 3),
            'oriented': (count,),
        }
        if self.covariance is not None:
            shapes['covariance'] = (count, 6, 6)
        if self.approach is not None:
            shapes['approach'] = self.joints.shape
        if self.distances is not None:
            shapes['distances'] = (count,)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(
                    f'{name} of {count} observations must have the shape {shape}, not '
                    f'{getattr(self, name).shape}'
                )
        for name in ('joints', 'positions', 'rotations', 'approach', 'distances'):
            if getattr(self, name) is not None and not np.isfinite(getattr(self, name)).all():
                raise InputError(f'{name} of the observations hold NaN or infinite values')

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.stamps_ns)

    @classmethod
    def from_arrays(
        cls, joints: FloatArray, positions: FloatArray, rotations: FloatArray | None = None
    ) -> Observations:
        """Make observations (N) from arrays; position only when `rotations` is None."""
        count = len(joints)
        return cls(
            np.arange(1, count + 1, dtype=np.int64) * 1_000_000_000,
            np.asarray(joints, dtype=np.float64),
            np.asarray(positions, dtype=np.float64),
            np.broadcast_to(np.eye(3), (count, 3, 3)) if rotations is None else rotations,
            np.full(count, rotations is not None),
        )

    def select(self, mask: NDArray[np.generic]) -> Observations:
        """Return the pairs chosen by a mask or by indices."""
        names = ('stamps_ns', 'joints', 'positions', 'rotations', 'oriented')
        optional = ('covariance', 'approach', 'distances')
        present = [name for name in optional if getattr(self, name) is not None]
        return replace(self, **{name: getattr(self, name)[mask] for name in (*names, *present)})

    def inverted(self, sigmas: tuple[float, float] | None = None) -> Observations:
        """Return the poses the other way round: a camera on the flange sees a fixed target.

        The measured pose of the target in the camera becomes that of the camera in the target's
        frame, which takes the place of the world. Covariances go along; `sigmas` (position [m],
        orientation [rad]) make them where the measurement brought none, because the inverse is
        uncertain by the orientation's sigma times the distance.
        """
        if not self.oriented.all():
            raise InputError(
                'poses of a camera on the flange need their orientation (qx qy qz qw): without it '
                'they cannot be turned round'
            )
        turned = np.swapaxes(self.rotations, 1, 2)
        positions = -np.einsum('nij,nj->ni', turned, self.positions)
        covariance = self.covariance
        if covariance is None and sigmas is not None:
            diagonal = np.diag(np.repeat(np.square(sigmas), 3))
            covariance = np.tile(diagonal, (len(self), 1, 1))
        if covariance is not None:
            jacobian = np.zeros((len(self), 6, 6))
            jacobian[:, :3, :3] = -turned
            jacobian[:, :3, 3:] = -turned @ se3.skew(self.positions)
            jacobian[:, 3:, 3:] = -turned
            covariance = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        return replace(self, positions=positions, rotations=turned, covariance=covariance)

    def at(self, stamps_ns: NDArray[np.int64]) -> Observations:
        """Return the same pairs with other stamps (N,)."""
        return replace(self, stamps_ns=stamps_ns)

    @cached_property
    def configurations(self) -> NDArray[np.intp]:
        """Return (N,) the number of the standing configuration that each pair belongs to."""
        return configurations(self.joints)


def stops(joints: FloatArray) -> NDArray[np.intp]:
    """Return (N,) the number of the stop at which joint values (N, n) in sequence were taken."""
    if len(joints) == 0:
        return np.zeros(0, dtype=np.intp)
    return np.concatenate([[0], np.cumsum(_moved(joints))]).astype(np.intp)


def _moved(joints: FloatArray) -> NDArray[np.bool_]:
    """Return (N - 1,) whether the arm moved from one row to the next; angles modulo a turn."""
    change = np.abs(np.diff(joints, axis=0)) % TURN
    return np.asarray(np.minimum(change, TURN - change).max(axis=1) > STILL)


def configurations(joints: FloatArray) -> NDArray[np.intp]:
    """Return (N,) the number of the configuration that joint values (N, n) belong to.

    Values within STILL of each other are one configuration, whenever they were taken: a program
    that runs in a loop visits it again, it does not measure another one. Angles count modulo a
    full turn.
    """
    if len(joints) == 0:
        return np.zeros(0, dtype=np.intp)
    standing = joints[np.concatenate([[True], _moved(joints)])] % TURN  # one row a stop
    tree = cKDTree(standing % TURN, boxsize=TURN)
    near = tree.query_pairs(STILL, p=np.inf, output_type='ndarray')
    links = coo_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=(len(standing),) * 2)
    _, label = connected_components(links, directed=False)
    return np.asarray(label[stops(joints)], dtype=np.intp)


class _Rows:
    """Stamped rows of numbers in one growing block of memory, up to a capacity."""

    def __init__(self, width: int, capacity: int) -> None:
        self.capacity = capacity
        self.count = 0
        self._stamps = np.empty(min(1024, capacity), dtype=np.int64)
        self._values = np.empty((len(self._stamps), width))

    @property
    def full(self) -> bool:
        return self.count == self.capacity

    @property
    def stamps(self) -> NDArray[np.int64]:
        return self._stamps[: self.count]

    @property
    def values(self) -> FloatArray:
        return self._values[: self.count]

    def append(self, stamp_ns: int, row: Sequence[float] | FloatArray) -> None:
        if self.count == len(self._stamps):
            size = min(2 * self.count, self.capacity)
            self._stamps = np.resize(self._stamps, size)
            self._values = np.resize(self._values, (size, self._values.shape[1]))
        self._stamps[self.count] = stamp_ns
        self._values[self.count] = row
        self.count += 1

    def keep(self, index: NDArray[np.intp]) -> None:
        """Keep only the rows of an index, in its order."""
        self._stamps[: len(index)] = self._stamps[index]
        self._values[: len(index)] = self._values[index]
        self.count = len(index)


def _unique_order(rows: _Rows) -> NDArray[np.intp]:
    """Return the order by stamp, one row a stamp; of equal stamps the smallest values win.

    So the choice does not depend on the order of arrival.
    """
    stamps = rows.stamps
    if rows.count > 1 and not (np.diff(stamps) > 0).all():
        order = np.lexsort((*rows.values.T[::-1], stamps))
        first = np.concatenate([[True], np.diff(stamps[order]) > 0])
        return np.asarray(order[first], dtype=np.intp)
    return np.arange(rows.count, dtype=np.intp)


class Pairing:
    """Bounded buffers of joint samples and poses, and the pairs that they make.

    When the joint buffer is full, the older half of it is let go: the poses of that time are
    matched first and keep their joint values. Poses are never let go; when their buffer is full,
    new ones are dropped. Everything dropped is counted by cause.

    Parameters
    ----------
    revolute : (n,) bool
        True for the joints whose values are angles.
    max_gap : float
        Longest time [s] between the two joint samples that bracket a pose.
    joint_capacity, pose_capacity : int
        Sizes of the buffers, in samples.

    """

    def __init__(
        self,
        revolute: Sequence[bool],
        *,
        max_gap: float,
        joint_capacity: int,
        pose_capacity: int,
    ) -> None:
        self._revolute = np.array(revolute, dtype=bool)
        self._max_gap_ns = round(max_gap * 1e9)
        self._joints = _Rows(len(revolute), joint_capacity)
        self._poses = _Rows(_POSE.stop + 2 * len(revolute), pose_capacity)
        self._horizon_ns = 0  # joint samples before this stamp have been let go
        self.dropped: Counter[str] = Counter()
        self.let_go = 0
        """Joint samples that made room after the poses of their time were matched."""

    def add_joints(self, stamp_ns: int, values: FloatArray) -> None:
        """Take joint values (n,) [rad or m] in the order of the chain."""
        if stamp_ns < self._horizon_ns:
            self.dropped['joints: older than the joint buffer'] += 1
            return
        if self._joints.full:
            self._settle()
        self._joints.append(stamp_ns, values)

    def add_pose(
        self,
        stamp_ns: int,
        position: Sequence[float],
        quat_xyzw: Sequence[float] | None = None,
        covariance: FloatArray | None = None,
        held_out: bool = False,
    ) -> None:
        """Take a measured pose: position (3,) [m], quaternion, covariance (6, 6).

        Held-out poses are never fitted; they judge the result.
        """
        if stamp_ns < self._horizon_ns:
            self.dropped['poses: older than the joint buffer'] += 1
            return
        if self._poses.full:
            self.dropped['poses: pose buffer full'] += 1
            return
        row = np.full(_POSE.stop + 2 * len(self._revolute), np.nan)
        row[_POSITION] = position
        if quat_xyzw is not None:
            row[_QUAT] = quat_xyzw
        if covariance is not None:
            row[_COVARIANCE] = covariance.ravel()
        row[_HELD_OUT] = held_out
        self._poses.append(stamp_ns, row)

    def match(self) -> tuple[Observations, Observations, Counter[str]]:
        """Return the pairs to fit, the held-out pairs, and what is dropped so far by cause."""
        stamps, rows, joints, dropped = self._matched()
        held_out = rows[:, _HELD_OUT] == 1.0
        fitted, kept_out = (
            _observations(stamps[k], joints[k], rows[k]) for k in (~held_out, held_out)
        )
        return fitted, kept_out, dropped

    def tally(self) -> tuple[int, int, int, Counter[str]]:
        """Return the numbers of pairs to fit, of held-out pairs and of stops to fit.

        Cheaper than `match`; the last item is what is dropped so far by cause.
        """
        _, rows, joints, dropped = self._matched()
        held_out = rows[:, _HELD_OUT] == 1.0
        numbers = stops(joints[~held_out, : len(self._revolute)])
        count = int(numbers[-1]) + 1 if len(numbers) else 0
        return int((~held_out).sum()), int(held_out.sum()), count, dropped

    def _matched(self) -> tuple[NDArray[np.int64], FloatArray, FloatArray, Counter[str]]:
        """Return stamps (N,), rows of the pose buffer, joint values and approach (N, 2 n)."""
        order = _unique_order(self._joints)
        dropped = self.dropped.copy()
        dropped['joints: same stamp twice'] += self._joints.count - len(order)
        index = _unique_order(self._poses)
        dropped['poses: same stamp twice'] += self._poses.count - len(index)
        stamps, rows = self._poses.stamps[index], self._poses.values[index]
        joints, cause = self._interpolate(order, stamps)
        settled = ~np.isnan(rows[:, -1])
        joints[settled] = rows[settled, _POSE.stop :]
        cause[settled] = 0
        for k, text in enumerate(_CAUSES[1:], start=1):
            dropped[text] += int((cause == k).sum())
        good = cause == 0
        return stamps[good], rows[good], joints[good], +dropped

    def _interpolate(
        self, order: NDArray[np.intp], stamps: NDArray[np.int64]
    ) -> tuple[FloatArray, NDArray[np.intp]]:
        """Return joint values and approach (N, 2 n) at the stamps, and why there are none.

        The cause is an index of _CAUSES.
        """
        known, values = self._joints.stamps[order], self._joints.values[order]
        joints = np.full((len(stamps), 2 * values.shape[1]), np.nan)
        cause = np.zeros(len(stamps), dtype=np.intp)
        if len(known) == 0:
            cause[:] = 1
            return joints, cause
        after = np.searchsorted(known, stamps, side='left')
        inside = after < len(known)
        hit = inside.copy()
        hit[inside] = known[after[inside]] == stamps[inside]
        cause[~inside] = 2
        cause[~hit & (after == 0)] = 1
        last = np.clip(after, 0, len(known) - 1)
        first = np.where(hit, last, np.clip(after - 1, 0, None))
        gap = known[last] - known[first]
        cause[(cause == 0) & (gap > self._max_gap_ns)] = 3
        step = values[last] - values[first]
        wrapped = self._revolute & (np.abs(step) > np.pi)  # a driver that counts within one turn
        step -= np.where(wrapped, 2.0 * np.pi * np.sign(step), 0.0)
        share = (stamps - known[first]) / np.maximum(gap, 1)
        good = cause == 0
        now = values[first] + share[:, None] * step
        joints[good] = np.concatenate([now, _approach(values, first, now)], axis=1)[good]
        return joints, cause

    def _settle(self) -> None:
        """Let the older half of the joint samples go after matching the poses of that time."""
        order = _unique_order(self._joints)
        self.dropped['joints: same stamp twice'] += self._joints.count - len(order)
        cut = len(order) // 2
        self.let_go += cut
        self._horizon_ns = int(self._joints.stamps[order[cut]])
        old = np.flatnonzero(
            (self._poses.stamps < self._horizon_ns) & np.isnan(self._poses.values[:, -1])
        )
        joints, cause = self._interpolate(order, self._poses.stamps[old])
        for k, text in enumerate(_CAUSES[1:], start=1):
            self.dropped[text] += int((cause == k).sum())
        self._poses.values[old, _POSE.stop :] = joints
        lost = np.zeros(self._poses.count, dtype=bool)
        lost[old[cause != 0]] = True
        self._poses.keep(np.flatnonzero(~lost))
        self._joints.keep(order[cut:])


def _approach(values: FloatArray, first: NDArray[np.intp], now: FloatArray) -> FloatArray:
    """Return the signs (N, n) of the last move of each joint before it stood as it does now.

    Looked for further and further back among the samples (M, n) before index `first` (N,).
    """
    signs = np.zeros_like(now)
    for back in (1, 4, 16, 64, 256, 1024, 4096):
        change = now - values[np.maximum(first - back, 0)]
        found = (signs == 0.0) & (np.abs(change) > STILL)
        signs[found] = np.sign(change[found])
    return signs


_POSITION, _QUAT, _COVARIANCE = slice(0, 3), slice(3, 7), slice(7, 43)
_HELD_OUT = 43
_POSE = slice(0, 44)
_CAUSES = (
    '',
    'poses: no joint sample before',
    'poses: no joint sample after',
    'poses: joint samples too far apart',
)


def _observations(stamps: NDArray[np.int64], joints: FloatArray, rows: FloatArray) -> Observations:
    """Turn rows of the pose buffer into observations."""
    oriented = ~np.isnan(rows[:, _QUAT.start])
    rotations = np.tile(np.eye(3), (len(rows), 1, 1))
    if oriented.any():
        rotations[oriented] = se3.from_quat(rows[oriented, _QUAT])
    covariance = rows[:, _COVARIANCE].reshape(-1, 6, 6)
    width = joints.shape[1] // 2
    return Observations(
        stamps,
        joints[:, :width].copy(),
        rows[:, _POSITION].copy(),
        rotations,
        oriented,
        None if np.isnan(covariance).all() else covariance.copy(),
        joints[:, width:].copy(),
    )
