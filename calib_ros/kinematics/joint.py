# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parts of a chain: rows of the DH table, and constant frames at its ends."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal, TypeAlias, get_args

import numpy as np

from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.kinematics import se3
from calib_ros.kinematics.lens import Lens
from calib_ros.kinematics.parameter import (
    DELAY,
    FRAME_KINDS,
    LENS_KINDS,
    ROW_KINDS,
    Parameter,
    parameters_of,
)
from calib_ros.kinematics.se3 import FloatArray

JointType: TypeAlias = Literal['revolute', 'prismatic']


@dataclass(frozen=True)
class Joint:
    """One row of the DH table: lengths in m, angles in rad, limits in rad or m.

    `mass` [kg] and `com` [m], its centre in the frame at the link's end, serve compliance only;
    `gear_ratio` (motor turns per joint turn, 0 if unknown) serves gear harmonics.
    """

    name: str
    type: JointType = 'revolute'
    a: float = 0.0
    alpha: float = 0.0
    d: float = 0.0
    theta: float = 0.0
    beta: float = 0.0
    sign: int = 1
    lower: float | None = None
    upper: float | None = None
    mass: float = 0.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gear_ratio: float = 0.0
    b: float = 0.0

    def __post_init__(self) -> None:
        if not self.name or '.' in self.name:
            raise ConfigError(f'a joint needs a name without dots, not "{self.name}"')
        if self.type not in get_args(JointType):
            raise UnknownNameError(f'joint "{self.name}": type', self.type, get_args(JointType))
        if self.sign not in (1, -1):
            raise ConfigError(f'sign of joint "{self.name}" must be 1 or -1, not {self.sign}')
        for kind in ROW_KINDS:
            if not math.isfinite(getattr(self, kind)):
                raise ConfigError(f'{kind} of joint "{self.name}" must be a finite number')
        if self.lower is not None and self.upper is not None and not self.lower <= self.upper:
            raise ConfigError(
                f'limits of joint "{self.name}": lower {self.lower} must not exceed upper '
                f'{self.upper}'
            )

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Return the joint's Denavit-Hartenberg parameters, in the order of ROW_KINDS."""
        return parameters_of(self.name, ROW_KINDS)

    @cached_property
    def driven(self) -> Parameter:
        """Return the parameter that the joint's value is added to."""
        return Parameter(self.name, 'theta' if self.type == 'revolute' else 'd')

    @property
    def tilt(self) -> float:
        """Return the sine of the angle between the two axes that the row connects."""
        return math.hypot(math.sin(self.alpha) * math.cos(self.beta), math.sin(self.beta))

    @property
    def apart(self) -> float:
        """Return how far apart [m] these axes are."""
        return math.hypot(self.a, self.b)

    @property
    def guessed(self) -> bool:
        """Tell whether `range` is only a guess: of a linear joint without one of its limits."""
        return self.type == 'prismatic' and None in (self.lower, self.upper)

    @property
    def range(self) -> tuple[float, float]:
        """Return the limits [rad or m], by default +-180 degrees or +-0.5 m."""
        reach = np.pi if self.type == 'revolute' else 0.5
        lower, upper = self.lower, self.upper
        if lower is None:
            lower = -reach if upper is None else min(-reach, upper - 2.0 * reach)
        return lower, max(reach, lower + 2.0 * reach) if upper is None else upper


@dataclass(frozen=True, eq=False)
class Frame:
    """A constant transform (4, 4); `fixed` if it is known and must not be fitted.

    `delay` [s] is the delay of the stamps of the device at a base frame after the joints'; None if
    the arm stood. `lens` belongs to a camera there.
    """

    matrix: FloatArray = field(default_factory=lambda: np.eye(4))
    fixed: bool = False
    delay: float | None = None
    lens: Lens | None = None

    def moved(self, offsets: Mapping[str, float]) -> Frame:
        """Return the frame shifted by x, y, z [m] and turned by rx, ry, rz [rad].

        Along and about the axes of the frame's parent (world for the base, flange for the tool),
        turned through the frame's own origin.
        """
        matrix = self.matrix.copy()
        matrix[:3, 3] += [offsets.get(kind, 0.0) for kind in FRAME_KINDS[:3]]
        turn = [offsets.get(kind, 0.0) for kind in FRAME_KINDS[3:]]
        if any(turn):
            matrix[:3, :3] = se3.turned(*turn) @ matrix[:3, :3]
        later = (self.delay or 0.0) + offsets[DELAY] if DELAY in offsets else self.delay
        seen = {kind: offsets[kind] for kind in LENS_KINDS if kind in offsets}
        return Frame(matrix, self.fixed, later, self.lens and self.lens.moved(seen))

    def offsets(self, reference: Frame | None = None) -> FloatArray:
        """Return the move (6,) from `reference`: x, y, z [m] and a rotation vector [rad]."""
        return _move(self, reference or ANYWHERE)


def small_units(joints: Iterable[Joint]) -> str:
    """Return in which unit small errors of joint values are told: mm, mrad, or either."""
    return ' or '.join(sorted({f'm{joint.driven.unit}' for joint in joints}))


@lru_cache(maxsize=16)
def _move(frame: Frame, start: Frame) -> FloatArray:  # asked for by each of its parameters
    turn = se3.log_rotation(frame.matrix[:3, :3] @ start.matrix[:3, :3].T)
    found = np.concatenate([frame.matrix[:3, 3] - start.matrix[:3, 3], turn])
    found.setflags(write=False)
    return found


ANYWHERE = Frame()
