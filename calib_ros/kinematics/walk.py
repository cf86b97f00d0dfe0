# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The walk along a chain: the frames of all joints at many joint values at once.

A link is a joint's motion along and about z, and a constant L = Tx(a) Ty(b) Rx(alpha) Ry(beta):

    standard   A = Rz(theta) Tz(d) L        modified   A = L Rz(theta) Tz(d)

Frames are (4, 3, B): the x, y and z axis and the origin in the world, of B samples, so a constant
transform is one product of matrices. Every parameter of a joint moves what follows along or about
an axis of one of these frames: theta and d along z of the frame before the joint's motion, a,
alpha and beta along x, x and y of the frame after L (before its turn by beta for the first two),
b along y before L, `beside` in the axes of the frame after it.
"""

from __future__ import annotations

import numpy as np

from calib_ros.kinematics.se3 import Flags, FloatArray, cos_sin

BLOCK = 2000
"""Samples per operation: their arrays fit the caches (benchmarks/peers.py), where rows a power of
two apart would compete for the same places."""


class Walk:
    """The parts of a chain's links that do not depend on the joint values.

    From the DH table (n, 6) with columns a, alpha, d, theta, beta, b [m, rad], `signs` (n,) of the
    joint values, `turning` (n,) for revolute joints, and the convention.
    """

    def __init__(
        self, table: FloatArray, signs: FloatArray, turning: Flags, standard: bool
    ) -> None:
        a, alpha, d, theta, self.beta, b = table.T
        self._theta = theta[:, np.newaxis]
        self._turn = np.cos(self._theta), np.sin(self._theta)
        self.signs = signs[:, np.newaxis]
        self.turning = turning
        self._turns = turning[:, np.newaxis]
        self.standard = standard
        cos, sin = np.cos(alpha), np.sin(alpha)
        self.cos, self.sin = np.cos(self.beta), np.sin(self.beta)
        links = np.zeros((len(table), 4, 4))
        links[:, 0, :3] = np.transpose([self.cos, sin * self.sin, -cos * self.sin])
        links[:, 1, 1:3] = np.transpose([cos, sin])
        links[:, 2, :3] = np.transpose([self.sin, -sin * self.cos, cos * self.cos])
        links[:, 3, 0], links[:, 3, 1], links[:, 3, 3] = a, b, 1.0
        self.beside = links[:, :3, 1]
        if standard:  # d moves along z, first or last
            links[:, 3, 2] = d
        self._links = links
        self._d = np.zeros_like(d) if standard else d

    def along(self, q: FloatArray, base: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the frames (n + 1, 4, 3, B) as `frames`, and those at the links' ends."""
        found = np.empty((len(q) + 1, 4, 3, q.shape[1]))
        if self.standard:
            return self.frames(q, base, found), found[1:]
        ends = np.empty((len(q), 4, 3, q.shape[1]))
        return self.frames(q, base, found, ends), ends

    def frames(
        self,
        q: FloatArray,
        base: FloatArray,
        found: FloatArray,
        ends: FloatArray | None = None,
        circle: FloatArray | None = None,
    ) -> FloatArray:
        """Write the frames of joints (before their motion) and flange to `found` (n + 1, 4, 3, B).

        At effective joint values (n, B), from T_world_base (4, 4). `ends` (n, 4, 3, B) receives
        the frames at the ends of the links of the modified convention; in the standard one these
        are the following frames. `circle` (2, n, B) are the cosines and sines of q, if known.
        """
        values = self.signs * q
        if circle is None or not self.turning.all():
            cos, sin = cos_sin(self._theta + values * self._turns)
        else:
            (first, second), along, across = self._turn, circle[0], self.signs * circle[1]
            cos, sin = first * along - second * across, second * along + first * across
        frame, turned = np.empty((4, *found.shape[2:])), np.empty((2, *found.shape[2:]))
        frame[:] = base[:3].T[..., np.newaxis]
        if self.standard:
            found[0] = frame
        for i, link in enumerate(self._links):
            before, after = found[i], found[i + 1]
            if not self.standard:
                np.matmul(link, frame.reshape(4, -1), out=before.reshape(4, -1))
            np.multiply(before[:2], cos[i], out=frame[:2])
            np.multiply(before[1::-1], sin[i], out=turned)
            frame[0] += turned[0]
            frame[1] -= turned[1]
            frame[2:] = before[2:]
            if not self.turning[i]:
                frame[3] += (self._d[i] + values[i]) * frame[2]
            elif self._d[i]:
                frame[3] += self._d[i] * frame[2]
            if self.standard:
                np.matmul(link, frame.reshape(4, -1), out=after.reshape(4, -1))
            elif ends is not None:
                ends[i] = frame
        if not self.standard:
            found[-1] = frame
        return found
