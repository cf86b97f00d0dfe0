# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Arms, what is wrong with them, and sessions: numpy alone, no kinematics of calib_ros.

An arm is read from the table in config/robots. Gravity, eccentricities of joints and ripple of
gears move its joints by what no geometric model holds,

    q_true = q + softness * torque(q) + sum_k amplitude_k sin(order_k q + phase_k)

and axes wobble: they tilt about x and y by amplitude sin(order q + phase).
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import bench
import numpy as np
import yaml
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

ROBOTS = Path(__file__).resolve().parent.parent / 'config' / 'robots'
REACH = 2.5
"""Joint values [rad] are drawn within the limits and this."""
RIPPLE = 50
LINKS = 0.5
"""Largest part of a cell [m] in which lines of constant orientation lie."""


def turn(k, angle):
    """Return rotations (..., 3, 3) about axis k."""
    angle = np.asarray(angle, dtype=float)
    i, j = (k + 1) % 3, (k + 2) % 3
    matrix = np.zeros((*angle.shape, 3, 3))
    matrix[..., k, k] = 1.0
    matrix[..., i, i] = matrix[..., j, j] = np.cos(angle)
    matrix[..., j, i] = np.sin(angle)
    matrix[..., i, j] = -np.sin(angle)
    return matrix


@dataclass(frozen=True)
class Arm:
    """An arm in its cell: rows of a, alpha, d, theta, beta [m, rad] and what bends.

    `base` and `tool` are (rotation, position), `weights` [N] hang at the ends of the links,
    `softness` [rad/(N m)] is of the joints; `waves` holds (order, amplitudes (n,), phases (n,)),
    `wobble` (order, amplitudes (n, 2), phases (n, 2)) or nothing.
    """

    convention: str
    table: np.ndarray
    signs: np.ndarray
    limits: np.ndarray
    base: tuple
    tool: tuple
    weights: np.ndarray
    softness: np.ndarray
    waves: tuple = ()
    wobble: tuple = ()

    @classmethod
    def read(cls, name):
        """Read a shipped robot of revolute joints; weights as of links that get lighter."""
        document = yaml.safe_load((ROBOTS / f'{name}.yaml').read_text())
        rows = document['joints']
        if any(row['type'] != 'revolute' for row in rows):
            raise SystemExit(f'{name} has joints that are not revolute')
        kinds = ('a', 'alpha', 'd', 'theta', 'beta')
        table = np.array([[row.get(kind, 0.0) for kind in kinds] for row in rows])
        limits = np.array([[row['lower'], row['upper']] for row in rows])
        count = len(rows)
        return cls(
            document['convention'],
            table,
            np.array([row.get('sign', 1) for row in rows], dtype=float),
            np.clip(limits, -REACH, REACH),
            (np.eye(3), np.zeros(3)),
            (np.eye(3), np.zeros(3)),
            50.0 / (1.0 + np.arange(count)),
            np.zeros(count),
        )

    def links(self, q):
        """Return axes and pivots of the joints, ends of the links (each n of (N, 3)), rotation."""
        rotation, origin = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        axes, pivots, ends = [], [], []
        angles = self.table[:, 3] + self.signs * q
        for k, ((a, alpha, d, _, beta), angle) in enumerate(
            zip(self.table, angles.T, strict=True)
        ):
            if self.convention == 'modified':
                rotation = rotation @ turn(0, alpha)
                origin = origin + a * rotation[:, :, 0]
                rotation = rotation @ turn(1, beta)
            if self.wobble:
                order, amplitudes, phases = self.wobble
                tilt = amplitudes[k] * np.sin(order * q[:, k, None] + phases[k])
                rotation = rotation @ turn(0, tilt[:, 0]) @ turn(1, tilt[:, 1])
            axes.append(rotation[:, :, 2])
            pivots.append(origin)
            rotation = rotation @ turn(2, angle)
            origin = origin + d * rotation[:, :, 2]
            if self.convention == 'standard':
                origin = origin + a * rotation[:, :, 0]
                rotation = rotation @ turn(0, alpha) @ turn(1, beta)
            ends.append(origin)
        return axes, pivots, ends, rotation

    def bent(self, q):
        """Return the joint values (N, n) that the arm really has."""
        moved = q.copy()
        for order, amplitudes, phases in self.waves:
            moved = moved + amplitudes * np.sin(order * q + phases)
        if self.softness.any():
            axes, pivots, ends, _ = self.links(q)
            for i, (axis, pivot) in enumerate(zip(axes, pivots, strict=True)):
                force = np.array([0.0, 0.0, -1.0])
                pairs = zip(ends[i:], self.weights[i:], strict=True)
                torque = sum(weight * np.cross(end - pivot, force) for end, weight in pairs)
                load = self.signs[i] * np.einsum('nk,nk->n', axis, torque)
                moved[:, i] += self.softness[i] * load
        return moved

    def forward(self, q, shift=0.0):
        """Return rotation (N, 3, 3) and position (N, 3) of the target, moved on the flange."""
        _, _, ends, rotation = self.links(self.bent(q))
        point = ends[-1] + np.einsum('nij,nj->ni', rotation, self.tool[1] + np.zeros((len(q), 3)))
        point = point + np.einsum('nij,nj->ni', rotation, np.broadcast_to(shift, (len(q), 3)))
        turned = self.base[0] @ rotation @ self.tool[0]
        return turned, point @ self.base[0].T + self.base[1]

    def draw(self, count, rng, limits=None):
        """Draw joint values (count, n) anywhere."""
        lower, upper = (self.limits if limits is None else limits).T
        return rng.uniform(lower, upper, (count, len(lower)))

    def in_cell(self, rng):
        """Return the arm with base and tool anywhere."""
        base, tool = (Rotation.from_quat(rng.normal(size=4)).as_matrix() for _ in range(2))
        places = rng.uniform(-2.0, 2.0, 3), rng.uniform(-0.15, 0.15, 3)
        return replace(self, base=(base, places[0]), tool=(tool, places[1]))

    def faulty(self, lengths, angles, rng):
        """Return the arm with errors in every row: beta too, where axes are parallel."""
        count = len(self.table)
        sizes = np.tile([lengths, angles, lengths, angles, 0.0], (count, 1))
        first = 0 if self.convention == 'standard' else 1
        flat = np.abs(np.sin(self.table[:, 1])) < 0.09
        between = np.arange(count) < count - 1 if first == 0 else np.arange(count) > 0
        sizes[flat & between, 4] = angles
        return replace(self, table=self.table + rng.normal(size=sizes.shape) * sizes)

    def slipped(self, joint, angle):
        """Return the arm after the encoder of a joint has slipped."""
        table = self.table.copy()
        table[joint, 3] += angle
        return replace(self, table=table)

    def soft(self, rng):
        """Return the arm with joints that bend under gravity."""
        return replace(self, softness=1e-5 * rng.uniform(0.2, 1.0, len(self.table)))

    def wavy(self, orders, size, rng):
        """Return the arm with harmonics in its joints."""
        count = len(self.table)
        drawn = [(rng.uniform(0.3, 1.0, count), rng.uniform(0.0, 6.28, count)) for _ in orders]
        waves = tuple((order, size * a, p) for order, (a, p) in zip(orders, drawn, strict=True))
        return replace(self, waves=waves)

    def wobbling(self, size, rng):
        """Return the arm with axes that tilt by `size` [rad] (RMS of the amplitudes)."""
        amplitudes = rng.normal(scale=size, size=(len(self.table), 2))
        phases = rng.uniform(0.0, 6.28, amplitudes.shape)
        return replace(self, wobble=(int(rng.integers(1, 3)), amplitudes, phases))


