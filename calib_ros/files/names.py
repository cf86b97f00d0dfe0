# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the words in the names of columns say: coordinates, measured or nominal, rotations."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path

from calib_ros.files.vocabulary import (
    IN_TURN,
    MATRIX,
    NUMBERS,
    POSITION,
    QUATERNION,
    TURNS,
    joint_columns,
)

WORD = re.compile(r'[\u3040-\u9fff]+|[A-Z]?[^\W\d_A-Z\u3040-\u9fff]+|[A-Z]+(?![a-z])|[0-9]+')
"""Words of a name: `X_meas`, `pose.position.x`, `dX`, `Nominal X`, `X実測`."""
JOINED = re.compile(r'([xyzw])([^\W\d_]+)|([^\W\d_]+)([xyzw])', re.I)
"""An axis and the rest of a name in one word: `Xact`, `Actualx`, `XM`."""
CORNER = re.compile(r'(\D*)([01])(\D*)\2(\D*)')
"""The name of the first number of a matrix."""
SECOND_NAMES = re.compile(r'q[0-9]+[._ (]+[0-9]\)?', re.I)  # q1.1, as pandas names a second q1
SECOND_ARM = re.compile(r'q[2-9][._ (]+\*')
PLAIN = re.compile(r'#[\d*]+|[^\W\d][\w*]*(\.[\w*]+)*')
"""Names that --columns takes without braces."""


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


MEASURED_WORDS = _set(
    'meas measured measurement act actual true truth ist istwert fb fbk feedback enc encoder obs '
    'observed real mes mess tracker leica laser faro vicon gemessen mesuré mesurée '
    'misurato misurata medido medida réel réelle reale 実測 実測値 測定値 实测 测量 实际'
)
NOMINAL_WORDS = _set(
    'nom nominal cmd command commanded target soll sollwert ref reference des desired goal '
    'setpoint theo theoretical ideal cad design model calc computed pred predicted sim simulated '
    'prog programmed planned tcp ee robot fk théorique teorico teórico nominale consigne ziel '
    'vorgabe 設計値 理論値 指令値 理论'
)
NOMINAL_TITLES = NOMINAL_WORDS - _set(
    'target robot tcp ee model ref reference design prog fk goal planned theo'
)
"""Words that call the rows below a title nominal; others are of any cell."""
TITLE_WORDS = _set(
    'value values pose poses position positions point points coordinate coordinates data table '
    'werte punkte positionen koordinaten'
)
"""Other words of such titles: `nominal speed` is a remark."""
DEVIATION = _set('d dev deviation delta dif diff difference abw abweichung')
TURNED = _set('q quat quaternion orientation rot rotation')
DISTANCE_WORDS = _set('distance length wire abstand')
JOINT_WORDS = _set(
    'q j a enc encoder joint joints axis achse axe position pos theta th angle winkel gelenk eje '
    'asse giunto articulation articulación junta eixo'
)
NO_JOINT = _set(
    'vel velocity speed qd acc acceleration qdd force torque moment tau effort load currents '
    'voltage power temp temperature std stdev sd sigma err error rms var uncertainty status mode '
    'count counts tick ticks min max residual residuals cov covariance strom drehmoment '
    'geschwindigkeit courant couple vitesse corriente velocidad corrente coppia velocità '
    'schleppfehler'
)
OTHER = NO_JOINT | _set('r s u v a f e n g normal twist angular angle euler rotvec omega gyro')
"""Other quantities that have coordinates, too."""
NO_PLACE = NOMINAL_WORDS | DEVIATION | TURNED | OTHER
ROTATIONS: dict[tuple[str, ...], tuple[tuple[str, ...], str]] = {
    ('roll', 'pitch', 'yaw'): (TURNS, ' --euler xyz'),
    ('a', 'b', 'c'): (IN_TURN, ' --euler ZYX'),
    ('w', 'p', 'r'): (TURNS, ' --euler xyz'),
    ('q 0', 'q 1', 'q 2', 'q 3'): (('qw', *QUATERNION[:3]), ''),
}
"""Words of names, with what they mean: about fixed axes, KUKA, Fanuc, Leica."""


