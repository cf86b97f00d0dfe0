# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sessions without a tracker, for `harm.py`: draw-wires, sockets, touched planes, cameras.

By the kinematics of `cell_simulator.py`; joint values that bring the target to a place follow from
numeric derivatives. The camera (1280 x 720, focal length 900 px) sees 40 corners 30 mm apart from
half a metre; its lens is fitted from values that are off by 1 %.
"""

from dataclasses import replace

import numpy as np
from cell_simulator import led
from scipy.spatial.transform import Rotation

from calib_ros.estimation.observations import Observations
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.lens import Lens

NOISE = 5e-5
NOISE_OF_WIRES = 1e-4
NOISE_OF_PIXELS = 0.3
CORNERS = np.array([(0.03 * i, 0.03 * j, 0.0) for j in range(5) for i in range(8)])
LENS = {'fx': 900.0, 'fy': 902.0, 'cx': 640.0, 'cy': 360.0, 'k1': -0.1, 'k2': 0.05}
TOLD = Lens(908.0, 896.0, 645.0, 353.0, -0.08, 0.02, fixed=False)


def place_of(arm, rng):
    """Return joint values (n,) away from the limits, and where the target is there."""
    home = 0.7 * arm.draw(1, rng)
    return home[0], arm.forward(home)[1][0]


def named(sets):
    """Return sets with a base frame each."""
    return [replace(each, base=f'base_{k}' if k else 'base') for k, each in enumerate(sets)]


def wires(arm, rng, count):
    """Return distances (120) from some anchors."""
    sets = []
    for anchor in rng.uniform(-1.5, 1.5, (count, 3)) + arm.base[1]:
        q = arm.draw(120 // count, rng)
        distances = np.linalg.norm(arm.forward(q)[1] - anchor, axis=1)
        distances += rng.normal(scale=NOISE_OF_WIRES, size=len(q))
        plain = Observations.from_arrays(q, np.zeros((len(q), 3)))
        sets.append(replace(plain, distances=distances))
    return named(sets), {'sigma_position': NOISE_OF_WIRES}


def sockets(arm, rng, count, apart):
    """Return 25 poses of a ball in each of some sockets, a known distance `apart` or not."""
    sets, places = [], []
    while len(sets) < count:
        home, place = place_of(arm, rng)
        noise = rng.normal(scale=NOISE, size=(150, 3))
        start = home + rng.uniform(-1.5, 1.5, (150, len(home)))
        q = led(
            arm,
            np.clip(start, *arm.limits.T),
            lambda q, k, aim=place + noise: arm.forward(q)[1] - aim[k],
        )
        if len(q) >= 25:
            places.append(place)
            sets.append(replace(Observations.from_arrays(q[:25], np.zeros((25, 3))), socket=True))
    sets, options = named(sets), {'sigma_position': NOISE}
    if apart:
        options['separations'] = [
            (sets[i].base, sets[j].base, float(np.linalg.norm(places[i] - places[j])))
            for i in range(count)
            for j in range(i)
        ]
    return sets, options


def planes(arm, rng, count):
    """Return 30 touches of each of some planes."""
    sets = []
    while len(sets) < count:
        place, normal = place_of(arm, rng)[1], rng.normal(size=3)
        normal /= np.linalg.norm(normal)
        noise = rng.normal(scale=NOISE, size=(120, 1))
        q = led(
            arm,
            arm.draw(120, rng),
            lambda q, k, p=place, n=normal[:, None], e=noise: (arm.forward(q)[1] - p) @ n - e[k],
        )
        if len(q) >= 30:
            sets.append(Observations.touching(q[:30]))
    return named(sets), {'sigma_touch': NOISE}


def ball(arm, rng):
    """Return 60 positions of a fixed ball seen by a 3D camera on the flange, 0.4 to 0.8 m away."""
    while True:
        home, place = place_of(arm, rng)
        wanted = rng.uniform([-0.2, -0.2, 0.4], [0.2, 0.2, 0.8], (180, 3))
        start = np.clip(home + rng.uniform(-1.5, 1.5, (180, len(home))), *arm.limits.T)
        q = led(arm, start, lambda q, k, aim=place, w=wanted: toward(arm, q, aim) - w[k])
        if len(q) >= 60:
            break
    seen = toward(arm, q[:60], place) + rng.normal(scale=NOISE, size=(60, 3))
    return [Observations.from_arrays(q[:60], seen).inverted()], {'sigma_position': NOISE}


def toward(arm, q, place):
    """Return (N, 3) where the tool frame at joint values (N, n) has a place (3,)."""
    turns, places = arm.forward(q)
    return np.einsum('nji,nj->ni', turns, place - places)


def projected(points):
    """Return pixels (..., 2) of points (..., 3) before the camera."""
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    square = x * x + y * y
    bent = 1.0 + LENS['k1'] * square + LENS['k2'] * square**2
    return np.stack(
        [LENS['cx'] + LENS['fx'] * x * bent, LENS['cy'] + LENS['fy'] * y * bent], axis=-1
    )


def board(arm, rng, on_flange, larger):
    """Return 40 images of a board that is printed so much `larger`."""
    corners = (1.0 + larger) * CORNERS
    while True:
        home = place_of(arm, rng)[0]
        turned, place = (each[0] for each in arm.forward(home[None]))
        tilt = Rotation.from_euler('xyz', rng.uniform([-0.3, -0.3, -3], [0.3, 0.3, 3])).as_matrix()
        before = np.array([0.0, 0.0, 0.5]) - tilt @ CORNERS.mean(axis=0)
        q = home + rng.normal(scale=0.45, size=(1600, len(home)))
        q = np.clip(q, *arm.limits.T)
        turns, places = arm.forward(q)
        if on_flange:
            fixed = corners @ (turned @ tilt).T + turned @ before + place
            seen = np.einsum('nji,nkj->nki', turns, fixed - places[:, None])
        else:
            moving = np.einsum('nij,kj->nki', turns, corners) + places[:, None]
            seen = (moving - place + turned @ tilt.T @ before) @ turned @ tilt.T
        pixels = projected(seen)
        normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 8] - seen[:, 0])
        middle = seen.mean(axis=1)
        lengths = np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1)
        good = np.abs((normal * middle).sum(axis=1)) > 0.5 * lengths
        good &= (seen[..., 2] > 0.2).all(axis=1)
        good &= ((pixels > 0.0) & (pixels < [1280.0, 720.0])).all(axis=(1, 2))
        if good.sum() >= 40:
            break
    chosen = np.flatnonzero(good)[:40]
    noisy = pixels[chosen] + rng.normal(scale=NOISE_OF_PIXELS, size=(40, 40, 2))
    joints, images = np.repeat(q[chosen], 40, axis=0), np.repeat(np.arange(40), 40)
    points = np.tile(CORNERS, (40, 1))
    observed = Observations.from_pixels(joints, noisy.reshape(-1, 2), points, images, on_flange)
    return [observed], {'sigma_pixel': NOISE_OF_PIXELS}


SENSORS = {
    'wire': lambda arm, rng, _: wires(arm, rng, 1),
    'wires': lambda arm, rng, _: wires(arm, rng, 3),
    'sockets': lambda arm, rng, _: sockets(arm, rng, 4, False),
    'separations': lambda arm, rng, _: sockets(arm, rng, 4, True),
    'planes': lambda arm, rng, _: planes(arm, rng, 3),
    'ball seen': lambda arm, rng, _: ball(arm, rng),
    'fixed camera': lambda arm, rng, larger: board(arm, rng, False, larger),
    'camera on the flange': lambda arm, rng, larger: board(arm, rng, True, larger),
}


def in_view(chain, what, off=None):
    """Return the chain with the lens of a camera where the sensor is one.

    It is nearly right and fitted, or held at values that are `off` by a share.
    """
    lens = TOLD
    if off is not None:
        shift = off * LENS['fx']
        wrong = {key: LENS[key] + shift for key in ('fx', 'fy', 'cx', 'cy')}
        lens = Lens(**LENS | wrong, fixed=True)
    if what == 'fixed camera':
        return replace(chain, base=Frame(lens=lens))
    return replace(chain, tool=Frame(lens=lens)) if what.startswith('camera') else chain
