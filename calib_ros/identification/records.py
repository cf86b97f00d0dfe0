# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The record of a calibration in its file: the key `calibration` of a chain file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from calib_ros.errors import ConfigError
from calib_ros.identification.noise import Noise
from calib_ros.identification.observations import SOME_POSES
from calib_ros.identification.start import likened
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import calibration_record, dictionary, parse_frames
from calib_ros.kinematics.parameter import DH_KINDS, parameters_of
from calib_ros.kinematics.se3 import ROUNDING, FloatArray
from calib_ros.settings import Settings
from calib_ros.values import parse_number, parse_numbers

Owner: TypeAlias = tuple[str, bool, bool, str]
"""Session, whether a camera on the flange measured, whether it is a socket; device or target."""


def packed(square: FloatArray) -> list[str]:
    """Return a positive matrix (P, P) as the rows of its lower Cholesky factor, in text."""
    scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
    scaled = square / np.outer(scale, scale) + ROUNDING * np.eye(len(scale))
    root = scale[:, np.newaxis] * np.linalg.cholesky(scaled)
    return [' '.join(f'{x:.9e}' for x in row[: k + 1]) for k, row in enumerate(root)]


def unpacked(rows: Sequence[str], size: int) -> FloatArray:
    """Return the matrix (P, P) of rows that `packed` made.

    Raises
    ------
    ValueError
        When they are not those of one of that size.

    """
    root = np.zeros((size, size))
    for k, row in enumerate(rows):
        root[k, : k + 1] = [float(part) for part in row.split()]
    if len(rows) != size or not np.isfinite(root).all():
        raise ValueError(f'{len(rows)} rows of finite numbers for {size} names')
    return np.asarray(root @ root.T)


def parse_record(text: str, where: str) -> dict[str, Any]:
    """Return what a calibration says of where it comes from.

    Raises
    ------
    ConfigError
        When it says nothing, was not accepted, or could not be judged or published.

    """
    record = calibration_record(text)
    if not record:
        raise ConfigError(
            f'{where} is a chain, but no calibration: it does not say where its numbers come '
            'from (key "calibration"); give the calibration.yaml of calib_ros identify'
        )
    if record.get('accepted') is False:
        raise ConfigError(f'{where} was not accepted: identify again, from more or better poses')
    rms, frame = record.get('rms_mm_after', 0.0), record.get('world_frame', '')
    number = isinstance(rms, int | float) and not isinstance(rms, bool)
    if not number or not 0.0 <= rms < math.inf:
        raise ConfigError(f'{where}: calibration.rms_mm_after must be a length [mm], not {rms!r}')
    if not isinstance(frame, str):
        raise ConfigError(f'{where}: calibration.world_frame must be a name, not {frame!r}')
    return record


def nominal_document(nominal: Chain) -> dict[str, Any]:
    """Return the numbers of the chain that a calibration belongs to, row by row."""
    rows = dict(zip(nominal.joint_names, nominal.table.tolist(), strict=True))
    effects = {name: float(value) for name, value in nominal.effects if value}
    return {'convention': nominal.convention, 'joints': rows} | (
        {'effects': effects} if effects else {}
    )


def nominal_of(record: Mapping[str, Any], chain: Chain, where: str) -> Chain:
    """Return the nominal chain of a corrected one, by its record."""
    known = _known(record, where)
    if known.get('convention') != chain.convention:
        raise ConfigError(f'{where} does not hold its nominal chain: give that with --chain')
    joints = []
    for joint, row in zip(chain.joints, _rows(known, chain, where).values(), strict=True):
        a, alpha, d, theta, beta = row.values()
        joints.append(replace(joint, a=a, alpha=alpha, d=d, theta=theta, beta=beta))
    effects = dictionary(known.get('effects'), f'{where}: calibration.nominal.effects')
    values = {
        name: parse_number(value, f'{where}: nominal {name}') for name, value in effects.items()
    }
    return replace(chain, joints=tuple(joints), effects=()).with_effect_values(values)


def check_joints(chain: Chain, nominal: Chain, where: str) -> None:
    """Refuse a calibration of an arm with other joints than the nominal chain's."""
    ours, theirs = (
        [f'{joint.name} ({joint.type})' for joint in each.joints] for each in (nominal, chain)
    )
    if ours != theirs:
        raise ConfigError(
            f'{where} has the joints {", ".join(theirs)}, the nominal chain has '
            f'{", ".join(ours)}: is it the right nominal chain?'
        )


def check_nominal(
    chain: Chain,
    record: Mapping[str, Any],
    nominal: Chain,
    where: str,
    settings: Settings | None = None,
) -> None:
    """Refuse a calibration that is not one of a nominal chain (`parse_calibration`)."""
    known = _known(record, where)
    told = known.get('convention') == nominal.convention  # else there is nothing to compare
    for name, row in (_rows(known, nominal, where) if told else {}).items():
        for kind, value in row.items():
            wanted = nominal.value(f'{name}.{kind}')
            if not math.isclose(value, wanted, abs_tol=1e-9):  # m, rad: nine digits are written
                raise ConfigError(
                    f'{where} was identified from another nominal chain, with {name}.{kind} '
                    f'{value:.9g} and not {wanted:.9g}: give that one, or identify again'
                )
    limits = settings or Settings()
    length, angle = limits.largest_length, limits.largest_angle
    if told and settings is None:
        length = angle = math.inf
    differing = _differing(chain, nominal, length, angle)
    if differing:
        raise ConfigError(
            f'{where} is not the calibration of this robot: {", ".join(differing)} differ from '
            f'chain "{nominal.name}" by more than largest_length and largest_angle allow'
        )


