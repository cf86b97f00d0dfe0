# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The sessions that `harm.py` judges: designs, errors of arms, what goes wrong meanwhile."""

from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np
from cell_simulator import RIPPLE, Arm, bent, poses, resized
from harm_sensors import SENSORS, in_view
from scipy.spatial.transform import Rotation

from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain

NOISE = (5e-5, 2e-4)
GOOD = 1e-4
WOBBLE = 3e-5, 2e-4  # of axes [rad], as measured robots have
SIX = ('ur10', 'puma560', 'staubli_tx90l')
SEVEN = ('kuka_iiwa14', 'franka_panda')
LINES = ('ur10', 'puma560', 'kuka_iiwa14')
ERRORS = {  # lengths [m], angles [rad]
    'none': (0.0, 0.0),
    'good': (5e-4, 1e-3),  # then scaled to pose errors of 0.1 to 0.2 mm
    'small': (5e-5, 1e-4),
    'usual': (5e-4, 1e-3),
    'large': (5e-3, 1e-2),
}
SIZES = ('usual', 'large', 'small', 'none')
ORDERS = ('random', 'path', 'sweeps')
NEAR = (*ORDERS, 'local')


@dataclass(frozen=True)
class Design:
    """A kind of session, with the number of its arms in a full run."""

    name: str
    arms: int
    orders: tuple = ('random',)
    errors: tuple = ('none', 'usual')
    what: str = ''
    size: float = 0.0
    robots: tuple = SIX + SEVEN
    model: str = 'geometric'
    bends: tuple = ('',)
    lens_off: float | None = None
    counts: tuple = (60,)


DESIGNS = (
    *(
        Design(order, 90, (order,), tuple(ERRORS))
        for order in ('random', 'sweeps', 'grid', 'path', 'local')
    ),
    *(
        Design(f'a joint within {size} mrad', 40, errors=SIZES, what='still', size=1e-3 * size)
        for size in (0, 0.3, 1, 3, 10)
    ),
    *(
        Design(f'five of 7 joints {how}', 30, what='still five', size=size, robots=SEVEN)
        for how, size in (('still', 0.0), ('in 0.3 mrad', 3e-4))
    ),
    Design(
        *('grid in succession', 80, ('succession',), ('none', 'small', 'usual')),
        bends=('', 'soft', 'wavy'),
        counts=(40, 80, 120, 160),
        robots=SIX,
    ),
    *(
        Design(f'{bend}, {order}', 60, (order,), ('none', 'small', 'usual'), bends=(bend,))
        for bend in ('soft', 'wavy')
        for order in ('local', 'half', 'random')
    ),
    *(
        Design(f'wobbling, {order}', 60, (order,), ('none', 'small', 'usual'), bends=('wobbling',))
        for order in ('local', 'half', 'sweeps', 'random')
    ),
    *(
        Design(f'{what} moved, {size} mm', 72, ORDERS, what=what, size=1e-3 * size)
        for what, size in (('tool', 0.3), ('tool', 1), ('tool', 4), ('base', 1), ('base', 4))
    ),
    Design(
        *('base moved in succession', 100, ('succession',), ('none', 'small', 'usual')),
        what='base',
        size=1e-3,
        counts=(40, 60, 80, 120),
    ),
    *(
        Design(f'{frame} held off by 1 mm', 80, NEAR, what=f'held {frame}', size=1e-3)
        for frame in ('base', 'tool')
    ),
    *(
        Design(f'slip of {size} degrees', 72, ORDERS, what='slip', size=size * np.pi / 180.0)
        for size in (0.02, 0.1, 0.5)
    ),
    Design('drifting tracker', 80, ('path',), what='drift', size=3e-4),
    *(Design(f'rounded, {order}', 40, (order,), what='rounded') for order in ('sweeps', 'grid')),
    Design('test rows repeat', 40, what='test repeats', bends=('ripple',)),
    Design('repeats within 2 mrad', 40, what='repeats', bends=('ripple',)),
    Design('two or three targets', 60, ORDERS, what='targets', bends=('', 'ripple')),
    *(
        Design(f'one orientation{how}', 30, ('lines',), what='wobble', size=size, robots=LINES)
        for how, size in (('', 0.0), (', to 1 mrad', 1e-3))
    ),
    *(
        Design(f'device off by {1e3 * size:g} mm', 40, NEAR, what='bent', size=size)
        for size in (1e-4, 3e-4, 1e-3)
    ),
    Design('scale of 500 ppm', 40, what='scale', size=5e-4),
    Design('scale of 1 %', 40, what='scale', size=1e-2),
    *(
        Design(f'by {what}', 60, errors=SIZES, what=what, bends=('', 'ripple', 'soft', 'wavy'))
        for what in SENSORS
    ),
    *(
        Design(f'lens off by 1 %, {what}', 60, errors=SIZES, what=what, lens_off=0.01)
        for what in ('fixed camera', 'camera on the flange')
    ),
    Design('board 0.3 % too large', 60, errors=SIZES, what='camera on the flange', size=3e-3),
    Design('auto', 40, ORDERS, model='auto'),
    Design('auto, bent', 40, ('local', 'half', 'path'), bends=('soft', 'wavy'), model='auto'),
    Design('auto, targets', 20, ORDERS, what='targets', bends=('', 'ripple'), model='auto'),
)