def misfit(wanted, rotation, position):
    """Return distances (N,) [m] that the best base and tool leave of two arms' positions.

    Gauss-Newton in a turn and a shift of the base and a shift of the tool; the axes of tools
    count for nothing. Base and tool are nearly right at the start.
    """
    around, shift, tool = np.eye(3), np.zeros(3), np.zeros(3)
    rows = np.zeros((len(wanted), 3, 9))
    rows[:, :, 3:6] = np.eye(3)
    for _ in range(30):
        point = (position + rotation @ tool) @ around.T
        rows[:, 0, 1], rows[:, 0, 2] = point[:, 2], -point[:, 1]
        rows[:, 1, 0], rows[:, 1, 2] = -point[:, 2], point[:, 0]
        rows[:, 2, 0], rows[:, 2, 1] = point[:, 1], -point[:, 0]
        rows[:, :, 6:] = around @ rotation
        error = wanted - point - shift
        step = np.linalg.lstsq(rows.reshape(-1, 9), error.ravel(), rcond=1e-10)[0]
        if np.abs(step).max() < 1e-10:
            break
        around = Rotation.from_rotvec(step[:3]).as_matrix() @ around
        shift, tool = shift + step[3:6], tool + step[6:]
    return np.linalg.norm(error, axis=1)


def resized(plain, wrong, what, size):
    """Return an arm with the field `what` scaled from that of `plain` to err by size [m]."""
    q = plain.draw(200, np.random.default_rng(0))
    own = getattr(wrong, what)
    for _ in range(2):  # nearly linear
        factor = size / bench.rms(misfit(wrong.forward(q)[1], *plain.forward(q)))
        if what == 'waves':
            own = tuple((order, factor * a, p) for order, a, p in own)
        else:
            own = getattr(plain, what) + factor * (own - getattr(plain, what))
        wrong = replace(wrong, **{what: own})
    return wrong


def bent(places, size, rng):
    """Return places (N, 3) [m] as a device sees them that bends space by so much (RMS).

    By squares and cubes of the coordinates.
    """
    x = (places - places.mean(axis=0)) / np.sqrt(places.var(axis=0).sum())
    powers = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    powers += [x[:, i] ** 2 * x[:, j] for i in range(3) for j in range(3)]
    error = np.array(powers).T @ rng.normal(size=(len(powers), 3))
    return places + size * error / bench.rms(np.linalg.norm(error, axis=1))


