# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A corrected chain in formats for controllers and other software.

    dh_standard.csv, dh_modified.csv   tables of a, alpha, d, theta, beta, perhaps b; exact
    dh_standard.yaml, dh_modified.yaml the same as chain files, with base and tool; exact
    kinematics.yaml                    x y z roll pitch yaw from joint to joint; exact
    dh_without_beta.csv                the best table for controllers without beta
    joint_offsets.csv                  the best correction by joint offsets alone

The conventions differ only in where a row is cut: Tx(a) Ty(b) Rx(alpha) Ry(beta) ends the row of a
joint in the one and begins that of the next joint in the other. Every file is read back and
compared with the chain on random poses; an exact one that differs is refused, others state their
error in the first line.
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros.errors import CalibrationError
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.start import fit_to_arm
from calib_ros.kinematics import se3
from calib_ros.kinematics.axes import with_common_normals
from calib_ros.kinematics.chain import PARALLEL_TOLERANCE, Chain, Convention, Frame, Joint
from calib_ros.kinematics.chain_file import dump_chain, parse_chain, table_hash
from calib_ros.kinematics.corrected_urdf import corrected_urdf
from calib_ros.kinematics.effects import group_of
from calib_ros.kinematics.parameter import DH_KINDS, Parameter
from calib_ros.kinematics.se3 import ROUNDING, FloatArray
from calib_ros.kinematics.urdf_editor import to_rpy
from calib_ros.shown import rounded
from calib_ros.texts import csv_text, dump_yaml, from_cell, parse_yaml, to_cell
from calib_ros.values import SAME

FILES = (
    *('dh_standard.csv', 'dh_modified.csv', 'dh_standard.yaml', 'dh_modified.yaml'),
    *('kinematics.yaml', 'dh_without_beta.csv', 'joint_offsets.csv'),
)
CORRECTED_URDF = '_corrected.urdf'  # suffix of a corrected URDF beside these files
TAIL = ('a', 'alpha', 'beta', 'b')
"""End of a joint's row in one convention, start of the next joint's in the other."""
ROW = ('joint', 'type', 'sign')
RANDOM = ' at 1,000 random poses'


class ExportError(CalibrationError):
    """An exported file that differs from the chain."""


@dataclass(frozen=True)
class Export:
    """An exported file."""

    name: str
    content: str
    error: float  # largest position error [m]
    beyond: str = ''  # poses before and after the rows, as text
    elsewhere: str = RANDOM  # where that is, and the error at other poses, as text


def exports(
    chain: Chain,
    nominal: Chain,
    joints: FloatArray | None = None,
    origin: Mapping[str, Any] | None = None,
) -> tuple[Export, ...]:
    """Return a corrected chain in all formats, for a controller that has the nominal one.

    Tables that cannot be exact are fitted at `joints` (N, n) [rad or m], by default over the joint
    range. `origin` is recorded. Raises ExportError if a file read back differs from the chain.
    """
    q = anywhere(chain)
    arm, of_file = (  # of the effects a chain file holds couplings
        replace(chain, effects=tuple(e for e in each.effects if group_of(e[0]) == 'coupling'))
        for each in (nominal, chain)
    )
    others = [each for each in nominal.effects if each not in arm.effects]
    wanted = arm.forward(q)
    controlled = (replace(each, effects=(*each.effects, *others)) for each in (arm, of_file))
    lost, of_file_lost = (distance(chain, each, q) for each in controlled)
    counting = ', with the effects of the nominal chain'
    of_table, of_file_too = counting * bool(nominal.effects), counting * bool(others)
    found = []
    for convention in get_args(Convention):
        name, form = f'dh_{convention}', converted(arm, convention)
        what = f'{convention} Denavit-Hartenberg table'
        beyond = cut_off(arm, convention)
        text = head(chain, f'{what}{of_table}{beyond and f" ({beyond})"}', lost) + _csv(form)
        table = checked(f'{name}.csv', text, _read_csv(text, form).forward(q), wanted, lost)
        found.append(replace(table, beyond=beyond))
        text = head(chain, what + of_file_too, of_file_lost)
        text += dump_chain(converted(of_file, convention), origin)
        again, exact = parse_chain(text).forward(q), of_file.forward(q)
        found.append(checked(f'{name}.yaml', text, again, exact, of_file_lost))
    text = head(chain, f'kinematics{of_table}', lost) + kinematics_yaml(arm, origin)
    found.append(checked('kinematics.yaml', text, forward_of(text, arm, q), wanted, lost))
    region = q if joints is None else np.asarray(joints, dtype=np.float64)
    for name, kinds, what in (
        ('dh_without_beta.csv', DH_KINDS[:4], 'table without beta, the best one'),
        ('joint_offsets.csv', ('zero',), 'nominal table with corrected joint offsets only'),
    ):
        best = _approximated(chain, nominal, kinds, region)
        error, elsewhere = distance(best, chain, region), RANDOM
        if joints is not None:
            most = 1e3 * distance(best, chain, q)
            elsewhere = f' at the measured joint values, {rounded(most)} mm{RANDOM}'
        text = head(chain, f'{nominal.convention} {what}{of_table}', error, elsewhere)
        found.append(Export(name, text + _csv(best), error, elsewhere=elsewhere))
    return tuple(found)