def _known(record: Mapping[str, Any], where: str) -> dict[str, Any]:
    return dictionary(record.get('nominal'), f'{where}: calibration.nominal')


def _rows(known: Mapping[str, Any], chain: Chain, where: str) -> dict[str, dict[str, float]]:
    """Return the recorded nominal numbers by joint and kind."""
    rows = dictionary(known.get('joints'), f'{where}: calibration.nominal.joints')
    found = {}
    for name in chain.joint_names:
        row = parse_numbers(rows.get(name), len(DH_KINDS), f'{where}: nominal {name}')
        found[name] = dict(zip(DH_KINDS, row.tolist(), strict=True))
    return found


def _differing(chain: Chain, nominal: Chain, length: float, angle: float) -> list[str]:
    """Return what of the joints differs by more than errors of one robot can [m, rad]."""
    if chain.convention != nominal.convention:
        return [f'the conventions ({chain.convention}, {nominal.convention})']
    names = []
    for joint, other in zip(chain.joints, nominal.joints, strict=True):
        if joint.sign != other.sign:
            names.append(f'the sign of {joint.name}')
        for name in joint.parameters:
            limit = length if name.is_length else angle
            if abs(chain.value(name) - nominal.value(name)) > limit:
                names.append(name)
    return names


def before_of(record: Mapping[str, Any], nominal: Chain, chain: Chain, where: str) -> Chain:
    """Return the nominal chain in its recorded frames, else in those closest to the other one."""
    known = _known(record, where)
    if {'base', 'tool'} & set(known):
        return replace(nominal, **parse_frames(known, f'{where}: calibration.nominal'))
    joints = nominal.random_joints(SOME_POSES, np.random.default_rng(0))
    start = replace(
        nominal, base=chain.frame('base'), tool=chain.frame('tool'), frames=chain.frames
    )
    names = [
        name
        for frame in ('base', 'tool')
        if not start.frame(frame).fixed
        for name in parameters_of(frame)
    ]
    return likened(start, names, chain, joints)[0] if names else start


def covariance_of(
    record: Mapping[str, Any], chain: Chain, where: str
) -> tuple[tuple[str, ...], FloatArray | None, float]:
    """Return the fitted parameters, their covariance (P, P) and its degrees of freedom."""
    known = dictionary(record.get('covariance'), f'{where}: calibration.covariance')
    if not known:
        return (), None, math.inf
    try:
        names = tuple(known['names'])
        square = unpacked(known['root'], len(names))
        freedom = math.inf if known['freedom'] is None else float(known['freedom'])
        if not set(names) <= set(chain.parameter_names) or len(set(names)) < len(names):
            raise ValueError('names of another chain')
        if not (np.diag(square) > 0.0).all() or not freedom > 0.0:
            raise ValueError('no covariance')
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as err:
        raise damaged('covariance', where, err) from err
    return names, square, freedom


def noise_of(record: Mapping[str, Any], where: str) -> Noise | None:
    """Return the noise of the measurements, if it is recorded."""
    known = dictionary(record.get('noise_in_sigma'), f'{where}: calibration.noise_in_sigma')
    if not known:
        return None
    try:
        turned = known['orientation']
        return Noise(
            parse_number(known['position'], 'position'),
            None if turned is None else parse_number(turned, 'orientation'),
            bool(known['consistent']),
            parse_number(known['successive'], 'successive'),
            parse_number(known['near'], 'near'),
            tuple(map(str, known['shared'])),
            parse_number(known['widened'], 'widened'),
            parse_number(known['size'], 'size'),
            {
                str(name): parse_number(sigma, f'given: {name}')
                for name, sigma in dictionary(known.get('given'), 'given').items()
            },
        )
    except (ConfigError, KeyError, TypeError) as err:
        raise damaged('noise_in_sigma', where, err) from err


OWNER = ('session', 'eye_in_hand', 'socket', 'label')


def owners_document(owners: Mapping[str, Owner]) -> dict[str, Any]:
    """Return which session, device or target each frame is of, as plain values."""
    return {name: dict(zip(OWNER, owner, strict=True)) for name, owner in owners.items()}


def owners_of(record: Mapping[str, Any], where: str) -> dict[str, Owner]:
    """Return which session, device or target each frame is of, where that is recorded."""
    known = dictionary(record.get('frames'), f'{where}: calibration.frames')
    owners = {}
    for name, row in known.items():
        parts = dictionary(row, f'{where}: calibration.frames.{name}')
        session, eye, socket, label = (parts.get(key) for key in OWNER)
        told = isinstance(session, str) and isinstance(label, str)
        if not (told and isinstance(eye, bool) and isinstance(socket, bool)):
            raise damaged(f'frames.{name}', where)
        owners[name] = (str(session), bool(eye), bool(socket), str(label))
    return owners


def damaged(key: str, where: str, err: Exception | None = None) -> ConfigError:
    """Return the error that says which part of a record is not as it was written."""
    kind = '' if err is None else f' ({type(err).__name__})'
    return ConfigError(f'{where}: calibration.{key} is damaged{kind}: identify again')