@dataclass(frozen=True)
class Session:
    """What was measured, in which order, and the arm as it is in the end."""

    chain: object
    nominal: Arm
    arm: Arm
    problem: Problem
    order: str
    errors: str
    healthy: bool


def session(design, number):
    """Return the session of the arm of that number."""
    rng = np.random.default_rng([crc32(design.name.encode()), number])
    errors = design.errors[number % len(design.errors)]
    robot, order, bend, count = (
        each[rng.integers(len(each))]
        for each in (design.robots, design.orders, design.bends, design.counts)
    )
    nominal = Arm.read(robot).in_cell(rng)
    arm = nominal.faulty(*ERRORS[errors], rng)
    if errors == 'good':
        arm = resized(nominal, arm, 'table', rng.uniform(1.0, 2.0) * GOOD)
    if bend in ('soft', 'wavy', 'ripple'):
        field = 'softness' if bend == 'soft' else 'waves'
        bare = nominal.soft(rng) if bend == 'soft' else nominal.wavy((1, 2), 1e-3, rng)
        bare = nominal.wavy((RIPPLE,), 1e-3, rng) if bend == 'ripple' else bare
        size = rng.uniform(1e-4, 2e-4) if bend == 'ripple' else rng.uniform(2e-4, 1e-3)
        arm = replace(arm, **{field: getattr(resized(nominal, bare, field, size), field)})
    if bend == 'wobbling':
        arm = arm.wobbling(10.0 ** rng.uniform(*np.log10(WOBBLE)), rng)
    q = poses(nominal, order, count, rng)
    if design.what.startswith('still'):
        still = rng.permutation(q.shape[1])[: 5 if design.what == 'still five' else 1]
        home = nominal.draw(1, rng)[0]
        q[:, still] = home[still] + rng.uniform(-1.0, 1.0, (len(q), len(still))) * design.size
    if design.what == 'wobble':
        q = q + rng.normal(scale=design.size, size=q.shape)
    measured, problem = measured_by(design, arm, q, rng)
    chain = load_chain(robot)
    if design.what.startswith('held'):
        frame = design.what.removeprefix('held ')
        chain = chain.with_frame(frame, stated(getattr(nominal, frame), design.size, rng))
    healthy = errors == 'none' and bend in ('', 'ripple') and design.what != 'slip'
    return Session(chain, nominal, measured, problem(chain), order, errors, healthy)