def anywhere(chain: Chain) -> FloatArray:
    """Return the joint values (N, n) at which files are compared with a chain."""
    return chain.random_joints(1000, np.random.default_rng(0))


def converted(chain: Chain, convention: Convention) -> Chain:
    """Return the same arm in another convention; poses cut off go into base and tool."""
    if chain.convention == convention:
        return chain
    tails = [{name: getattr(joint, name) for name in TAIL} for joint in chain.joints]
    bends, gravity = [_tail(**tail) for tail in tails], chain.gravity
    none, base, tool = dict.fromkeys(TAIL, 0.0), chain.frame('base'), chain.frame('tool')
    moved = dict(zip(chain.joint_names, chain.joint_names[1:], strict=False))
    if convention == 'modified':
        tool = replace(tool, matrix=bends[-1] @ tool.matrix)
        tails = [none, *tails[:-1]]
    else:
        moved = {after: before for before, after in moved.items()}
        base = replace(base, matrix=base.matrix @ bends[0])
        gx, gy, gz = (bends[0][:3, :3].T @ gravity).tolist()
        gravity, tails = (gx, gy, gz), [*tails[1:], none]
        bends = [*map(se3.invert, bends[1:]), np.eye(4)]
    rows = zip(chain.joints, tails, bends, strict=True)
    joints = tuple(replace(_weighed(joint, bend), **tail) for joint, tail, bend in rows)
    parallel = tuple(moved[name] for name in chain.parallel or () if name in moved)
    more: dict[str, Any] = {'base': base, 'tool': tool, 'frames': (), 'parallel': parallel}
    return replace(chain, convention=convention, joints=joints, gravity=gravity, **more)


def _weighed(joint: Joint, bend: FloatArray) -> Joint:
    """Return a joint whose mass is given in another frame at the end of its link."""
    x, y, z, _ = (bend @ [*joint.com, 1.0]).tolist()
    return replace(joint, com=(x, y, z)) if joint.mass else joint


def cut_off(chain: Chain, convention: Convention) -> str:
    """Return the poses before and after the rows of another convention as text, if any.

    A modified table has no a and alpha after the last joint, a standard one none before the first.
    """
    form = converted(replace(chain, base=Frame(), tool=Frame(), frames=()), convention)
    places = {'from the base to the first row': 'base', 'from the last row to the flange': 'tool'}
    found = []
    for words, frame in places.items():
        matrix = form.frame(frame).matrix
        if np.abs(matrix - np.eye(4)).max() > SAME:
            numbers = [f'{kind} {number:.10g}' for kind, number in xyz_rpy(matrix).items()]
            found.append(f'{words}: {" ".join(numbers)}')
    return ', '.join(found)


def _tail(a: float, alpha: float, beta: float, b: float) -> FloatArray:
    about_x, about_y = se3.exp_rotation(np.array([[alpha, 0.0, 0.0], [0.0, beta, 0.0]]))
    return se3.transform(about_x @ about_y, np.array([a, b, 0.0]))


