# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why a result is refused: a sentence, and the rule behind it."""

from __future__ import annotations

from enum import Enum, auto


class Rule(Enum):
    """What a result can fail; `acceptance.py` says how each is judged."""

    ENCODER = auto()
    MOVED = auto()
    OWN_BEHAVIOUR = auto()
    CONVERGENCE = auto()
    EXCITATION = auto()
    COMMON_SENSE = auto()
    LARGEST_ERROR = auto()
    CONFIGURATIONS = auto()
    OUTLIERS = auto()
    GAIN = auto()
    DRIFT = auto()
    REGION = auto()
    GAIN_WITH_OUTLIERS = auto()
    ROUNDING = auto()
    ORIENTATION = auto()
    SCALE = auto()
    MISTAKE = auto()
    UNKNOWN_LOSS = auto()
    UNREADABLE = auto()
    DROPPED = auto()
    POSED = auto()


class Reason(str):
    """The sentence for a reader; `rule` is what failed."""

    __slots__ = ('rule',)
    rule: Rule

    def __new__(cls, rule: Rule, text: str) -> Reason:
        """Return the text with its rule."""
        reason = super().__new__(cls, text)
        reason.rule = rule
        return reason

    def __getnewargs__(self) -> tuple[Rule, str]:  # type: ignore[override]
        """Return what a copy is made of."""
        return self.rule, str(self)
