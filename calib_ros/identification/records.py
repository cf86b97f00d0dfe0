# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The record of a calibration: the key `calibration` of a chain file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from calib_ros.decision.matrices import damage_error, parse_rows, unpacked_matrix
from calib_ros.errors import ConfigError, UnknownNameError
from calib_ros.estimation.joint_errors import NOTHING, Unmodelled
from calib_ros.estimation.noise import Noise
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.start import fit_to_arm, free_in
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import (
    calibration_record,
    dictionary,
    parse_frames,
    table_hash,
)
from calib_ros.kinematics.parameter import DH_KINDS, ROW_KINDS
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.settings import Settings
from calib_ros.shown import some
from calib_ros.values import parse_like, parse_number, parse_numbers

Owner: TypeAlias = tuple[str, bool, bool, str]
"""Session, camera on the flange, socket; device or target."""
OWNER = ('session', 'eye_in_hand', 'socket', 'label')
ALWAYS = ('table_sha256', 'nominal', 'region')
"""Keys of every record that calib_ros writes; others come before, the first of these is last."""


def nominal_document(nominal: Chain) -> dict[str, Any]:
    """Return the numbers of the nominal chain, row by row."""
    rows = dict(zip(nominal.joint_names, nominal.table.tolist(), strict=True))
    effects = {name: float(value) for name, value in nominal.effects if value}
    more = {'effects': effects} if effects else {}
    return {'convention': nominal.convention, 'joints': rows, **more}


def owners_document(owners: Mapping[str, Owner]) -> dict[str, Any]:
    """Return the owners of the frames as plain values."""
    return {name: dict(zip(OWNER, owner, strict=True)) for name, owner in owners.items()}


def outdated(record: Mapping[str, Any], where: str = '') -> tuple[str, ...]:
    """Return the frames that moved while they were measured; `where` begins its errors."""
    found: tuple[str, ...] = parse_like((), record.get('outdated', ()), f'{where}outdated')
    return found