def kinematics_yaml(chain: Chain, origin: Mapping[str, Any] | None = None) -> str:
    """Return the pose of each joint in the frame of the one before, as vendors write it.

    The first is in the base, the last is the flange. Joints turn about their z, those listed as
    prismatic move along it.
    """
    form = converted(replace(chain, base=Frame(), tool=Frame()), 'modified')
    names = (*chain.joint_names, _flange(chain))
    poses = {name: xyz_rpy(place) for name, place in zip(names, origins(form), strict=True)}
    signs = {joint.name: joint.sign for joint in form.joints}
    document: dict[str, Any] = {'kinematics': poses, 'signs': signs}
    if slides := [joint.name for joint in form.joints if joint.type == 'prismatic']:
        document['prismatic'] = slides
    digest = hashlib.sha256(dump_yaml(document).encode()).hexdigest()
    return labelled({**document, 'hash': f'sha256_{digest}'}, origin)


def labelled(document: Mapping[str, Any], origin: Mapping[str, Any] | None) -> str:
    """Return a file for vendors with the origin of its numbers, less its region of 100 kB."""
    known = {name: each for name, each in (origin or {}).items() if name != 'region'}
    return dump_yaml({**document, 'calibration': known} if known else dict(document))


def origins(form: Chain) -> FloatArray:
    """Return the frames (n + 1, 4, 4) of the joints of a modified chain, and the tool, at zero."""
    rows = [replace(joint, sign=1, lower=None, upper=None) for joint in form.joints]
    chains = [Chain(form.name, 'modified', (row,), parallel=()) for row in rows]
    places = [chain.forward(np.zeros((1, 1)))[0] for chain in chains]
    return np.array([*places, form.frame('tool').matrix])


def forward_of(text: str, chain: Chain, q: FloatArray) -> FloatArray:
    """Return the target's poses (N, 4, 4) by a kinematics file, in the frames of a chain."""
    document = parse_yaml(text, 'kinematics.yaml')
    poses, signs = document['kinematics'], document['signs']
    places = [pose_matrix(poses[name]) for name in chain.joint_names]
    slides = [name in document.get('prismatic', ()) for name in chain.joint_names]
    values = chain.effective(q.T).T
    moved = walked(places, values * [signs[name] for name in chain.joint_names], slides)
    end = pose_matrix(poses[_flange(chain)]) @ chain.frame('tool').matrix
    return np.asarray(chain.frame('base').matrix @ moved @ end)


def _flange(chain: Chain) -> str:
    """Return the name of the last frame, which no joint may have."""
    return 'flange' + '_' * ('flange' in chain.joint_names)


def walked(
    places: Sequence[FloatArray], q: FloatArray, slides: Sequence[bool] | None = None
) -> FloatArray:
    """Return the poses (N, 4, 4) after frames that turn about, or slide along, their z."""
    pose = np.eye(4)
    for k, place in enumerate(places):
        moved = np.tile(np.eye(4), (len(q), 1, 1))
        if slides is not None and slides[k]:
            moved[:, 2, 3] = q[:, k]
        else:
            moved[:, :3, :3] = se3.exp_rotation(q[:, k, np.newaxis] * [0.0, 0.0, 1.0])
        pose = pose @ place @ moved
    return np.asarray(pose)


def xyz_rpy(matrix: FloatArray) -> dict[str, float]:
    """Return a pose (4, 4) as x, y, z [m] and the angles [rad] about fixed axes."""
    angles = se3.to_euler(matrix[:3, :3], 'xyz')
    again = Rotation.from_euler('xyz', angles).as_matrix()
    if np.abs(again - matrix[:3, :3]).max() > ROUNDING:  # a pitch of 90 degrees but for 1e-7
        angles = to_rpy(matrix[:3, :3], angles)
    numbers = [*matrix[:3, 3].tolist(), *angles.tolist()]
    return dict(zip(('x', 'y', 'z', 'roll', 'pitch', 'yaw'), numbers, strict=True))


def pose_matrix(pose: Mapping[str, float]) -> FloatArray:
    """Return the pose (4, 4) of x, y, z, roll, pitch, yaw."""
    rotation = Rotation.from_euler('xyz', [pose[k] for k in ('roll', 'pitch', 'yaw')])
    return se3.transform(rotation.as_matrix(), np.array([pose[k] for k in 'xyz']))


