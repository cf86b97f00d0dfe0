# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A calibration: a chain file with a record of its origin.

It removes at q the distance between the nominal arm, in fitted frames, and the calibrated one. The
remaining error is predicted from the expected squares C of the parameter errors, with J the
position rows of the error model, and the RMS error r on held-out poses:

    removed(q) = |p_nominal - p|      sigma(q)^2 = tr J C J^T      remaining(q)^2 = sigma^2 + r^2

Errors of the joints that no parameter explains add to sigma but, being in r, not to `remaining`.
Wobble of the axes that the parameters have absorbed shows only at other poses, and adds to sigma
there.

Commanded by its nominal model the arm is expected to miss by the root of removed^2 + remaining^2,
by its calibrated model by `remaining`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

import calib_ros
from calib_ros.annotated import as_annotated
from calib_ros.decision.matrices import packed, rows_of
from calib_ros.decision.moved import Step
from calib_ros.decision.region import Region, region_of_record
from calib_ros.decision.result import Identification
from calib_ros.decision.steps import find_step
from calib_ros.errors import ConfigError, InputError
from calib_ros.estimation.fitting import fit
from calib_ros.estimation.joint_errors import NOTHING, Unmodelled
from calib_ros.estimation.levels import ALIKE
from calib_ros.estimation.noise import Noise
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.start import reframed
from calib_ros.identification import records
from calib_ros.identification.age import recorded_time
from calib_ros.identification.fingerprint import Fingerprint
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, refuse_other_joints
from calib_ros.kinematics.chain_file import (
    chain_text,
    dump_chain,
    frames_document,
    parse_chain,
    table_hash,
)
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.limits import narrowed
from calib_ros.kinematics.se3 import FloatArray, norms
from calib_ros.settings import Model, Settings
from calib_ros.shown import Shown

