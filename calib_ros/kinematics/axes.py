# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The row of the table that leads from one axis to the next.

In both conventions the same five parameters lead from a frame on one axis to a frame on the next,

    Rz(theta_i) Tz(d_i) Tx(a) Rx(alpha) Ry(beta)

with a, alpha and beta in row i of the standard convention and in row i + 1 of the modified one.
Skew or intersecting axes take their common normal, with beta = 0. (Nearly) parallel ones take
d = 0: theta and a lead to the point where the next axis pierces the plane across this one, alpha
and beta tilt z into it. Nothing is divided by the angle between the axes there, so the tilts in a
calibrated URDF give no absurd lengths (Hayati and Mirmirani 1985).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import PARALLEL_TOLERANCE, Chain, Joint, nearly_parallel
from calib_ros.kinematics.se3 import FloatArray


def with_common_normals(chain: Chain) -> Chain:
    """Return the same arm without b, and beta only between axes closer than PARALLEL_TOLERANCE."""
    rows = list(chain.joints)
    for i in range(len(rows) - 1):
        k = i if chain.convention == 'standard' else i + 1  # row of the bend
        bend = rows[k]
        row = replace(rows[i], a=bend.a, alpha=bend.alpha, beta=bend.beta, b=bend.b)
        close = row.tilt < np.sin(PARALLEL_TOLERANCE)
        if not row.b and (close or not row.beta):
            continue
        end = link_ends(Chain('row', 'standard', (row,)))[0]
        plain = row_to_axis(row, np.eye(4), end[:3, 2], end[:3, 3], common_normal=not close)
        rest = se3.invert(link_ends(Chain('row', 'standard', (plain,)))[0]) @ end
        rows[i] = replace(rows[i], theta=plain.theta, d=plain.d)
        rows[k] = replace(rows[k], a=plain.a, alpha=plain.alpha, beta=plain.beta, b=0.0)
        turn = float(np.arctan2(rest[1, 0], rest[0, 0]))
        later = rows[i + 1]
        rows[i + 1] = replace(later, theta=later.theta + turn, d=later.d + float(rest[2, 3]))
    return replace(chain, joints=tuple(rows), parallel=None)


def row_to_axis(
    row: Joint, frame: FloatArray, axis: FloatArray, point: FloatArray, common_normal: bool = False
) -> Joint:
    """Return a standard row that leads from a frame (4, 4) on its axis to the next.

    That `axis` is a direction (3,) through a `point` (3,) [m]. Of the two directions of its x the
    one within 90 degrees of the frame's is chosen.
    """
    z = frame[:3, :3].T @ axis
    p = frame[:3, :3].T @ (point - frame[:3, 3])
    tilt = float(np.hypot(z[0], z[1]))
    x, y = p[:2] - p[2] / (z[2] or 1.0) * z[:2]
    parallel = not common_normal and nearly_parallel(tilt, float(np.hypot(x, y)))
    if parallel:
        d, a = 0.0, float(np.hypot(x, y))
        theta = float(np.arctan2(y, x)) if clean(a) else 0.0
    else:
        normal = np.array([-z[1], z[0]]) / tilt
        d, a = float(p[2] - z[2] * (p[:2] @ z[:2]) / tilt**2), float(normal @ p[:2])
        theta = float(np.arctan2(normal[1], normal[0]))
    if clean(np.cos(theta)) < 0.0:
        theta, a = theta - np.copysign(np.pi, theta), -a
    theta = _clean_angle(theta)
    across = np.cos(theta) * z[1] - np.sin(theta) * z[0]
    along = np.cos(theta) * z[0] + np.sin(theta) * z[1]
    return replace(
        row,
        theta=theta,
        d=clean(d),
        a=clean(a),
        alpha=_clean_angle(float(np.arctan2(-across, z[2]))),
        beta=_clean_angle(float(np.arcsin(along))) if parallel else 0.0,
        b=0.0,
    )


def clean(length: float) -> float:
    """Return a length [m] without the rounding of sums in its last digit."""
    return round(length, np.finfo(float).precision - 1) + 0.0


def _clean_angle(angle: float) -> float:
    """Return an angle [rad] without rounding; a right angle if that close."""
    right = round(angle / (np.pi / 2)) * (np.pi / 2)
    return clean(angle) if clean(angle - right) else right


def link_ends(chain: Chain) -> FloatArray:
    """Return the frames (n, 4, 4) at the ends of the links at zero."""
    ends = chain.walk.along(np.zeros((len(chain.joints), 1)), chain.frame('base').matrix)[1]
    found = ends[..., 0]
    return se3.transform(np.swapaxes(found[:, :3], 1, 2), found[:, 3])