def head(chain: Chain, what: str, error: float, elsewhere: str = RANDOM) -> str:
    """Return the first line: a file's kind, its error [m], and the table of the chain."""
    name = re.sub(r'[^\w .-]', '_', chain.name)  # one line, one cell
    off = f'up to {rounded(1e3 * error)} mm off the calibrated arm{elsewhere}'
    table = f'calibrated table {table_hash(chain)}'
    return f'# {name}: {what}; metres and radians; {off if error else "exact"}; {table}\n'


def urdf_export(name: str, urdf: str, chain: Chain, links: Mapping[str, str | None]) -> Export:
    """Return a corrected URDF; a comment at its end identifies each arm by its last joint."""
    arm = re.sub(r'\W', '_', chain.joint_names[-1])  # as a comment may hold it
    urdf = re.sub(f'<!-- calibrated table [0-9a-f]* of {arm} -->\n', '', urdf)  # corrected before
    foot = f'<!-- calibrated table {table_hash(chain)} of {arm} -->\n'
    return Export(name, corrected_urdf(urdf, chain, **links) + foot, 0.0)


def _csv(chain: Chain) -> str:
    pairs = zip(chain.joints, chain.table.tolist(), strict=True)
    rows = [(to_cell(each.name), each.type, each.sign, *row) for each, row in pairs]
    return csv_text([(*ROW, *chain.columns), *rows])


def _read_csv(text: str, form: Chain) -> Chain:
    joints = []
    for row in csv.DictReader(io.StringIO(text.partition('\n')[2], newline='')):
        known: dict[str, Any] = {name: float(row[name]) for name in form.columns}
        known |= {'name': from_cell(row['joint']), 'type': row['type'], 'sign': int(row['sign'])}
        joints.append(Joint(**known))
    return replace(form, joints=tuple(joints))


def checked(name: str, text: str, again: FloatArray, wanted: FloatArray, lost: float) -> Export:
    """Return a file that, read back, gives the wanted poses (N, 4, 4)."""
    difference = float(np.abs(again - wanted).max())
    if not difference <= SAME:
        raise ExportError(
            f'{name}, read back, differs from the calibration by {difference:.3g} (m or rad): '
            'it is not written'
        )
    return Export(name, text, lost)


def distance(first: Chain, second: Chain, joints: FloatArray) -> float:
    """Return the largest distance [m] of two arms at joint values (N, n), by any last moves."""
    moves = np.random.default_rng(0).choice(np.array([-1.0, 1.0]), joints.shape)
    apart = first.forward(joints, moves)[:, :3, 3] - second.forward(joints, moves)[:, :3, 3]
    return float(se3.norms(apart).max())


def _approximated(chain: Chain, nominal: Chain, kinds: Sequence[str], joints: FloatArray) -> Chain:
    """Return the nominal chain with some kinds of parameters fitted to another one.

    `zero` stands for the joints' offsets. The controller's effects are those of the nominal
    chain. Base and tool are those of the other one, since no row holds them, and d of nearly
    parallel axes stays: without beta it would carry a tilt as a common normal metres away.
    """
    base, tool = chain.frame('base'), chain.frame('tool')
    start = replace(nominal, parallel=(), base=base, tool=tool, frames=())
    if 'zero' in kinds:
        names = {joint.driven for joint in start.joints}
    else:
        form = with_common_normals(start)
        plain = tuple(replace(joint, beta=0.0, b=0.0) for joint in form.joints)
        close = {each.name for each in plain if each.tilt < np.sin(PARALLEL_TOLERANCE)}
        start = replace(start, joints=plain)
        names = {name for name in start.parameter_names if Parameter(name).kind in kinds}
        names -= {Parameter(name, 'd') for name in close.intersection(form.parallel or ())}
    ordered = [name for name in start.parameter_names if name in names]
    joints = joints[:: max(1, len(joints) // SOME_POSES)]  # fitted on some, judged on all
    return fit_to_arm(start, ordered, chain, joints, 1e-3)[0]