def measured_by(design, arm, q, rng):
    """Return the arm in the end, and what makes a problem of the chain."""
    what, size = design.what, design.size
    if what in SENSORS:
        (seen, *more), options = SENSORS[what](arm, rng, size)
        return arm, lambda chain: Problem(
            in_view(chain, what, design.lens_off), seen, more=more, **options
        )
    oriented = rng.random() > 1.0 / 3.0
    options = {'sigma_position': NOISE[0], 'sigma_orientation': NOISE[1]}
    if what in ('test repeats', 'repeats'):
        q = q[:20] if what == 'test repeats' else q[:12]
        q = np.tile(q, (3 if what == 'test repeats' else 5, 1))
        q = q + (rng.uniform(-2e-3, 2e-3, q.shape) if what == 'repeats' else 0.0)
        if what == 'test repeats':
            options['held_out'] = observed(arm, q[:20], rng, oriented)
    late = np.arange(len(q)) >= rng.integers(len(q) // 4, 3 * len(q) // 4)
    direction = rng.normal(size=3)
    far = size * (rng.uniform(0.5, 1.75) if size > 2e-3 else 1.0)
    moved = late[:, None] * far * direction / np.linalg.norm(direction)
    if what == 'tool':
        seen = observed(arm, q, rng, oriented, shift=moved)
    elif what == 'targets':
        tools = [rng.uniform(-0.15, 0.15, 3) for _ in range(rng.integers(2, 4))]
        q = q[:: len(tools)]
        seen, *more = (observed(arm, q, rng, oriented, shift=tool) for tool in tools)
        options['more'] = [replace(o, tool=f'tool_{k}') for k, o in enumerate(more)]
    elif what == 'slip':
        after = arm.slipped(rng.integers(q.shape[1]), size * rng.choice([-1.0, 1.0]))
        early, then = (observed(a, q[w], rng, oriented) for a, w in ((arm, ~late), (after, late)))
        parts = [
            np.concatenate([getattr(o, name) for o in (early, then)])
            for name in ('joints', 'positions', 'rotations')
        ]
        seen, arm = Observations.from_arrays(*parts[: 3 if oriented else 2]), after
    else:
        seen = observed(arm, q, rng, oriented)
    if what == 'base':
        seen = replace(seen, positions=seen.positions + moved)
    if what == 'drift':
        seen = replace(seen, positions=seen.positions + drift(len(q), size, rng))
    if what == 'bent':
        seen = replace(seen, positions=bent(seen.positions, size, rng))
        options['sigma_position'] = float(np.hypot(NOISE[0], size))
    if what == 'scale':
        seen = replace(seen, positions=seen.positions * (1.0 + size))
    if what == 'rounded':
        seen = replace(seen, joints=np.round(seen.joints, 3))
    return arm, lambda chain: Problem(chain, seen, **options)


def stated(frame, size, rng):
    """Return a frame (rotation, position) as known, but off by so much (RMS) [m, rad]."""
    shift, turn = rng.normal(scale=size / np.sqrt(3.0), size=(2, 3))
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ frame[0]
    matrix[:3, 3] = frame[1] + shift
    return Frame(matrix, fixed=True)


def observed(arm, q, rng, oriented, shift=0.0):
    """Return observations of an arm at joint values (N, n)."""
    rotation, place = arm.forward(q, shift)
    place = place + rng.normal(scale=NOISE[0], size=place.shape)
    noise = Rotation.from_rotvec(rng.normal(scale=NOISE[1], size=place.shape)).as_matrix()
    return Observations.from_arrays(q, place, noise @ rotation if oriented else None)


def drift(count, size, rng):
    """Return how far (count, 3) [m] a tracker is off: a swing, or a random walk."""
    if rng.random() < 0.5:
        share = np.arange(count)[:, None] / count
        return size * np.sin(6.28 * (rng.uniform(0.5, 1.5, 3) * share + rng.random(3)))
    return size * np.cumsum(rng.normal(size=(count, 3)), axis=0) / np.sqrt(count)
