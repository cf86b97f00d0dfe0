# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why a result is refused: a sentence, and the rule behind it."""

from __future__ import annotations

from enum import Enum

Rule = Enum(
    'Rule',
    'LAG MISTAKE CONFIGURATIONS ENCODER MOVED OWN_BEHAVIOUR EXCITATION SCALE COMMON_SENSE '
    'LARGEST_ERROR CONVERGENCE OUTLIERS GAIN DRIFT REGION GAIN_WITH_OUTLIERS ROUNDING '
    'ORIENTATION UNKNOWN_LOSS UNREADABLE DROPPED POSED',
)
"""What a result can fail, in the order in which it is told: causes before consequences."""


class Reason(str):
    """The sentence for a reader, with the failed `rule`; `short` is without its last part."""

    __slots__ = ('rule', 'short')
    rule: Rule
    short: str

    def __new__(cls, rule: Rule, short: str, more: str = '') -> Reason:
        """Return the text with its rule."""
        reason = super().__new__(cls, short + more)
        reason.rule, reason.short = rule, short
        return reason

    @classmethod
    def with_remedy(cls, rule: Rule, text: str) -> Reason:
        """Return the text, whose sentences after the first say what to do."""
        short, *more = text.partition('. ')
        return cls(rule, short, ''.join(more))

    def __getnewargs__(self) -> tuple[Rule, str, str]:  # type: ignore[override]
        return self.rule, self.short, self.removeprefix(self.short)
