# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Kinematics files for vendors' own descriptions of the arm.

    ur_kinematics.yaml      kinematics_params_file of ur_description and the UR driver
    franka_kinematics.yaml  kinematics.yaml of a robot of franka_description

Both hold x y z roll pitch yaw for each joint: the origin of a frame that turns about its z, in the
frame of the joint before. The position of a frame along its axis and its rotation about it do not
matter to the arm, but to everything drawn in it. The frames are those of the URDF if given, else
those of the nominal table in the modified convention, which are the vendors'. Arms with another
layout get no file.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from calib_ros.errors import ConfigError
from calib_ros.files import export
from calib_ros.files.vendors import FRANKA, UR, Vendor
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.corrected_urdf import corrected_urdf
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.kinematics.urdf import chain_from_urdf
from calib_ros.kinematics.urdf_reader import parse_urdf
from calib_ros.texts import dump_yaml, parse_yaml
from calib_ros.values import SAME


def vendor_files(
    chain: Chain,
    nominal: Chain,
    origin: Mapping[str, Any] | None = None,
    urdf: str = '',
    links: Mapping[str, str | None] | None = None,
    checksum: str = '',
) -> tuple[export.Export, ...]:
    """Return a corrected chain as files of the vendor with its joint names, if any.

    `origin` is recorded. Frames are those of the nominal `urdf`, if given, which has the chain
    between `links` (`base_link`, `tip_link`). `checksum` is that of the factory calibration of a
    Universal Robots arm, which identifies the robot to its driver: by default a hash of the
    numbers, which the driver reports as a mismatch and accepts.
    """
    if checksum and not re.fullmatch(r'calib_\d+', checksum):
        raise ConfigError(
            f'"{checksum}" is not a Universal Robots checksum: give calib_ and digits, as its '
            'driver prints them at the start'
        )
    found = []
    for vendor in (UR, FRANKA):
        if not vendor.describes(nominal):
            continue
        arm = replace(chain, effects=(), frames=())
        if vendor.end is None and arm.convention == 'standard':
            # the last frame is on the last axis, the rest belongs to the tool
            before, last = nominal.joints[-1], arm.joints[-1]
            last = replace(last, **{name: getattr(before, name) for name in export.TAIL})
            arm = replace(arm, joints=(*arm.joints[:-1], last))
        layouts = [_layout(vendor, each, urdf, links or {}) for each in (nominal, arm)]
        if layouts[0] is None or layouts[1] is None or not vendor.has_layout(layouts[0][0]):
            continue
        places, reference = layouts[1]
        q = export.anywhere(chain)
        lost = export.distance(chain, arm, q)
        text = export.head(chain, 'kinematics', lost)
        text += _document(vendor, places, origin, checksum)
        again = forward_of_vendor(text, vendor, q)
        found.append(export.checked(vendor.file, text, again, reference.forward(q), lost))
    return tuple(found)


def forward_of_vendor(text: str, vendor: Vendor, q: FloatArray) -> FloatArray:
    """Return the poses (N, 4, 4) of a file's last frame in the frame of its first joint."""
    document = parse_yaml(text, vendor.file)
    poses = document['kinematics'] if vendor is UR else document
    entries = [poses[key] if vendor is UR else poses[key]['kinematic'] for key in vendor.all_keys]
    places = [export.pose_matrix(entry) for entry in entries]
    pose = export.walked(places[: len(vendor.keys)], q)
    return pose if vendor.end is None else pose @ places[-1]


def _document(
    vendor: Vendor, places: FloatArray, origin: Mapping[str, Any] | None, checksum: str
) -> str:
    poses = {k: export.xyz_rpy(place) for k, place in zip(vendor.all_keys, places, strict=True)}
    if vendor is UR:
        number = int(hashlib.sha256(dump_yaml(poses).encode()).hexdigest()[:16], 16)
        document: dict[str, Any] = {'kinematics': {**poses, 'hash': checksum or f'calib_{number}'}}
    else:
        document = {key: {'kinematic': pose} for key, pose in poses.items()}
    return export.labelled(document, origin)


def _layout(
    vendor: Vendor, arm: Chain, urdf: str, links: Mapping[str, str | None]
) -> tuple[FloatArray, Chain] | None:
    """Return the origins of a file for an arm, and a chain between its first and last frame."""
    if urdf:
        return _layout_of_urdf(vendor, arm.joint_names, corrected_urdf(urdf, arm, **links))
    arm = replace(arm, base=Frame(), tool=Frame())
    form = export.converted(arm, 'modified')
    places = export.origins(form)
    if vendor.end is None:  # the table's flange is the last frame
        return (places[:-1], arm) if np.allclose(places[-1], np.eye(4), atol=SAME) else None
    # the vendor has d of the last joint after it
    last = form.joints[-1]
    shift = np.eye(4)
    shift[2, 3] = last.d
    places = export.origins(replace(form, joints=(*form.joints[:-1], replace(last, d=0.0))))
    places[-1] = shift @ places[-1]
    return places, arm


def _layout_of_urdf(
    vendor: Vendor, names: Sequence[str], text: str
) -> tuple[FloatArray, Chain] | None:
    joints = {joint.name: joint for joint in parse_urdf(text).joints}
    path = [joints[name] for name in names]
    if any(not np.allclose(joint.axis, [0.0, 0.0, 1.0]) for joint in path):
        return None
    if vendor.end is not None:
        prefix = names[-1].removesuffix(vendor.joints[-1])
        if f'{prefix}_{vendor.end}' not in joints:
            return None
        path.append(joints[f'{prefix}_{vendor.end}'])
    if any(after.parent != joint.child for joint, after in pairwise(path)):
        return None
    places = np.array([joint.origin for joint in path])
    return places, chain_from_urdf(text, path[0].parent, path[-1].child)
