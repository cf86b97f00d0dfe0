# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Cameras: `calib_ros board | images`, and what `identify` takes of them."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calib_ros.cli.commands import Command
from calib_ros.errors import InputError

if TYPE_CHECKING:
    from calib_ros.files.images import Image
    from calib_ros.identification.identification import Identification
    from calib_ros.identification.problem import Problem
    from calib_ros.kinematics.chain import Chain
    from calib_ros.settings import Settings

DETECTIONS = ('detections', 'board', 'places', 'intrinsics', 'lens', 'sigma_pixel')
"""Options of `identify` for what a camera saw."""
SIGMA_PIXEL = 0.3


def add_camera_commands(command: Command) -> None:
    """Add the commands of this module by a function of name, what to run, and help."""
    board = command('board', _board, 'print a board for cameras, as PDF in its true size')
    board.add_argument('type', choices=('charuco', 'markers'), help='markers: a grid of them')
    for name, text in (('columns', 'across'), ('rows', 'down')):
        board.add_argument(f'--{name}', type=int, required=True, help=f'squares or markers {text}')
    board.add_argument(
        '--square', type=float, required=True, metavar='M', help='from one to the next'
    )
    board.add_argument('--marker', type=float, required=True, metavar='M', help='side of a marker')
    board.add_argument('--dictionary', default='DICT_5X5_250', help='DICT_APRILTAG_36h11, ...')
    board.add_argument('--out', type=Path, required=True, help='PDF; its YAML is put beside it')
    board.add_argument('--force', action='store_true', help='overwrite --out')

    images = command('images', _images, 'find the corners of a board in photographs')
    images.add_argument('images', type=Path, help='folder of images, or a bag')
    images.add_argument('--board', type=Path, required=True, help='YAML of the board')
    images.add_argument('--topic', default='', help='of the images in a bag, if there are several')
    images.add_argument('--fewest', type=int, default=6, help='corners that an image must show')
    images.add_argument('--out', type=Path, required=True, help='table: image, corner, u, v')
    images.add_argument('--force', action='store_true', help='overwrite --out')


def add_detections(identify: argparse.ArgumentParser) -> None:
    """Add the options of `identify` for what a camera saw."""
    add = identify.add_argument
    add('--detections', type=Path, metavar='FILE', help='corners of a board, by calib_ros images')
    add('--board', type=Path, metavar='FILE', help='YAML of that board')
    add(
        '--places',
        type=Path,
        metavar='FILE',
        help='table of the arm at each image: image and q1 ... qn; with --chain flange_pose x y z '
        'qx qy qz qw of the flange',
    )
    add(
        '--intrinsics', type=Path, metavar='FILE', help='camera_info, as camera_calibration has it'
    )
    add(
        '--lens',
        choices=('given', 'fitted'),
        help='whether the intrinsics are fitted as well; given if not said',
    )
    add('--sigma-pixel', type=float, metavar='PX', help=f'of a corner, {SIGMA_PIXEL} if not given')


def _board(options: argparse.Namespace) -> int:
    import numpy as np

    from calib_ros.atomic import write_file
    from calib_ros.files.boards import Board
    from calib_ros.files.images import marker_cells
    from calib_ros.kinematics.chain_file import dump_yaml
    from calib_ros.report.plots import board_pdf

    keys = ('type', 'columns', 'rows', 'square', 'marker', 'dictionary')
    content = {key: getattr(options, key) for key in keys}
    board = Board(**content)
    rows: list[tuple[float, float, float, float]] = []
    if board.type == 'charuco':
        x, y = np.meshgrid(np.arange(board.columns), np.arange(board.rows))
        black = np.column_stack([x.ravel(), y.ravel()])[(x + y).ravel() % 2 == 0]
        rows += [(board.square * i, board.square * j, *[board.square] * 2) for i, j in black]
    for cells, (left, top) in zip(marker_cells(board), board.markers.tolist(), strict=True):
        size = board.marker / len(cells)
        for k, row in enumerate(cells):  # runs of black cells: no white lines between them
            edges = np.flatnonzero(np.diff(np.concatenate([[0], row, [0]])))
            for first, last in edges.reshape(-1, 2).tolist():
                rows.append((left + first * size, top + k * size, (last - first) * size, size))
    if options.out.suffix.lower() != '.pdf':
        raise InputError(f'--out must end in .pdf, not {options.out.name}')
    width, height = (1e3 * side for side in board.size)
    words = f'{board.type} {board.columns} x {board.rows}, {board.dictionary}; must measure '
    words += f'{width:.2f} x {height:.2f} mm: print in true size (100 %)'
    described = options.out.with_suffix('.yaml')
    if described.exists() and not options.force:
        raise InputError(f'{described} exists already: choose another name or --force')
    write_file(options.out, board_pdf(np.array(rows), board.size, words), overwrite=options.force)
    write_file(described, dump_yaml(content), overwrite=options.force)
    print(f'wrote {options.out} and {described}: {width:.2f} x {height:.2f} mm; measure the print')
    return 0


