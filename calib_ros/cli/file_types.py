# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What kind of file was given, by content and name, and where it belongs if not here."""

from __future__ import annotations

from pathlib import Path

from calib_ros.errors import InputError
from calib_ros.files import images
from calib_ros.files.loading import TABLES
from calib_ros.files.unpacked import RECORDED
from calib_ros.kinematics.chain_file import URDF_SUFFIXES

BEGINNINGS = (
    *((mark, 'bag') for mark in (b'\x89MCAP', b'SQLite format 3', b'\x28\xb5\x2f\xfd')),
    *((mark, 'image') for mark in (b'\x89PNG', b'\xff\xd8\xff')),
    *((mark, 'report') for mark in (b'%PDF', b'<!doctype html')),
    *((mark, 'native') for mark in (b'&ACCESS', b'DEFDAT', b'DEF ', b'MODULE ', b'/PROG')),
)
NATIVE = ('.src', '.mod', '.prg', '.ls', '.tp', '.script', '.urp', '.pgx', '.dtx', '.jbi')
KIND_OF_SUFFIX = {
    **dict.fromkeys(NATIVE, 'native'),
    **dict.fromkeys((*RECORDED, '.bag'), 'bag'),
    **dict.fromkeys(URDF_SUFFIXES, 'urdf'),
    **dict.fromkeys(('.yaml', '.yml'), 'chain'),
    **dict.fromkeys(images.SUFFIXES, 'image'),
    **dict.fromkeys(('.html', '.pdf', '.md', '.json'), 'report'),
    **dict.fromkeys(TABLES, 'table'),
    **dict.fromkeys(('.zip', '.tar', '.tgz', '.gz', '.7z', '.rar'), 'archive'),
    **dict.fromkeys(('.xls', '.xlsb', '.ods', '.numbers'), 'workbook'),
}
IN_FOLDERS = (('metadata.yaml', 'bag'), ('result.json', 'result'), ('calibration.yaml', 'result'))
IN_ANY_FOLDER = (('bag', 'bag'), ('image', 'images'), ('table', 'tables'))
FILE_KINDS = {
    'bag': ('a bag', 'use identify or verify, or bag2csv to make a table'),
    'table': ('a table', 'use identify or verify, or csv2bag to make a bag'),
    'program': ('a JointTrajectory', 'use compensate'),
    'native': (
        "a program in a robot's own language",
        'write its joint values as a CSV of q1 [deg] ... (q1 ... in rad), a row for each pose',
    ),
    'chain': ('a YAML file', 'give an arm as --chain, a calibration as --calibration'),
    'urdf': ('a URDF', 'give it as --chain'),
    'result': ('the result of identify', 'use workspace, or give it as --calibration'),
    'image': ('an image', 'use calib_ros images on its folder'),
    'images': ('a folder of images', 'use calib_ros images'),
    'tables': ('a folder of tables', 'use identify or verify on the tables in it (FOLDER/*.csv)'),
    'workbook': ('a workbook of another kind', 'save it as .xlsx or CSV'),
    'archive': ('an archive', 'unpack it and give what is in it'),
    'report': ('a report', 'read it; calibration.yaml beside it is the result'),
}


def _by_suffix(name: str) -> str:
    return KIND_OF_SUFFIX.get(Path(name).suffix.lower(), '')


def kind_of(path: Path) -> str:
    """Return a key of `FILE_KINDS`, or empty text if unknown."""
    if path.is_dir():
        names = [each.name for each in path.iterdir()]
        found = [kind for name, kind in IN_FOLDERS if name in names]
        inside = {*map(_by_suffix, names)}
        found += [kind for each, kind in IN_ANY_FOLDER if each in inside]
        return found[0] if found else ''
    begin = b''
    if path.is_file():
        with path.open('rb') as file:
            begin = file.read(100_000)
    for mark, kind in BEGINNINGS:
        if begin[:16].lower().startswith(mark.lower()):
            return kind
    if b' jointtarget ' in begin[:100]:  # RAPID without its MODULE
        return 'native'
    kind = 'urdf' if b'<robot' in begin else _by_suffix(path.name)
    return 'program' if kind == 'chain' and b'points:' in begin else kind


def proposal(path: Path) -> str | None:
    """Return what to do with a file given instead of a command; None for no file."""
    kind = kind_of(path)
    if not kind:
        return None
    what, where = FILE_KINDS[kind]
    return f'{path} is {what}, not a command: {where} (calib_ros COMMAND --help)'


def refuse_others(path: Path, command: str, *wanted: str) -> str:
    """Return which of the wanted kinds a path is: the first of an unknown file, else the last."""
    kind = kind_of(path) or wanted[0 if path.exists() and not path.is_dir() else -1]
    if kind not in wanted:
        what, where = FILE_KINDS[kind]
        takes = ' or '.join(FILE_KINDS[each][0] for each in wanted)
        raise InputError(f'{path} is {what}, but {command} takes {takes}: {where}')
    return kind
