# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pixels of a board: is the estimator at the limit, how much better than by poses, how fast?

    python benchmarks/pixels.py [--runs 300] [--images 40] [--only NAME] [--speed | --rendered]

Simulated UR10e with errors of 0.5 mm and 1 mrad, a board of 8 x 5 corners 30 mm apart, 0.3 px of
noise on each coordinate. `mse_over_crlb` and `coverage_95` are those of `monte_carlo.py`. The same
images are identified from the pose of the board in each image as well (PnP, fed as poses):
`error` is the RMS position error that each leaves on other configurations in view. `--rendered`
finds the corners in rendered images (blur 0.7 px, noise of 2 grey levels), which takes five
seconds a run. What follows +- is the standard error over the runs.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import bench
import numpy as np

from calib_ros.apply.camera import Camera, before_camera, photograph
from calib_ros.apply.simulation import Cell, faulty
from calib_ros.errors import InputError
from calib_ros.estimation import uncertainty
from calib_ros.estimation.normal import normal_equations, triangular_factor
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.resection import board_poses
from calib_ros.identification.identification import identify
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.kinematics.lens import Lens

SIGMA = 0.3
POINTS = np.array([(0.03 * i, 0.03 * j, 0.0) for j in range(5) for i in range(8)])
CASES = {
    f'camera {where}, intrinsics {lens}': (where != 'fixed', lens)
    for where in ('on the flange', 'fixed')
    for lens in ('given', 'prior', 'fitted')
}
OFF = {'fx': 8.0, 'fy': -6.0, 'cx': 5.0, 'cy': -7.0, 'k1': 0.02, 'k2': -0.03}
"""By how much intrinsics are wrong before they are fitted."""
PRIOR = {'fx': 3.0, 'fy': 3.0, 'cx': 3.0, 'cy': 3.0, 'k1': 0.01, 'k2': 0.02, 'p1': 1e-3}
PRIOR |= {'p2': 1e-3, 'k3': 0.02}
"""Standard deviations by which they are wrong where a prior holds them."""


def scene(nominal, seed, on_flange, kind, images):
    """Return the true chain, the nominal one with its lens, what was seen, and other joints.

    The lens is `given`, `fitted` from OFF on, or off by a PRIOR.
    """
    rng = np.random.default_rng(seed)
    camera = Camera()
    while True:
        true = before_camera(faulty(nominal, Cell(), rng), camera, POINTS, on_flange, rng)
        try:
            seen = photograph(true, camera, POINTS, on_flange, images, rng, SIGMA)
            other = photograph(true, camera, POINTS[:1], on_flange, 50, rng).joints
            break
        except InputError:  # out of the arm's reach
            continue
    off = {
        'given': {},
        'fitted': OFF,
        'prior': {name: s * rng.normal() for name, s in PRIOR.items()},
    }
    lens = replace(camera.lens.moved(off[kind]), fixed=kind == 'given')
    frame = Frame(lens=lens)
    known = replace(nominal, tool=frame) if on_flange else replace(nominal, base=frame)
    return true, known, seen, other


def error_of(chain, true, joints):
    """Return the RMS distance [mm] of positions at other joint values."""
    return 1e3 * bench.rms(bench.distances(chain, true, joints))


def off(result, true):
    """Return how far (P,) parameters are from the true ones, and whether within their limits."""
    deviation = np.array([result.chain.offset(name, true) for name in result.names])
    width = {p.name: p.half_width() for p in result.parameters if p.std is not None}
    return deviation, np.abs(deviation) <= [width[name] for name in result.names]


def one_run(nominal, seed, on_flange, lens, images):
    """Return squared deviation / bound (P,), hits (P,), errors [mm] by pixels and by poses."""
    true, known, seen, other = scene(nominal, seed, on_flange, lens, images)
    frame = 'tool' if on_flange else 'base'
    priors = {f'{frame}.{kind}': sigma for kind, sigma in PRIOR.items() if lens == 'prior'}
    problem = Problem(
        known, seen, held_out=seen.select(np.arange(80)), sigma_pixel=SIGMA, priors=priors
    )
    result = identify(problem)
    bound = uncertainty.covariance(triangular_factor(true, result.names, problem.system([seen])))
    deviation, hits = off(result, true)
    poses = board_poses(seen, known.frame(frame).lens)
    by_poses = identify(Problem(known, poses, held_out=poses.select(np.arange(2))))
    errors = error_of(result.chain, true, other), error_of(by_poses.chain, true, other)
    return deviation**2 / np.diag(bound), hits, errors


