# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of samples (CSV): measurements or a journal (docs/formats.md).

A table is read as a CSV with our names (`vocabulary`), a journal, or one of another system
(`foreign`); its rows become measurements with their rules, then sets of observations.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.annotated import Count, Positive, as_annotated
from calib_ros.errors import ColumnsError, InputError
from calib_ros.files.columns import Columns, columns_of
from calib_ros.files.foreign import Foreign
from calib_ros.files.headers import TURNS_LEFT, joints_left_out, name_and_unit, not_read
from calib_ros.files.journal import columns, of_journal
from calib_ros.files.measurements import Measurements, distinct_rows
from calib_ros.files.names import in_doubt, like_joints, option, quaternions_in, turns_in
from calib_ros.files.selection import select_rows, without_others
from calib_ros.files.skipped import drop_unmeasured
from calib_ros.files.summary_rows import without_statistics
from calib_ros.files.vocabulary import (
    COVARIANCE,
    MATRIX,
    POSITION,
    QUATERNION,
    SIGMAS,
    TURNS,
    WORDS,
    joint_columns,
)
from calib_ros.progress import Notify, quiet
from calib_ros.sampling.dataset import Dataset, dataset_of
from calib_ros.settings import Settings
from calib_ros.texts import LARGEST_TABLE, read_bytes

USUAL_SIGMAS = Settings().sigmas


@as_annotated
def read_table(
    path: Path | str,
    joints: Count,
    sessions: Sequence[str] = (),
    sigmas: tuple[Positive, Positive] = USUAL_SIGMAS,
    eye_in_hand: bool = False,
    foreign: Foreign | None = None,
    progress: Notify = quiet,
) -> Dataset:
    """Read a CSV table, or one in any other layout.

    `joints` is their number; `dataset.problem(chain)` is what `identify` takes. Of several
    `sessions`, each after the first gets its own base and tool frames. `sigmas` are the
    standard deviations [m, rad] of poses seen by a camera on the flange; with `eye_in_hand` all
    poses are of a fixed target in such a camera. `foreign` tells how to read a table from another
    system; `progress` receives the share read.

    Raises InputError for a missing column, a value that is not a number, an ambiguous session, or
    measurements of one device in different frames. The message names the line.
    """
    path, read = Path(path), None
    if foreign is not None:
        read = foreign.convert(path)
    elif path.is_file():  # a pipe can be read once only
        read = of_journal(path, joints, progress)
    found, warnings = read or _of_csv(path, joints, progress)
    found, more = without_others(found)
    made = _dataset(select_rows(found, joints, sessions), sigmas, eye_in_hand)
    return replace(made, warnings=(*warnings, *more), by_line='stamp_ns' not in found.cells)


def _of_csv(path: Path, joints: int, progress: Notify) -> tuple[Columns, tuple[str, ...]]:
    """Return the columns of a table with our names, and what of it is not read as it stands."""
    found = columns_of(path, read_bytes(path, LARGEST_TABLE, InputError), progress)
    count = Counter(map(str.lower, found.cells))
    low = {name: name.lower() for name in found.cells if count[name.lower()] == 1}
    meant = {name: ours for name, ours in low.items() if ours in WORDS and ours != name}
    if {*POSITION} <= {*low.values()} and not {*POSITION} & {*low}:
        raise ColumnsError(f'{path} has no column x, y, z, but X, Y, Z: rename them')
    if not {*QUATERNION} & {*found.cells}:
        meant |= {name: ours for ours, name in quaternions_in(found.header).items()}
    cells = {meant.get(name, name): given for name, given in found.cells.items()}
    found = replace(found, cells=cells)
    plain = [name for name in POSITION if name in cells]
    if doubt := in_doubt(found.header, plain, joints * ('q1' in cells)):
        raise ColumnsError(f'{path}: {doubt}')
    found, left = without_statistics(found)
    kept, skipped = drop_unmeasured(found)
    if skipped and 'q1' in cells:  # of whole rows: others were cut off
        found.block([name for name in joint_columns(joints) if name in cells], needed=False)
        if np.setdiff1d(found.lines[found.blank('q1')], kept.lines).size:
            raise ColumnsError(f'{path} has rows without numbers')  # remarks, perhaps titles
    if {*MATRIX} <= {*cells}:
        raise ColumnsError(f'{path} has rotation matrices: calib_ros import makes quaternions')
    if {*SIGMAS[:3]} <= {*low.values()} and COVARIANCE[0] not in cells:
        raise ColumnsError(f'{path} has standard deviations: calib_ros import makes covariances')
    notes = [f'{path}: the column {name} is read as {ours}' for name, ours in meant.items()]
    notes += [f'{path}: {note}' for note in left]
    notes += (*skipped, *joints_left_out(path, found.header, joints))
    if QUATERNION[0] not in cells:
        if {*TURNS} <= {*cells}:
            notes.append(f'{path}: {TURNS_LEFT}')
        notes += turns_in(path, [name_and_unit(name)[0] for name in found.header])
    known = {*columns(joints), *TURNS, 'plane', 'valid', f'q{joints + 1}'}
    return kept, (*notes, *not_read(path, [name for name in cells if name not in known]))


def _dataset(made: Measurements, sigmas: tuple[float, float], eye_in_hand: bool) -> Dataset:
    made = made.kept()
    made.check_frames()
    if eye_in_hand:
        made = replace(made, eye_in_hand=np.ones(len(made.lines), dtype=bool))
    if made.view[1] != ['']:
        found = dataset_of([*made.samples()], sigmas)
    else:  # arrays, with one example of each kind
        _, number = distinct_rows(made.codes)
        examples = made.select(np.unique(number, return_index=True)[1])

        def columns_of_set(members: Sequence[int]) -> dict[str, Any]:
            rows = np.isin(number, members)
            return vars(made if rows.all() else made.select(rows))

        found = dataset_of([*examples.samples()], sigmas, columns=columns_of_set)
    place, names = made.frame_id
    return replace(found, world_frame=next((names[k] for k in place.tolist() if names[k]), ''))


def check_table(made: Columns) -> None:
    """Refuse columns that no table may have: any sessions, with as many joints as there are."""
    joints = sum(re.fullmatch('q[0-9]+', name) is not None for name in made.cells)
    if not joints:
        likes = (like_joints(made.theirs, count) for count in range(9, 2, -1))
        like = next(filter(None, likes), {'q*': 'NAME*'})
        given = option(like, like.values())
        raise InputError(
            f'{made.path} has no joint values: name their columns ({given}), give the '
            'chain with those joint names (--chain), or their separate table (--joints)'
        )
    sessions = made.texts('session') if 'session' in made.cells else ()
    made, _ = without_others(made)
    _dataset(select_rows(made, joints, tuple(dict.fromkeys(sessions))), USUAL_SIGMAS, False)