def home_of(arm, rng, inner=0.6):
    """Return joint values (n,) away from the limits."""
    middle, half = arm.limits.mean(axis=1), np.ptp(arm.limits, axis=1) / 2.0
    return middle + inner * half * rng.uniform(-1.0, 1.0, len(middle))


def clipped(arm, q):
    """Return joint values within the limits."""
    return np.clip(q, *arm.limits.T)


def poses(arm, order, count, rng):
    """Return joint values (count, n) in the order of a session."""
    joints = len(arm.limits)
    if order == 'random':
        return arm.draw(count, rng)
    if order == 'sweeps':
        home, each = home_of(arm, rng, 0.5), -(-count // joints)
        q = np.tile(home, (joints * each, 1))
        for i in range(joints):
            reach = np.clip(home[i] + np.array([-1.2, 1.2]), *arm.limits[i])
            q[i * each : (i + 1) * each, i] = np.linspace(*reach, each)
        return q
    if order == 'grid':
        reach = rng.uniform(0.3, 0.8, joints) * np.ptp(arm.limits, axis=1) / 2.0
        levels = arm.limits.mean(axis=1)[:, None] + reach[:, None] * [-1.0, 0.0, 1.0]
        nodes = np.sort(rng.choice(3**joints, count, replace=False))
        return levels[np.arange(joints), nodes[:, None] // 3 ** np.arange(joints)[::-1] % 3]
    if order == 'succession':  # stations near each other, at each a grid of the last two joints
        stations = -(-count // 25)
        walk = np.cumsum(rng.uniform(-0.15, 0.15, (stations, joints)), axis=0)
        q = np.repeat(home_of(arm, rng) + walk, 25, axis=0)
        levels = 0.17 * np.stack(np.meshgrid(np.arange(-2, 3), np.arange(-2, 3)), -1)
        q[:, -2:] += np.tile(levels.reshape(25, 2), (stations, 1))
        return clipped(arm, q + rng.normal(scale=3e-4, size=q.shape))[:count]
    if order == 'path':
        corners = arm.draw(9, rng)
        corners[-1] = corners[0]
        spline = CubicSpline(np.arange(9), corners, bc_type='periodic')
        return clipped(arm, spline(np.arange(count) * 8.0 / count))
    if order == 'local':
        return clipped(arm, home_of(arm, rng) + rng.uniform(-0.4, 0.4, (count, joints)))
    if order == 'half':
        limits = arm.limits.copy()
        limits[0, 1] = 0.0
        return arm.draw(count, rng, limits)
    return lines(arm, count, rng)


def lines(arm, count, rng):
    """Return joint values (count, n) on straight lines, all at one orientation."""
    plain = replace(arm, softness=0.0 * arm.softness, waves=(), wobble=())
    for _ in range(50):
        home = home_of(arm, rng)
        rotation, place = plain.forward(home[None])
        corners = place + rng.uniform(-0.5 * LINKS, 0.5 * LINKS, (5, 3))
        along = np.linspace(0.0, 4.0, 2 * count)
        wanted = np.stack([np.interp(along, np.arange(5), c) for c in corners.T], axis=1)
        start = np.tile(home, (len(wanted), 1))
        missing = partial(_missing, plain, wanted, rotation)
        kept = led(plain, start, lambda q, _, left=missing: left(q), 1e-8)
        if len(kept) >= count:
            return kept[np.sort(rng.choice(len(kept), count, replace=False))]
    raise SystemExit('no lines of constant orientation found')


def _missing(arm, wanted, rotation, q):
    """Return what is missing (N, 6) [m, rad] to the wanted places at one orientation."""
    turned, place = arm.forward(q)
    turn = Rotation.from_matrix(rotation @ np.swapaxes(turned, 1, 2)).as_rotvec()
    return np.hstack([place - wanted, -turn])


def led(arm, start, left, damping=1e-10):
    """Return those joint values near `start` (N, n) that make what is `left` (N, c) vanish."""
    q, numbers = start, np.arange(len(start))
    for _ in range(40):
        here = left(q, numbers)
        slopes = []
        for i in range(q.shape[1]):
            ahead = q.copy()
            ahead[:, i] += 1e-6
            slopes.append((left(ahead, numbers) - here) / 1e-6)
        jacobian = np.stack(slopes, axis=2)
        back = np.swapaxes(jacobian, 1, 2)
        normal = jacobian @ back + damping * np.eye(here.shape[1])
        step = (back @ np.linalg.solve(normal, -here[:, :, None]))[:, :, 0]
        q = q + np.clip(step, -0.3, 0.3)
    inside = ((q >= arm.limits[:, 0]) & (q <= arm.limits[:, 1])).all(axis=1)
    return q[inside & (np.abs(left(q, numbers)).max(axis=1) < 1e-7)]