def words_of(name: str) -> list[str]:
    """Return the words of a name in small letters; `dx`, `QX` and `qact` are two."""
    words = [word.lower() for word in WORD.findall(name)]
    words = [part for w in words for part in (w if re.fullmatch('[a-z][xyzw]', w) else (w,))]
    told = MEASURED_WORDS | NOMINAL_WORDS
    return [
        part for w in words for part in (('q', w[1:]) if w[0] == 'q' and w[1:] in told else (w,))
    ]


def groups(
    header: Sequence[str], axes: Sequence[str], without: frozenset[str]
) -> dict[frozenset[str], list[str]]:
    """Return the names of columns that have all of some axes, in their order, by other words."""
    found: dict[frozenset[str], dict[str, str]] = {}
    for name in header:
        words = words_of(name)
        axis = [word for word in words if word in 'xyzw']
        if not axis and name not in NUMBERS and (joined := JOINED.fullmatch(name)):
            axis = [(joined[1] or joined[4]).lower()]
            words = [*axis, *words_of(joined[2] or joined[3])]
        if len(axis) == 1 and header.count(name) == 1 and not without & {*words} - {*axis}:
            found.setdefault(frozenset(words) - {*axis}, {}).setdefault(axis[0], name)
    return {w: [each[a] for a in axes] for w, each in found.items() if {*axes} <= {*each}}


def _one(found: Mapping[frozenset[str], Sequence[str]]) -> Sequence[str]:
    """Return the names in the only group, in the measured or the plain one."""
    measured = [names for words, names in found.items() if words & MEASURED_WORDS]
    plain = [names for words, names in found.items() if not words]
    return next((each[0] for each in (measured, plain, [*found.values()]) if len(each) == 1), ())


def distance_in(header: Sequence[str]) -> dict[str, str]:
    """Return the name of the only measured distance."""
    known = [name for name in header if DISTANCE_WORDS & {*words_of(name)}]
    wires = [name for name in known if not (NO_PLACE - TURNED) & {*words_of(name)}]
    return {'distance': wires[0]} if len(wires) == 1 else {}


def positions_in(header: Sequence[str], missing: Sequence[str]) -> dict[str, str]:
    """Return the names of measured coordinates, never of nominal ones, if only some may be."""
    names = _one(groups(header, missing, without=NO_PLACE))
    return {} if in_doubt(header, names) else dict(zip(missing, names, strict=False))


def matrix_in(header: Sequence[str]) -> dict[str, str]:
    """Return the names of a pose as a homogeneous matrix: `m_00`, `T[1,1]`; never nominal ones."""
    for name in header:
        first = CORNER.fullmatch(name)
        if first is None or {*words_of(name)} & (NOMINAL_WORDS | DEVIATION):
            continue
        before, start, between, after = first.groups()
        rows, columns = (range(int(start), int(start) + count) for count in (3, 4))
        names = [[f'{before}{i}{between}{j}{after}' for j in columns] for i in rows]
        turned = [each for *three, _ in names for each in three]
        places = [place for *_, place in names]
        if {*turned, *places} <= {*header}:
            return dict(zip((*POSITION, *MATRIX), (*places, *turned), strict=True))
    return {}


def quaternions_in(header: Sequence[str], sure: bool = True) -> dict[str, str]:
    """Return the names of a quaternion called so; if `sure`, of nothing else."""
    found = groups(header, 'xyzw', without=NO_PLACE - TURNED)
    known = {words: names for words, names in found.items() if words & TURNED}
    if sure and (len(known) > 1 or any(words - TURNED - MEASURED_WORDS for words in known)):
        return {}
    return dict(zip(QUATERNION, _one(known), strict=False))


