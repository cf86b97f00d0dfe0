# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Observations: matched pairs of joint values and measurements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.annotated import as_annotated, check_fields
from calib_ros.errors import InputError
from calib_ros.estimation.configurations import configurations, renumber, stops
from calib_ros.kinematics import se3
from calib_ros.kinematics.se3 import Flags, FloatArray, Index
from calib_ros.shown import Shown

_SHAPES: dict[str, tuple[int | None, ...]] = {
    **dict.fromkeys(('stamps_ns', 'oriented', 'distances', 'delay'), ()),
    **dict.fromkeys(('joints', 'approach', 'velocity', 'acceleration'), (None,)),
    **dict.fromkeys(('positions', 'points'), (3,)),
    'rotations': (3, 3),
    **dict.fromkeys(('covariance', 'punctual'), (6, 6)),
    'pixels': (2,),
}
"""Shapes per pair; None for the number of joints."""
NO_ROTATION = 0.05
"""Largest deviation of R^T R from the identity for a rotation: two digits leave 0.02."""
SOME_POSES = 200
"""Sample size by convention: random poses for the joint range, even ones for the measured poses.
Other counts are multiples."""


@dataclass(frozen=True, eq=False, repr=False)
class Observations(Shown):
    """N matched pairs of joint values and measured poses, in stamp order."""

    stamps_ns: NDArray[np.int64]
    joints: FloatArray
    """(N, n) [rad or m]."""
    positions: FloatArray
    rotations: FloatArray
    """(N, 3) [m] and (N, 3, 3) of the target in the measuring device's frame, the world."""
    oriented: Flags
    """(N,) where the orientation was measured; elsewhere the rotation is the identity."""
    covariance: FloatArray | None = None
    """(N, 6, 6) of x, y, z [m] and the rotation about the world's x, y, z axes [rad], as in
    PoseWithCovariance; NaN rows where unknown."""
    approach: FloatArray | None = None
    """(N, n) signs of the velocities with which the joints reached their values, for backlash; by
    default those of `velocity`."""
    distances: FloatArray | None = None
    """(N,) [m] from the origin of the world to the target, for draw-wires and ball-bars.
    Positions and rotations are then ignored."""
    velocity: FloatArray | None = None
    acceleration: FloatArray | None = None
    """(N, n) of the joints, if the arm was moving when measured."""
    delay: FloatArray | None = None
    """(N,) [s] before the stamps at which the joints had these values."""
    punctual: FloatArray | None = None
    """(N, 6, 6) matrices that leave of errors what no stamp early or late at random explains; they
    also leave that part of `covariance`, which holds both."""
    base: str = 'base'
    tool: str = 'tool'
    """Frames of the chain for these pairs: names that begin with base, and with tool."""
    socket: bool = False
    """The target is a ball in a socket at an unknown place: the origin of the world, whose axes
    are parallel to the arm's base."""
    inverse: bool = False
    """The poses are inverted: a fixed target was measured by a camera on the flange."""
    pixels: FloatArray | None = None
    points: FloatArray | None = None
    """(N, 2) [px] and (N, 3) [m]: points of a board in images, one a row, with the place in the
    image and in the board frame. Rows of one image are consecutive and share stamp and joint
    values. Positions and rotations are then ignored. Points alone are one fixed point, the origin
    of the world, in the frame of a camera on the flange; positions are then zero."""
    on_flange: bool = False
    """The camera is on the flange, at `tool`, and the board is the world. Otherwise the camera is
    the world and the board is at `tool`."""
    plane: bool = False
    """The distances are heights over the plane z = 0 of the world, zero where touched."""

    def __post_init__(self) -> None:
        check_fields(self)
        if not (self.base.startswith('base') and self.tool.startswith('tool')):
            ends = f'"{self.base:.100}" and "{self.tool:.100}"'
            raise InputError(f'the names of frames begin with base and tool, not as {ends}')
        if self.plane and self.distances is None:
            raise InputError('a plane needs the heights over it as distances, zero where touched')
        if self.pixels is not None and self.points is None:
            raise InputError('pixels need the board points they show')
        if self.seen and not self.inverse:
            raise InputError('points need their pixels; of a camera on the flange use inverted()')
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
        if self.approach is None and self.velocity is not None:
            object.__setattr__(self, 'approach', np.sign(self.velocity))

    def _arrays(self) -> dict[str, NDArray[Any]]:
        arrays = {name: getattr(self, name) for name in _SHAPES}
        return {name: array for name, array in arrays.items() if array is not None}

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @classmethod
    @as_annotated
    def from_arrays(
        cls, joints: FloatArray, positions: FloatArray, rotations: FloatArray | None = None
    ) -> Observations:
        """Make observations of joint values (N, n) [rad or m] and positions (N, 3) [m].

        With `rotations` (N, 3, 3) they are poses. Masked values count as missing.

        Raises InputError for arrays that are not numeric, have another shape, or are not
        rotations.
        """
        joints, positions = joints.copy(), positions.copy()
        if joints.ndim != 2:
            raise InputError(f'joints must have the shape (N, n), not {joints.shape}')
        count, oriented = len(joints), rotations is not None
        plain = np.broadcast_to(np.eye(3), (count, 3, 3))
        turns = plain if rotations is None else rotations.copy()
        stamps = np.arange(1, count + 1, dtype=np.int64) * 1_000_000_000
        found = cls(stamps, joints, positions, turns, np.full(count, oriented))
        if oriented:
            _refuse_other_than_rotations(turns)
        return found

    @classmethod
    @as_annotated
    def from_pixels(
        cls,
        joints: FloatArray,
        pixels: FloatArray,
        points: FloatArray,
        images: Index,
        on_flange: bool = False,
    ) -> Observations:
        """Make observations of board `points` (N, 3) [m] at `pixels` (N, 2).

        `images` (N,) numbers the image of each row, `joints` (N, n) are the joint values at that
        image.
        """
        plain = cls.from_arrays(joints, np.broadcast_to(np.zeros(3), (len(joints), 3)))
        stamps = (images.astype(np.int64) + 1) * 1_000_000_000
        return replace(
            plain,
            stamps_ns=stamps,
            pixels=pixels.copy(),
            points=points.copy(),
            on_flange=on_flange,
        )

    @classmethod
    @as_annotated
    def touching(cls, joints: FloatArray, base: str = 'base', tool: str = 'tool') -> Observations:
        """Make observations of a point touching one plane, at joint values (N, n)."""
        heights = np.zeros(len(joints))
        plain = cls.from_arrays(joints, np.zeros((len(joints), 3)))
        return replace(plain, distances=heights, plane=True, base=base, tool=tool)

    def changed(self, **values: Any) -> Observations:
        """Return the pairs with other values of some fields, unchecked."""
        found, known = object.__new__(Observations), vars(self)
        vars(found).update({name: known[name] for name in self.__dataclass_fields__} | values)
        return found

    def select(self, mask: NDArray[np.generic] | slice) -> Observations:
        """Return the pairs of a mask (N,), indices (K,) or a slice, unchecked."""
        chosen = self.changed()
        count = len(self.stamps_ns[mask])
        for name, array in self._arrays().items():
            alike = array.strides[0] == 0  # keep broadcast arrays so
            few = np.broadcast_to(array[:1], (count, *array.shape[1:])) if alike else array[mask]
            vars(chosen)[name] = few
        if 'configurations' in vars(self):  # slow to compute
            vars(chosen)['configurations'] = renumber(self.configurations[mask])
        return chosen

    def spread(self, most: int = SOME_POSES) -> Observations:
        """Return evenly spread pairs, at most `most`."""
        stride = -(-len(self) // most)
        return self if stride < 2 else self.select(np.arange(0, len(self), stride))

    def without_orientations(self) -> Observations:
        """Return the observations as of positions alone."""
        return replace(self, oriented=np.zeros_like(self.oriented))

    def some_images(self) -> Observations:
        """Return evenly spread images with all their rows, at most SOME_POSES."""
        stride = -(-(int(self.images[-1]) + 1) // SOME_POSES)
        return self.select(self.images % stride == 0)

    def inverted(self, sigmas: tuple[float, float] | None = None) -> Observations:
        """Return the inverted poses, for a camera on the flange that sees a fixed target.

        The pose of the target in the camera becomes the pose of the camera in the target frame,
        the new world. Covariances are transformed too. `sigmas` (position [m], orientation [rad])
        replace missing ones, because the uncertainty of the inverse includes the orientation's
        sigma times the distance. Positions alone become points in the frame of the camera.
        """
        mixed = self.oriented.any() > self.oriented.all()
        if mixed or self.socket or self.distances is not None:
            raise InputError(
                'one camera on the flange measures either poses or positions, no distances or '
                'sockets, all with an orientation (qx qy qz qw) or none: leave out the others, or '
                'give them another device'
            )
        if not self.oriented.all():
            given, points = self.points, None
            if given is None:
                given, points = np.zeros_like(self.positions), self.positions
            return replace(self, positions=given, points=points, inverse=not self.inverse)
        turned = np.swapaxes(self.rotations, 1, 2)
        positions = -np.einsum('nij,nj->ni', turned, self.positions)
        covariance = self.covariance if sigmas is None else self.covariances(sigmas)
        if covariance is not None:
            lever, none = turned @ se3.skew(self.positions), np.zeros_like(turned)
            jacobian = -np.block([[turned, lever], [none, turned]])
            covariance = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        return replace(
            self,
            positions=positions,
            rotations=turned,
            covariance=covariance,
            inverse=not self.inverse,
        )

    def covariances(self, sigmas: tuple[float, float]) -> FloatArray:
        """Return the covariances (N, 6, 6), from `sigmas` [m, rad] where missing.

        A covariance with zeros for the rotation is that of the position alone.
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
        """Return the pairs with other stamps (N,)."""
        return replace(self, stamps_ns=stamps_ns)

    def earlier(self, delay: float | FloatArray | None) -> Observations:
        """Return the measurements with the joint values a delay [s] (N,) before the stamps.

        By velocity and acceleration; without them the arm was at rest and nothing changes.
        Unchecked: the solver asks for it again and again.
        """
        if self.velocity is None or delay is None:
            return self
        delays = np.full(len(self), delay, dtype=float)
        more = (delays if self.delay is None else delays - self.delay)[:, np.newaxis]
        if not more.any():
            return self
        velocity, joints = self.velocity, self.joints - more * self.velocity
        if self.acceleration is not None:
            joints = joints + 0.5 * more**2 * self.acceleration
            velocity = velocity - more * self.acceleration
        return self.changed(joints=joints, velocity=velocity, delay=delays)

    @property
    def given(self) -> FloatArray:
        """Return the positions (N, 3) [m] as the device gave them, on the flange too."""
        return (self.inverted() if self.inverse else self).positions

    @property
    def seen(self) -> bool:
        """Tell whether the positions are of a fixed point, seen by a camera on the flange."""
        return self.points is not None and self.pixels is None

    @property
    def of_wire(self) -> bool:
        """Tell whether they are distances to the origin of the world, as of a draw-wire."""
        return self.distances is not None and not self.plane

    @property
    def turned(self) -> bool:
        """Tell whether orientations were measured, or show in images."""
        return self.pixels is not None or bool(self.oriented.any())

    @property
    def width(self) -> int:
        """Return the number of equations of one configuration."""
        return 1 if self.distances is not None else 6 if self.turned else 3

    @property
    def ways(self) -> FloatArray:
        """Return in how many of the three directions each error (N,) was measured."""
        return np.full(len(self), 3.0 if self.distances is None else 1.0)

    @property
    def moving(self) -> bool:
        """Tell whether the arm moved while it was measured, so that a delay matters."""
        return self.velocity is not None and bool(self.velocity.any())

    def between(self, names: Mapping[str, str]) -> Observations:
        """Return them with their base and tool renamed; names that are not given stay."""
        base, tool = (names.get(name, name) for name in (self.base, self.tool))
        return replace(self, base=base, tool=tool)

    @property
    def camera(self) -> str:
        """Return the frame of the camera."""
        return self.tool if self.on_flange else self.base

    @cached_property
    def images(self) -> Index:
        """Return the image number (N,) of each row of pixels."""
        other = np.zeros(len(self), dtype=np.intp)
        other[1:] = np.diff(self.stamps_ns) != 0
        other[1:] |= (np.diff(self.joints, axis=0) != 0.0).any(axis=1)
        return np.cumsum(other)

    @cached_property
    def configurations(self) -> Index:
        """Return the configuration number (N,) of each pair."""
        return configurations(self.joints, self.stops)

    @cached_property
    def by_joint(self) -> tuple[FloatArray, FloatArray]:
        """Return joint values (n, N), and their cosines and sines (2, n, N), for the solver."""
        rows = np.ascontiguousarray(self.joints.T)
        return rows, np.array(se3.cos_sin(rows))

    @cached_property
    def stops(self) -> Index:
        """Return the stop number (N,) of each pair, in sequence."""
        return stops(self.joints)


def _refuse_other_than_rotations(turns: FloatArray) -> None:
    square = np.einsum('nij,nik->njk', turns, turns)
    wrong = np.abs(square - np.eye(3)).max(axis=(1, 2), initial=0.0) > NO_ROTATION
    wrong |= np.linalg.det(turns) < 0.0
    if wrong.any():
        k = int(wrong.argmax())
        what = 'left-handed' if np.linalg.det(turns[k]) < 0.0 else 'not orthogonal'
        raise InputError(
            f'the rotation of pair {k} (counted from 0) is {what}: {np.count_nonzero(wrong)} of '
            f'{len(turns)} are not rotation matrices'
        )
