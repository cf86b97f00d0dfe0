# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observations: matched pairs of joint values and measurements, and their configurations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from calib_ros.errors import InputError
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown

_SHAPES: dict[str, tuple[int | None, ...]] = {
    'stamps_ns': (),
    'joints': (None,),
    'positions': (3,),
    'rotations': (3, 3),
    'oriented': (),
    'covariance': (6, 6),
    'approach': (None,),
    'distances': (),
    'velocity': (None,),
    'acceleration': (None,),
    'delay': (),
    'pixels': (2,),
    'points': (3,),
}
"""Shapes of a pair's share of each array; None for the number of joints."""
STILL = 1e-3
"""Joint values [rad or m] that differ by less are one configuration."""
SCATTER = 0.02
"""Distance [rad or m] up to which visits of one configuration may scatter."""
GAP = 5.0
"""Ratio of the distance of configurations to that of the visits of one."""
WIDEST = 2.0
"""Size of a configuration's visits in units of the longest step between them."""
FEWEST = 8
"""Configurations from which on their distances tell what a visit is, or who is near; so many
nearest ones are looked at."""

POSES = 200
"""Poses that stand for many: random ones for the joint range, even ones for those measured."""


@dataclass(frozen=True, eq=False, repr=False)
class Observations(Shown):
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
    plane : bool
        The distances are heights over the plane z = 0 of the world: zero where it was touched.
    velocity, acceleration : (N, n), optional
        Of the joints, where the arm was moving when it was measured.
    delay : (N,), optional
        How much earlier than the stamps the joints had these values [s].
    base, tool : str
        Frames of the chain that hold for these pairs.
    socket : bool
        The target, a ball, sat in a socket of unknown place: it was at the origin of the world all
        the time, and the world's axes are those of the arm's base.
    inverse : bool
        The poses were the other way round before: of a fixed target in a camera on the flange.
    pixels, points : (N, 2), (N, 3), optional
        Points of a board as a camera saw them: a row for each point, with its place in the image
        and in the frame of the board [m]. Rows of one image follow each other and share stamp and
        joint values. Positions and rotations count for nothing then.
    on_flange : bool
        The camera is on the flange, at `tool`, and the board is the world. Else the camera is the
        world and the board is at `tool`.

    """

    stamps_ns: NDArray[np.int64]
    joints: FloatArray
    positions: FloatArray
    rotations: FloatArray
    oriented: NDArray[np.bool_]
    covariance: FloatArray | None = None
    approach: FloatArray | None = None
    distances: FloatArray | None = None
    velocity: FloatArray | None = None
    acceleration: FloatArray | None = None
    delay: FloatArray | None = None
    base: str = 'base'
    tool: str = 'tool'
    socket: bool = False
    inverse: bool = False
    pixels: FloatArray | None = None
    points: FloatArray | None = None
    on_flange: bool = False
    plane: bool = False

    def __post_init__(self) -> None:
        """Check that the arrays fit together and hold only numbers."""
        if self.plane and self.distances is None:
            raise InputError('a plane needs the heights over it as distances, zero where touched')
        if (self.pixels is None) != (self.points is None):
            raise InputError('pixels need the points of the board that they show, and points them')
        count, joints = len(self.stamps_ns), self.joints.shape[-1]
        for name, array in self._arrays().items():
            shape = (count, *(joints if size is None else size for size in _SHAPES[name]))
            if array.shape != shape:
                raise InputError(
                    f'{name} of {count} observations must have the shape {shape}, not '
                    f'{array.shape}'
                )
            if name != 'covariance' and not np.isfinite(array).all():
                raise InputError(f'{name} of the observations hold NaN or infinite values')

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that there are, a row each pair."""
        arrays = {name: getattr(self, name) for name in _SHAPES}
        return {name: array for name, array in arrays.items() if array is not None}

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

    @classmethod
    def from_pixels(
        cls,
        joints: FloatArray,
        pixels: FloatArray,
        points: FloatArray,
        images: NDArray[np.intp],
        on_flange: bool = False,
    ) -> Observations:
        """Make observations (N) of a board: `images` (N,) numbers the image of each row.

        The joint values (N, n) are those of the image, the `points` (N, 3) [m] those of the board
        that are seen at `pixels` (N, 2).
        """
        plain = cls.from_arrays(joints, np.zeros((len(joints), 3)))
        stamps = (np.asarray(images, dtype=np.int64) + 1) * 1_000_000_000
        return replace(
            plain,
            stamps_ns=stamps,
            pixels=np.asarray(pixels, dtype=np.float64),
            points=np.asarray(points, dtype=np.float64),
            on_flange=on_flange,
        )

    @classmethod
    def touching(cls, joints: FloatArray, base: str = 'base', tool: str = 'tool') -> Observations:
        """Make observations (N) of a point at the tool that touched one plane."""
        plain = cls.from_arrays(joints, np.zeros((len(joints), 3)))
        heights = np.zeros(len(joints))
        return replace(plain, distances=heights, plane=True, base=base, tool=tool)

    def select(self, mask: NDArray[np.generic] | slice) -> Observations:
        """Return the pairs chosen by a mask, by indices or a slice; they have been checked."""
        chosen = object.__new__(Observations)
        vars(chosen).update({name: vars(self)[name] for name in self.__dataclass_fields__})
        vars(chosen).update({name: array[mask] for name, array in self._arrays().items()})
        if 'configurations' in vars(self):  # takes longer to find than all the rest
            _, vars(chosen)['configurations'] = np.unique(
                self.configurations[mask], return_inverse=True
            )
        return chosen

    def spread(self, most: int = POSES) -> Observations:
        """Return every so many pairs, at most so many."""
        step = 1 + len(self) // most
        return self if step == 1 else self.select(np.arange(0, len(self), step))

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
        covariance = self.covariance if sigmas is None else self.covariances(sigmas)
        if covariance is not None:
            jacobian = np.zeros((len(self), 6, 6))
            jacobian[:, :3, :3] = -turned
            jacobian[:, :3, 3:] = -turned @ se3.skew(self.positions)
            jacobian[:, 3:, 3:] = -turned
            covariance = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        return replace(
            self,
            positions=positions,
            rotations=turned,
            covariance=covariance,
            inverse=not self.inverse,
        )

    def covariances(self, sigmas: tuple[float, float]) -> FloatArray:
        """Return (N, 6, 6) the covariances, by `sigmas` [m, rad] where a measurement brought none.

        One that is zero in all that concerns the rotation is that of the position alone.
        """
        given = np.diag(np.repeat(np.square(sigmas), 3))
        found = np.tile(given, (len(self), 1, 1))
        if self.covariance is not None:
            own = ~np.isnan(self.covariance[:, 0, 0])
            found[own] = self.covariance[own]
            position_only = ~found[:, 3:].any(axis=(1, 2))
            found[position_only, 3:, 3:] = given[3:, 3:]
        return found

    def at(self, stamps_ns: NDArray[np.int64]) -> Observations:
        """Return the same pairs with other stamps (N,)."""
        return replace(self, stamps_ns=stamps_ns)

    def earlier(self, delay: float) -> Observations:
        """Return the same measurements with the joint values of a delay [s] before the stamps.

        By velocity and acceleration; without them the arm stood and nothing changes.
        """
        if self.velocity is None:
            return self
        more = np.full((len(self), 1), delay)
        if self.delay is not None:
            more -= self.delay[:, np.newaxis]
        if not more.any():
            return self
        velocity, joints = self.velocity, self.joints - more * self.velocity
        if self.acceleration is not None:
            joints = joints + 0.5 * more**2 * self.acceleration
            velocity = velocity - more * self.acceleration
        return replace(
            self, joints=joints, velocity=velocity, delay=np.full(len(self), float(delay))
        )

    @property
    def camera(self) -> str:
        """Return the frame of the camera that saw the pixels."""
        return self.tool if self.on_flange else self.base

    @cached_property
    def images(self) -> NDArray[np.intp]:
        """Return (N,) the number of the image that each row of pixels is from."""
        if not len(self):
            return np.zeros(0, dtype=np.intp)
        other = np.diff(self.stamps_ns) != 0
        other |= (np.diff(self.joints, axis=0) != 0.0).any(axis=1)
        return np.concatenate([[0], np.cumsum(other)]).astype(np.intp)

    @cached_property
    def configurations(self) -> NDArray[np.intp]:
        """Return (N,) the number of the standing configuration that each pair belongs to."""
        return configurations(self.joints)

    @cached_property
    def stops(self) -> NDArray[np.intp]:
        """Return (N,) the number of the stop, in sequence, at which each pair was taken."""
        return stops(self.joints)


