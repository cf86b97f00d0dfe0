# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The arms and limits of a correction, and its outcome."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from calib_ros.annotated import check_fields
from calib_ros.decision.region import Region
from calib_ros.errors import ConfigError
from calib_ros.kinematics.chain import Chain, refuse_other_joints
from calib_ros.kinematics.follower import Follower, Solution
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.settings import Limits, refuse_larger
from calib_ros.shown import Shown


@dataclass(frozen=True, eq=False, repr=False)
class Compensator(Shown, Limits):
    """The arm the controller assumes, the real arm, and the limits of a correction (`Limits`)."""

    nominal: Chain
    """The arm the controller assumes, with its joint limits."""
    calibrated: Chain
    """The identified arm. Base and tool frames of both are ignored."""
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Tool point [m] in the flange frame. It matters for arms that cannot reach every
    orientation, and for the reported errors."""
    region: Region | None = None
    """Where the calibration may be used; samples elsewhere are refused."""

    def __post_init__(self) -> None:
        check_fields(self)
        known = 'the nominal chain', self.nominal
        refuse_other_joints('the calibrated chain', self.calibrated, *known)
        if not (np.abs(self.tool) <= 5.0).all():
            raise ConfigError(f'tool must be within 5 m, not {self.tool}: 150 mm is 0.15')
        for item in fields(Limits):
            value = getattr(self, item.name)
            if value is not None and not 0.0 < value < np.inf:
                raise ConfigError(f'{item.name} must be a positive number, not {value}')
            refuse_larger(item.name, value or 0.0, item.metadata)

    @cached_property
    def follower(self) -> Follower:
        """Return the solver of the corrections."""
        return Follower(
            self.nominal, self.calibrated, self.tool, self.largest, self.orientation_weight
        )

    @property
    def largest(self) -> FloatArray:
        """Return the largest correction (n,) of each joint [rad or m]."""
        sizes = {'revolute': self.largest_turn, 'prismatic': self.largest_shift}
        return np.array([sizes[joint.type] for joint in self.nominal.joints])


@dataclass(frozen=True)
class Refusal:
    """A sample that cannot be corrected, and why."""

    sample: int
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class Compensation(Solution):
    """Corrected joint commands, their remaining errors (`Solution`), and refusals."""

    command: FloatArray
    """(N, n) joint values [rad or m] before correction."""
    joints: FloatArray
    """(N, n) the corrected ones; NaN in refused samples."""
    approach: FloatArray | None = None
    """(N, n) signs of the moves to these."""
    refusals: tuple[Refusal, ...] = ()
    """In the order of the samples."""

    @property
    def correction(self) -> FloatArray:
        """Return the change of the command (N, n)."""
        return self.joints - self.command
