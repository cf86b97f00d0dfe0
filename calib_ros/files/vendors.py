# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How vendors' own descriptions of the arm name its joints and place their frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import FloatArray


@dataclass(frozen=True)
class Vendor:
    """How a vendor's description names the joints and places their frames."""

    file: str
    joints: tuple[str, ...]  # suffixes of joint names in a chain or URDF
    keys: tuple[str, ...]  # their names in the file
    rolls: tuple[int, ...]  # of each frame about x of the one before, in quarter turns
    end: str | None = None  # fixed joint after the last, if in the file
    height: float = 0.0  # its end along the last axis [m]
    families: tuple[str, ...] = ('',)  # required in names, if the suffixes are common

    @property
    def all_keys(self) -> tuple[str, ...]:
        """Return the keys in the file, the end last."""
        return self.keys if self.end is None else (*self.keys, self.end)

    def describes(self, chain: Chain) -> bool:
        """Tell whether a chain has the joints of this vendor's arms."""
        names = chain.joint_names
        return (
            len(names) == len(self.joints)
            and all(map(str.endswith, names, self.joints))
            and any(family in names[0] for family in self.families)
            and all(joint.type == 'revolute' and joint.sign == 1 for joint in chain.joints)
        )

    def has_layout(self, places: FloatArray) -> bool:
        """Tell whether nominal origins (N, 4, 4) have this vendor's layout, except lengths.

        To 0.1 rad, since layouts differ by quarter turns, and to 0.01 m of the flange after the
        last axis: otherwise the table includes a tool.
        """
        rolls = np.zeros((len(self.rolls), 3))
        rolls[:, 0] = 0.5 * np.pi * np.array(self.rolls)
        off = np.swapaxes(se3.exp_rotation(rolls), 1, 2) @ places[:, :3, :3]
        turned = np.linalg.norm(se3.log_rotation(off), axis=1).max()
        end = [0.0, 0.0, self.height] if self.end else places[-1, :3, 3]
        shifted = np.linalg.norm(places[-1, :3, 3] - end)
        return bool(turned < 0.1 and shifted < 0.01)


WRISTS = ('wrist_1', 'wrist_2', 'wrist_3')
UR = Vendor(
    'ur_kinematics.yaml',
    tuple(f'{each}_joint' for each in ('shoulder_pan', 'shoulder_lift', 'elbow', *WRISTS)),
    ('shoulder', 'upper_arm', 'forearm', *WRISTS),
    (0, 1, 0, 0, 1, -1),
)
FRANKA = Vendor(
    'franka_kinematics.yaml',
    tuple(f'_joint{k}' for k in range(1, 8)),
    tuple(f'joint{k}' for k in range(1, 8)),
    (0, -1, 1, 1, -1, 1, 1, 0),
    'joint8',
    0.107,
    ('panda', 'fer', 'fr3', 'fp3'),
)
VENDOR_FILES = (UR.file, FRANKA.file)