def distinct(numbers: NDArray[np.intp]) -> int:
    """Return how many different numbers (N,) of configurations there are."""
    return int(np.count_nonzero(np.bincount(numbers)))


def stops(joints: FloatArray) -> NDArray[np.intp]:
    """Return (N,) the number of the stop at which joint values (N, n) in sequence were taken."""
    if len(joints) == 0:
        return np.zeros(0, dtype=np.intp)
    return np.append(0, np.cumsum(~_still(np.diff(joints, axis=0)))).astype(np.intp)


def _still(change: FloatArray) -> NDArray[np.bool_]:
    """Return (N,) which changes (N, n) of joint values are none; angles modulo a turn."""
    change = np.abs(change) % (2.0 * np.pi)
    return np.asarray(np.minimum(change, 2.0 * np.pi - change).max(axis=1) <= STILL)


def configurations(joints: FloatArray) -> NDArray[np.intp]:
    """Return (N,) the number of the configuration that joint values (N, n) belong to.

    Values within STILL of each other are one configuration, whenever they were taken: a program
    that runs in a loop visits it again, it does not measure another one. So are those that lie
    as close together beside their distance from all others. Angles count modulo a full turn.
    """
    if len(joints) == 0:
        return np.zeros(0, dtype=np.intp)
    number = stops(joints)
    standing = joints[np.flatnonzero(np.diff(number, prepend=-1))]  # one row a stop
    place = np.concatenate([np.cos(standing), np.sin(standing)], axis=1)  # which knows no turns
    near, label = _near(standing, place), np.arange(len(standing))
    if len(near):
        links = _graph(np.ones(len(near)), near[:, 0], near[:, 1], len(standing))
        _, label = connected_components(links, directed=False)
    _, first = np.unique(label, return_index=True)
    return np.asarray(_repeats(place[first])[label[number]], dtype=np.intp)


