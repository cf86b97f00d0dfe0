# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the words in the names of columns say: coordinates, measured or nominal, rotations."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from calib_ros.files.vocabulary import POSITION, QUATERNION

WORD = re.compile(r'[^\W\d_A-Z]+|[A-Z][^\W\d_A-Z]+|[A-Z]+(?![a-z])|[0-9]+')
"""Words of a name: `X_meas`, `pose.position.x`, `dX`, `Nominal X`."""


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


MEASURED_WORDS = _set(
    'meas measured measurement act actual ist istwert fbk feedback tracker leica laser faro vicon'
)
NOMINAL_WORDS = _set(
    'nom nominal cmd command commanded target soll sollwert ref reference des desired goal '
    'setpoint theo theoretical ideal cad design model calc computed pred predicted sim simulated '
    'prog programmed planned tcp ee robot fk'
)
DEVIATION = _set('d dev deviation delta dif diff difference abw abweichung')
TURNED = _set('q quat quaternion orientation rot rotation')
DISTANCE_WORDS = _set('distance length wire abstand')
JOINT_WORDS = _set('q j a joint joints axis achse axe position pos theta th angle')
NO_JOINT = _set('vel velocity acc acceleration force torque tau effort currents temp temperature')
OTHER = NO_JOINT | _set(
    'r s u v a f std stdev sd sigma err error rms var uncertainty twist angular angle euler'
)
"""Other quantities that have coordinates, too."""
NO_PLACE = NOMINAL_WORDS | DEVIATION | TURNED | OTHER
EULER = {('roll', 'pitch', 'yaw'): 'xyz', ('a', 'b', 'c'): 'ZYX', ('w', 'p', 'r'): 'xyz'}
"""Names of three angles, with their meaning: about fixed axes, KUKA, Fanuc."""


def words_of(name: str) -> list[str]:
    """Return the words of a name in small letters; `dx` and `QX` are two."""
    words = [word.lower() for word in WORD.findall(name)]
    return [part for w in words for part in (w if re.fullmatch('[a-z][xyzw]', w) else (w,))]


def groups(header: Sequence[str], axes: str) -> Iterator[tuple[frozenset[str], dict[str, str]]]:
    """Yield the other words of columns that have all of some axes, and their names by axis."""
    found: dict[frozenset[str], dict[str, str]] = {}
    for name in header:
        words = words_of(name)
        axis = [word for word in words if word in 'xyzw']
        if len(axis) == 1 and header.count(name) == 1:
            found.setdefault(frozenset(words) - {*axis}, {}).setdefault(axis[0], name)
    for others, names in found.items():
        if {*axes} <= {*names}:
            yield others, {axis: names[axis] for axis in axes}


def _one(found: Sequence[tuple[frozenset[str], dict[str, str]]]) -> list[str]:
    """Return the names in the only group, in the measured or the plain one."""
    for some in (
        [g for g in found if g[0] & MEASURED_WORDS],
        [g for g in found if not g[0]],
        found,
    ):
        if len(some) == 1:
            return [*some[0][1].values()]
    return []


def is_distance(name: str) -> bool:
    """Tell whether a name is that of a measured distance."""
    words = {*words_of(name)}
    return bool(words & DISTANCE_WORDS) and not words & (NOMINAL_WORDS | DEVIATION | OTHER)


def positions_in(header: Sequence[str], missing: Sequence[str] = POSITION) -> dict[str, str]:
    """Return the names of measured coordinates, never of nominal ones, if only some may be."""
    known = [each for each in groups(header, ''.join(missing)) if not each[0] & NO_PLACE]
    names = _one(known)
    doubt = in_doubt(header, names) if len(names) == len(POSITION) else ''
    return {} if doubt else dict(zip(missing, names, strict=False))


def quaternions_in(header: Sequence[str], sure: bool = True) -> dict[str, str]:
    """Return the names of a quaternion called so; if `sure`, of nothing else."""
    known = [each for each in groups(header, 'xyzw') if each[0] & TURNED]
    known = [each for each in known if not each[0] & (NOMINAL_WORDS | DEVIATION | OTHER)]
    if sure and (len(known) > 1 or any(words - TURNED - MEASURED_WORDS for words, _ in known)):
        return {}
    return dict(zip(QUATERNION, _one(known), strict=False))


def in_doubt(header: Sequence[str], plain: Sequence[str]) -> str:
    """Return why coordinates in columns with `plain` names may be nominal, with the options."""
    known = {words: each for words, each in groups(header, 'xyz') if not words & (TURNED | OTHER)}
    measured = [each for words, each in known.items() if words & MEASURED_WORDS - DEVIATION]
    apart = [each for words, each in known.items() if words & DEVIATION]
    first, second = [], [*map(as_typed, plain)]
    if measured and [*measured[0].values()] != [*plain]:
        beside = [*measured[0].values()]
        first = [*map(as_typed, beside)]
    elif apart and not measured and not any(words & NOMINAL_WORDS - DEVIATION for words in known):
        beside = [*apart[0].values()]
        first = [f'{a}+{as_typed(b)}' for a, b in zip(second, beside, strict=True)]
    if not first:
        return ''
    options = (
        ','.join(f'{ours}={name}' for ours, name in zip(POSITION, names, strict=True))
        for names in (first, second)
    )
    return (
        f'{", ".join(plain)} may be nominal beside {", ".join(beside)}: give --columns '
        f'"{next(options)}", or --columns "{next(options)}" if they were measured'
    )


def as_typed(name: str) -> str:
    """Return the name of a column as --columns takes it."""
    plain = re.fullmatch(r'#[\d*]+|[^\W\d][\w*]*(\.[\w*]+)*', name)
    return name if plain else f'{{{name}}}'


def turns_in(header: Sequence[str]) -> str:
    """Return how to use the angles of a header, by their names; empty without any."""
    words = {tuple(words_of(name)): name for name in header}
    for angles, euler in EULER.items():
        found = [next((n for w, n in words.items() if w == (a,)), '') for a in angles]
        if all(found):
            ours = [f'r{k}' for k in (1, 2, 3)] if euler == 'ZYX' else ['rx', 'ry', 'rz']
            pairs = zip(ours, map(as_typed, found), strict=True)
            given = ','.join(f'{name}={theirs}' for name, theirs in pairs)
            return f'to use {", ".join(found)}, give --columns "{given}" --euler {euler}'
    return ''
