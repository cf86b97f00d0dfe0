# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What became of the messages: every one of them is in one of these counts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Account:
    """What became of the messages: how many came, how many samples, what was dropped and why."""

    joint_states: int
    poses: int
    waiting: int
    samples: int
    held_out: int
    configurations: int
    unused: dict[str, int]
    dropped: dict[str, int]
    notes: dict[str, int]
    foreign_names: tuple[str, ...]

    def __str__(self) -> str:
        """Return the account in words."""
        text = f'{self.joint_states} joint states and {self.poses} measurements gave '
        text += f'{self.samples} poses'
        if self.held_out:
            text += f' to fit and {self.held_out} held out'
        if self.configurations < self.samples:
            text += f', {self.configurations} of them different'
        if self.waiting:
            text += f', {self.waiting} measurements wait'
        for label, counts in (
            ('not used', self.unused),
            ('dropped', self.dropped),
            ('note', self.notes),
        ):
            if counts:
                parts = ', '.join(f'{count} x {cause}' for cause, count in counts.items())
                text += f'; {label}: {parts}'
        if self.foreign_names:
            text += (
                f'; joint states name {", ".join(self.foreign_names)}: if these are the joints of '
                'the chain by other names, set joint_names (--joint-names)'
            )
        return text