def numbered(sets: Sequence[Observations]) -> tuple[NDArray[np.intp], ...]:
    """Return the numbers (N,) of the configurations of each set, counted over all of them.

    What several targets or sessions show of one configuration has its number in common.
    """
    if len(sets) == 1:
        return (sets[0].configurations,)
    numbers = configurations(np.concatenate([each.joints for each in sets]))
    return tuple(np.split(numbers, np.cumsum([len(each) for each in sets])[:-1]))


def _repeats(place: FloatArray) -> NDArray[np.intp]:
    """Return (N,) which places (N, 2 n) are visits of one configuration that scatter.

    Where the distances of nearest values leave a gap, from so much to GAP times as much, those
    below it are visits, as long as each configuration is as small as they are.
    """
    count = len(place)
    apart = np.arange(count)
    if count < FEWEST or not len(_pairs(place, SCATTER)):
        return apart
    far, near = cKDTree(place).query(
        place, k=range(2, 2 + min(FEWEST, count - 1)), distance_upper_bound=GAP * SCATTER
    )
    first, which = np.nonzero(np.isfinite(far))
    graph = _graph(far[first, which], first, near[first, which], count)
    tree = minimum_spanning_tree(graph).tocoo()
    lengths = np.append(np.sort(tree.data), GAP * SCATTER)
    gaps = np.flatnonzero((lengths[1:] >= GAP * lengths[:-1]) & (lengths[:-1] <= SCATTER))
    for reach in lengths[gaps[::-1]]:
        close = tree.data <= reach
        links = _graph(tree.data[close], tree.row[close], tree.col[close], count)
        number, label = connected_components(links, directed=False)
        middle = np.stack([np.bincount(label, row) for row in place.T]) / np.bincount(label)
        extent = np.linalg.norm(place - middle.T[label], axis=1).max()
        if number >= FEWEST and extent <= WIDEST * reach:
            return np.asarray(label, dtype=np.intp)
    return apart


def _graph(
    lengths: FloatArray, first: NDArray[np.integer], second: NDArray[np.integer], count: int
) -> coo_array:
    """Return edges (K,) between nodes, whose numbers scipy 1.11 wants in 32 bits."""
    ends = (first.astype(np.int32), second.astype(np.int32))
    return coo_array((lengths, ends), shape=(count, count))


def _near(joints: FloatArray, place: FloatArray) -> NDArray[np.intp]:
    """Return (K, 2) the rows of (N, n), at places (N, 2 n), within STILL of each other."""
    pairs = _pairs(place, STILL * joints.shape[1] ** 0.5)
    return np.asarray(pairs[_still(joints[pairs[:, 0]] - joints[pairs[:, 1]])])


def _pairs(place: FloatArray, reach: float) -> NDArray[np.intp]:
    """Return (K, 2) the rows of (N, D) that are no further apart than a reach.

    In a projection on three directions they are as near; trees of more dimensions are slow.
    """
    along = place @ _directions(place.shape[1])
    tree = cKDTree(along, balanced_tree=False, compact_nodes=False)
    pairs = tree.query_pairs(reach, output_type='ndarray')
    close = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1) <= reach
    return np.asarray(pairs[close])


@lru_cache
def _directions(size: int) -> FloatArray:
    """Return (D, 3 at most) orthonormal directions, seeded."""
    return np.linalg.qr(np.random.default_rng(0).normal(size=(size, min(size, 3))))[0]