def rendered_run(nominal, seed, images):
    """Return hits (P,), the RMS of residuals [px] and the error [mm] by rendered images."""
    sys.path[:0] = [str(Path(__file__).resolve().parents[1] / 'test')]
    from photographs import rendered

    from calib_ros.files.boards import Board
    from calib_ros.files.detections import observed
    from calib_ros.files.detector import detect

    rng = np.random.default_rng(seed)
    board = Board('charuco', 9, 7, 0.03, 0.022, 'DICT_5X5_250')
    camera = Camera(lens=Lens(1350.0, 1355.0, 795.0, 605.0))
    true = before_camera(faulty(nominal, Cell(), rng), camera, board.corners, True, rng)
    joints = photograph(true, camera, board.corners, True, images, rng).joints[
        :: len(board.corners)
    ]
    poses = se3.invert(true.forward(joints))
    size = (camera.width, camera.height)
    pictures = ((str(k), rendered(board, p, camera.lens, size)[0]) for k, p in enumerate(poses))
    places = {str(k): q for k, q in enumerate(joints)}
    seen, _ = observed(detect(pictures, board)[0], board, places, True)
    known = replace(nominal, tool=Frame(lens=camera.lens))
    result = identify(Problem(known, seen, sigma_pixel=0.03))
    other = photograph(true, camera, board.corners[:1], True, 50, rng).joints
    rms = result.fitted.figures[1].rms_px
    return off(result, true)[1], rms, error_of(result.chain, true, other)


def speed(nominal):
    """Print how long 500 images of 40 corners take, and one pass over them."""
    for lens in ('given', 'fitted'):
        _, known, seen, _ = scene(nominal, 0, True, lens, 500)
        taken = []
        for _ in range(5):
            begin = time.process_time()
            identify(Problem(known, seen, sigma_pixel=SIGMA))
            taken.append(time.process_time() - begin)
        system = Problem(known, seen, sigma_pixel=SIGMA).system([seen])
        names = known.parameter_names
        begin = time.process_time()
        for _ in range(20):
            normal_equations(known, names, system)
        once = (time.process_time() - begin) / 20
        print(
            f'500 images, intrinsics {lens}: {min(taken):.3f} s of CPU, '
            f'{min(taken) / once:.0f} times a pass over all corners'
        )


def over_runs(found, scale=1.0):
    """Return the mean over runs of what was found for each parameter, and its standard error."""
    means = scale * np.array([np.mean(each) for each in found])
    return f'{means.mean():.3f} +- {means.std() / np.sqrt(len(means)):.3f}'


def main():
    """Run all cases and print the figures."""
    options = bench.options(
        __doc__,
        runs=300,
        images=40,
        only=('', 'only cases with this in their names'),
        speed=(False, 'only how long 500 images take'),
        rendered=(False, 'only by rendered images'),
    )
    nominal = load_chain('ur10e')
    if options.speed:
        speed(nominal)
        return
    print(f'{options.runs} runs of {options.images} images')
    if options.rendered:
        rows = [rendered_run(nominal, seed, options.images) for seed in range(options.runs)]
        hits, rms, errors = zip(*rows, strict=True)
        print(
            f'rendered: coverage {over_runs(hits, 100.0)} %, RMS '
            f'{bench.rms(rms):.4f} px, error {bench.rms(errors):.4f} mm'
        )
        return
    for name, case in CASES.items():
        if options.only not in name:
            continue
        rows = [one_run(nominal, seed, *case, options.images) for seed in range(options.runs)]
        errors = np.sqrt((np.array([row[2] for row in rows]) ** 2).mean(axis=0))
        print(
            f'{name}: MSE / CRLB {over_runs([row[0] for row in rows])}, coverage '
            f'{over_runs([row[1] for row in rows], 100.0)} %, error {errors[0]:.4f} mm by pixels, '
            f'{errors[1]:.4f} mm by poses from PnP',
            flush=True,
        )


if __name__ == '__main__':
    main()