@dataclass(frozen=True, eq=False)
class Record:
    """The record of a calibration; `where` names it in errors."""

    content: Mapping[str, Any]
    where: str

    @classmethod
    def parse(cls, text: str, where: str) -> Record:
        """Return the record in the text of a calibration.

        Raises ConfigError if it is missing, was not accepted, or is incomplete.
        """
        record = calibration_record(text)
        if not record:
            raise ConfigError(
                f'{where} is a chain, but not a calibration: it does not say where its numbers '
                'come from (key "calibration"); give the calibration.yaml from calib_ros identify'
            )
        if not parse_like(True, record.get('accepted', True), f'{where}: calibration.accepted'):
            raise ConfigError(
                f'{where} was not accepted: identify again, from more or better poses'
            )
        unset = {key for key, value in record.items() if value in (None, {}) and key != 'region'}
        missing = [key for key in ALWAYS if key not in record or key in unset]
        if missing and {'created', 'software'} & set(record):
            raise ConfigError(
                f'{where} is cut off: its record lacks {", ".join(missing)}, which calib_ros '
                'always writes; copy the file again'
            )
        rms, frame = record.get('rms_mm_after', 0.0), record.get('world_frame', '')
        number = isinstance(rms, int | float) and not isinstance(rms, bool)
        if not number or not 0.0 <= rms < math.inf:
            raise ConfigError(
                f'{where}: calibration.rms_mm_after must be a length [mm], not {rms!r:.100}'
            )
        if not isinstance(frame, str):
            raise ConfigError(f'{where}: calibration.world_frame must be text, not {frame!r:.100}')
        outdated(record, f'{where}: calibration.')
        return cls(record, where)

    def _part(self, key: str) -> dict[str, Any]:
        return dictionary(self.content.get(key), f'{self.where}: calibration.{key}')

    def _rows(self, chain: Chain) -> dict[str, dict[str, Any]]:
        """Return the recorded nominal numbers by joint and kind."""
        where = f'{self.where}: calibration.nominal.joints'
        rows = dictionary(self._part('nominal').get('joints'), where)
        found = {}
        for name in chain.joint_names:
            row = rows.get(name)
            kinds = ROW_KINDS if isinstance(row, list) and len(row) > len(DH_KINDS) else DH_KINDS
            numbers = parse_numbers(row, len(kinds), f'{self.where}: nominal {name}')
            found[name] = {'b': 0.0, **dict(zip(kinds, numbers.tolist(), strict=True))}
        return found

    def nominal(self, chain: Chain) -> Chain:
        """Return the recorded nominal chain."""
        known, where = self._part('nominal'), self.where
        if known.get('convention') != chain.convention:
            raise ConfigError(
                f'{where} does not contain its nominal chain: give the calibration.yaml written '
                'by calib_ros identify or, where a command takes it, that chain (--chain)'
            )
        rows = self._rows(chain)
        joints = tuple(replace(joint, **rows[joint.name]) for joint in chain.joints)
        effects = dictionary(known.get('effects'), f'{where}: calibration.nominal.effects')
        values = {n: parse_number(x, f'{where}: nominal {n}') for n, x in effects.items()}
        return replace(chain, joints=joints, effects=()).with_effect_values(values)

    def _check_table(self, chain: Chain) -> None:
        """Refuse a table other than the identified one, if that is recorded.

        Programs that rewrite a file may sort its effects; the region lists those fitted in their
        order, and those held after them.
        """
        known = self.content.get('table_sha256')
        converted = self._part('nominal').get('convention', chain.convention) != chain.convention
        names = self._part('region').get('names', ())
        order = {name: k for k, name in enumerate(names)}
        effects = tuple(sorted(chain.effects, key=lambda each: order.get(each[0], -1)))
        likely = table_hash(chain), table_hash(replace(chain, effects=effects))
        if not (known is None or converted or known in likely):
            raise ConfigError(
                f'{self.where} does not contain the table and effects identified '
                '(calibration.table_sha256): it was edited, damaged, or exported without its '
                'effects; give the file written by calib_ros identify. If the change is intended, '
                'write your own record: calibration: {source: ...}'
            )

    def check(self, chain: Chain, nominal: Chain, settings: Settings | None = None) -> None:
        """Refuse a calibration of another nominal chain (`parse_calibration`)."""
        self._check_table(chain)
        frames = 'base', 'tool', *dict(chain.frames)
        for name in {*outdated(self.content)}.difference(frames):
            raise UnknownNameError(f'{self.where}: frame', name, frames)
        comparable = self._part('nominal').get('convention') == nominal.convention
        if comparable:
            self._check_nominal(nominal)
        limits = settings or Settings()
        length, angle = limits.largest_length, limits.largest_angle
        if comparable and settings is None:
            length = angle = math.inf
        if differing := _differing(chain, nominal, length, angle):
            raise ConfigError(
                f'{self.where} is not the calibration of chain "{nominal.name}": {differing}'
            )

    def _check_nominal(self, nominal: Chain) -> None:
        """Refuse a nominal chain with other numbers than the recorded ones."""
        where = f'{self.where}: calibration.nominal.effects'
        known = dictionary(self._part('nominal').get('effects'), where)
        ours, numbers = dict(nominal.effects), []
        for name in {**known, **ours}:
            value = parse_number(known.get(name, 0.0), where)
            numbers.append((f'effect {name}', value, ours.get(name, 0.0), 1e-15))
        for joint, row in self._rows(nominal).items():
            for kind, value in row.items():  # m, rad: nine digits written
                name = f'{joint}.{kind}'
                numbers.append((name, value, nominal.value(name), 1e-9))
        for name, value, wanted, least in numbers:
            if not math.isclose(value, wanted, abs_tol=least):
                raise ConfigError(
                    f'{self.where} was identified from another nominal chain, with {name} '
                    f'{value:.9g} and not {wanted:.9g}: give that one, or identify again'
                )

    def before(self, nominal: Chain, chain: Chain) -> Chain:
        """Return the nominal chain in its recorded frames, else in those closest to the chain."""
        known = self._part('nominal')
        if {'base', 'tool'} & set(known):
            return replace(nominal, **parse_frames(known, f'{self.where}: calibration.nominal'))
        joints = nominal.random_joints(SOME_POSES, np.random.default_rng(0))
        base, tool = chain.frame('base'), chain.frame('tool')
        start = replace(nominal, base=base, tool=tool, frames=chain.frames)
        names = free_in(start, ('base', 'tool'))
        return fit_to_arm(start, names, chain, joints)[0] if names else start

    def covariance(
        self, chain: Chain
    ) -> tuple[tuple[str, ...], FloatArray | None, float, Unmodelled]:
        """Return fitted parameters, their covariance (P, P), its freedom, and what is lacking."""
        known, lacking = self._part('covariance'), NOTHING
        if not known:
            return (), None, math.inf, lacking
        try:
            names = tuple(known['names'])
            square = unpacked_matrix(known['root'], len(names))
            freedom = math.inf if known['freedom'] is None else float(known['freedom'])
            ours = set(names) <= set(chain.parameter_names) and len(set(names)) == len(names)
            if 'unmodelled' in known:
                more = known['unmodelled']
                turns, tilts, waves = (float(more[key]) for key in lacking.sizes)
                followed = parse_rows(more['followed'], len(names))
                lacking = Unmodelled(turns, tilts, waves, names, followed)
                fine = all(0.0 <= size < math.inf for size in lacking.sizes.values())
                ours = ours and fine and followed.shape[1] == 8 * len(chain.joints)
            if not (ours and (np.diag(square) > 0.0).all() and freedom > 0.0):
                raise ValueError('no covariance of this chain')
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as err:
            raise damage_error('covariance', self.where, err) from err
        return names, square, freedom, lacking

    def noise(self) -> Noise | None:
        """Return the noise of the measurements, if recorded."""
        known = self._part('noise_in_sigma')
        if not known:
            return None
        sizes = ('position', 'successive', 'near', 'widened', 'size')
        try:
            turned, given = known['orientation'], dictionary(known.get('given'), 'given')
            return Noise(
                **{key: parse_number(known[key], key) for key in sizes},
                orientation=None if turned is None else parse_number(turned, 'orientation'),
                consistent=bool(known['consistent']),
                shared=tuple(map(str, known['shared'])),
                given={str(n): parse_number(sigma, f'given: {n}') for n, sigma in given.items()},
            )
        except (ConfigError, KeyError, TypeError) as err:
            raise damage_error('noise_in_sigma', self.where, err) from err

    def owners(self) -> dict[str, Owner]:
        """Return the recorded owners of the frames."""
        found = {}
        for name, row in self._part('frames').items():
            parts = dictionary(row, f'{self.where}: calibration.frames.{name}')
            session, eye, socket, label = (parts.get(key) for key in OWNER)
            named = isinstance(session, str) and isinstance(label, str)
            if not (named and isinstance(eye, bool) and isinstance(socket, bool)):
                raise damage_error(f'frames.{name}', self.where)
            found[name] = (str(session), bool(eye), bool(socket), str(label))
        return found


def _differing(chain: Chain, nominal: Chain, length: float, angle: float) -> str:
    """Return in words what differs by more than errors of one robot [m, rad]; empty if nothing."""
    if chain.convention != nominal.convention:
        return f'its convention is {chain.convention}, not {nominal.convention}'
    for joint, other in zip(chain.joints, nominal.joints, strict=True):
        if joint.sign != other.sign:
            return f'the sign of {joint.name} is {joint.sign}, not {other.sign}'
    limits = {
        name: length if name.is_length else angle for j in chain.joints for name in j.parameters
    }
    far = [n for n, most in limits.items() if abs(chain.value(n) - nominal.value(n)) > most]
    beyond = 'too far from it (largest_length, largest_angle): '
    return f'{beyond}{", ".join(some(far))}' * bool(far)
