# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The joint values at which a calibration may be used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from calib_ros.decision.matrices import damage_error, packed, parse_rows, rows_of, unpacked_matrix
from calib_ros.errors import UnknownNameError
from calib_ros.estimation.joint_errors import NOTHING, Unmodelled
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.limits import beyond
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import Flags, FloatArray
from calib_ros.shown import Shown


@dataclass(frozen=True, eq=False, repr=False)
class Region(Shown):
    """The joint values at which a calibration may be used.

    `chain` is the calibrated arm with considered effects, `square` (P, P) the expected squares of
    the errors of its parameters `names` for the measuring device; another device adds `device` (P,
    K) times its transpose. Predicted positions may be off by `limit` [m], infinite if the whole
    joint range is used, within the limits of `chain`; `share` is the used share of it. It was
    measured between `base` and `tool`. `by_scale`, unknown for a loaded region, is the probability
    that the device is out of scale and makes the arm worse there.
    """

    chain: Chain
    names: tuple[str, ...]
    square: FloatArray
    device: FloatArray
    limit: float
    share: float
    base: str = 'base'
    tool: str = 'tool'
    by_scale: float = 0.0

    def known(self, joints: FloatArray) -> FloatArray:
        """Return the expected error (N,) [m] by the parameters alone, compared with `limit`."""
        return np.asarray(np.sqrt(self.variances(joints)[0]))

    def variances(
        self,
        joints: FloatArray,
        part: slice = np.s_[:3],
        approach: FloatArray | None = None,
        unmodelled: Unmodelled = NOTHING,
    ) -> FloatArray:
        """Return the variances (3, N) of a part of poses, as `Unmodelled.variances`."""
        model = ErrorModel(self.chain, self.names, self.base, self.tool)
        return unmodelled.variances(model, self.square, joints, part, approach)

    def covers(self, joints: FloatArray) -> Flags:
        """Tell (N,) whether the calibration may be used at joint values (N, n)."""
        joints = self.chain.joint_values(joints)
        inside = np.asarray(~beyond(joints, self.chain).any(axis=1))
        return inside if self.whole else inside & (self.known(joints) <= self.limit)

    @property
    def whole(self) -> bool:
        """Tell whether the region is the whole joint range."""
        return bool(np.isinf(self.limit))

    def in_words(self) -> str:
        """Return where the calibration may be used."""
        if self.whole:
            return 'valid over the whole joint range'
        if guessed := [joint.name for joint in self.chain.joints if joint.guessed]:
            return (
                'valid near the measured poses; how far is unknown, because the chain file has no '
                f'limits for {", ".join(guessed)}'
            )
        share = f'{min(100.0 * self.share, 99.0):.0f}' if self.share >= 0.01 else 'under 1'
        return (
            f'valid near the measured poses, in {share} % of the joint range; elsewhere it may '
            'make the arm worse'
        )

    def document(self) -> dict[str, Any]:
        """Return the region as plain values: a Cholesky factor and the rows of the device."""
        return {
            'limit': None if self.whole else self.limit,
            'share': self.share,
            'base': self.base,
            'tool': self.tool,
            'names': list(self.names),
            'root': packed(self.square),
            'device': rows_of(self.device),
        }


def region_of_record(record: Mapping[str, Any], chain: Chain, where: str) -> Region | None:
    """Return the region in the record of a calibration, or None.

    Raises ConfigError if it is not as `Region.document` writes it; `where` names it.
    """
    document = record.get('region')
    if document is None:
        return None
    try:
        names = tuple(str(name) for name in document['names'])
        geometric = {n for n in names if chain.owns_frame(n) or Parameter(n).of_dh}
        chain = chain.with_effects([n for n in names if n not in geometric])
        ends = str(document['base']), str(document['tool'])
        ErrorModel(chain, names)
        for frame in ends:
            if frame not in chain.frame_names:
                raise UnknownNameError('frame', frame, chain.frame_names)
        limit = document['limit']
        region = Region(
            chain,
            names,
            unpacked_matrix(document['root'], len(names)),
            parse_rows(document.get('device', [''] * len(names)), len(names)),
            np.inf if limit is None else float(limit),
            float(document['share']),
            *ends,
        )
    except UnknownNameError as err:
        what = f'{where}: calibration.region: {err.what}'
        raise UnknownNameError(what, err.name, err.alternatives) from err
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as err:
        raise damage_error('region', where, err) from err
    if not (region.limit > 0.0 and 0.0 <= region.share <= 1.0):
        raise damage_error('region', where)
    return region
