# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros board | images`: a printed board, and its corners in photographs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from calib_ros.atomic import write_file, write_together
from calib_ros.cli import checks
from calib_ros.cli.file_types import refuse_others
from calib_ros.cli.screen import Screen, Work
from calib_ros.errors import InputError
from calib_ros.files.bags import pictures
from calib_ros.files.boards import BOARD_KEYS, Board, read_board
from calib_ros.files.detector import Image, black_of, detect
from calib_ros.files.images import SUFFIXES, image_files, image_of, read_image
from calib_ros.sampling.sample import Flaw
from calib_ros.texts import dump_yaml


def _board(options: argparse.Namespace, screen: Screen) -> int:
    from calib_ros.report.plots import board_pdf

    content = {key: getattr(options, key) for key in BOARD_KEYS[:-1]}
    board = Board(**content)
    black = black_of(board)
    if options.out.suffix.lower() != '.pdf':
        raise InputError(f'--out must end in .pdf, not {options.out.name}')
    printed = ' x '.join(f'{1e3 * side:.2f}' for side in board.size) + ' mm'
    words = f'{board.type} {board.columns} x {board.rows}, {board.dictionary}; must measure '
    words += f'{printed}: print in true size (100 %)'
    described = options.out.with_suffix('.yaml')
    checks.refuse_existing(options, options.out, described)
    drawn = {options.out: board_pdf(black, board.size, words)}
    write_together({**drawn, described: dump_yaml(content)}, overwrite=options.force)
    screen.say(f'wrote {options.out} and {described}: {printed}; measure the print')
    return 0


def _images(options: argparse.Namespace, screen: Screen) -> int:
    checks.refuse_existing(options, options.out)
    checks.at_least(options, fewest=1)
    board = read_board(options.board)
    with screen.work('looking for corners') as work:
        found, unused = detect(_pictures(options, work), board, options.fewest, screen.say)
    write_file(options.out, found.as_csv(), overwrite=options.force)
    corners = f'{len(found.corner)} corners of {len(found.names)} images'
    screen.say(f'wrote {options.out}: {corners}, {unused} not used')
    return 0


def _pictures(options: argparse.Namespace, work: Work) -> Iterator[tuple[str, Image | Flaw]]:
    if not options.images.exists():
        raise InputError(f'there is nothing at {options.images}')
    if not options.images.is_dir():
        refuse_others(options.images, 'images', 'images', 'bag')
    elif paths := image_files(options.images):
        for k, path in enumerate(paths):
            work(path.name)
            work(k / len(paths))
            yield path.name, read_image(path)
        return
    elif not (options.images / 'metadata.yaml').exists():
        raise InputError(f'{options.images} has neither images ({", ".join(SUFFIXES)}) nor a bag')
    for k, (stamp, message) in enumerate(pictures(options.images, options.topic), 1):
        work(f'image {k}')
        yield str(stamp), image_of(message)
