# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The account of messages: received, sampled, and lost by cause."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calib_ros.decision.reasons import Reason, Rule
from calib_ros.sampling.slices import JOINTS, POSES

ALLOW = 'accept the rest with largest_loss (--largest-loss)'


class Lost(str):
    """Why messages are lost: their stamp or a full buffer, not what the device did not see."""


class Cause(str):
    """Why messages of a `kind` are not in samples, for a reader; `why` without the kind."""

    kind: str
    why: str

    def __new__(cls, kind: str, why: str) -> Cause:
        """Return the text with its parts."""
        cause = super().__new__(cls, f'{kind}: {why}')
        cause.kind, cause.why = kind, why
        return cause

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        return self.kind, self.why


@dataclass(frozen=True)
class Account:
    """Counts of messages received, samples made, and what was dropped, by cause."""

    joint_states: int
    poses: int
    waiting: int
    samples: int
    held_out: int
    configurations: int
    unused: dict[Cause, int]
    dropped: dict[Cause, int]
    notes: dict[str, int]
    foreign_names: tuple[str, ...]
    never_named: tuple[str, ...]

    def __str__(self) -> str:
        text = f'{self.joint_states} joint states and {self.poses} measurements gave '
        text += f'{self.samples} poses'
        if self.held_out:
            text += f' to fit and {self.held_out} held out'
        if self.configurations < self.samples:
            text += f', {self.configurations} of them different'
        if self.waiting:
            text += f', {self.waiting} measurements waiting'
        if self.foreign_names:  # all else follows from it, and would cut the names
            return (
                f'{text}; joint states never name {", ".join(self.never_named)}, but '
                f'{", ".join(self.foreign_names)}: give the chain of this arm (--chain) or, if '
                'only the names differ, set joint_names (--joint-names)'
            )
        tables: tuple[Mapping[Any, int], ...] = (self.unused, self.dropped, self.notes)
        for label, counts in zip(('not used', 'dropped', 'note'), tables, strict=True):
            if counts:
                parts = ', '.join(f'{count} x {cause}' for cause, count in counts.items())
                text += f'; {label}: {parts}'
        return text


def lost(kind: str, total: int, dropped: Mapping[Cause, int]) -> tuple[float, str]:
    """Return the share of messages of a kind that was lost, and that in words with its cause."""
    causes = {c.why: n for c, n in dropped.items() if c.kind == kind and isinstance(c.why, Lost)}
    share = sum(causes.values()) / total if total else 0.0
    most = max(causes, key=causes.__getitem__, default='')
    what = 'joint states' if kind == JOINTS else kind
    return share, f'{100.0 * share:.0f} % of the {what} were dropped: {most}'


def too_much_lost(account: Account, largest_loss: float) -> list[Reason]:
    """Return why a result must not be accepted: more than `largest_loss` of a kind was lost."""
    found = []
    for kind, count in ((JOINTS, account.joint_states), (POSES, account.poses)):
        share, text = lost(kind, count, account.dropped)
        if share > largest_loss:
            remedy = f'; remove the cause, or {allowing(share)}'
            found.append(Reason(Rule.DROPPED, text, remedy))
    return found


def allowing(share: float) -> str:
    """Return how to accept the loss of a share."""
    return f'{ALLOW} {min(1.0, share + 0.01):.2f}'
