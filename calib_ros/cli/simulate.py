# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros simulate | demo`: a cell with known errors."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from calib_ros.apply.simulation import Cell, drive, faulty, measure
from calib_ros.atomic import whole_folder, write_files
from calib_ros.cli import checks, common, inputs
from calib_ros.cli.identify import RESULT_FILES, identified, result_files, show
from calib_ros.cli.screen import Screen
from calib_ros.estimation.visits import approaches
from calib_ros.files.loading import load_bag
from calib_ros.files.recording import Recording, write_bag
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import chain_text, dump_chain, load_chain, parse_chain
from calib_ros.report import words


def _run(options: argparse.Namespace, screen: Screen) -> int:
    truth = _write_simulation(load_chain(options.chain), options, options.bag, screen)
    screen.say(f'wrote {options.bag} and the true chain {truth}')
    return 0


def _demo(options: argparse.Namespace, screen: Screen) -> int:
    chain = load_chain(options.chain)
    own = (*RESULT_FILES, 'bag_truth.yaml', 'bag/bag.*', 'bag/metadata.yaml')
    with whole_folder(options.out, own, overwrite=options.force) as folder:
        folder.mkdir()
        bag = folder / 'bag'
        screen.say(f'1. simulating an arm with known errors: {options.out / "bag"}')
        truth = _write_simulation(chain, options, bag, screen)
        screen.say('2. reading the recording as if from a real cell')
        loaded = load_bag(*inputs.replayed_bag(options, bag, chain, screen))
        screen.say('3. identifying the errors')
        found = identified(options, screen, loaded, bag)
        screen.say('4. writing the report')
        contents = result_files(found, options, screen)
        write_files(folder, contents)
        against = words.against_truth(found.result, parse_chain(chain_text(truth)))
    screen.say('identified offsets against the true ones [mm, mrad]:')
    screen.say(against)
    show(found, screen)
    screen.say(common.written(options.out, contents))
    return 0 if found.result.accepted else common.Status.NOT_ACCEPTED


def _write_simulation(
    chain: Chain, options: argparse.Namespace, bag: Path, screen: Screen
) -> Path:
    checks.at_least(options, poses=1, seed=0)
    rng, cell = np.random.default_rng(options.seed), Cell()
    true = faulty(chain, cell, rng)
    configurations = chain.random_joints(options.poses, rng)
    joint_stamps, joints, pose_stamps = drive(configurations, cell, 1_700_000_000_000_000_000)
    standing = np.repeat(configurations, cell.poses_per_dwell, axis=0)
    noise = cell.noise_position, cell.noise_orientation
    poses = measure(true, standing, rng, *noise, approach=approaches(standing))
    measured, held_out = poses.at(pose_stamps), np.zeros(len(poses), bool)
    recording = Recording(chain.joint_names, joint_stamps, joints, measured, held_out)
    truth = bag.parent / f'{bag.name}_truth.yaml'
    beside = {truth: dump_chain(true, {'source': 'simulation'})}
    with screen.work('simulating') as work:
        write_bag(bag, recording, options.storage, beside, work)
    return truth