def _images(options: argparse.Namespace) -> int:
    from calib_ros.atomic import write_file
    from calib_ros.files.boards import read_board
    from calib_ros.files.images import detect

    if options.out.exists() and not options.force:
        raise InputError(f'{options.out} exists already: choose another name or --force')
    if options.fewest < 1:
        raise InputError(f'--fewest must be at least 1, not {options.fewest}')
    board = read_board(options.board)
    found = detect(_pictures(options), board, options.fewest, lambda line: print(line, flush=True))
    write_file(options.out, found.detections.as_csv(), overwrite=options.force)
    used, corners = len(found.detections.names), len(found.detections.corner)
    print(
        f'wrote {options.out}: {corners} corners of {used} images, {len(found.refused)} not used'
    )
    return 0


def _pictures(options: argparse.Namespace) -> Iterator[tuple[str, Image]]:
    """Yield the images of a folder by their names, of a bag by their stamps."""
    from calib_ros.files.images import SUFFIXES, decoded, files_of, grey

    if not options.images.exists():
        raise InputError(f'there is nothing at {options.images}')
    folder = options.images.is_dir()
    if folder and any(path.suffix.lower() in SUFFIXES for path in options.images.iterdir()):
        yield from files_of(options.images)
        return
    if folder and not (options.images / 'metadata.yaml').exists():
        raise InputError(f'{options.images} has neither images ({", ".join(SUFFIXES)}) nor a bag')
    from calib_ros.files.bags import pictures

    for stamp, message in pictures(options.images, options.topic):
        if hasattr(message, 'format'):
            yield str(stamp), decoded(message.data.tobytes())
        else:
            size = (message.height, message.width, message.step)
            yield str(stamp), grey(message.data, *size, message.encoding)


def detected(
    options: argparse.Namespace, chain: Chain, settings: Settings
) -> tuple[Problem, Identification, dict[str, Any], tuple[str, ...]]:
    """Identify from corners of a board, and from a table besides; return what became of them."""
    from calib_ros.files.boards import (
        POSED,
        observed,
        read_board,
        read_detections,
        read_lens,
        read_places,
    )
    from calib_ros.files.tables import read_table
    from calib_ros.identification.model_choice import identify_model
    from calib_ros.identification.problem import Problem
    from calib_ros.kinematics.chain import Frame

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
    more = []
    if options.csv is not None:
        sigmas = (settings.sigma_position, settings.sigma_orientation)
        table = read_table(options.csv, len(chain.joints), (), sigmas)
        more, warnings = [*table.fitted], (*warnings, *table.warnings)
        names = ('base_board', 'tool_camera') if seen.on_flange else ('base_camera', 'tool_board')
        seen = replace(seen, base=names[0], tool=names[1])
    if seen.camera not in chain.frame_names:
        chain = chain.with_frame(seen.camera, Frame())
    camera = chain.frame(seen.camera)
    lens = camera.lens if options.intrinsics is None else read_lens(options.intrinsics)
    if lens is not None:
        lens = replace(lens, fixed=options.lens != 'fitted')
    chain = chain.with_frame(seen.camera, replace(camera, lens=lens))
    given = settings.for_problem()
    if options.sigma_touch is not None:
        given['sigma_touch'] = options.sigma_touch
    if posed:
        given['fixed'] = (*given['fixed'], *(f'{name}.*' for name in chain.joint_names))
    problem = Problem(
        chain,
        seen,
        table.held_out if options.csv is not None else None,
        more=more,
        sigma_pixel=SIGMA_PIXEL if options.sigma_pixel is None else options.sigma_pixel,
        **given,
    )
    result = identify_model(problem, settings.model)
    if posed:
        reason = 'joint values are not known, so nothing of the arm was fitted: only what follows'
        result = replace(result, refusals=(reason,))
    count = sum(map(len, problem.sets))
    samples = {'samples': count, 'images': len(found.names), 'sets': len(problem.sets)}
    return problem, result, samples, warnings
