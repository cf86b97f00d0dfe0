# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The outcome of a recalibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib_ros.decision import changes
from calib_ros.decision.changes import Explanation
from calib_ros.decision.comparison import Comparison
from calib_ros.decision.moved import Step
from calib_ros.decision.residuals import ErrorFigures
from calib_ros.estimation.levels import ALIKE, CLEARLY
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.fingerprint import reused_in_words
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import Parameter
from calib_ros.settings import Settings
from calib_ros.shown import Shown, as_html, rounded
from calib_ros.values import SAME

ANEW = 'measure 30 poses or more and identify them without --previous'


@dataclass(frozen=True, eq=False, repr=False)
class Recalibration(Shown):
    """An earlier calibration, updated with new poses.

    `changed` lists the changes, each with those indistinguishable from it; `unexplained` is the
    probability of residuals as large as the remaining ones. `comparison` holds the errors of the
    new poses by the earlier calibration, and predicted from the other poses; both in new frames by
    the others. `known_before` and `known_after` are the RMS uncertainty [m] of positions over the
    joint range, `moved` is their change. `reused` is the share of poses that the earlier
    calibration was fitted to: they would count twice. `fitted_mm` is the RMS error of the new
    poses by the updated one. `odd` names a pose without which the others would be accepted, `step`
    tells what moved while they were measured. `another` robot is likelier than the changes.
    """

    calibration: Calibration
    changed: tuple[tuple[Explanation, ...], ...]
    unexplained: float
    comparison: Comparison
    known_before: float
    known_after: float
    moved: float
    reused: float = 0.0
    fitted_mm: float = 0.0
    odd: str = ''
    step: Step | None = None
    another: bool = False

    @property
    def before(self) -> ErrorFigures:
        """Return the errors of the new poses by the earlier calibration."""
        return self.comparison.figures[0]

    @property
    def after(self) -> ErrorFigures:
        """Return the errors of the new poses predicted from the others."""
        return self.comparison.figures[1]

    @property
    def owners(self) -> set[str]:
        """Return what has changed, of indistinguishable ones the likeliest."""
        return {reasons[0].owner for reasons in self.changed}

    @property
    def accepted(self) -> bool:
        """Tell whether the result may be used."""
        most = max(ALIKE * self.before.rms_mm, 1e3 * SAME)  # simulated without noise
        agrees = self.after.rms_mm <= min(most, 1e3 * Settings.largest_error)
        doubted = self.reused or self.outside or self.another
        return self.explained and agrees and self.determined and not doubted

    @property
    def explained(self) -> bool:
        """Tell whether no more is left of the new poses than by chance."""
        return self.unexplained > changes.FALSE_ALARM

    @property
    def determined(self) -> bool:
        """Tell whether other poses confirm a change or new frames, and the arm is known enough.

        About as well as before, or both poses and arm far better than they changed.
        """
        after, before = self.after.rms_mm, self.before.rms_mm
        usual = CLEARLY * max(1e3 * (self.calibration.residual or np.inf), self.fitted_mm)
        clearly = after < max(usual, before / CLEARLY)
        most = max(ALIKE * self.known_before, clearly * self.moved / CLEARLY)
        return after < (before if self.changed else usual) and self.known_after <= most

    @property
    def outside(self) -> Explanation | None:
        """Return the change of the device's scale or of the load, if either explains most."""
        first = (reasons[0] for reasons in self.changed)
        return next((e for e in first if e.owner in changes.OUTSIDE), None)

    @property
    def out_of_scale(self) -> bool:
        """Tell whether that is the scale of the device."""
        return self.outside is not None and self.outside.owner != changes.LOAD

    @property
    def far(self) -> bool:
        """Tell whether the new poses are further off than any arm."""
        return self.before.rms_mm > 1e3 * Settings.largest_error

    @property
    def perhaps_moved(self) -> bool:
        """Tell whether a single frame moved far away may look like several changes, or like none.

        So far from the earlier arm the linear model of changes does not hold.
        """
        return self.far and not self.reused and (len(self.changed) > 1 or not self.explained)

    def with_moved(
        self, frames: Sequence[str], earlier: Chain, found: Recalibration
    ) -> Recalibration:
        """Return the result, fitted with free `frames`, that names these first as changes.

        `earlier` is the arm before, and `found` has its errors.
        """
        updated = self.calibration
        changed: list[tuple[Explanation, ...]] = []
        for frame in frames:
            own = [k for k, name in enumerate(updated.names) if Parameter(name).owner == frame]
            names = tuple(Parameter(updated.names[k]) for k in own)
            change = np.array([updated.chain.offset(name, earlier) for name in names])
            sigma = np.sqrt(np.diag(np.asarray(updated.covariance))[own])
            changed.append((Explanation(frame, names, np.inf, 0.0, 1.0, change, sigma),))
        changed += self.changed
        record = {**updated.record, 'changed': [*map(changes.reason_in_words, changed)]}
        return replace(
            self,
            calibration=replace(updated, record=record),
            changed=tuple(changed),
            comparison=replace(self.comparison, before=found.comparison.before),
        )

    def _repr_html_(self) -> str:
        before, after = (rounded(each.rms_mm) for each in self.comparison.figures)
        known = (rounded(1e3 * each) for each in (self.known_before, self.known_after))
        rows = (('[mm]', 'before', 'after'), ('RMS', before, after), ('arm known to', *known))
        verdict = 'accepted' if self.accepted else 'not accepted'
        notes = (*map(changes.reason_in_words, self.changed), *filter(None, self.refusal()))
        return as_html(f'{self.calibration.chain.name}: {verdict}', notes, rows)

    def document(self) -> dict[str, Any]:
        """Return the result as plain values, without its figures."""
        return {
            'accepted': self.accepted,
            'refusal': ': '.join(filter(None, self.refusal())),
            'reused': self.reused,
            'changed': [changes.reasons_document(each) for each in self.changed],
            'unexplained': self.unexplained,
            'known_before_mm': 1e3 * self.known_before,
            'known_after_mm': 1e3 * self.known_after,
            'moved_mm': 1e3 * self.moved,
        }

    def refusal(self) -> tuple[str, str]:
        """Return why it must not be used, and what to do; empty if accepted."""
        if self.accepted:
            return '', ''
        if self.reused:
            return reused_in_words(self.reused), 'measure new ones, and give only those'
        if self.odd:
            why = f'{self.odd} contradicts all others: without it they would be accepted'
            return why, 'measure it again, or leave it out'
        if self.another and not self.step and (self.explained or not self.far):
            why = 'another robot of this type fits the new poses better than changes of this one'
            return why, f'check whose they are; if they are of this one, {ANEW}'
        if (cause := self.outside) and self.explained:
            if not self.out_of_scale:
                why = 'the arm bends as under another load than in the earlier calibration'
                return why, f'measure with that load, or, with this one, {ANEW}'
            if cause.owner != changes.OUTSIDE[0]:
                why = f'all lengths of the arm changed alike, by {cause.size_in_words()}'
                return why, f'measure it as warm as it was, or, as warm as now, {ANEW}'
            return (
                f'the scale of the measuring device changed, by {cause.size_in_words()}',
                'check it with a known length, and the temperature and pressure set in it; or the '
                'arm is warmer or colder than it was',
            )
        if self.step:
            why = f'something moved while the new poses were measured: {self.step}'
            return why, 'measure again, or give only the poses from there on'
        if not self.explained:
            step = f'if the device has more noise, state it (--sigma-position); else {ANEW}'
            if self.far:
                step = (
                    'if the device or the target was moved, give --new-base or --new-tool; check '
                    f'units, columns and rows of the measurements; else {ANEW}'
                )
            return 'no change of a few parameters explains the new poses', step
        if not self.determined:
            what = 'what has changed' if self.changed else 'where the new frames are'
            step = 'measure more poses, all over the joint range'
            return f'the new poses do not show well enough {what}', step
        return 'the new poses contradict each other', 'measure more'
