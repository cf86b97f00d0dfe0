# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A change of an arm between nights, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from calib_ros.decision.changes import changes_in_words
from calib_ros.decision.several import Changes, names_of, question
from calib_ros.estimation.levels import SEVERAL
from calib_ros.kinematics.parameter import Parameter
from calib_ros.shown import rounded


@dataclass(frozen=True, eq=False)
class Change:
    """A change of an arm."""

    time: datetime  # of the first night after it
    seen: datetime  # of the night of its detection
    changed: Changes = field(default_factory=list)
    """Of a joint, of two, or of several zeros; empty if others changed."""
    loaded: bool = False  # its night fitted gravity and no earlier one, or the other way round

    def __str__(self) -> str:
        if not self.changed:
            return (
                'several joints changed: was the robot repaired, or are these the measurements of '
                'another robot?'
            )
        lengths = all(name.is_length for name in names_of(self.changed))
        more = ['does it creep', *['is it warmer or colder'] * lengths] * (self.seen > self.time)
        more += ['does it carry another load'] * self.loaded
        asked = question(self.changed, *more)
        if len(self.changed) == 2:
            joints = ' and '.join(reason.owner for reason, *_ in self.changed)
            return f'two joints changed: {joints}: {asked}'
        return f'{changes_in_words(self.changed)}: {asked}'

    @property
    def alone(self) -> dict[tuple[Parameter, float], float]:
        """Return the change [m, rad] of each parameter that may explain it alone, by its sign."""
        reasons = self.changed[0] if len(self.changed) == 1 else ()
        single = ((e.names[0], float(e.change[0])) for e in reasons if len(e.names) == 1)
        return {(name, math.copysign(1.0, change)): change for name, change in single}


def alarms_of(changes: Sequence[Change]) -> Iterator[str]:
    """Yield changes with their dates; SEVERAL of one parameter and sign in a row are creep."""
    runs: list[list[Change]] = [[]]
    for each in changes:
        if not set(each.alone).intersection(*(one.alone for one in runs[-1])):
            runs.append([])
        runs[-1].append(each)
    for run in filter(None, runs):
        shared = set(run[0].alone).intersection(*(each.alone for each in run))
        if not shared or len(run) < SEVERAL:
            yield from (f'{each.time:%Y-%m-%d}: {each}' for each in run)
            continue
        factor, unit = min(shared)[0].small_unit
        size = factor * sum(each.alone[min(shared)] for each in run)
        names = ' or '.join(sorted(name for name, _ in shared))
        yield (
            f'{run[0].time:%Y-%m-%d}: {names} creeps: by {rounded(size, "+")} {unit} in '
            f'{len(run)} changes up to {run[-1].time:%Y-%m-%d}: is it worn or loose?'
        )
