# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a camera saw, as what `identify` fits."""

from __future__ import annotations

import argparse
from dataclasses import replace

from calib_ros.cli.given import table
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.files.boards import (
    POSED,
    observed,
    read_board,
    read_detections,
    read_lens,
    read_places,
)
from calib_ros.files.loading import Loaded
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason, Rule
from calib_ros.kinematics.chain import Chain
from calib_ros.sampling.problems import with_lenses
from calib_ros.settings import Settings


def detected(
    options: argparse.Namespace, chain: Chain, settings: Settings, screen: Screen
) -> Loaded:
    """Return what is to be fitted of corners of a board, and of a table besides."""
    for name in ('board', 'places'):
        if getattr(options, name) is None:
            raise InputError(f'--detections need --{name} as well')
    board = read_board(options.board)
    found = read_detections(options.detections, board)
    places, posed = read_places(options.places, len(chain.joints))
    if posed != (chain.name == POSED):
        raise InputError(
            f'{options.places} holds {"poses of the flange" if posed else "joint values"}: '
            + (f'give --chain {POSED}' if posed else 'give the chain of the arm')
        )
    seen, warnings = observed(found, board, places, options.eye_in_hand)
    more, by_line = [], True
    if options.csv is not None:
        rows = table(options, options.csv, chain, settings, screen)
        more, warnings = [*rows.fitted], (*warnings, *rows.warnings)
        by_line = rows.by_line
        names = ('base_board', 'tool_camera') if seen.on_flange else ('base_camera', 'tool_board')
        seen = replace(seen, base=names[0], tool=names[1])
    known = chain.frame(seen.camera).lens if seen.camera in chain.frame_names else None
    lens = known if options.intrinsics is None else read_lens(options.intrinsics)
    if lens is not None:
        chain = with_lenses(chain, {seen.camera: replace(lens, fixed=options.lens != 'fitted')})
    given = settings.for_problem()
    if options.sigma_touch is not None:
        given['sigma_touch'] = options.sigma_touch
    if posed:
        given['fixed'] = (*given['fixed'], *(f'{name}.*' for name in chain.joint_names))
    problem = Problem(
        chain,
        seen,
        rows.held_out if options.csv is not None else None,
        more=more,
        **given,
    )
    reason = 'joint values are not known, so nothing of the arm was fitted: only what follows'
    refusals = (Reason(Rule.POSED, reason),) if posed else ()
    count = sum(map(len, problem.sets))
    samples = {'samples': count, 'images': len(found.names), 'sets': len(problem.sets)}
    images = dict(zip(found.lines, found.names, strict=True)) if by_line else {}
    return Loaded(problem, samples, warnings, '', by_line, images, refusals, instead=posed)