HEAD = '# Corrected chain by calib_ros; readable wherever a chain file is expected.\n'


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Shown):
    """A corrected chain, its nominal chain, and how well it is known; None where unknown."""

    chain: Chain
    before: Chain
    """The nominal chain in fitted frames."""
    names: tuple[str, ...] = ()
    """Fitted parameters, (P,)."""
    covariance: FloatArray | None = None
    """Of the fitted parameters, (P, P)."""
    unmodelled: Unmodelled = NOTHING
    """What no parameter explains; it has a share in the covariance."""
    freedom: float = np.inf
    """Degrees of freedom of the covariance estimate."""
    residual: float | None = None
    """RMS position error [m] on held-out poses."""
    noise: Noise | None = None
    region: Region | None = None
    """Where the calibration may be used."""
    world_frame: str = ''
    """Frame of the measured poses."""
    owners: Mapping[str, records.Owner] = field(default_factory=dict)
    """Session, device or target of each frame (`sampling.sample.Frames`)."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the numbers, as in the file, without covariance and rows."""
    rows: Fingerprint | None = None
    """Of the fitted measurements."""

    @classmethod
    @as_annotated
    def of(
        cls,
        result: Identification,
        origin: Mapping[str, Any] | None = None,
        owners: Mapping[str, records.Owner] | None = None,
        fitted: Sequence[Observations] = (),
    ) -> Calibration:
        """Return the calibration of an identification; `origin` describes the measurements.

        `verify` recognises the `fitted` ones, and cannot pass on them.
        """
        late, region, noise, owners = result.lateness, result.region, result.noise, owners or {}
        rms_mm = [round(float(np.hypot(x.rms_mm, late)), 6) for x in result.comparison.figures]
        record = {
            **provenance(),
            'measured': recorded_time(fitted),
            'accepted': result.accepted,
            'world_frame': result.problem.world_frame,
            'samples': len(result.fitted.judged),
            'outliers': len(result.outliers),
            'validated_by': result.validated_by,
            'rms_mm_before': rms_mm[0],
            'rms_mm_after': rms_mm[1],
            'noise_in_sigma': asdict(noise) | {'shared': list(noise.shared)},
            'not_identifiable': list(result.unidentifiable),
            **about(result.chain, result.before, region),
            'frames': records.owners_document(owners),
            'outdated': [*result.outdated],
            **(origin or {}),
        }
        return cls(
            chain=result.chain,
            before=result.before,
            names=result.names,
            covariance=result.covariance,
            unmodelled=result.posterior.unmodelled,
            freedom=result.uncertainty.overall,
            residual=1e-3 * rms_mm[1],  # as in the file
            noise=noise,
            region=region,
            world_frame=result.problem.world_frame,
            owners=owners,
            record=record,
            rows=Fingerprint.of(fitted) if fitted else None,
        )

    def dump(self) -> str:
        """Return the text of the chain file."""
        record = dict(self.record)
        if self.covariance is not None:
            record['covariance'] = {
                'names': list(self.names),
                'freedom': None if np.isinf(self.freedom) else self.freedom,
                'root': packed(self.covariance),
            }
            if self.unmodelled.names:
                followed = {'followed': rows_of(self.unmodelled.followed)}
                record['covariance']['unmodelled'] = self.unmodelled.sizes | followed
        if self.rows is not None:
            record['rows'] = self.rows.document()
        return HEAD + dump_chain(self.chain, record)

    def serial_of(self, where: str, serial: str = '') -> str:
        """Return the serial number of the robot, empty if unknown.

        Raises InputError if another `serial` is given; `where` names the calibration.
        """
        own = str(self.record.get('robot_serial') or '')
        if own and serial and serial != own:
            raise InputError(
                f'{where} is the calibration of the robot with serial "{own}"; this one is '
                f'"{serial}"'
            )
        return serial or own

    @property
    def whose(self) -> str:
        """Return the robot and the date of the calibration, as far as known."""
        made, serial = (str(self.record.get(key) or '') for key in ('created', 'robot_serial'))
        robot = f'{self.chain.name} {serial or "(no serial)"}'
        moved = f'; {", ".join(self.outdated)} moved since: measure again' * bool(self.outdated)
        return f'the calibration of {robot}' + f', made {made[:10]}' * bool(made) + moved

    @property
    def outdated(self) -> tuple[str, ...]:
        """Return the frames that moved during the session: they are those of before."""
        return records.outdated(self.record)

    def removed(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the correction at joint values (N, n): distance (N,) [m] and angle (N,) [rad]."""
        before, after = self.before.forward(joints), self.chain.forward(joints)
        turn = se3.log_rotation(before[:, :3, :3] @ np.swapaxes(after[:, :3, :3], 1, 2))
        shift = before[:, :3, 3] - after[:, :3, 3]
        return norms(shift), norms(turn)

    def sigma(
        self,
        joints: FloatArray,
        components: slice = np.s_[:3],
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Return the standard deviation (N,) [m] of predicted positions; NaN if unknown.

        Of orientations [rad] by other `components` of the pose. With a region it is the expected
        error, unmodelled effects included; without the `approach` (N, n), signs of the preceding
        moves, also by fitted play.
        """
        squares = self._variances(joints, components, approach).sum(axis=0)
        return np.asarray(np.sqrt(squares))

    def _variances(
        self, joints: FloatArray, part: slice, approach: FloatArray | None
    ) -> FloatArray:
        """Return the variances (3, N) of a part of poses, as `Unmodelled.variances`."""
        if self.region is not None:
            return self.region.variances(joints, part, approach, self.unmodelled)
        if self.covariance is None:
            return np.full((3, len(joints)), np.nan)
        model = ErrorModel(self.chain, self.names)
        return NOTHING.variances(model, self.covariance, joints, part, approach)

    def remaining(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the expected remaining error (N,) [m] at joint values (N, n), and `sigma` (N,).

        NaN if unknown. The held-out error contains what no parameter explains: that counts once.
        Joints come from either side.
        """
        known, play, beyond = self._variances(joints, np.s_[:3], None)
        left = np.sqrt(known + play + (self.residual or 0.0) ** 2)
        sigma = np.sqrt(known + play + beyond)
        return np.maximum(sigma, left), sigma

    @as_annotated
    def expected(self, joints: FloatArray, model: Model) -> FloatArray:
        """Return the expected error (N,) [m] of a model at joint values (N, n)."""
        left, _ = self.remaining(joints)
        if model == 'nominal':
            return np.hypot(np.nan_to_num(left, nan=self.residual or 0.0), self.removed(joints)[0])
        if np.isnan(left).any():
            raise ConfigError(
                'a chain alone does not predict the error after correction: give the '
                'calibration.yaml of an identification, or use the nominal model'
            )
        return left

    def limit(self, sets: Sequence[Observations] = (), rms_mm: float = np.inf) -> float | None:
        """Return the largest RMS error [m] of new poses at which it still holds, None if unknown.

        ALIKE times its former error; if larger, ALIKE times the error expected at the poses of
        `sets`, but no more than it removes there, or the error `rms_mm` of the nominal arm. Those
        in sockets are no further off: each is measured from its own place, as those held out.
        """
        if self.residual is None:
            return None
        former = ALIKE * self.residual
        few = [each.spread() for each in sets if not each.socket]
        if not few:
            return former
        sizes = [
            (self.sigma(each.joints, approach=each.approach), self.removed(each.joints)[0])
            for each in few
        ]
        both = np.nan_to_num(np.concatenate(sizes, axis=1))
        share = np.concatenate([each.ways for each in few]) / 3.0
        expected, removed = (float(np.sqrt(np.mean(share * each**2))) for each in both)
        return max(former, min(ALIKE * expected, removed, 1e-3 * rms_mm))

    def reused(self, sets: Sequence[Observations]) -> float:
        """Return the share of measurements that this calibration was fitted to, if known."""
        return 0.0 if self.rows is None else self.rows.share(sets)

    def outside(self, sets: Sequence[Observations]) -> float:
        """Return the share of measurements where it may not be used."""
        if self.region is None:
            return 0.0
        joints = np.concatenate([each.joints for each in sets])
        return 1.0 - float(np.mean(self.region.covers(joints)))

    def step(self, sets: Sequence[Observations], of_messages: bool = False) -> Step | None:
        """Return what moved while new measurements were taken, if that explains most errors."""
        chain = reframed(self.chain, self.chain.frame_names, fixed=False)
        arm = tuple(name for name in chain.parameter_names if not chain.owns_frame(name))
        try:
            problem = Problem(chain, sets[0], more=sets[1:], fixed=arm, of_messages=of_messages)
            fitted = fit(problem)
        except InputError:  # too few for frames of their own
            return None
        found = find_step(fitted)
        return found and replace(found, unused='')  # here every measurement counts

    def require_frames(self, sets: Sequence[Observations]) -> None:
        """Refuse measurements by devices or of targets that it does not know."""
        known = self.chain.frame_names
        labels = {name: label for name, (*_, label) in self.owners.items() if label}
        for name in [n for each in sets for n in (each.base, each.tool) if n not in known][:1]:
            told = [f'{n} ({labels[n]})' if n in labels else n for n in known]
            raise InputError(
                f'the calibration knows the frames {", ".join(told)}, not {name}: name devices '
                'and targets as they were named for it, or identify again with these'
            )

    def frames_of(self, owners: Mapping[str, records.Owner]) -> dict[str, str]:
        """Return the calibration's frame for each frame of new measurements.

        That of the same session and device or target; else of the same one in another session;
        else of the same name. If that is taken, the name becomes one that no frame has.
        """
        same = {(name[:4], *owner): name for name, owner in self.owners.items()}
        other = {(side, *what): n for (side, _, *what), n in reversed(same.items()) if what[-1]}
        keys = {name: (name[:4], *owner) for name, owner in owners.items()}
        found = {name: same[key] for name, key in keys.items() if key in same}
        for name in [name for name in owners if name not in found]:
            _, *what = owners[name]
            now = other.get((name[:4], *what), name)
            found[name] = f'{name} ({what[-1]})' if now in found.values() else now
        return found

    def commanded_by(self, model: Model) -> Chain:
        """Return the chain that converts poses to joint values for a model."""
        return self.chain if model == 'corrected' else self.before


def provenance() -> dict[str, str]:
    """Return the time and software version, for the record."""
    now = datetime.now(timezone.utc).isoformat(timespec='seconds')
    return {'created': now, 'software': f'calib_ros {calib_ros.__version__}'}


def about(chain: Chain, before: Chain, region: Region | None) -> dict[str, Any]:
    """Return the identity of the arm and its region, for the record."""
    return {
        'table_sha256': table_hash(chain),
        'nominal': records.nominal_document(before) | frames_document(before),
        'region': None if region is None else region.document(),
    }


def calibration_file(path: str | os.PathLike[str]) -> Path:
    """Return the calibration file at a path or in an identification's folder."""
    file = Path(path)
    return file / 'calibration.yaml' if file.is_dir() else file


@as_annotated
def load_calibration(path: str | os.PathLike[str], nominal: Chain | None = None) -> Calibration:
    """Read a calibration from its file or an identification's folder (`parse_calibration`).

    Raises ConfigError if there is none, above all of a result that was not accepted.
    """
    file = calibration_file(path)
    if not file.exists():
        names = 'report.html', 'result.json'  # without jinja2 no report
        other = next(filter(Path.exists, map(file.with_name, names)), None)
        if other is not None and file.name == 'calibration.yaml':
            raise ConfigError(
                f'the result in {file.parent} was not accepted, so there is no calibration; '
                f'{other} says why and what to do'
            )
        lacks = (
            f'{path} holds no {file.name}' if file != Path(path) else f'no calibration at {path}'
        )
        raise ConfigError(f'{lacks}: give the folder written by identify --out')
    return parse_calibration(chain_text(file), str(file), nominal)


def parse_calibration(
    text: str, where: str, nominal: Chain | None = None, settings: Settings | None = None
) -> Calibration:
    """Parse the text of a calibration; errors name it `where`.

    A correction by the wrong chain moves the arm anywhere, so the record must be present and must
    agree with a given nominal chain. With settings, the parameters may differ from it by at most
    `largest_length` and `largest_angle`; without, the recorded identification has judged that.
    Without a nominal chain the recorded one is used; without recorded frames, those closest to the
    corrected arm. Joints keep the limits of the file and of the nominal chain.

    Raises ConfigError if the text is no chain file, has no record, was not accepted, or was
    identified from another nominal chain.
    """
    chain = parse_chain(text, where)
    if nominal is not None:
        refuse_other_joints(where, chain, 'the nominal chain', nominal)
    record = records.Record.parse(text, where)
    nominal = nominal or record.nominal(chain)
    record.check(chain, nominal, settings)
    content = record.content
    names, covariance, freedom, unmodelled = record.covariance(chain)
    residual = content.get('rms_mm_after')
    return Calibration(
        chain=narrowed(chain, nominal),
        before=narrowed(record.before(nominal, chain), chain),
        names=names,
        covariance=covariance,
        unmodelled=unmodelled,
        freedom=freedom,
        residual=None if residual is None else 1e-3 * residual,
        noise=record.noise(),
        region=region_of_record(content, chain, where),
        world_frame=content.get('world_frame', ''),
        owners=record.owners(),
        record={key: value for key, value in content.items() if key not in ('covariance', 'rows')},
        rows=Fingerprint.of_record(content, where),
    )