def in_doubt(header: Sequence[str], plain: Sequence[str], joints: int = 0) -> str:
    """Return why values in columns with plain names may be nominal, with the options.

    These are coordinates in columns with `plain` names, and the values of joints in q1, q2 ...
    """
    if {'before_x', 'after_x'} <= {*header}:
        return 'it holds the errors of a result: give the table that was measured'
    for ours in (plain and POSITION, joint_columns(joints)):
        capitals = [name.upper() for name in ours]
        if ours and {*ours, *capitals} <= {*header}:
            return (
                f'{ours[0]} may be nominal beside {capitals[0]}: give '
                f'{option(ours, capitals)}, or {option(ours, ours)} if it was measured'
            )
    known = groups(header, 'xyz', without=TURNED | OTHER)
    measured, nominal, apart = (
        [names for words, names in known.items() if words & some]
        for some in (MEASURED_WORDS, NOMINAL_WORDS, DEVIATION)
    )
    others = [names for words, names in known.items() if words]
    beside = next(iter(measured or ([] if nominal else apart or others)), plain)
    if len(plain) == len(POSITION) and beside != [*plain]:
        of_sum = beside in apart and beside not in measured
        better = option(POSITION, plain, beside) if of_sum else option(POSITION, beside)
        return (
            f'{", ".join(plain)} may be nominal beside {", ".join(beside)}: give {better}, or '
            f'{option(POSITION, plain)} if they were measured'
        )
    again = [name for name in header if _rank(name) < 0 or SECOND_NAMES.fullmatch(name)]
    like = like_joints(again, joints) if joints else {}
    first = next(iter(like.values()), '')
    if first and not SECOND_ARM.match(first):
        return (
            f'q1 may be commanded beside {first.replace("*", "1")}: give '
            f'{option(like, like.values())}, or --columns "q*=q*" if it was measured'
        )
    return ''


def option(ours: Iterable[str], *theirs: Iterable[str]) -> str:
    """Return --columns for our columns by the names of theirs, or of those to add."""
    given = (
        f'{name}={"+".join(n if PLAIN.fullmatch(n) else f"{{{n}}}" for n in names)}'
        for name, *names in zip(ours, *theirs, strict=True)
    )
    return f'--columns "{",".join(given)}"'


def turns_in(path: Path, header: Sequence[str]) -> Iterator[str]:
    """Yield how to use the angles or the quaternion of a header, by their names."""
    names = {' '.join(words_of(name)): name for name in header}
    for words, (ours, more) in ROTATIONS.items():
        found = [names.get(each, '') for each in words]
        if all(found) and not ('q 0' in words and 'q 4' in names):  # q0 to q5 are joints
            yield f'{path}: to use {", ".join(found)}, give {option(ours, found)}{more}'
            return


def named_in(header: Sequence[str], joint: str) -> str:
    """Return the column of the name of a joint, or the only one for values with it."""
    low = joint.lower()
    same = [each for each in header if each.lower() == low]
    longer = [each for each in header if low in each.lower() and not {*words_of(each)} & OTHER]
    return (same or longer * (len(longer) == 1) or [''])[0]


def numbers_in(header: Sequence[str], count: int) -> list[str]:
    """Return the numbers `#k` of columns called by values; of `count` and a whole one, these."""
    whole = [k for k, name in enumerate(header, 1) if re.fullmatch(r'-?[\d.,]+(e[+-]?\d+)?', name)]
    values = [k for k in whole if re.search('[.,]', header[k - 1])]  # 1 may count rows
    if re.search(r'[={\[(]', ''.join(header)) or not (len(whole) == len(header) or values[1:]):
        return []  # not from a program
    return [f'#{k}' for k in (values if len(values) == count == len(whole) - 1 else whole)]


def _no_joint(name: str) -> bool:
    """Tell whether a column holds other values of joints; an `actual current` is in amperes."""
    words = {*words_of(name)}
    amperes = 'current' in words and bool(words & (MEASURED_WORDS | NOMINAL_WORDS))
    return amperes or bool(words & NO_JOINT)


def _rank(name: str) -> int:
    """Return -1 for a measured joint by its name, 1 for a nominal one, 2 and more for others."""
    words = {*words_of(name)}
    nominal = bool(words & NOMINAL_WORDS)
    return nominal - bool(words & MEASURED_WORDS) + 3 * (not words & JOINT_WORDS)


def like_joints(header: Sequence[str], joints: int) -> dict[str, str]:
    """Return the names in a header that count the joints, with a star for the number from 1."""
    if len(numbers := numbers_in(header, joints)) >= max(joints, 1):
        whole = len(numbers) == len(header)
        return {'q*': '#*'} if whole else dict(zip(joint_columns(joints), numbers, strict=False))
    names = [name for name in header if not _no_joint(name)]
    for name, first in product(
        sorted(names, key=lambda each: (_rank(each), len(words_of(each)))), (1, 0)
    ):
        for one in re.finditer(str(first), name):
            before, after = name[: one.start()], name[one.end() :]
            like = [f'{before}{k}{after}' for k in range(first, joints + first)]
            if {*like} <= {*header}:
                if first:
                    return {'q*': f'{before}*{after}'}
                return dict(zip(joint_columns(joints), like, strict=True))
    return {}
